"""`train`: from a configuration to splat.ply, with checkpoints and events on the way."""

from __future__ import annotations

import contextlib
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from gsopt.config.guidance import GuidanceConfig
from gsopt.config.train import TrainConfig
from gsopt.data.scene import Scene, read_ahead
from gsopt.errors import InputError, NumericalError, UsageError
from gsopt.events import to_json, write_atomic
from gsopt.formats import load_splats
from gsopt.formats.ply import save_ply
from gsopt.gaussians import Gaussians
from gsopt.init.first_gaussians import ENOUGH_AGREED, first_gaussians
from gsopt.init.guessed_views import with_guessed_views
from gsopt.init.mask_repair import RepairedMask, load_with_agreeing_masks
from gsopt.raster.api import make_backend
from gsopt.raster.backend import Backend
from gsopt.raster.device.memory import PRIOR_BYTES, Memory, free_bytes, is_out_of_memory
from gsopt.raster.threads import available_cores, one_torch_thread
from gsopt.training.checkpoint import load_newest, newest_saved, save_checkpoint
from gsopt.training.estimate import estimate, memory_limit
from gsopt.training.few_photos import few_photo_warnings
from gsopt.training.finite import require_finite, require_finite_loss
from gsopt.training.guided.choice import recorded_choice
from gsopt.training.interrupt import StopRequest
from gsopt.training.mirror_images import with_recorded_mirrors
from gsopt.training.plan import RunPlan, guesses, matches_photos
from gsopt.training.run_directory import Listener, RunDirectory, opened
from gsopt.training.surroundings import Surrounded, narrowed, surrounded
from gsopt.training.trainer import Trainer

if TYPE_CHECKING:
    from gsopt.training.guided.session import RunGuidance

PROGRESS_SECONDS = 0.5
# Steps between two checks that every parameter is finite; the loss is checked in every step.
FINITE_EVERY = 100


@dataclass(frozen=True)
class TrainResult:
    """The outcome of a run."""

    run: Path
    gaussians: Gaussians
    scene: Scene
    backend: str
    init: str
    """Method that made the first Gaussians, and why."""
    steps: int
    """Steps taken, earlier sessions of a resumed run included."""
    stopped: bool
    """True when someone asked it to stop before it was finished."""
    train_seconds: float
    """Wall time of the steps, checkpoints and previews; without reading the data and making the first Gaussians."""
    cpu_seconds: float
    """CPU time of all threads over the same stretch: other work on the machine does not add to it."""
    peak_memory_mb: float | None
    """Largest resident set of this process since it started, interpreter and libraries included; Windows has none."""


@torch.no_grad()
def train(
    config: TrainConfig, run: Path, *, resume: bool = False, on_progress: Listener | None = None, done: bool = True
) -> TrainResult:
    """Optimize Gaussians for the scene in `config.data` and write `run` (see gsopt/events.py for what is in there).

    `resume` continues from the newest checkpoint in `run`, with the same bits as if it had never stopped; without
    one it starts. `on_progress` is called with every event. `done`: end with the event `done`; a caller that adds an
    evaluation says False and emits it afterwards. SIGINT, SIGTERM and a file `stop` end the run after its step.

    Raises UsageError for a folder that holds another run, InputError for unusable data, NumericalError when a value
    stops being finite.
    """
    if config.cells:
        raise UsageError(f"`--cells {config.cells}` is for `gsopt train` and reconstruct(), got it here. Leave it out.")
    began = time.process_time()
    with opened(Path(run), config, resume, on_progress) as directory, StopRequest(directory.stop_file) as stop:
        backend = make_backend(config.backend, config.threads, config.device)
        with one_torch_thread(config.threads or available_cores()), on_its_gpu(backend):
            scene, repaired = load_with_agreeing_masks(config.data)
            read_ahead(scene.test)  # an image that cannot be decoded is named before the work that it is to evaluate
            scene = with_recorded_mirrors(config, scene, directory)
            if config.guidance != GuidanceConfig() or len(scene.train) == 1:
                scene = _with_prior_body(config, scene, backend, directory)
            if guesses(config, len(scene.train)) and not scene.mirrored:
                scene = with_guessed_views(scene, backend)
            if matches_photos(config, scene):
                from gsopt.init.stereo.depths import with_stereo_depths

                scene = with_stereo_depths(scene, ENOUGH_AGREED, config.seed)
            plan = RunPlan.of(config, scene)
            scene, backend = narrowed(plan.cell, scene), surrounded(plan, backend)
            guidance = _guidance(config, plan, scene, backend, directory)
            expected = require_memory(config, plan, scene, backend, guidance)
            directory.record(estimate=expected)
            trainer, clock = _start(plan, scene, backend, directory, guidance, began)
            _report_masks(repaired, directory)
            stopped = _advance(trainer, directory, stop, clock)
            _finish(trainer, directory, clock)
            if guidance is not None:
                guidance.finish(trainer.result, trainer.settings())
        if stopped or done:
            kind = "stopped" if stopped else "done"
            directory.emit(kind, step=trainer.step, n=len(trainer.model), seconds=round(clock.seconds(), 3))
        return TrainResult(
            run=directory.path,
            gaussians=trainer.result.to("cpu"),
            scene=scene,
            backend=backend.name,
            init=str(directory.recorded("gaussians_init")),
            steps=trainer.step,
            stopped=stopped,
            train_seconds=clock.seconds(),
            cpu_seconds=clock.cpu_seconds(),
            peak_memory_mb=peak_memory_mb(),
        )


@contextmanager
def on_its_gpu(backend: Backend) -> Iterator[None]:
    """The backend's GPU is torch's current one: a prior that asks for "cuda" goes beside it."""
    if backend.device.type != "cuda":
        yield
        return
    with torch.cuda.device(backend.device):
        yield


def _with_prior_body(config: TrainConfig, scene: Scene, backend: Backend, directory: RunDirectory) -> Scene:
    """The scene with the body that a library or a shape prior sees in it, where somebody asks for one."""
    from gsopt.training.library_body import with_library_body
    from gsopt.training.shape_prior_body import with_shape_prior_body

    scene = with_library_body(config, scene, backend, directory)
    return with_shape_prior_body(config, scene, backend, directory)


def _guidance(
    config: TrainConfig, plan: RunPlan, scene: Scene, backend: Backend, directory: RunDirectory
) -> RunGuidance | None:
    """Guidance of the run, or None; what it needs is imported only for a prior."""
    if recorded_choice(plan, directory)["prior"] is None:
        return None
    from gsopt.training.guided.start import start_guidance

    return start_guidance(config, plan, scene, backend, directory)


def require_memory(
    config: TrainConfig, plan: RunPlan, scene: Scene, backend: Backend, guidance: RunGuidance | None
) -> dict[str, float] | None:
    """Raise InputError or NumericalError before the first step where memory, or the GPU's, will not do.

    Returns the estimate of memory, and on the CPU without guidance of the time, or None for the reference.
    """
    if backend.name == "cpu":
        expected = estimate(config, plan, scene, len(backend) if isinstance(backend, Surrounded) else 0)
        if (limit := memory_limit(config)) is not None:
            expected.require(limit)
        found: dict[str, float] = {"memory_mb": round(expected.memory / 1e6)}
        return found if guidance is not None else {**found, "cpu_seconds": round(expected.seconds)}
    if backend.device.type == "cpu":
        return None
    views = scene.drawn
    pixels = max(view.camera.width * view.camera.height for view in views)
    every = sum(16 * view.camera.width * view.camera.height for view in views)
    targets = min(int(plan.target_cache_mb * 1e6), every)
    prior = PRIOR_BYTES if guidance is not None else 0
    memory = Memory.of(plan.density.max_gaussians, plan.schedule.max_sh_degree, pixels, targets, prior)
    memory.require(backend.device, free_bytes(backend.device))
    return {"memory_mb": round(memory.total / 1e6)}


@contextmanager
def gpu_memory(step: int, checkpoints: Path) -> Iterator[None]:
    """NumericalError, with the way on, where a GPU's memory ends in the middle of a run."""
    try:
        yield
    except (RuntimeError, NumericalError) as error:
        if not is_out_of_memory(error) and not is_out_of_memory(error.__cause__):
            raise
        newest = newest_saved(checkpoints)
        state = f"The last good state is {newest}." if newest else "No checkpoint was written yet."
        raise NumericalError(
            f"The GPU's memory ended in step {step + 1}: {error} {state} Go on with the CPU (--resume --backend cpu), "
            "or start in another folder with a lower --max-gaussians."
        ) from error


class Clock:
    """Wall and CPU time of a run, over all its sessions, and its recent speed."""

    def __init__(self, step: int, seconds: float, cpu_seconds: float) -> None:
        self._began = time.perf_counter() - seconds
        self._cpu_began = time.process_time() - cpu_seconds
        self._reported, self._reported_step = time.perf_counter(), step
        self._rate = 0.0

    def seconds(self) -> float:
        return time.perf_counter() - self._began

    def cpu_seconds(self) -> float:
        return time.process_time() - self._cpu_began

    def spent(self) -> dict[str, float]:
        """Kept in a checkpoint, for the next session to go on from."""
        return {"seconds": self.seconds(), "cpu_seconds": self.cpu_seconds()}

    def is_due(self) -> bool:
        """True when progress was last reported long enough ago."""
        return time.perf_counter() - self._reported >= PROGRESS_SECONDS

    def rate(self, step: int) -> float:
        """Steps per second, averaged over the last few calls."""
        now = time.perf_counter()
        rate = (step - self._reported_step) / max(now - self._reported, 1e-9)
        self._rate = rate if self._rate == 0 else 0.7 * self._rate + 0.3 * rate
        self._reported, self._reported_step = now, step
        return self._rate


def _start(
    plan: RunPlan, scene: Scene, backend: Backend, directory: RunDirectory, guidance: RunGuidance | None, began: float
) -> tuple[Trainer, Clock]:
    """A trainer at step 0 or at the newest checkpoint, and the time already spent. `began`: in CPU seconds."""
    names = [view.name for view in scene.train]
    checkpoint = load_newest(directory.checkpoints, directory.warn)
    if checkpoint is None:
        if plan.cell.start:
            gaussians, init = load_splats(plan.cell.start), f"splats of {plan.cell.start}"
        else:
            gaussians, init = first_gaussians(scene, plan.init, plan.schedule.max_sh_degree, plan.seed)
        if len(gaussians) == 0:
            raise InputError(f"`{init}` made no Gaussians. Choose another --init.")
        directory.record(gaussians_init=init, train_views=names, origin=list(scene.origin), plan=plan.to_dict())
        trainer, spent = Trainer(plan, scene, gaussians, backend, guidance), (0.0, 0.0)
    else:
        if names != directory.recorded("train_views"):
            raise InputError(f"{scene.path} has other views than when the run began. Start in another folder.")
        trainer = Trainer.resumed(plan, scene, backend, checkpoint, guidance)
        spent = checkpoint.seconds("seconds"), checkpoint.seconds("cpu_seconds")
    directory.emit(
        "started",
        total=plan.schedule.iterations,
        step=trainer.step,
        pid=os.getpid(),
        backend=backend.name,
        device=str(backend.device),
        init=directory.recorded("gaussians_init"),
        n=len(trainer.model),
        train_views=len(names),
        test_views=len(scene.test),
        mirrors=sum(view.mirrored for view in scene.mirrored) // len(names),
        turns=sum(not view.mirrored for view in scene.mirrored) // len(names),
        guessed=len(scene.guessed),
        sparse=plan.sparse,
        guidance=directory.recorded("guidance"),
        estimate=directory.recorded("estimate"),
        setup_cpu_seconds=round(time.process_time() - began, 3),
    )
    for warning in scene.warnings + few_photo_warnings(scene):
        directory.warn(warning)
    return trainer, Clock(trainer.step, *spent)


def _report_masks(repaired: list[RepairedMask], directory: RunDirectory) -> None:
    """Records the masks that were repaired, and warns about each."""
    directory.record(repaired_masks=[mask.to_dict() for mask in repaired])
    for mask in repaired:
        directory.warn(mask.about)


def _advance(trainer: Trainer, directory: RunDirectory, stop: StopRequest, clock: Clock) -> bool:
    """Step until the end; True when asked to stop before it."""
    plan = trainer.plan
    if trainer.step > 0 and is_due(trainer.step, plan.preview_every) and not _preview_path(trainer, directory).exists():
        _preview(trainer, directory)  # the disk refused it, then took the checkpoint
    while not trainer.finished:
        if stop:
            return True
        with gpu_memory(trainer.step, directory.checkpoints):
            loss, view = trainer.advance()
        require_finite_loss(loss, view, trainer.step, directory.checkpoints)
        if trainer.step % FINITE_EVERY == 0:
            _check_finite(trainer, directory)
        try:
            if is_due(trainer.step, plan.preview_every):  # first: the steps before a checkpoint are not taken again
                _preview(trainer, directory)
            if clock.is_due() or trainer.finished:
                _report_progress(trainer, directory, clock)
        except InputError:  # the disk refused: keep the steps since the last checkpoint where it has room again
            _save(trainer, directory, clock)
            raise
        if is_due(trainer.step, plan.checkpoint_every):
            _save(trainer, directory, clock)
    return False


def is_due(step: int, every: int) -> bool:
    return every > 0 and step % every == 0


def _finish(trainer: Trainer, directory: RunDirectory, clock: Clock) -> None:
    """The last checkpoint and splat.ply."""
    _save(trainer, directory, clock)
    require_finite(trainer.result.items(), trainer.step, directory.checkpoints)
    save_ply(directory.path / "splat.ply", trainer.result.to("cpu"), antialiased=trainer.plan.antialiased)
    if trainer.poses is not None:
        write_atomic(directory.path / "poses.json", to_json(trainer.poses.record(trainer.scene.origin)))
    if trainer.exposure is not None:
        write_atomic(directory.path / "exposure.json", to_json(trainer.exposure.record()))


def _save(trainer: Trainer, directory: RunDirectory, clock: Clock) -> None:
    """A checkpoint, of finite numbers only."""
    _check_finite(trainer, directory)
    tensors, meta = trainer.state()
    save_checkpoint(directory.checkpoints, trainer.step, tensors, {**meta, **clock.spent()})


def _preview(trainer: Trainer, directory: RunDirectory) -> None:
    """The splats so far: written, closed, then announced."""
    _check_finite(trainer, directory)
    path = _preview_path(trainer, directory)
    save_ply(path, trainer.model.gaussians.to("cpu"), antialiased=trainer.plan.antialiased)
    directory.emit("preview", step=trainer.step, path=path.relative_to(directory.path).as_posix())


def _preview_path(trainer: Trainer, directory: RunDirectory) -> Path:
    return directory.previews / f"step_{trainer.step:06d}.ply"


def _report_progress(trainer: Trainer, directory: RunDirectory, clock: Clock) -> None:
    if trainer.means.loss is None:  # so far only mirror images were drawn
        return
    rate = clock.rate(trainer.step)
    left = trainer.plan.schedule.iterations - trainer.step
    psnr = trainer.means.psnr
    directory.emit(
        "progress",
        step=trainer.step,
        total=trainer.plan.schedule.iterations,
        loss=trainer.means.loss,
        psnr=None if psnr is None else round(psnr, 3),
        n=len(trainer.model),
        steps_per_second=round(rate, 3),
        eta_seconds=round(left / rate, 1) if rate > 0 else None,
        seconds=round(clock.seconds(), 3),
        cpu_seconds=round(clock.cpu_seconds(), 3),
    )


def _check_finite(trainer: Trainer, directory: RunDirectory) -> None:
    require_finite(trainer.model.gaussians.items(), trainer.step, directory.checkpoints)


def peak_memory_mb() -> float | None:
    """Largest resident set of this process so far, MB (10^6 bytes)."""
    with contextlib.suppress(OSError, ValueError, StopIteration):  # Linux; getrusage counts the parent's memory too
        lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
        return int(next(line for line in lines if line.startswith("VmHWM:")).split()[1]) * 1024 / 1e6
    try:
        import resource
    except ImportError:
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # KiB on Linux, bytes on macOS
    return peak * (1 if sys.platform == "darwin" else 1024) / 1e6
