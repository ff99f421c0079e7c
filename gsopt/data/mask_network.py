"""Soft masks of the salient object by a network in an ONNX file: U2-Net (Qin et al. 2020) and its relatives.

Nothing is fetched: the file is one that the user names, or one that the package rembg has put into its folder.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, UInt8
from PIL import Image

from gsopt._optional import require
from gsopt.data import files
from gsopt.errors import InputError, MissingDependency

MODEL_VARIABLE = "GSOPT_MASK_MODEL"
KNOWN_MODELS = ("u2net.onnx", "isnet-general-use.onnx", "u2netp.onnx")
"""Files that rembg keeps, best first."""
MAX_MODEL_BYTES = 1 << 30
MAX_SIDE = 2048
"""Largest input that a network may declare, px."""
IMAGENET = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Mean and deviation of U2-Net's input; networks with a larger one (IS-Net, 1024 px) take mean 0.5, deviation 1."""
PLAIN = (0.5, 0.5, 0.5), (1.0, 1.0, 1.0)
IMAGENET_UP_TO = 512
NOTHING = 0.1
"""Highest probability in a photo that shows no object: below it nothing is stretched to full white."""


@dataclass(frozen=True)
class MaskNetwork:
    """An opened network."""

    path: Path
    session: Any
    side: int
    """Width and height of its input, px."""

    @staticmethod
    def open(path: Path) -> MaskNetwork:
        """Open a model. Raises MissingDependency without onnxruntime, InputError for a file that is no such network."""
        onnxruntime = require("onnxruntime", "masks", "Cutting out an object")
        if not files.is_regular(path) or path.stat().st_size > MAX_MODEL_BYTES:
            raise InputError(f"The mask model {path} is no file of at most 1 GB. {_REMEDY}")
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1  # other numbers of threads give other bits
        options.log_severity_level = 4
        try:
            session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # its parser raises its own kinds of errors
            raise InputError(f"The mask model {path} cannot be opened: {_first_line(error)}. {_REMEDY}") from error
        inputs = session.get_inputs()
        shape = inputs[0].shape if len(inputs) == 1 else []
        sides = [side if isinstance(side, int) else 320 for side in shape[2:]]  # a free size is named, not numbered
        if len(shape) != 4 or shape[1] != 3 or sides[0] != sides[1] or not 32 <= sides[0] <= MAX_SIDE:
            raise InputError(f"The mask model {path} takes {shape}; one square RGB image is needed. {_REMEDY}")
        return MaskNetwork(path, session, sides[0])

    def probabilities(self, pixels: UInt8[np.ndarray, "H W 3"]) -> Float32[np.ndarray, "H W"]:
        """Probability of the object at every pixel, stretched to 0..1 as the network's authors do."""
        image = Image.fromarray(pixels)
        small = np.asarray(image.resize((self.side, self.side), Image.Resampling.LANCZOS), dtype=np.float32)
        mean, deviation = (np.array(v, np.float32) for v in (IMAGENET if self.side <= IMAGENET_UP_TO else PLAIN))
        scaled = (small / max(float(small.max()), 1.0) - mean) / deviation
        name = self.session.get_inputs()[0].name
        try:
            found = np.asarray(self.session.run(None, {name: scaled.transpose(2, 0, 1)[None]})[0], dtype=np.float32)
            height, width = found.shape[-2:]
            found = found.reshape(height, width)
            low, high = float(found.min()), float(found.max())
        except Exception as error:
            raise InputError(f"The mask model {self.path} gives no mask: {_first_line(error)}. {_REMEDY}") from error
        if not NOTHING < high < np.inf or not low > -np.inf:
            return np.zeros(pixels.shape[:2], np.float32)
        stretched = Image.fromarray((found - low) / max(high - low, 1e-6))
        return np.asarray(stretched.resize(image.size, Image.Resampling.BILINEAR)).clip(0, 1)


def find_model(named: str | None = None) -> Path:
    """The model file: `named`, $GSOPT_MASK_MODEL, or what rembg has. MissingDependency without any."""
    if given := named or os.environ.get(MODEL_VARIABLE):
        return Path(given).expanduser()
    folder = Path(os.environ.get("U2NET_HOME", "~/.u2net")).expanduser()
    for name in KNOWN_MODELS:
        if files.is_regular(folder / name):
            return folder / name
    raise MissingDependency(
        f"Cutting out an object needs a mask model, and none was found: give `--model FILE` (`--mask-model FILE` "
        f"in a run; a run needs none with `--masks none`), set {MODEL_VARIABLE}, or "
        f"put u2net.onnx into {folder} (pip install rembg; rembg d u2net). gsopt downloads nothing by itself."
    )


def _first_line(error: Exception) -> str:
    return (str(error) or type(error).__name__).splitlines()[0][:200]


_REMEDY = "Give an ONNX file of U2-Net or IS-Net, as rembg keeps them."
