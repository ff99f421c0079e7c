"""A run's folder while it is being written: who may write there, what stands in it first, what is told as it goes."""

from __future__ import annotations

import importlib.metadata
import json
import platform
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from gsopt._version import __version__
from gsopt.config.train import TrainConfig
from gsopt.errors import GsoptError, InputError, UsageError, refused, shortened
from gsopt.events import EventWriter, refuse_links, sweep, to_json, write_atomic

Listener = Callable[[Mapping[str, Any]], None]

# What a run leaves behind that must not be lost. A folder with config.json, events and a log alone holds no work.
WORK = (
    "splat.ply",
    "metrics.json",
    "report.html",
    "plan.json",
    "previews/*",
    "checkpoints/*.safetensors",
    "coarse/checkpoints/*.safetensors",
)
# Settings that may differ when a run is resumed: they do not change a bit of the result, but for backend and device, of
# which each has bits of its own: a run must not be lost with its GPU.
FREE = ("threads", "max_memory", "checkpoint_every", "preview_every", "data.cache_mb", "backend", "device")
PACKAGES = ("torch", "numpy", "pillow", "safetensors")


class RunDirectory:
    """One run's folder, open for writing. Every event goes to events.jsonl and to the listener."""

    def __init__(self, path: Path, writer: EventWriter, listener: Listener | None) -> None:
        self.path = path
        self.checkpoints = path / "checkpoints"
        self.previews = path / "previews"
        self.stop_file = path / "stop"
        self._writer = writer
        self._listener = listener

    def emit(self, kind: str, **fields: Any) -> None:
        event = self._writer.emit(kind, **fields)
        if self._listener is not None:
            self._listener(event)

    def warn(self, message: str) -> None:
        self.emit("warning", message=message)

    def record(self, **fields: Any) -> None:
        """Add to config.json what is known only once the data is read."""
        document = json.loads((self.path / "config.json").read_bytes())
        write_atomic(self.path / "config.json", to_json({**document, **fields}))

    def recorded(self, key: str) -> Any:
        """The value that `record` wrote under this key, in this process or an earlier one, or None."""
        return json.loads((self.path / "config.json").read_bytes()).get(key)


@contextmanager
def opened(path: Path, config: TrainConfig, resume: bool, listener: Listener | None) -> Iterator[RunDirectory]:
    """Create or re-open a run's folder; whatever ends the block early stands in events.jsonl as `error`.

    Raises UsageError when the folder holds another run, or when `resume` finds other settings than it started with.
    """
    make_folder(path)
    refuse_links(path)
    if not resume:
        refuse_another_run(path)
    writer = EventWriter(path)
    run = RunDirectory(path, writer, listener)
    try:
        _write_config(path, config, resume)
        run.stop_file.unlink(missing_ok=True)  # a request to an earlier run, which heeded it
        run.previews.mkdir(exist_ok=True)
        run.checkpoints.mkdir(exist_ok=True)
        folders = ("previews", "checkpoints", "guidance", "renders/test", "renders/train")
        # The lock is held: nobody else is writing.
        sweep(path, *(path / name for name in folders if (path / name).is_dir()))
        yield run
    except BaseException as error:
        run.emit("error", message=describe(error), exit_code=exit_code(error))
        raise
    finally:
        writer.close()


def make_folder(path: Path) -> None:
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"Cannot make the folder {path}: {error.strerror}. Choose another one.") from error


def refuse_another_run(path: Path) -> None:
    """Raise UsageError when the folder holds work that a new run would overwrite."""
    if work := work_in(path):
        raise UsageError(
            f"{path} holds another run ({work.relative_to(path)}). Add --resume to continue it, or name another folder."
        )


def work_in(path: Path) -> Path | None:
    """The first thing found in a folder that a new run would overwrite, or None."""
    return next((found for pattern in WORK for found in sorted(path.glob(pattern))), None)


def versions() -> dict[str, str]:
    """Versions of the software: a rerun with the same versions gives the same bits."""
    packages = {name: importlib.metadata.version(name) for name in PACKAGES}
    return {
        "gsopt": __version__,
        "python": platform.python_version(),
        **packages,
        "platform": f"{platform.system()} {platform.machine()}",
    }


def describe(error: BaseException) -> str:
    """One line for people: our own errors speak for themselves."""
    if isinstance(error, KeyboardInterrupt):
        return "interrupted; the last checkpoint can be resumed with --resume"
    if isinstance(error, OSError):
        return refused(error)
    return str(error) if isinstance(error, GsoptError) else f"{type(error).__name__}: {error}"


def exit_code(error: BaseException) -> int:
    if isinstance(error, KeyboardInterrupt):
        return 130
    if isinstance(error, OSError):
        return InputError.exit_code
    return error.exit_code if isinstance(error, GsoptError) else 1


def _write_config(path: Path, config: TrainConfig, resume: bool) -> None:
    """First thing in the folder. A resumed run keeps the one it has, which must be the same."""
    file = path / "config.json"
    if resume and file.exists():
        if difference := first_difference(TrainConfig.read(file).to_dict(), config.to_dict()):
            raise UsageError(
                f"{path} was started with other settings: {difference}. "
                "Resume with the settings in its config.json, or start in another folder."
            )
        return
    if resume and work_in(path):
        raise InputError(f"{path} has no config.json, so it cannot be resumed. Start in another folder.")
    document = {"config": config.to_dict(), "versions": versions(), "gaussians_init": None}
    write_atomic(file, to_json(document))


def first_difference(old: dict[str, Any], new: dict[str, Any], where: str = "") -> str | None:
    """Name and both values of the first setting that differs and matters, or None."""
    for key, value in old.items():
        name = f"{where}{key}"
        if name in FREE or new[key] == value:
            continue
        if not isinstance(value, dict):
            return f"`{name}` was {shortened(value)}, now {shortened(new[key])}"
        if inner := first_difference(value, new[key], f"{name}."):
            return inner
    return None
