"""`gsopt doctor`: what is installed, what is missing and how to get it, and how fast this machine is."""

from __future__ import annotations

import json
import os
import platform
import re
import statistics
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from importlib import metadata
from typing import TYPE_CHECKING, Any

import tyro

from gsopt._version import __version__
from gsopt.errors import GsoptError

if TYPE_CHECKING:
    from gsopt.raster.backend import Backend

REPETITIONS = 9
GAUSSIANS = 20_000
SIDE = 200


@dataclass(frozen=True)
class Flags:
    """Say what is installed, what is missing and how to get it, and how fast this machine is."""

    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """Print JSON instead of text."""


@dataclass(frozen=True)
class Package:
    """A package that gsopt uses."""

    name: str
    extra: str
    """The extra of gsopt it belongs to; empty for what is always needed."""
    version: str | None
    """Installed version, or None when it is missing."""


@dataclass(frozen=True)
class Rasterizer:
    """The compiled backend, or why there is none."""

    backend: str | None
    isa: str | None
    """Instruction set the kernels run on."""
    ms_per_step: float | None
    """Median time of one forward and backward pass over `GAUSSIANS` of SH degree 3, `SIDE` x `SIDE` px, in ms."""
    problem: str | None


@dataclass(frozen=True)
class Gpu:
    """The GPU that `--backend auto` takes, or why there is none."""

    device: str | None
    arch: str | None
    """Its architecture, as sm_90."""
    library: str | None
    """The compiler of its kernels, and the driver's version."""
    compile_seconds: float | None
    """Time to compile the kernels, or to read them from the cache, and to load them."""
    ms_per_step: float | None
    """As for the rasterizer."""
    problem: str | None


def main(argv: Sequence[str]) -> int:
    """Print the findings; always 0, a missing part is a finding."""
    flags = tyro.cli(Flags, prog="gsopt doctor", args=argv)
    findings = examine()
    print(json.dumps(findings, indent=1, allow_nan=False) if flags.json else text(findings))
    return 0


def examine() -> dict[str, Any]:
    """Everything `gsopt doctor` says, JSON-ready."""
    packages = required_packages()
    missing = sorted({package.extra for package in packages if package.version is None})
    return {
        "gsopt": __version__,
        "python": platform.python_version(),
        "machine": f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores",
        "packages": [asdict(package) for package in packages],
        "missing_extras": {extra: pip_line(extra) for extra in missing},
        "rasterizer": asdict(examine_rasterizer()),
        "gpu": asdict(examine_gpu()),
        "lpips_vgg": find_lpips_vgg(),
    }


def required_packages() -> list[Package]:
    """Returns the packages that gsopt's metadata requires, with their versions; empty when gsopt is not installed."""
    try:
        lines = metadata.requires("gsopt") or []
    except metadata.PackageNotFoundError:
        return []
    return [parse_requirement(line) for line in lines]


def parse_requirement(line: str) -> Package:
    """`viser>=1.1; extra == "viewer"` to a Package."""
    name = re.match(r"[\w.-]+", line)
    extra = re.search(r"""extra\s*==\s*['"]([\w-]+)['"]""", line)
    found = name.group() if name else line
    return Package(found, extra.group(1) if extra else "", installed_version(found))


def installed_version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def pip_line(extra: str) -> str:
    """The command that installs an extra, or what is always needed when `extra` is empty."""
    return f"{sys.executable} -m pip install 'gsopt[{extra}]'" if extra else f"{sys.executable} -m pip install gsopt"


def examine_rasterizer() -> Rasterizer:
    """Build the backend of this processor and time it."""
    try:
        from gsopt.raster.api import make_backend

        backend = make_backend("cpu")
        return Rasterizer(backend.name, getattr(backend, "isa", None), measure(backend), None)
    except (GsoptError, ImportError) as error:
        return Rasterizer(None, None, None, str(error))


def examine_gpu() -> Gpu:
    """Compile the kernels for torch's GPU and time them."""
    try:
        from gsopt.raster.device.gpus import open_gpu, seen

        backend = open_gpu(seen() or ("mps" if sys.platform == "darwin" else "cuda"))
        about = backend.runtime.about
        seconds = float(about["compile_seconds"])
        return Gpu(about["device"], about["arch"], about["library"], seconds, measure(backend), None)
    except (GsoptError, ImportError) as error:
        return Gpu(None, None, None, None, None, str(error))


def measure(backend: Backend) -> float:
    """Median time of one forward and backward pass, ms."""
    import torch

    from gsopt.gaussians import Gaussians
    from gsopt.geometry.cameras import Cameras, intrinsics, look_at
    from gsopt.raster.backend import RasterSettings

    random = torch.Generator().manual_seed(0)
    n = GAUSSIANS
    gaussians = Gaussians(
        means=torch.rand(n, 3, generator=random) * 2 - 1,
        quats=torch.randn(n, 4, generator=random),
        log_scales=torch.rand(n, 3, generator=random) - 4.5,  # 1-3 % of the scene
        logit_opacities=torch.randn(n, generator=random),
        sh0=torch.randn(n, 1, 3, generator=random),
        shN=0.1 * torch.randn(n, 15, 3, generator=random),
    ).to(backend.device)
    viewmats = look_at(torch.tensor([[0.0, -4.0, 1.0]]), torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
    camera = Cameras(viewmats, intrinsics(0.7, SIDE, SIDE)[None].float(), SIDE, SIDE)
    v_colors = torch.rand(SIDE, SIDE, 3, generator=random).to(backend.device)
    times = []
    for _ in range(REPETITIONS):
        start = time.perf_counter()
        backend.backward(backend.forward(gaussians, camera, RasterSettings()), v_colors).means.cpu()
        times.append(time.perf_counter() - start)
    return round(1000 * statistics.median(times), 2)


def find_lpips_vgg() -> dict[str, str | None]:
    """Returns the path of the LPIPS (VGG) weights, or why there are none."""
    try:
        from gsopt.metrics import VGG_NOTE, find_vgg_weights

        path = find_vgg_weights()
    except (GsoptError, ImportError) as error:
        return {"path": None, "problem": str(error)}
    return {"path": None, "problem": VGG_NOTE} if path is None else {"path": str(path), "problem": None}


def text(findings: dict[str, Any]) -> str:
    """The findings for a person."""
    lines = [f"gsopt {findings['gsopt']}, Python {findings['python']}, {findings['machine']}", "", "packages"]
    if not findings["packages"]:
        lines.append("  gsopt itself is not installed: run `pip install -e .` in the source folder")
    for package in findings["packages"]:
        extra = f" [{package['extra']}]" if package["extra"] else ""
        lines.append(f"  {package['name'] + extra:<24} {package['version'] or 'not installed'}")
    lines += ["", "rasterizer", *rasterizer_lines(findings["rasterizer"]), "", "GPU", *gpu_lines(findings["gpu"])]
    lines += ["", "LPIPS (VGG) weights"]
    lines.append(f"  {findings['lpips_vgg']['path'] or findings['lpips_vgg']['problem']}")
    if findings["missing_extras"]:
        lines += ["", "to install what is missing"]
        lines += [f"  {line}" for line in findings["missing_extras"].values()]
    return "\n".join(lines)


def rasterizer_lines(found: dict[str, Any]) -> list[str]:
    if found["problem"]:
        return [f"  none: {found['problem']}"]
    return [
        f"  backend {found['backend']}, instruction set {found['isa'] or 'unknown'}",
        f"  {found['ms_per_step']} ms per forward + backward ({GAUSSIANS} Gaussians, {SIDE}x{SIDE})",
    ]


def gpu_lines(found: dict[str, Any]) -> list[str]:
    if found["problem"]:
        return [f"  none: {found['problem']}"]
    return [
        f"  {found['device']}, {found['arch']}",
        f"  kernels by {found['library']}, ready in {found['compile_seconds']} s",
        f"  {found['ms_per_step']} ms per forward + backward ({GAUSSIANS} Gaussians, {SIDE}x{SIDE})",
    ]
