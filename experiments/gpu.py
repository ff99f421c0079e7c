"""Measures the GPU backend where a GPU is at hand, in ten minutes, and writes experiments/results/gpu.json.

    python experiments/gpu.py --lego DATA            # on a GPU; DATA: NeRF-synthetic's lego at 400 px
    python experiments/gpu.py --tiny --out OUT.json  # the same on this CPU, a thread at a time, in a minute

Each part is written as soon as it is known. No compiler is needed, but the extension of a wheel in gsopt/raster, torch,
numpy, pillow, plyfile, safetensors, jaxtyping, hypothesis and pytest; diffusers and transformers for the last part.
"""

from __future__ import annotations

import argparse
import hashlib
import platform
import statistics
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), *(str(ROOT / "tests" / folder) for folder in ("", "raster", "sds"))]

import torch  # noqa: E402
from raster_scenes import make_case, undecided_gaussians  # noqa: E402
from stress_cases import STRESSES  # noqa: E402
from stress_measure import Truth, deviation  # noqa: E402
from tolerances import DECISION, GRADIENT, IMAGE  # noqa: E402

from gsopt.benchmark.surface_scene import surface_scene  # noqa: E402
from gsopt.config.guidance import GuidanceConfig  # noqa: E402
from gsopt.config.train import DataConfig, InitConfig, OptimizerConfig, TrainConfig  # noqa: E402
from gsopt.data.scene import load_scene  # noqa: E402
from gsopt.events import to_json, write_atomic  # noqa: E402
from gsopt.gaussians import PARAMETERS  # noqa: E402
from gsopt.metrics import capped_psnr  # noqa: E402
from gsopt.raster.backend import RasterSettings  # noqa: E402
from gsopt.raster.device.backend import DeviceBackend  # noqa: E402
from gsopt.raster.device.frame import Context  # noqa: E402
from gsopt.results.finished_run import draw, truth  # noqa: E402
from gsopt.sds.guidance_step import Guidance  # noqa: E402
from gsopt.training import loop  # noqa: E402
from gsopt.training.loop import train  # noqa: E402
from gsopt.training.optimizer import OptimizedGaussians, adam_step  # noqa: E402

RESULT = ROOT / "experiments" / "results" / "gpu.json"
COMMAND = "python experiments/gpu.py"
CASES = ((200, 20_000), (400, 50_000), (800, 100_000), (800, 300_000), (800, 1_000_000), (1600, 3_000_000))
"""Side in px, number of Gaussians."""
LARGEST_SCENE = 300_000
"""Larger scenes are this one, shifted by less than a splat: finding neighbors takes a CPU minutes."""
LEGO_STEPS = (7000, 30_000)
FLOATS = 59
"""Numbers of a Gaussian of SH degree 3."""
PAIR_FLOPS = 70
"""Operations on a pair of splat and pixel, forward and back (docs/math.md, 7 to 11); an exponential counts as one."""


@dataclass(frozen=True)
class Bench:
    """The backend, and how large everything is."""

    backend: DeviceBackend
    lego: Path | None
    tiny: bool

    def wait(self) -> None:
        """Until the device has done what it was given."""
        if self.backend.device.type == "cuda":
            torch.cuda.synchronize(self.backend.device)
        if self.backend.device.type == "mps":
            torch.mps.synchronize()

    def forget_peak(self) -> None:
        """Begin to watch torch's memory anew."""
        if self.backend.device.type == "cuda":
            torch.cuda.empty_cache()
            torch.cuda.reset_peak_memory_stats(self.backend.device)

    def peak(self) -> int:
        """Most bytes that torch held since; 0 on a CPU and on Apple's GPU, which does not count them."""
        return torch.cuda.max_memory_allocated(self.backend.device) if self.backend.device.type == "cuda" else 0

    def seconds(self, work: Callable[[], object], repetitions: int) -> float:
        """Median time of one call, of five series."""
        series = []
        for _ in range(1 if self.tiny else 5):
            self.wait()
            began = time.perf_counter()
            for _ in range(repetitions):
                work()
            self.wait()
            series.append((time.perf_counter() - began) / repetitions)
        return statistics.median(series)


class Iteration:
    """A training iteration that can be repeated, as `gsopt bench kernels` has it."""

    def __init__(self, bench: Bench, side: int, count: int) -> None:
        self.backend = bench.backend
        gaussians, self.camera = surface_scene(min(count, LARGEST_SCENE), side, side)
        copies = -(-count // len(gaussians))
        rows = torch.arange(count) // copies
        gaussians = gaussians.select(rows)
        shift = torch.rand(count, 3, generator=torch.Generator().manual_seed(0)) - 0.5
        smaller = copies**-0.5  # so that all of them cover what one did
        means = gaussians.means + shift * gaussians.scales
        gaussians = replace(gaussians, means=means, log_scales=gaussians.log_scales + torch.tensor(smaller).log())
        self.model = OptimizedGaussians.start(gaussians.to(self.backend.device))
        self.settings, self.config = RasterSettings(), OptimizerConfig()
        self.rates = dict.fromkeys(PARAMETERS, 1e-10)
        noise = torch.rand(side, side, 3, generator=torch.Generator().manual_seed(1))
        self.target = noise.to(self.backend.device)
        self.gradients: Any = None

    def forward(self) -> Any:
        return self.backend.forward(self.model.gaussians, self.camera, self.settings)

    def run(self) -> None:
        frame = self.forward()
        loss = self.backend.photometric(frame.colors, self.target, 0.2)
        self.gradients = self.backend.backward(frame, loss.v_colors, bands=False, into=self.gradients)
        adam_step(self.model, self.gradients, self.rates, self.config, self.backend, self.camera, self.settings)

    def bits(self) -> str:
        """A digest of all that an iteration changes."""
        tensors = [t for record in (self.model.gaussians, self.model.exp_avg_sq) for _, t in record.items()]
        return hashlib.sha256(b"".join(t.cpu().numpy().tobytes() for t in tensors)).hexdigest()


def oracle(bench: Bench) -> dict[str, Any]:
    """The float64 reference on random scenes; those where rounding may decide are left out."""
    found = []
    for seed in range(4 if bench.tiny else 60):
        case = make_case(seed, count=10 + 3 * seed, width=20 + seed, height=50 - seed // 2)
        if not undecided_gaussians(case, DECISION):
            found.append(deviation(bench.backend, Truth.of(case)))
    worst = {"image": max(d.image for d in found), "gradient": max(d.gradient for d in found)}
    return {"scenes": len(found), **worst, "passed": worst["image"] <= IMAGE and worst["gradient"] <= 5 * GRADIENT}


def stress(bench: Bench) -> dict[str, Any]:
    """Every case of the stress table beside what is permitted."""
    rows = []
    for case in STRESSES[:3] if bench.tiny else STRESSES:
        found = deviation(bench.backend, Truth.of(case.make()))
        passed = found.image <= case.image and found.gradient <= case.gradient
        rows.append({"case": case.name, "image": found.image, "gradient": found.gradient, "passed": passed})
    return {"rows": rows, "passed": all(row["passed"] for row in rows)}


def repeatability(bench: Bench) -> dict[str, Any]:
    """Digests of models after the same iterations, from the start each time."""
    side, count, steps = (32, 300, 3) if bench.tiny else (400, 50_000, 50)
    digests = []
    for _ in range(2 if bench.tiny else 4):
        iteration = Iteration(bench, side, count)
        for _ in range(steps):
            iteration.run()
        digests.append(iteration.bits())
    return {"digests": digests, "passed": len(set(digests)) == 1}


def ceilings(bench: Bench) -> dict[str, float]:
    """Bytes per second of a copy, read and written, and float32 operations per second of a matrix product."""
    size = 1 << (16 if bench.tiny else 28)
    a, b = (torch.rand(size, device=bench.backend.device) for _ in range(2))
    side = 64 if bench.tiny else 8192
    m = torch.rand(side, side, device=bench.backend.device)
    copied = bench.seconds(lambda: a.copy_(b), 10)
    multiplied = bench.seconds(lambda: m @ m, 3)
    return {"bytes_per_second": 8 * size / copied, "flops_per_second": 2 * side**3 / multiplied}


def speed(bench: Bench) -> dict[str, Any]:
    """Time of a full iteration and of its parts, beside the least that memory and arithmetic allow."""
    most = ceilings(bench)
    rows = [case_speed(bench, side, count, most) for side, count in (((32, 300),) if bench.tiny else CASES)]
    return {"ceilings": most, "rows": rows}


def case_speed(bench: Bench, side: int, count: int, most: dict[str, float]) -> dict[str, Any]:
    iteration = Iteration(bench, side, count)
    for _ in range(2 if bench.tiny else 20):
        iteration.run()
    bench.forget_peak()
    whole = bench.seconds(iteration.run, 2 if bench.tiny else 50)
    drawn = bench.seconds(iteration.forward, 2 if bench.tiny else 50)
    context = iteration.forward().context
    assert isinstance(context, Context)
    entries = len(context.entries.slots)
    bound = least_seconds(count, entries, side * side, most)
    row = {"side": side, "count": count, "pairs": entries, "ms": 1e3 * whole, "forward_ms": 1e3 * drawn}
    row |= {"bound_ms": 1e3 * bound, "share_of_bound": bound / whole, "peak_bytes": bench.peak()}
    print(row, flush=True)
    return row


def profile(bench: Bench) -> dict[str, Any]:
    """Time that every kernel of an iteration takes on the GPU, torch's own among them, in microseconds."""
    sizes = ((32, 300),) if bench.tiny else (CASES[1], CASES[3])
    return {f"{side} px, {count}": case_profile(bench, side, count) for side, count in sizes}


def case_profile(bench: Bench, side: int, count: int) -> dict[str, float]:
    iteration, repetitions = Iteration(bench, side, count), 2 if bench.tiny else 20
    for _ in range(repetitions):
        iteration.run()
    bench.wait()
    with torch.profiler.profile() as profiler:
        for _ in range(repetitions):
            iteration.run()
        bench.wait()
    spent = {found.key[:100]: found.self_device_time_total / repetitions for found in profiler.key_averages()}
    return {key: round(us, 2) for key, us in sorted(spent.items(), key=lambda item: -item[1]) if us > 0}


def least_seconds(count: int, entries: int, pixels: int, most: dict[str, float]) -> float:
    """Bytes that must move once, or operations on every pixel of a listed tile, whichever takes longer."""
    gaussians = 4 * (2 * FLOATS + 6 * FLOATS + 3 * 14)  # read twice, stepped with two moments, gradients without bands
    moved = count * (gaussians + 2 * 48) + entries * (2 * 48 + 2 * 48 + 40) + pixels * 120
    return max(moved / most["bytes_per_second"], 256 * entries * PAIR_FLOPS / most["flops_per_second"])


def lego(bench: Bench) -> dict[str, Any]:
    """Runs to the end: seconds of training, PSNR over the 200 test views, Gaussians, memory."""
    if bench.lego is None:
        return {"skipped": "no --lego"}
    return {str(steps): lego_run(bench, bench.lego, steps) for steps in ((12,) if bench.tiny else LEGO_STEPS)}


def lego_run(bench: Bench, data: Path, steps: int) -> dict[str, Any]:
    config = TrainConfig(data=DataConfig(path=str(data), background="white"), checkpoint_every=0, preview_every=0)
    config = replace(config, guidance=GuidanceConfig(lambda_sds=0.0)).with_steps(steps)
    if bench.tiny:
        config = replace(config, init=InitConfig(method="random", count=200))
    bench.forget_peak()
    with tempfile.TemporaryDirectory() as folder:
        result = train(config, Path(folder, "run"))
    if result.stopped:
        raise RuntimeError(f"stopped after {result.steps} of {steps} steps")
    peak = bench.peak()
    scene = load_scene(config.data)
    views, white = scene.test[:2] if bench.tiny else scene.test, torch.ones(3)
    settings = RasterSettings(sh_degree=result.gaussians.sh_degree)
    gaussians = result.gaussians.to(bench.backend.device)
    pairs = [(draw(gaussians, view.camera, bench.backend, settings, white), truth(view, white)) for view in views]
    psnr = statistics.mean(float(capped_psnr(a[None].double() / 255, b[None].double() / 255)) for a, b in pairs)
    row = {"seconds": result.train_seconds, "psnr": psnr, "gaussians": len(result.gaussians), "peak_bytes": peak}
    print(steps, row, flush=True)
    return row


def stable_diffusion(bench: Bench) -> dict[str, Any]:
    """Guided steps beside the trainer: seconds each, and the most memory that torch held."""
    import real_sd21
    import tiny_sd21
    from tiny_scenes import write_dataset

    with tempfile.TemporaryDirectory() as folder:
        prior = tiny_sd21.build(Path(folder, "sd")) if bench.tiny else real_sd21.build(Path(folder, "sd"))
        guidance = GuidanceConfig(lambda_sds=1.0, prior=str(prior), prompt=("a chair",), size=64 if bench.tiny else 512)
        guidance = replace(guidance, start=0.0, stop=1.0, every=1, guard_views=0, min_uncertainty=0.0)
        scene = write_dataset(Path(folder, "scene"), train=4, test=1)
        config = TrainConfig(data=DataConfig(path=str(scene)), init=InitConfig("random", 200), guidance=guidance)
        config = replace(config, checkpoint_every=0, preview_every=0).with_steps(3 if bench.tiny else 12)
        bench.forget_peak()
        seconds = guided_seconds(bench, config, Path(folder, "run"))
    return {"steps": len(seconds), "seconds": statistics.median(seconds[1:]), "peak_bytes": bench.peak()}


def guided_seconds(bench: Bench, config: TrainConfig, run: Path) -> list[float]:
    """Time of every guided step's share."""
    inner, found = Guidance.gradients, []

    def gradients(self: Guidance, *arguments: Any) -> Any:
        bench.wait()
        began = time.perf_counter()
        answer = inner(self, *arguments)
        bench.wait()
        if answer is not None:
            found.append(time.perf_counter() - began)
        return answer

    Guidance.gradients = gradients  # type: ignore[method-assign]
    try:
        train(config, run)
    finally:
        Guidance.gradients = inner  # type: ignore[method-assign]
    return found


PARTS = {
    "oracle": oracle,
    "stress": stress,
    "repeatability": repeatability,
    "speed": speed,
    "profile": profile,
    "lego": lego,
    "stable_diffusion": stable_diffusion,
}


def open_backend(tiny: bool) -> DeviceBackend:
    """The GPU's, or its kernels on this CPU."""
    if tiny:
        from simt_runtime import SimtRuntime

        return DeviceBackend(SimtRuntime())
    from gsopt.raster.device.gpus import open_runtime, seen

    return DeviceBackend(open_runtime(seen() or "cuda"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--lego", type=Path)
    parser.add_argument("--out", type=Path, default=RESULT)
    parser.add_argument("--tiny", action="store_true")
    parser.add_argument("--parts", nargs="+", choices=tuple(PARTS), default=tuple(PARTS))
    flags = parser.parse_args()
    bench = Bench(open_backend(flags.tiny), flags.lego, flags.tiny)
    loop.make_backend = lambda *_: bench.backend  # type: ignore[assignment]
    host = {"python": platform.python_version(), "torch": torch.__version__, "tiny": flags.tiny}
    document: dict[str, Any] = {
        "command": "python experiments/gpu.py",
        "machine": {**host, **bench.backend.runtime.about},
    }
    for name in flags.parts:
        began = time.perf_counter()
        try:
            document[name] = PARTS[name](bench)
        except Exception as error:  # the other parts are worth having
            traceback.print_exc()
            document[name] = {"failed": f"{type(error).__name__}: {error}"[:2000]}
        document[name]["part_seconds"] = round(time.perf_counter() - began, 2)
        print(name, document[name], flush=True)
        write_atomic(flags.out, to_json(document))


if __name__ == "__main__":
    main()
