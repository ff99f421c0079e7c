"""PSNR, SSIM and LPIPS: laws they obey, and values published or computed by others."""

from __future__ import annotations

import math
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from gsopt import metrics
from gsopt.errors import InputError, UsageError
from gsopt.metrics import PSNR_CAP, Lpips, capped_psnr, color_corrected, object_psnr, psnr, ssim

LPIPS_TOLERANCE = 5e-5
"""Weights rounded to float16 move the distance by at most 3e-5 (measured against float32)."""


def waves(height: int, width: int, phase: float) -> Tensor:
    """A smooth color image [1, H, W, 3] that anybody can make again."""
    row = torch.arange(height, dtype=torch.float64)[:, None] / height
    col = torch.arange(width, dtype=torch.float64)[None] / width
    planes = [
        0.5 + 0.5 * torch.sin(6 * col + 9 * row + phase + 2 * c) * torch.cos(14 * col * row + c + phase)
        for c in range(3)
    ]
    return torch.stack(planes, dim=-1).float()[None]


def noise(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed))


@pytest.fixture(scope="module")
def alex() -> Lpips:
    return Lpips("alex")


@pytest.fixture(scope="module")
def vgg() -> Lpips:
    if metrics.find_vgg_weights() is None:
        pytest.skip("no lpips_vgg16.npz on this machine")
    return Lpips("vgg")


def test_psnr_of_a_constant_difference_is_its_logarithm() -> None:
    truth = torch.full((2, 4, 5, 3), 0.25)
    offsets = torch.tensor([0.5, 0.125])
    values = psnr(truth + offsets[:, None, None, None], truth)
    assert values.tolist() == pytest.approx([20 * math.log10(2), 20 * math.log10(8)])


def test_psnr_of_equal_images_is_infinite() -> None:
    assert torch.isinf(psnr(waves(8, 9, 0), waves(8, 9, 0))).all()
    assert bool((capped_psnr(waves(8, 9, 0), waves(8, 9, 0)) == PSNR_CAP).all())


def test_ssim_agrees_with_its_definition_written_out() -> None:
    """Every window by hand in float64, zeros outside the image, no separable shortcut."""
    x, y = noise(1, 9, 13, 3), noise(1, 9, 13, 3, seed=1)
    offsets = np.arange(11) - 5.0
    window = np.exp(-(offsets[:, None] ** 2 + offsets[None] ** 2) / (2 * 1.5**2))
    window /= window.sum()
    a, b = (np.pad(image[0].double().numpy(), ((5, 5), (5, 5), (0, 0))) for image in (x, y))
    total = []
    for i in range(9):
        for j in range(13):
            for c in range(3):
                p, q = a[i : i + 11, j : j + 11, c], b[i : i + 11, j : j + 11, c]
                mu_p, mu_q = (window * p).sum(), (window * q).sum()
                var_p, var_q = (window * p * p).sum() - mu_p**2, (window * q * q).sum() - mu_q**2
                cov = (window * p * q).sum() - mu_p * mu_q
                top = (2 * mu_p * mu_q + 1e-4) * (2 * cov + 9e-4)
                total.append(top / ((mu_p**2 + mu_q**2 + 1e-4) * (var_p + var_q + 9e-4)))
    assert ssim(x, y).item() == pytest.approx(np.mean(total), abs=1e-5)


@pytest.mark.parametrize("metric", ["psnr", "ssim", "alex"])
def test_a_batch_gives_what_each_image_gives_alone(metric: str, alex: Lpips) -> None:
    function = {"psnr": psnr, "ssim": ssim, "alex": alex}[metric]
    x, y = noise(3, 40, 44, 3), noise(3, 40, 44, 3, seed=1)
    alone = torch.cat([function(x[i : i + 1], y[i : i + 1]) for i in range(3)])
    torch.testing.assert_close(function(x, y), alone, atol=1e-6, rtol=0)


def test_lpips_of_an_image_with_itself_is_zero_and_the_order_does_not_matter(alex: Lpips) -> None:
    x, y = waves(40, 50, 0), waves(40, 50, 0.4)
    assert alex(x, x).item() == 0
    assert alex(x, y).item() == pytest.approx(alex(y, x).item(), abs=1e-7)
    assert alex(x, y).item() > 0.01


def test_lpips_grows_with_the_blur_that_psnr_hardly_sees(alex: Lpips) -> None:
    truth = waves(64, 64, 0)
    half, full = (truth.lerp(truth.roll(4, dims=2), weight) for weight in (0.25, 0.5))
    assert alex(truth, half).item() < alex(truth, full).item()


# Printed by the package `lpips` 0.1.4 (net=..., version="0.1", normalize=True) on `waves`, float32 weights.
@pytest.mark.parametrize(
    ("size", "phase", "flip", "expected"),
    [
        ((64, 72), 0.7, False, {"alex": 0.125374, "vgg": 0.453369}),
        ((64, 72), 0.1, False, {"alex": 0.005974, "vgg": 0.025277}),
        ((97, 131), 0.1, True, {"alex": 0.391416, "vgg": 0.700563}),
    ],
)
@pytest.mark.parametrize("net", ["alex", "vgg"])
def test_lpips_is_what_the_published_package_gives(
    net: str,
    size: tuple[int, int],
    phase: float,
    flip: bool,
    expected: dict[str, float],
    request: pytest.FixtureRequest,
) -> None:
    other = waves(*size, phase)
    distance = request.getfixturevalue(net)(waves(*size, 0), other.flip(1) if flip else other)
    assert distance.item() == pytest.approx(expected[net], abs=LPIPS_TOLERANCE)


def test_lpips_vgg_repeats_values_published_by_a_third_party(vgg: Lpips) -> None:
    """numpy seed 123, uniform [10, 3, 100, 100] twice, torchmetrics and lpips with normalize=True; four digits printed.

    Found in public notes on the two packages; unlike the test above it also checks the weights of the convolutions.
    """
    published = [0.3497, 0.3494, 0.3473, 0.3558, 0.3437, 0.3366, 0.3716, 0.3516, 0.3472, 0.3413]
    state = np.random.RandomState(123)
    first, second = (torch.from_numpy(state.rand(10, 3, 100, 100)).float().permute(0, 2, 3, 1) for _ in range(2))
    assert vgg(first[:4], second[:4]).tolist() == pytest.approx(published[:4], abs=1e-4)


def test_images_too_small_for_the_network_are_refused_and_the_smallest_fits(alex: Lpips) -> None:
    with pytest.raises(InputError, match="31 px or more, got 40x30"):
        alex(noise(1, 30, 40, 3), noise(1, 30, 40, 3))
    assert math.isfinite(alex(noise(1, 31, 31, 3), noise(1, 31, 31, 3, seed=1)).item())


def test_mismatched_or_empty_images_are_refused() -> None:
    with pytest.raises(InputError, match="truth"):
        psnr(noise(1, 4, 4, 3), noise(1, 4, 5, 3))
    with pytest.raises(InputError, match="pixels"):
        ssim(noise(1, 0, 4, 3), noise(1, 0, 4, 3))


def test_an_unknown_network_is_a_usage_error() -> None:
    with pytest.raises(UsageError, match="alex, vgg"):
        Lpips("squeeze")  # type: ignore[arg-type]


def _alex_arrays() -> dict[str, np.ndarray]:
    with np.load(metrics._shipped_alex()) as file:
        return {name: file[name] for name in file.files}


def test_weights_that_are_not_weights_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "w.npz"
    path.write_bytes(b"PK\x03\x04 not a zip")
    with pytest.raises(InputError, match="Cannot read"):
        Lpips("alex", path)
    arrays = _alex_arrays()
    np.savez(path, **{name: array for name, array in arrays.items() if name != "lin3.weight"})
    with pytest.raises(InputError, match=r"lin3\.weight"):
        Lpips("alex", path)
    np.savez(path, **{**arrays, "conv1.bias": arrays["conv1.bias"][:-1]})
    with pytest.raises(InputError, match=r"conv1\.bias"):
        Lpips("alex", path)
    np.savez(path, **{**arrays, "conv1.bias": np.full_like(arrays["conv1.bias"], np.nan)})
    with pytest.raises(InputError, match="finite"):
        Lpips("alex", path)


def test_pickled_weights_are_never_unpickled(tmp_path: Path) -> None:
    path = tmp_path / "w.npz"
    np.savez(path, **{**_alex_arrays(), "conv0.bias": np.array([object()] * 64)})
    with pytest.raises(InputError, match="Cannot read"):
        Lpips("alex", path)


def test_weights_that_unpack_without_end_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metrics, "MAX_WEIGHT_BYTES", 1000)
    path = tmp_path / "w.npz"
    np.savez_compressed(path, **{"conv0.weight": np.zeros(10_000)})
    with pytest.raises(InputError, match="at most 1000 bytes"):
        Lpips("alex", path)


def test_the_variable_decides_where_vgg_is_looked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(metrics.VGG_VARIABLE, str(tmp_path / "absent.npz"))
    with pytest.raises(InputError, match=metrics.VGG_VARIABLE):
        metrics.find_vgg_weights()
    present = tmp_path / "mine.npz"
    present.write_bytes(b"")
    monkeypatch.setenv(metrics.VGG_VARIABLE, str(present))
    assert metrics.find_vgg_weights() == present


def test_object_psnr_counts_pixels_by_their_alpha() -> None:
    """Errors outside the mask do not count, and a larger empty background changes nothing."""
    generator = torch.Generator().manual_seed(4)
    truth, rendered = (torch.rand(2, 12, 12, 3, generator=generator) for _ in range(2))
    alphas = torch.zeros(2, 12, 12)
    alphas[:, 3:9, 2:8] = 1
    inside = object_psnr(rendered, truth, alphas)
    torch.testing.assert_close(inside, psnr(rendered[:, 3:9, 2:8], truth[:, 3:9, 2:8]))
    noisy = torch.where(alphas[..., None] > 0, rendered, 1 - rendered)
    assert torch.equal(object_psnr(noisy, truth, alphas), inside)
    halved = object_psnr(rendered, truth, alphas / 2)
    torch.testing.assert_close(halved, inside)


def test_color_correction_undoes_an_affine_change_of_color() -> None:
    """Exposure, white balance and mixed channels; pixels that the change clips are left out of the fit."""
    truth = waves(24, 30, 0.3)[0]
    mixed = torch.tensor([[0.7, 0.05, 0.0], [0.02, 0.8, 0.03], [0.0, 0.1, 0.6]])
    changed = truth @ mixed + torch.tensor([0.02, 0.05, 0.1])
    torch.testing.assert_close(color_corrected(changed, truth), truth, atol=1e-3, rtol=0)
    brighter = (1.3 * truth).clamp(max=1)
    kept = brighter.amax(dim=2) < 1
    torch.testing.assert_close(color_corrected(brighter, truth)[kept], truth[kept], atol=2e-3, rtol=0)


def test_color_correction_changes_no_color_where_nothing_determines_it() -> None:
    """Images that are clipped everywhere, and masks that are empty."""
    white, other = torch.ones(6, 6, 3), waves(6, 6, 0.1)[0]
    assert torch.equal(color_corrected(white, other), white)
    torch.testing.assert_close(color_corrected(other, white[..., :3] * 0.5, torch.zeros(6, 6)), other)


def test_color_correction_is_fitted_inside_the_mask() -> None:
    truth = waves(16, 16, 0.2)[0]
    changed = 0.8 * truth + 0.1
    changed[:, 8:] = noise(16, 8, 3)
    alphas = torch.zeros(16, 16)
    alphas[:, :8] = 1
    corrected = color_corrected(changed, truth, alphas)
    torch.testing.assert_close(corrected[:, :8], truth[:, :8], atol=1e-3, rtol=0)
    assert torch.equal(corrected[:, 8:], changed[:, 8:]), "a background has no exposure"


def test_two_equal_images_count_as_a_hundred_decibels() -> None:
    image, alphas = noise(1, 4, 4, 3), torch.full((1, 4, 4), 0.5)
    assert capped_psnr(image, image).tolist() == [100]
    assert object_psnr(image, image, alphas).tolist() == [100]
    assert bool(object_psnr(image, 1 - image, 0 * alphas).isnan().all())


def test_a_pixel_is_clipped_where_any_channel_is_black_or_white() -> None:
    levels = torch.tensor([[0.0, 9, 9], [1, 9, 9], [9, 0, 9], [9, 9, 254], [9, 9, 255], [255, 255, 255]]) / 255
    assert metrics._unclipped(levels.T.double()).tolist() == [False, True, False, True, False, False]


@pytest.mark.parametrize("net", ["alex", "vgg"])
def test_the_smallest_image_leaves_one_pixel_at_the_last_layer(net: str) -> None:
    """A window of k px at steps of s px fits (n - k) // s + 1 times into n px."""

    def left(side: int) -> int:
        for layer in metrics._LAYERS[net]:
            if layer.pool is not None:
                side = (side - layer.pool[0]) // layer.pool[1] + 1
            side = (side + 2 * layer.padding - layer.kernel) // layer.stride + 1
        return side

    assert left(metrics._SMALLEST[net]) == 1
    assert left(metrics._SMALLEST[net] - 1) == 0


def test_vgg_is_configuration_d_compared_after_each_block() -> None:
    """Table 1 of Simonyan & Zisserman 2015: thirteen convolutions of 3 x 3, a pooling between the blocks."""
    layers = metrics._LAYERS["vgg"]
    assert [layer.out_channels for layer in layers] == [64] * 2 + [128] * 2 + [256] * 3 + [512] * 6
    assert [layer.in_channels for layer in layers] == [3, *(layer.out_channels for layer in layers[:-1])]
    assert {(layer.kernel, layer.stride, layer.padding) for layer in layers} == {(3, 1, 1)}
    assert [row for row, layer in enumerate(layers) if layer.pool == (2, 2)] == [2, 4, 7, 10]
    assert sum(layer.pool is not None for layer in layers) == 4
    assert [row for row, layer in enumerate(layers) if layer.tap] == [1, 3, 6, 9, 12]
    heads = {name: shape for name, shape in metrics._expected_shapes(layers).items() if name.startswith("lin")}
    assert heads == {f"lin{row}.weight": (width,) for row, width in enumerate((64, 128, 256, 512, 512))}


def test_weights_of_just_the_largest_size_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "w.npz"
    np.savez(path, **_alex_arrays())
    with zipfile.ZipFile(path) as archive:
        size = sum(member.file_size for member in archive.infolist())
    monkeypatch.setattr(metrics, "MAX_WEIGHT_BYTES", size)
    Lpips("alex", path)
    monkeypatch.setattr(metrics, "MAX_WEIGHT_BYTES", size - 1)
    with pytest.raises(InputError, match=f"at most {size - 1} bytes, got {size}"):
        Lpips("alex", path)


def test_weights_of_whole_numbers_are_refused(tmp_path: Path) -> None:
    path, arrays = tmp_path / "w.npz", _alex_arrays()
    np.savez(path, **{**arrays, "conv1.bias": np.zeros(arrays["conv1.bias"].shape, np.int32)})
    with pytest.raises(InputError, match=r"conv1\.bias.*floats"):
        Lpips("alex", path)


def test_vgg_is_also_looked_for_in_the_cache_of_torch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(metrics.VGG_VARIABLE, raising=False)
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / "lpips_vgg16.npz").write_bytes(b"")
    assert metrics.find_vgg_weights() == tmp_path / "checkpoints" / "lpips_vgg16.npz"
