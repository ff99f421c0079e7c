"""Image metrics: PSNR, SSIM and LPIPS, as the field reports them.

Images are `[B, H, W, 3]`, sRGB-coded, 0..1. Every metric returns one value per image; the mean over views comes last.
"""

from __future__ import annotations

import math
import os
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Literal

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from gsopt import check
from gsopt.errors import InputError
from gsopt.raster.ssim import ssim_map

# LPIPS v0.1 feeds the networks (x - SHIFT) / SCALE, x in [-1, 1] (Zhang et al. 2018): ImageNet's mean and deviation.
LPIPS_SHIFT = (-0.030, -0.088, -0.188)
LPIPS_SCALE = (0.458, 0.448, 0.450)
LPIPS_EPS = 1e-10

VGG_VARIABLE = "GSOPT_LPIPS_VGG"
VGG_FILE = "lpips_vgg16.npz"
VGG_NOTE = (
    f"LPIPS (VGG) needs its weights, {VGG_FILE}, which were not found. Set {VGG_VARIABLE} to that file; "
    "gsopt/weights/LICENSES.md says how to make it from the packages torchvision and lpips."
)
MAX_WEIGHT_BYTES = 200 * 2**20
"""Largest unpacked size of a file of weights."""
CC_ROUNDS, CC_CLIPPED = 5, 0.5 / 255
"""Rounds of the color correction, and the margin below which a channel counts as clipped (Mildenhall et al. 2022)."""
CC_RIDGE = 1e-6
"""Weight of no correction, per pixel: decides where the pixels determine none."""
PSNR_CAP = 100.0
"""dB; replaces the infinite PSNR of two equal images, which JSON cannot hold."""


def psnr(rendered: Float[Tensor, "B H W 3"], truth: Float[Tensor, "B H W 3"]) -> Float[Tensor, "B"]:
    """Peak signal-to-noise ratio in dB, 20 log10(1 / sqrt(mse)); infinite where the images are the same."""
    _check_pair(rendered, truth)
    return _decibels(_squared_error(rendered, truth).mean(dim=(1, 2)))


def capped_psnr(
    rendered: Float[Tensor, "B H W 3"], truth: Float[Tensor, "B H W 3"], cap: float = PSNR_CAP
) -> Float[Tensor, "B"]:
    """`psnr`, at most `cap` dB."""
    return psnr(rendered, truth).clamp(max=cap)


def object_psnr(
    rendered: Float[Tensor, "B H W 3"], truth: Float[Tensor, "B H W 3"], alphas: Float[Tensor, "B H W"]
) -> Float[Tensor, "B"]:
    """`capped_psnr` over the object: squared errors are weighted by the alpha (0..1) of the truth, so that an empty
    background neither counts nor helps. NaN where the alpha is 0 everywhere."""
    _check_pair(rendered, truth)
    check.shape("alphas", alphas, tuple(rendered.shape[:3]))
    squared, weights = _squared_error(rendered, truth), alphas.double()
    return _decibels((squared * weights).sum(dim=(1, 2)) / weights.sum(dim=(1, 2))).clamp(max=PSNR_CAP)


def _squared_error(rendered: Float[Tensor, "B H W 3"], truth: Float[Tensor, "B H W 3"]) -> Float[Tensor, "B H W"]:
    """Mean over the channels, float64; planes in turn, which is three times as fast as their mean in memory's order."""
    total = torch.zeros(rendered.shape[:3], dtype=torch.float64, device=rendered.device)
    for a, b in zip(rendered.unbind(3), truth.unbind(3), strict=True):
        total += (a.double() - b.double()).square()
    return total / 3


def _decibels(mse: Float[Tensor, "B"]) -> Float[Tensor, "B"]:
    return 20 * torch.log10(1 / mse.sqrt())


def color_corrected(
    rendered: Float[Tensor, "H W 3"], truth: Float[Tensor, "H W 3"], alphas: Float[Tensor, "H W"] | None = None
) -> Float[Tensor, "H W 3"]:
    """The render after the affine map of RGB, one for the whole image, that brings it nearest to the truth.

    A photo's exposure and white balance are not known before it is taken, so the field also reports PSNR after a fit
    per image, `cc_psnr` (Mildenhall et al. 2022, RawNeRF; Wang et al. 2024, bilateral guided radiance fields). As
    there, least squares over pixels that are clipped in neither image, again after each correction. `alphas` weigh
    the pixels, and what they leave transparent keeps its color."""
    weights = torch.ones_like(truth[..., 0]) if alphas is None else alphas
    colors, truths = (image.double().view(-1, 3).T.contiguous() for image in (rendered, truth))
    sources = torch.cat([colors, torch.ones_like(colors[:1])])
    counted = (_unclipped(colors) & _unclipped(truths) & (weights.flatten() > 0)).nonzero()[:, 0]
    fitted, targets, shares = sources[:, counted], truths[:, counted], weights.flatten()[counted].double()
    ridge = CC_RIDGE * weights.numel() * torch.eye(4, dtype=torch.float64, device=truth.device)
    corrected = fitted[:3]
    for _ in range(CC_ROUNDS):
        weighted = fitted * (shares * _unclipped(corrected))
        warp = torch.linalg.solve(weighted @ fitted.T + ridge, weighted @ targets.T + ridge[:, :3]).T
        corrected = (warp @ fitted).clamp_(0, 1)
    everywhere = (warp @ sources).clamp_(0, 1).T.view(truth.shape)
    return (rendered + weights.double()[..., None] * (everywhere - rendered)).to(truth)


def _unclipped(colors: Float[Tensor, "3 N"]) -> Bool[Tensor, "N"]:
    return ((colors >= CC_CLIPPED) & (colors <= 1 - CC_CLIPPED)).all(dim=0)


def ssim(rendered: Float[Tensor, "B H W 3"], truth: Float[Tensor, "B H W 3"]) -> Float[Tensor, "B"]:
    """Structural similarity (Wang et al. 2004) of gsopt/raster/ssim.py, mean over pixels and channels."""
    _check_pair(rendered, truth)
    return ssim_map(rendered, truth).double().mean(dim=(1, 2, 3))


@dataclass(frozen=True)
class _Layer:
    """One convolution of a feature network, with its pooling before and its comparison after."""

    out_channels: int
    in_channels: int
    kernel: int
    stride: int = 1
    padding: int = 1
    pool: tuple[int, int] | None = None
    """Kernel and stride of the maximum taken before the convolution."""
    tap: bool = False
    """True when its activations are compared."""


# Krizhevsky 2014 ("one weird trick") and Simonyan & Zisserman 2015 (configuration D), convolutions only.
_ALEX = (
    _Layer(64, 3, 11, stride=4, padding=2, tap=True),
    _Layer(192, 64, 5, padding=2, pool=(3, 2), tap=True),
    _Layer(384, 192, 3, pool=(3, 2), tap=True),
    _Layer(256, 384, 3, tap=True),
    _Layer(256, 256, 3, tap=True),
)


def _vgg16() -> Iterator[_Layer]:
    before = 3
    for width, count in ((64, 2), (128, 2), (256, 3), (512, 3), (512, 3)):
        for i in range(count):
            first_of_block = i == 0 and before != 3
            yield _Layer(width, before, 3, pool=(2, 2) if first_of_block else None, tap=i == count - 1)
            before = width


_LAYERS = {"alex": _ALEX, "vgg": tuple(_vgg16())}
_SMALLEST = {"alex": 31, "vgg": 16}
"""Least image side, px, that leaves a pixel at the last layer."""


class Lpips:
    """Learned perceptual image patch similarity, version 0.1 (Zhang et al. 2018). Lower is more alike.

    Images in [0, 1] are mapped to [-1, 1] first (`normalize=True` of the `lpips` package). Activations after each
    tapped ReLU are scaled to unit length over channels, their squared difference is weighted by the learned head,
    averaged over pixels and summed over layers.
    """

    def __init__(self, net: Literal["alex", "vgg"], weights: Path | None = None) -> None:
        """Read the weights: Alex's ship with gsopt, VGG's come from `weights` or `find_vgg_weights()`.

        Raises InputError when there are none or the file is invalid.
        """
        check.one_of("net", net, tuple(_LAYERS))
        path = weights or (_shipped_alex() if net == "alex" else find_vgg_weights())
        if path is None:
            raise InputError(VGG_NOTE)
        self.net = net
        self._layers = _LAYERS[net]
        self._weights = _read_weights(path, _expected_shapes(self._layers))

    def fits(self, height: int, width: int) -> bool:
        """True when images of this size are large enough for the network."""
        return min(height, width) >= _SMALLEST[self.net]

    @torch.no_grad()
    def __call__(self, rendered: Float[Tensor, "B H W 3"], truth: Float[Tensor, "B H W 3"]) -> Float[Tensor, "B"]:
        """Distance per image."""
        _check_pair(rendered, truth)
        if not self.fits(rendered.shape[1], rendered.shape[2]):
            got = f"{rendered.shape[2]}x{rendered.shape[1]}"
            raise InputError(
                f"LPIPS ({self.net}) needs images of {_SMALLEST[self.net]} px or more, got {got}. Enlarge them."
            )
        total = torch.zeros(len(rendered), dtype=torch.float64, device=rendered.device)
        # Both images in one batch; the features are used up as they appear, so only one layer is ever held.
        # The view of [B, H, W, C] as [B, C, H, W] is channels-last in memory, which convolves faster on a CPU.
        both = torch.cat([rendered, truth]).float().permute(0, 3, 1, 2)
        for i, features in enumerate(self._features(both)):
            total += self._compare(features, self._weights[f"lin{i}.weight"].to(features.device))
        return total

    def _features(self, images: Float[Tensor, "B 3 H W"]) -> Iterator[Float[Tensor, "B C h w"]]:
        shift, scale = (torch.tensor(v, device=images.device)[:, None, None] for v in (LPIPS_SHIFT, LPIPS_SCALE))
        x = ((2 * images - 1) - shift) / scale
        for i, layer in enumerate(self._layers):
            if layer.pool is not None:
                x = F.max_pool2d(x, *layer.pool)
            weight, bias = (self._weights[f"conv{i}.{kind}"].to(x.device) for kind in ("weight", "bias"))
            x = F.conv2d(x, weight, bias, layer.stride, layer.padding).relu_()
            if layer.tap:
                yield x

    @staticmethod
    def _compare(features: Float[Tensor, "2*B C h w"], head: Float[Tensor, "C"]) -> Float[Tensor, "B"]:
        unit = features / (features.square().sum(dim=1, keepdim=True).sqrt() + LPIPS_EPS)
        a, b = unit.chunk(2)
        weighted = (a - b).square_() * head[:, None, None]
        return weighted.sum(dim=1).double().mean(dim=(1, 2))


def find_vgg_weights() -> Path | None:
    """`lpips_vgg16.npz` from the environment variable, torch's hub cache or `shared/data/weights` beside the checkout.

    Returns the first that exists, else None. A variable that names no file is an error (InputError), not a
    reason to look elsewhere.
    """
    named = os.environ.get(VGG_VARIABLE)
    if named:
        if not Path(named).is_file():
            raise InputError(f"{VGG_VARIABLE} must name a file, got {named!r}. Correct it or unset it.")
        return Path(named)
    checkout = Path(__file__).resolve().parent.parent
    folders = (Path(torch.hub.get_dir()) / "checkpoints", checkout.parent / "shared" / "data" / "weights")
    return next((folder / VGG_FILE for folder in folders if (folder / VGG_FILE).is_file()), None)


def _shipped_alex() -> Path:
    return Path(str(resources.files("gsopt") / "weights" / "lpips_alexnet.npz"))


def _expected_shapes(layers: tuple[_Layer, ...]) -> dict[str, tuple[int, ...]]:
    shapes: dict[str, tuple[int, ...]] = {}
    for i, layer in enumerate(layers):
        shapes[f"conv{i}.weight"] = (layer.out_channels, layer.in_channels, layer.kernel, layer.kernel)
        shapes[f"conv{i}.bias"] = (layer.out_channels,)
    for i, layer in enumerate(layer for layer in layers if layer.tap):
        shapes[f"lin{i}.weight"] = (layer.out_channels,)
    return shapes


def _read_weights(path: Path, shapes: dict[str, tuple[int, ...]]) -> dict[str, Tensor]:
    """Arrays of an npz as float32, after checking size, names, shapes and finiteness; pickled objects are refused."""
    remedy = "Make it again as gsopt/weights/LICENSES.md says."
    try:
        with zipfile.ZipFile(path) as archive:
            unpacked = sum(member.file_size for member in archive.infolist())
        if unpacked > MAX_WEIGHT_BYTES:
            raise InputError(f"{path} must unpack to at most {MAX_WEIGHT_BYTES} bytes, got {unpacked}. {remedy}")
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in shapes if name in file.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"Cannot read the LPIPS weights {path}: {error}. {remedy}") from error
    for name, shape in shapes.items():
        got = arrays[name].shape if name in arrays else "nothing"
        if got != shape or arrays[name].dtype.kind != "f":
            raise InputError(f"`{name}` in {path} must be floats of shape {shape}, got {got}. {remedy}")
    tensors = {name: torch.from_numpy(array.astype(np.float32)) for name, array in arrays.items()}
    for name, tensor in tensors.items():
        check.finite(name, tensor)
    return tensors


def _check_pair(rendered: Tensor, truth: Tensor) -> None:
    check.shape("rendered", rendered, (None, None, None, 3))
    check.shape("truth", truth, tuple(rendered.shape))
    if math.prod(rendered.shape) == 0:
        raise InputError(f"Images must have pixels, got shape {list(rendered.shape)}. Give at least one pixel.")
