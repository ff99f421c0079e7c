"""Encoding of splat attributes as the pixels, codebooks and palette of .sog, and decoding.

Formulas: developer.playcanvas.com, "The SOG Format", version 2.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gsopt.formats.validation import BYTE_OPACITY_MARGIN, logit, opacity_bytes
from gsopt.gaussians import Gaussians
from gsopt.geometry.quats import normalize

_STEPS = 65535
_LARGEST = 252
"""Alpha of a rotation whose largest component is w; 253 to 255 for x, y, z."""
_ENTRIES = 256
_MAX_LOG_SCALE = 20.0
_MAX_COEFFICIENT = 100.0
"""Harmonics beyond are black or white from every side; larger ones would overflow the distances of the palette."""
_MIN_PALETTE, _MAX_PALETTE = 1 << 10, 1 << 16
_SHARE = 8
"""Splats per entry of the palette: with as many, a file is smaller than a .spz."""
_GROUP = 256
"""Splats per group of the coarse level of the palette's clustering, about."""
_ROUNDS = 10
_HISTOGRAM = 4096
_BLOCK = 1 << 13
Floats = NDArray[np.float32]
Pixels = NDArray[np.uint8]


def encode(gaussians: Gaussians) -> tuple[dict[str, Pixels], dict[str, Any]]:
    """(images by file name, meta.json) of at least one splat."""
    n = len(gaussians)
    width = -(-math.isqrt(n - 1) // 4) * 4 + 4 if n > 1 else 4
    height = -(-n // width)

    def image(columns: NDArray[np.uint8]) -> Pixels:
        pixels = np.zeros((height * width, 4), np.uint8)
        pixels[:, 3] = 255
        pixels[:n, : columns.shape[1]] = columns
        return pixels.reshape(height, width, 4)

    low, high, mins, maxs = _pack_means(gaussians.means.double().numpy())
    scales, scale_codes = codebook(gaussians.log_scales.clamp(-_MAX_LOG_SCALE, _MAX_LOG_SCALE).numpy())
    colors, color_codes = codebook(gaussians.sh0[:, 0].clamp(-_MAX_COEFFICIENT, _MAX_COEFFICIENT).numpy())
    opacities = opacity_bytes(gaussians.opacities).numpy()[:, None]
    images = {
        "means_l.webp": image(low),
        "means_u.webp": image(high),
        "scales.webp": image(scale_codes),
        "quats.webp": image(_pack_quats(normalize(gaussians.quats.double()).numpy())),
        "sh0.webp": image(np.concatenate([color_codes, opacities], axis=1)),
    }
    meta: dict[str, Any] = {"version": 2, "count": n}
    meta["means"] = {"mins": mins, "maxs": maxs, "files": ["means_l.webp", "means_u.webp"]}
    meta["scales"] = {"codebook": scales, "files": ["scales.webp"]}
    meta["quats"] = {"files": ["quats.webp"]}
    meta["sh0"] = {"codebook": colors, "files": ["sh0.webp"]}
    if gaussians.sh_degree:
        palette, labels, meta["shN"] = _pack_bands(
            gaussians.shN.clamp(-_MAX_COEFFICIENT, _MAX_COEFFICIENT).numpy(), gaussians.sh_degree
        )
        images |= {"shN_centroids.webp": palette, "shN_labels.webp": image(labels)}
    return images, meta


def _pack_means(means: NDArray[np.float64]) -> tuple[Pixels, Pixels, list[float], list[float]]:
    bent = np.sign(means) * np.log1p(np.abs(means))
    mins, maxs = bent.min(axis=0), bent.max(axis=0)
    extent = np.where(maxs > mins, maxs - mins, 1)
    values = np.floor((bent - mins) / extent * _STEPS + 0.5).astype(np.uint16)
    return (values & 255).astype(np.uint8), (values >> 8).astype(np.uint8), mins.tolist(), maxs.tolist()


def unpack_means(low: Pixels, high: Pixels, mins: Floats, maxs: Floats) -> Floats:
    """[N, 3] positions."""
    share = (low.astype(np.float64) + 256.0 * high) / _STEPS
    bent = mins + (maxs.astype(np.float64) - mins) * share
    with np.errstate(over="ignore"):  # the caller drops what is not finite
        return (np.sign(bent) * np.expm1(np.abs(bent))).astype(np.float32)


def _pack_quats(wxyz: NDArray[np.float64]) -> Pixels:
    largest = np.abs(wxyz).argmax(axis=1)[:, None]
    wxyz = wxyz * np.where(np.take_along_axis(wxyz, largest, axis=1) < 0, -1, 1)
    others = wxyz[np.arange(4) != largest].reshape(-1, 3)
    parts = np.clip(np.floor((others * math.sqrt(0.5) + 0.5) * 255 + 0.5), 0, 255)
    return np.concatenate([parts, largest + _LARGEST], axis=1).astype(np.uint8)


def _unpack_quats(pixels: Pixels) -> Floats:
    """wxyz; a rotation without a valid mark is the identity, as in other readers."""
    valid = pixels[:, 3] >= _LARGEST
    largest = np.where(valid, pixels[:, 3].astype(np.int64) - _LARGEST, 0)[:, None]
    others = np.where(valid[:, None], (pixels[:, :3] / 255.0 - 0.5) * math.sqrt(2), 0)
    wxyz = np.empty((len(pixels), 4))
    wxyz[np.arange(4) != largest] = others.reshape(-1)
    rest = np.sqrt(np.maximum(0, 1 - np.square(others).sum(axis=1)))
    np.put_along_axis(wxyz, largest, rest[:, None], axis=1)
    return wxyz.astype(np.float32)


def codebook(values: Floats) -> tuple[list[float], Pixels]:
    """(256 ascending values, for each of `values` the number of the nearest).

    Starts where 256 levels are best for the values' density (its cube root, Panter and Dite 1951), then moves each to
    the mean of its values (Lloyd 1982).
    """
    flat = np.sort(values, axis=None).astype(np.float64)
    counts, edges = np.histogram(flat, _HISTOGRAM)
    density = np.concatenate([[0], np.cumsum(np.cbrt(counts))])
    levels = np.interp((np.arange(_ENTRIES) + 0.5) / _ENTRIES * density[-1], density, edges)
    sums = np.concatenate([[0], np.cumsum(flat)])
    for _ in range(_ROUNDS):
        bounds = np.concatenate([[0], np.searchsorted(flat, (levels[1:] + levels[:-1]) / 2), [len(flat)]])
        sizes = np.diff(bounds)
        levels = np.where(sizes > 0, np.diff(sums[bounds]) / np.maximum(sizes, 1), levels)
        levels = np.maximum.accumulate(levels)
    levels = levels.astype(np.float32).astype(np.float64)
    nearest = np.searchsorted((levels[1:] + levels[:-1]) / 2, values)
    return levels.tolist(), nearest.astype(np.uint8)


def _pack_bands(shN: Floats, degree: int) -> tuple[Pixels, Pixels, dict[str, Any]]:
    """(image of the palette, labels [N, 2], the section of meta.json)."""
    n, bands = shN.shape[:2]
    palette, labels = _palette(shN.reshape(n, -1))
    levels, entries = codebook(palette)
    rows = -(-len(palette) // 64)
    image = np.full((rows * 64 * bands, 4), 255, np.uint8)
    image[: len(palette) * bands, :3] = entries.reshape(-1, 3)
    section = {"count": len(palette), "bands": degree, "codebook": levels}
    section |= {"files": ["shN_centroids.webp", "shN_labels.webp"]}
    halves = np.stack([labels & 255, labels >> 8], axis=1).astype(np.uint8)
    return image.reshape(rows, 64 * bands, 4), halves, section


def _palette(rows: Floats) -> tuple[Floats, NDArray[np.int64]]:
    """(centers, the center of each row) by k-means in two levels: groups, then entries inside each group."""
    n = len(rows)
    entries = min(_MAX_PALETTE, max(min(n, _MIN_PALETTE), n // _SHARE))
    groups = _clusters(rows, max(1, min(256, n // _GROUP)))[1]
    centers: list[Floats] = []
    labels = np.empty(n, np.int64)
    begin = 0
    sizes = np.bincount(groups)
    shares = np.maximum(1, sizes * entries // n) * (sizes > 0)
    shares[sizes.argmax()] -= max(0, shares.sum() - entries)  # what small groups were rounded up by
    for group, share in enumerate(shares.tolist()):
        members = np.flatnonzero(groups == group)
        if len(members):
            found, labels[members] = _clusters(rows[members], share)
            labels[members] += begin
            begin += len(found)
            centers.append(found)
    return np.concatenate(centers), labels


def _clusters(rows: Floats, count: int) -> tuple[Floats, NDArray[np.int64]]:
    """Lloyd's k-means from evenly spaced rows; the rows are in Morton order, so that these are spread in space."""
    centers = rows[np.linspace(0, len(rows) - 1, count).astype(np.int64)]
    for _ in range(_ROUNDS):
        labels = _nearest(rows, centers)
        sizes = np.bincount(labels, minlength=count)[:, None]
        sums = np.stack([np.bincount(labels, column, count) for column in rows.T], axis=1)
        centers = np.where(sizes > 0, sums / np.maximum(sizes, 1), centers).astype(np.float32)
    return centers, _nearest(rows, centers)


def _nearest(rows: Floats, centers: Floats) -> NDArray[np.int64]:
    half = 0.5 * np.square(centers).sum(axis=1)
    blocks = (rows[start : start + _BLOCK] for start in range(0, len(rows), _BLOCK))
    return np.concatenate([(block @ centers.T - half).argmax(axis=1) for block in blocks])


def decode(
    *, means: Floats, quats: Pixels, log_scales: Floats, sh0: Floats, opacities: Pixels, shN: Floats
) -> Gaussians:
    """The record of values that were looked up."""
    return Gaussians(
        means=torch.from_numpy(means),
        quats=torch.from_numpy(_unpack_quats(quats)),
        log_scales=torch.from_numpy(log_scales),
        logit_opacities=logit(torch.from_numpy(opacities.astype(np.float32)) / 255, BYTE_OPACITY_MARGIN),
        sh0=torch.from_numpy(sh0)[:, None],
        shN=torch.from_numpy(shN),
    )
