"""`rasterize`: the same image and gradients as the backend beneath it, errors that name the fault, no silent choice."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from raster_scenes import Case, make_case, weights_like
from tolerances import EXACT
from torch import Tensor

from gsopt.errors import GsoptError, InputError, MissingDependency, NumericalError, UsageError
from gsopt.gaussians import PARAMETERS, Gaussians
from gsopt.geometry.cameras import Cameras
from gsopt.raster.api import Rendering, expected_depth, make_backend, rasterize
from gsopt.raster.reference import ReferenceBackend


def leaves(case: Case) -> Gaussians:
    return Gaussians(**{name: tensor.clone().requires_grad_() for name, tensor in case.gaussians.items()})


def draw(gaussians: Gaussians, case: Case, background: Tensor | None = None) -> Rendering:
    return rasterize(gaussians, case.camera, case.settings, background, backend="reference", depth=True)


def test_autograd_gives_what_the_backend_gives() -> None:
    case, backend = make_case(21), ReferenceBackend()
    v_colors, v_alphas, _ = weights_like(case)
    frame = backend.forward(case.gaussians, case.camera, case.settings, case.background)
    explicit = backend.backward(frame, v_colors, v_alphas)
    gaussians, background = leaves(case), case.background.clone().requires_grad_()
    image = draw(gaussians, case, background)
    assert torch.equal(image.colors[0], frame.colors)
    assert torch.equal(image.alphas[0, ..., 0], frame.alphas)
    assert torch.equal(image.radii[0], frame.radii)
    ((image.colors[0] * v_colors).sum() + (image.alphas[0, ..., 0] * v_alphas).sum()).backward()
    for name in PARAMETERS:
        torch.testing.assert_close(getattr(gaussians, name).grad, getattr(explicit, name), atol=EXACT, rtol=EXACT)
    expected = (v_colors * (1 - frame.alphas[..., None])).sum((0, 1))
    torch.testing.assert_close(background.grad, expected, atol=EXACT, rtol=EXACT)


def test_the_background_gradient_is_the_central_difference() -> None:
    case = make_case(21)
    background = case.background.clone().requires_grad_()
    draw(case.gaussians, case, background).colors.square().sum().backward()
    assert background.grad is not None
    for channel in range(3):
        step = torch.zeros(3, dtype=torch.float64)
        step[channel] = 1e-5
        sums = [draw(case.gaussians, case, case.background + s * step).colors.square().sum() for s in (1, -1)]
        assert float(background.grad[channel]) == pytest.approx(float(sums[0] - sums[1]) / 2e-5, rel=1e-6)


def test_several_cameras_are_stacked_and_their_gradients_added() -> None:
    first, second = make_case(21), make_case(22)
    both = Cameras.cat([first.camera, second.camera])
    gaussians = leaves(first)
    image = rasterize(gaussians, both, backend=ReferenceBackend())
    assert image.colors.shape == (2, 16, 20, 3)
    assert image.alphas.shape == (2, 16, 20, 1)
    assert image.radii.shape == (2, 12, 2)
    assert image.depths is None
    image.colors.square().sum().backward()
    assert gaussians.means.grad is not None
    total = torch.zeros_like(gaussians.means)
    for camera in (first.camera, second.camera):
        alone = leaves(first)
        rasterize(alone, camera, backend="reference").colors.square().sum().backward()
        assert alone.means.grad is not None
        total += alone.means.grad
    torch.testing.assert_close(gaussians.means.grad, total, atol=1e-10, rtol=1e-10)


def test_depth_is_the_mean_distance_along_the_axis_and_zero_where_nothing_is() -> None:
    depths, alphas = torch.tensor([[1.5, 0.0]]), torch.tensor([[0.5, 0.0]]).requires_grad_()
    mean = expected_depth(depths, alphas)
    assert mean.tolist() == [[3.0, 0.0]]
    mean.sum().backward()
    assert alphas.grad is not None
    assert alphas.grad.tolist() == [[-6.0, 0.0]]
    case = make_case(21)
    image = draw(case.gaussians, case)
    assert image.depths is not None
    hit = image.alphas > 0
    z = (case.gaussians.means @ case.camera.viewmats[0, 2, :3]) + case.camera.viewmats[0, 2, 3]
    assert bool(hit.any())
    assert bool((~hit).any())
    assert float(image.depths[hit].min()) >= float(z.min()) - EXACT
    assert float(image.depths[hit].max()) <= float(z.max()) + EXACT
    assert float(image.depths[~hit].abs().max()) == 0


def test_only_the_depth_is_differentiated() -> None:
    case = make_case(21)
    gaussians = leaves(case)
    depths = draw(gaussians, case).depths
    assert depths is not None
    depths.sum().backward()
    assert gaussians.means.grad is not None
    assert gaussians.sh0.grad is not None
    assert float(gaussians.means.grad.abs().max()) > 0
    assert float(gaussians.sh0.grad.abs().max()) == 0


def test_an_image_is_differentiated_once() -> None:
    case = make_case(21)
    total = draw(leaves(case), case).colors.sum()
    total.backward(retain_graph=True)
    with pytest.raises(UsageError, match="Draw it again"):
        total.backward()


@pytest.mark.parametrize("name", PARAMETERS)
def test_a_value_that_is_not_finite_is_named(name: str) -> None:
    case = make_case(21)
    broken = getattr(case.gaussians, name).clone()
    broken.view(len(broken), -1)[3, 0] = math.nan
    with pytest.raises(InputError, match=rf"`{name}` must be finite, got nan at index \[3"):
        draw(replace(case.gaussians, **{name: broken}), case)


def test_a_zero_quaternion_is_named_with_its_row() -> None:
    case = make_case(21)
    quats = case.gaussians.quats.clone()
    quats[5] = 0
    with pytest.raises(InputError, match=r"`quats` must not be zero, got \[0.0, 0.0, 0.0, 0.0\] at row 5"):
        draw(replace(case.gaussians, quats=quats), case)


def test_wrong_shapes_types_and_cameras_are_refused() -> None:
    case = make_case(21)
    g, camera = case.gaussians, case.camera
    with pytest.raises(InputError, match=r"`quats` must have shape \[12, 4\], got \[12, 3\]"):
        draw(replace(g, quats=g.quats[:, :3]), case)
    with pytest.raises(InputError, match=r"`log_scales` must be float32 or float64 like `means`.*got torch.float32"):
        draw(replace(g, log_scales=g.log_scales.float()), case)
    with pytest.raises(InputError, match=r"`means` must be float32 or float64.*got torch.float16"):
        draw(g.to(torch.float16), case)
    with pytest.raises(InputError, match=r"`background` must have shape \[3\], got \[4\]"):
        draw(g, case, torch.zeros(4))
    with pytest.raises(InputError, match="`cameras` must hold at least one camera"):
        rasterize(g, camera[0:0], backend="reference")
    with pytest.raises(UsageError, match="`focal length` must be at least"):
        rasterize(g, replace(camera, Ks=-camera.Ks), backend="reference")


def with_field(name: str, value: object) -> Callable[[Case], dict[str, object]]:
    """Arguments of a call in which one field of the Gaussians or cameras has another value."""

    def build(case: Case) -> dict[str, object]:
        if name in PARAMETERS:
            own = value(getattr(case.gaussians, name)) if callable(value) else value
            return {"gaussians": replace(case.gaussians, **{name: own})}
        own = value(getattr(case.camera, name)) if callable(value) else value
        return {"cameras": replace(case.camera, **{name: own})}

    return build


@pytest.mark.parametrize(
    ("build", "text"),
    [
        (with_field("means", None), "`means` must be of type Tensor, got NoneType"),
        (with_field("sh0", "text"), "`sh0` must be of type Tensor, got str"),
        (with_field("quats", lambda t: t.numpy()), "`quats` must be of type Tensor, got ndarray"),
        (with_field("means", lambda t: t.to_sparse()), "`means` must be a dense tensor of floats"),
        (with_field("means", lambda t: t.long()), "`means` must be a dense tensor of floats"),
        (with_field("means", torch.tensor(1.0)), "`means` must be a dense tensor of floats"),
        (with_field("viewmats", lambda t: t.numpy()), "`viewmats` must be of type Tensor, got ndarray"),
        (with_field("Ks", lambda t: t + 1j), "`Ks` must be a dense tensor of floats"),
        (with_field("width", "20"), "`width` must be of type int, got str"),
        (with_field("height", 2**31), r"`height` must lie in \[1, 16777216\]"),
        (lambda case: {"gaussians": None}, "`gaussians` must be of type Gaussians, got NoneType"),
        (lambda case: {"cameras": "camera"}, "`cameras` must be of type Cameras, got str"),
        (lambda case: {"settings": {}}, "`settings` must be of type RasterSettings, got dict"),
        (lambda case: {"background": [1, 1, 1]}, "`background` must be of type Tensor, got list"),
        (lambda case: {"backend": None}, "`backend` must be of type str, got NoneType"),
        (lambda case: {"threads": "2"}, "`threads` must be of type int, got str"),
        (lambda case: {"threads": 1025}, r"`threads` must lie in \[0, 1024\], got 1025"),
    ],
)
def test_what_is_no_tensor_is_named(build: Callable[[Case], dict[str, Any]], text: str) -> None:
    case = make_case(21)
    with pytest.raises(GsoptError, match=text):
        rasterize(**{"gaussians": case.gaussians, "cameras": case.camera, "backend": "reference", **build(case)})


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_an_image_that_memory_cannot_hold_is_named(backend: str) -> None:
    case = make_case(21)
    camera = replace(case.camera, width=1 << 24, height=1 << 24)
    with pytest.raises(NumericalError, match="at 16777216x16777216 needs more memory than there is"):
        rasterize(case.gaussians, camera, backend=backend)


@pytest.mark.parametrize("backend", ["cpu", "reference"])
@pytest.mark.parametrize("name", PARAMETERS)
def test_parameters_that_changed_since_they_were_drawn_have_no_gradient(name: str, backend: str) -> None:
    case = make_case(21)
    gaussians = leaves(replace(case, gaussians=case.gaussians.to(torch.float32)))
    loss = rasterize(gaussians, case.camera, backend=backend).colors.sum()
    with torch.no_grad():
        getattr(gaussians, name).mul_(0.5)
    with pytest.raises(UsageError, match=f"`{name}` must be as it was drawn"):
        loss.backward()


def test_a_backend_is_chosen_by_name_only() -> None:
    assert make_backend("reference").name == "reference"
    with pytest.raises(UsageError, match="`backend` must be one of auto, cpu, cuda, mps, reference; got 'gpu'"):
        make_backend("gpu")
    with pytest.raises(UsageError, match="`threads` must be at least 0"):
        make_backend("auto", threads=-1)


@pytest.mark.parametrize("name", ["auto", "cpu"])
def test_a_missing_extension_is_an_error_with_its_remedy(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    # None in sys.modules makes the import fail as it does where the extension was never built.
    monkeypatch.setitem(sys.modules, "gsopt.raster.cpu_backend", None)
    with pytest.raises(MissingDependency, match=r"pip install -e \."):
        make_backend(name)
