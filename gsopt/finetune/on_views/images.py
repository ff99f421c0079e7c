"""The images Stable Diffusion is trained on: input views of posed scenes, or plain images; and their variants."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image
from torch import Tensor

from gsopt.config.train import DataConfig
from gsopt.data.files import is_regular
from gsopt.data.images import IMAGE_FORMATS, read_header, read_pixels
from gsopt.data.scene import View, is_posed, load_scene
from gsopt.errors import InputError, UsageError
from gsopt.events import Report
from gsopt.finetune.captions import said_of
from gsopt.finetune.on_views.training_config import Preparation
from gsopt.sds.conditioning import NEUTRAL
from gsopt.sds.noise import generator
from gsopt.sds.priors.protocol import Images

SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff")
MOST = 4096
"""Variants of images: each is kept as latents, 150 kB at 768 px."""
LUMA = (0.299, 0.587, 0.114)
ORIENTATION = 274
"""EXIF tag of how a camera was held."""
UPRIGHT = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}


@dataclass(frozen=True)
class Picture:
    """One image, read when it is needed."""

    name: str
    text: str
    """What is said of it."""
    side: int
    """The shorter one, px."""
    pixels: Callable[[], UInt8[Tensor, "H W C"]]


@dataclass(frozen=True)
class Chosen:
    """Which views of a posed scene: as `gsopt train` chooses them, for the others are what a run is judged by."""

    views: int | None = None
    view_ids: tuple[int, ...] | None = None
    eval: bool = False


def find_pictures(roots: Sequence[Path], chosen: Chosen, prompt: str, report: Report) -> list[Picture]:
    """Input views of posed scenes, images of folders, and images. InputError where there is none.

    `prompt` is said of all; where it is empty, the scene's caption, or what fits any object.
    """
    if not roots:
        raise UsageError("No images were given to learn from. Give a posed scene, a folder of images, or images.")
    found: list[Picture] = []
    for root in roots:
        if root.is_dir() and is_posed(root):
            found += _views(root, chosen, prompt, report)
        elif (chosen.views, chosen.view_ids, chosen.eval) != (None, None, False):
            raise UsageError(
                f"`--views`, `--view-ids` and `--eval` choose among the views of a posed scene, which {root} is not. "
                "Drop them, or give the scene."
            )
        else:
            found += [_plain(path, prompt) for path in _files(root)]
    names = [picture.name for picture in found]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise UsageError(f"Two images are called {twice}. Rename a folder, or name each only once.")
    return found


def _views(root: Path, chosen: Chosen, prompt: str, report: Report) -> list[Picture]:
    scene = load_scene(DataConfig(str(root), chosen.views, chosen.view_ids, eval=chosen.eval))
    for warning in scene.warnings:
        report(warning)
    text = prompt or next(iter(said_of(root)), NEUTRAL)

    def picture(view: View) -> Picture:
        return Picture(f"{root.name}/{view.name}", text, min(view.camera.width, view.camera.height), view.pixels)

    return [picture(view) for view in scene.train]


def _files(root: Path) -> list[Path]:
    if is_regular(root):
        return [root]
    if not root.is_dir():
        raise InputError(f"{root} does not exist. Give a posed scene, a folder of images, or an image.")
    found = [p for p in sorted(root.iterdir()) if p.suffix.lower() in SUFFIXES and p.name[0] != "." and is_regular(p)]
    if not found:
        raise InputError(
            f"{root} holds no images and is no posed scene. Looked for {', '.join(SUFFIXES)} directly in it, for "
            "transforms.json and for a COLMAP model. Give another folder."
        )
    return found


def _plain(path: Path, prompt: str) -> Picture:
    width, height, _ = read_header(path)
    return Picture(f"{path.parent.name}/{path.name}", prompt or NEUTRAL, min(width, height), lambda: read_upright(path))


def read_upright(path: Path) -> UInt8[Tensor, "H W C"]:
    """A plain image, turned as its EXIF tag says: unlike views it has no pose that refers to the stored rows."""
    pixels = read_pixels(path)
    try:
        with Image.open(path, formats=IMAGE_FORMATS) as image:
            turn = UPRIGHT.get(image.getexif().get(ORIENTATION, 1))
    except Exception:  # a broken tag tells nothing
        turn = None
    return pixels if turn is None else torch.from_numpy(np.array(Image.fromarray(pixels.numpy()).transpose(turn)))


def prepared(
    pixels: UInt8[Tensor, "H W C"], size: int, how: Preparation, variant: int, random: torch.Generator
) -> Images:
    """One variant, the plain middle square for 0: stretched, jittered, put on white, cut out, mirrored."""
    planes = pixels.permute(2, 0, 1).float() / 255
    rgb, alpha = planes[:3], planes[3:] if len(planes) == 4 else torch.ones_like(planes[:1])
    if how.stretch:
        rgb = stretched(rgb, alpha, how.stretch)
    if variant and how.jitter:
        rgb = jittered(rgb, how.jitter, random)
    square = _cut(rgb * alpha + (1 - alpha), how.crop if variant else 0.0, random)
    square = torch.nn.functional.interpolate(square[None], (size, size), mode="bilinear", antialias=True).clamp(0, 1)
    return square.flip(3) if how.flip and variant % 2 else square


def stretched(rgb: Float[Tensor, "3 H W"], alpha: Float[Tensor, "1 H W"], percent: float) -> Float[Tensor, "3 H W"]:
    """Contrast such that `percent` of the visible values are clipped at either end. One curve for all channels keeps
    hues; an image of one value is left as it is."""
    visible = rgb[:, alpha[0] > 0.5].numpy()
    if visible.size == 0:
        return rgb
    low, high = np.percentile(visible, [percent, 100 - percent])
    return rgb if high - low < 1 / 255 else ((rgb - float(low)) / float(high - low)).clamp(0, 1)


def jittered(rgb: Float[Tensor, "3 H W"], share: float, random: torch.Generator) -> Float[Tensor, "3 H W"]:
    """Brightness, contrast and saturation times 1 ± share, each."""
    brightness, contrast, saturation = (1 + share * (2 * torch.rand(3, generator=random) - 1)).tolist()
    rgb = rgb * brightness
    rgb = (rgb - rgb.mean()) * contrast + rgb.mean()
    grey = (rgb * torch.tensor(LUMA)[:, None, None]).sum(0)
    return ((rgb - grey) * saturation + grey).clamp(0, 1)


def _cut(planes: Float[Tensor, "3 H W"], crop: float, random: torch.Generator) -> Float[Tensor, "3 s s"]:
    """A square: the middle one, or one up to `crop` smaller anywhere."""
    height, width = planes.shape[1:]
    side, at = min(height, width), torch.tensor([0.5, 0.5])
    if crop:
        side = max(1, round(side * (1 - crop * float(torch.rand(1, generator=random)))))
        at = torch.rand(2, generator=random)
    top, left = int((height - side) * at[0] + 0.5), int((width - side) * at[1] + 0.5)
    return planes[:, top : top + side, left : left + side]


def variants(pictures: Sequence[Picture], row: int, size: int, how: Preparation, seed: int) -> list[Images]:
    """All variants of one picture; each depends on nothing but its number."""
    pixels = pictures[row].pixels()
    return [prepared(pixels, size, how, v, generator(seed, row, v, "variant")) for v in range(how.count)]
