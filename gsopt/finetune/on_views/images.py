"""Training images of Stable Diffusion: input views of posed scenes or plain images, and their variants."""

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
from gsopt.data.image_files import IMAGE_FORMATS
from gsopt.data.images import read_header, read_pixels
from gsopt.data.scene import View, is_posed, load_scene
from gsopt.errors import InputError, UsageError
from gsopt.events import Report
from gsopt.finetune.captions import read_captions
from gsopt.finetune.on_views.training_config import ImagePreparation
from gsopt.sds.conditioning import NEUTRAL_PROMPT
from gsopt.sds.noise import generator
from gsopt.sds.priors.protocol import Images

SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff")
MAX_VARIANTS = 4096
"""Limit on the variants of all images, each kept as latents, 150 kB at 768 px."""
LUMA = (0.299, 0.587, 0.114)
ORIENTATION = 274
"""EXIF tag of the camera's orientation."""
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
class TrainingImage:
    """One image, read on demand."""

    name: str
    text: str
    """Its prompt."""
    side: int
    """The shorter one, px."""
    pixels: Callable[[], UInt8[Tensor, "H W C"]]


@dataclass(frozen=True)
class ViewSelection:
    """Input views of a posed scene, as in `gsopt train`: the other views evaluate a run."""

    views: int | None = None
    view_ids: tuple[int, ...] | None = None
    eval: bool = False


def find_images(roots: Sequence[Path], chosen: ViewSelection, prompt: str, report: Report) -> list[TrainingImage]:
    """Returns input views of posed scenes, images of folders, and images. Raises InputError when there is none.

    `prompt` describes all of them; when it is empty, the scene's caption or a neutral prompt does.
    """
    if not roots:
        raise UsageError("No images were given to train on. Give a posed scene, a folder of images, or images.")
    found: list[TrainingImage] = []
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
    names = [image.name for image in found]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise UsageError(f"Two images are called {twice}. Rename a folder, or name each only once.")
    return found


def _views(root: Path, chosen: ViewSelection, prompt: str, report: Report) -> list[TrainingImage]:
    scene = load_scene(DataConfig(str(root), chosen.views, chosen.view_ids, eval=chosen.eval))
    for warning in scene.warnings:
        report(warning)
    text = prompt or next(iter(read_captions(root)), NEUTRAL_PROMPT)

    def image(view: View) -> TrainingImage:
        return TrainingImage(f"{root.name}/{view.name}", text, min(view.camera.width, view.camera.height), view.pixels)

    return [image(view) for view in scene.train]


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


def _plain(path: Path, prompt: str) -> TrainingImage:
    width, height, _ = read_header(path)
    return TrainingImage(
        f"{path.parent.name}/{path.name}", prompt or NEUTRAL_PROMPT, min(width, height), lambda: read_upright(path)
    )


def read_upright(path: Path) -> UInt8[Tensor, "H W C"]:
    """Reads a plain image in its EXIF orientation; it has no pose that refers to the stored rows, as views have."""
    pixels = read_pixels(path)
    try:
        with Image.open(path, formats=IMAGE_FORMATS) as image:
            turn = UPRIGHT.get(image.getexif().get(ORIENTATION, 1))
    except Exception:  # a broken tag is ignored
        turn = None
    return pixels if turn is None else torch.from_numpy(np.array(Image.fromarray(pixels.numpy()).transpose(turn)))


def prepared(
    pixels: UInt8[Tensor, "H W C"], size: int, preparation: ImagePreparation, variant: int, random: torch.Generator
) -> Images:
    """Returns one variant: stretched, jittered, on white, cropped, mirrored; variant 0 is the plain center square."""
    planes = pixels.permute(2, 0, 1).float() / 255
    rgb, alpha = planes[:3], planes[3:] if len(planes) == 4 else torch.ones_like(planes[:1])
    if preparation.stretch:
        rgb = stretched(rgb, alpha, preparation.stretch)
    if variant and preparation.jitter:
        rgb = jittered(rgb, preparation.jitter, random)
    square = _cut(rgb * alpha + (1 - alpha), preparation.crop if variant else 0.0, random)
    square = torch.nn.functional.interpolate(square[None], (size, size), mode="bilinear", antialias=True).clamp(0, 1)
    return square.flip(3) if preparation.flip and variant % 2 else square


def stretched(rgb: Float[Tensor, "3 H W"], alpha: Float[Tensor, "1 H W"], percent: float) -> Float[Tensor, "3 H W"]:
    """Stretches contrast so that `percent` of the visible values are clipped at either end. One curve for all channels
    keeps hues; a constant image is unchanged."""
    visible = rgb[:, alpha[0] > 0.5].numpy()
    if visible.size == 0:
        return rgb
    low, high = np.percentile(visible, [percent, 100 - percent])
    return rgb if high - low < 1 / 255 else ((rgb - float(low)) / float(high - low)).clamp(0, 1)


def jittered(rgb: Float[Tensor, "3 H W"], share: float, random: torch.Generator) -> Float[Tensor, "3 H W"]:
    """Scales brightness, contrast and saturation by 1 ± share each."""
    brightness, contrastive_loss, saturation = (1 + share * (2 * torch.rand(3, generator=random) - 1)).tolist()
    rgb = rgb * brightness
    rgb = (rgb - rgb.mean()) * contrastive_loss + rgb.mean()
    gray = (rgb * torch.tensor(LUMA)[:, None, None]).sum(0)
    return ((rgb - gray) * saturation + gray).clamp(0, 1)


def _cut(planes: Float[Tensor, "3 H W"], crop: float, random: torch.Generator) -> Float[Tensor, "3 s s"]:
    """Returns the center square, or a random square smaller by up to `crop`."""
    height, width = planes.shape[1:]
    side, at = min(height, width), torch.tensor([0.5, 0.5])
    if crop:
        side = max(1, round(side * (1 - crop * float(torch.rand(1, generator=random)))))
        at = torch.rand(2, generator=random)
    top, left = int((height - side) * at[0] + 0.5), int((width - side) * at[1] + 0.5)
    return planes[:, top : top + side, left : left + side]


def variants(
    images: Sequence[TrainingImage], row: int, size: int, preparation: ImagePreparation, seed: int
) -> list[Images]:
    """Returns all variants of one image; each depends on its number only."""
    pixels = images[row].pixels()
    return [
        prepared(pixels, size, preparation, v, generator(seed, row, v, "variant")) for v in range(preparation.count)
    ]
