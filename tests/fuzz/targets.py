"""The fuzzer calls every reader of bytes that a stranger may have written; each has a law and first inputs."""

from __future__ import annotations

import json
import tempfile
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

from ksplat_files import ksplat
from splat_laws import reads_or_refuses, require_short
from tiny_scenes import cloud, write_dataset
from usd_forks import in_forks
from usd_seeds import usd_binaries, usd_texts

from blender_addon.core import cameras, colmap, job, ply, spz
from blender_addon.core import prompts as panel_prompts
from blender_addon.core.errors import GsoptError as PanelError
from blender_addon.core.run_follower import Follower
from gsopt.benchmark.suite import definition
from gsopt.config.train import TrainConfig
from gsopt.data import colmap_files, pointcloud, transforms
from gsopt.errors import GsoptError
from gsopt.events import read_events
from gsopt.formats import SUFFIXES, save_splats
from gsopt.formats.units import read_units
from gsopt.llm_prompts.expand import PromptSpec
from gsopt.llm_prompts.reply import read_reply
from gsopt.llm_prompts.tokens import ESTIMATED_COUNTER
from gsopt.results.report import write_report
from gsopt.sds.prompts import Prompt, PromptSet, read_set, write_set
from gsopt.training.checkpoint import read_checkpoint, save_checkpoint

Law = Callable[[Path], None]


@dataclass(frozen=True)
class Target:
    """A reader, the law it keeps, and its first inputs."""

    file: str
    """Name of the file that it reads."""
    law: Law
    seeds: Callable[[Path], list[bytes]]
    """Valid inputs, made in a scratch folder."""
    beside: Mapping[str, bytes] = field(default_factory=dict)
    """Other files of the folder, by name."""


def clear(read: Callable[[Path], object], errors: type[Exception] = GsoptError) -> Law:
    """The law of readers: a file is read, or refused in a message of bounded length. Any other exception breaks it."""

    def law(path: Path) -> None:
        try:
            read(path)
        except errors as error:
            require_short(error, path)

    return law


def never_raises(path: Path) -> None:
    """The law of an LLM's reply: any text is parsed without an exception."""
    answer = path.read_bytes().decode("utf-8", "replace")
    prompts = read_reply(answer, PromptSpec("worn oak chair", "chair", 8, 2), "llm:a", ESTIMATED_COUNTER, ()).prompts
    assert all(prompt.text.isprintable() for prompt in prompts)


def report(path: Path) -> object:
    """This target writes the report of a run without splats or dataset."""
    return write_report(path.parent)


def report_of_parts(path: Path) -> object:
    """This target writes a report whose guidance, library, shape prior and poses are all described by its input."""
    run = path.parent / "run"
    for part in ("guidance/summary.json", "library/summary.json", "shape_prior/summary.json", "poses.json"):
        (run / part).parent.mkdir(parents=True, exist_ok=True)
        (run / part).write_bytes(path.read_bytes())
    (run / "config.json").write_bytes(SHORT_CONFIG)
    return write_report(run)


def follow(path: Path) -> object:
    """This target does what the panel does with the events of a run."""
    return Follower(path.parent).poll()


def usd(path: Path) -> None:
    """The law of splats and the law of readers for the notes of a layer."""
    with in_forks():
        reads_or_refuses(path)
        clear(read_units)(path)


def padded_ksplat(path: Path) -> None:
    """This target fills the headers of a .ksplat up with zeros, 5 kB that no reader looks at, and reads that."""
    data = path.read_bytes()
    whole = path.with_name("a.ksplat")
    whole.write_bytes(data[:48].ljust(4096, b"\0") + data[48:96].ljust(1024, b"\0") + data[96:])
    reads_or_refuses(whole)


def short_ksplats(folder: Path) -> list[bytes]:
    """Files of every level of compression, without the empty part of their headers."""
    return [whole[:48] + whole[4096:4144] + whole[5120:] for whole in (ksplat(level, 3, 1) for level in range(3))]


@cache
def sog_members() -> dict[str, bytes]:
    """The files of a valid .sog."""
    with tempfile.TemporaryDirectory() as folder:
        save_splats(Path(folder, "a.sog"), cloud(3, seed=0))
        with zipfile.ZipFile(Path(folder, "a.sog")) as archive:
            return {name: archive.read(name) for name in archive.namelist()}


def packed_sog(path: Path) -> None:
    """This target puts its input into a valid .sog, with the checksum that no change of the archive's bytes keeps."""
    whole = path.with_name("a.sog")
    with zipfile.ZipFile(whole, "w") as archive:
        for name, data in {**sog_members(), path.name: path.read_bytes()}.items():
            archive.writestr(name, data)
    reads_or_refuses(whole)


def in_a_sog(name: str) -> Target:
    return Target(name, packed_sog, lambda folder: [sog_members()[name]])


def saved(suffix: str) -> Callable[[Path], list[bytes]]:
    def seeds(folder: Path) -> list[bytes]:
        path = folder / f"seed{suffix}"
        save_splats(path, cloud(3, seed=0))
        return [path.read_bytes()]

    return seeds


def dataset(name: str) -> Callable[[Path], list[bytes]]:
    return lambda folder: [(write_dataset(folder / "scene", 1, 1) / name).read_bytes()]


def checkpoint(folder: Path) -> list[bytes]:
    return [save_checkpoint(folder, 1, dict(cloud(2, seed=0).items()), {"seconds": 1.0}).read_bytes()]


def prompt_file(folder: Path) -> list[bytes]:
    write_set(folder / "prompts.json", PromptSet((Prompt("a worn oak chair", source="user"),)))
    return [(folder / "prompts.json").read_bytes()]


def texts(*lines: str) -> Callable[[Path], list[bytes]]:
    return lambda folder: [line.encode() for line in lines]


EVENTS = (
    '{"v": 1, "seq": 0, "kind": "started", "total": 30, "step": 0, "pid": 1, "n": 5}\n'
    '{"v": 1, "seq": 1, "kind": "progress", "step": 3, "total": 30, "loss": 0.1, "psnr": 20.0, "n": 5}\n'
    '{"v": 1, "seq": 2, "kind": "preview", "step": 5, "path": "previews/step_000005.ply"}\n'
    '{"v": 1, "seq": 3, "kind": "done", "step": 30, "n": 5, "seconds": 1.0}\n'
)
METRICS = (
    '{"protocol": {}, "mean": {"psnr": 20.0}, "views": [{"name": "a.png", "psnr": 20.0}]}',
    '{"mean": {"psnr": 20.0, "lpips_vgg": null}, "per_view": [{"name": "a", "psnr": 9}], "notes": ["b"], '
    '"reason": "c", "protocol": "d", "n_gaussians": 5, "steps": 30, "train_seconds": 1.5, "peak_memory_mb": 300}',
    '{"train": {"mean": {"psnr": 20}, "per_view": [{"name": "a", "ssim": 0.9}]}}',
)
TROUBLE = (
    '{"v": 1, "seq": 0, "kind": "progress", "step": 9, "seconds": 2.0, "loss": 0.2, "n": 5}\n'
    '{"v": 1, "seq": 1, "kind": "progress", "step": 3, "seconds": null, "loss": 0.1, "psnr": 20.0}\n'
    '{"v": 1, "seq": 2, "kind": "warning", "message": "slow"}\n{"v": 1, "seq": 3, "kind": "error", "message": "no"}\n'
)
PARTS = (
    '{"guided": 3, "wanted": 4, "decided": 1, "failed": 1, "ended": true, "model": "a", "policy": "b", '
    '"lambda_sds": 0.1, "guard": {"factor": 0.5, "reason": "c"}, "views": [0], '
    '"samples": [{"step": 5, "text": "a chair"}]}',
    '{"views": [{"turned_degrees": 0.5}, {"turned_degrees": 1}], "texts": ["a chair"], "entries": 7, "library": "a", '
    '"shapes": [{"name": "a", "id": "b", "share": 0.5, "agreement": 0.9, "words": 1, "creator": "c", "license": "d"}]}',
    '{"words": ["chair"], "unknown_words": ["chaise"], "prior": "a", "digest": "b"}',
)
JOB = json.dumps(
    {
        "version": job.VERSION,
        "kind": "train",
        "folder": "",
        "product": "",
        "identity": "",
        "arguments": ["python", "-m", "gsopt"],
        "pid": 1,
        "total": 10,
        "started": 1.0,
    }
)
REPLY = (
    '{"all": [{"text": "a worn oak chair with four legs", "why": "use"}], "negative": [{"text": "blurry", "why": ""}]}'
)
CAMERAS = "# cameras\n1 PINHOLE 24 24 30 30 12 12\n2 SIMPLE_RADIAL 24 24 30 12 12 0.1\n"
IMAGES = "# images\n1 1 0 0 0 0 0 3 1 a.png\n0 0 -1\n"
POINTS = "# points\n1 0 0 0 255 0 0 0.5 1 0\n"
SUITE = (Path(definition.__file__).parent.parent / "suites" / "smoke.toml").read_text(encoding="utf-8")

CONFIG = json.dumps({"config": TrainConfig().to_dict()}).encode()
SHORT_CONFIG = b'{"config": {}}'
RECORDED = '{"config": {}, "gaussians_init": 5, "symmetry": [{"about": "a"}], "versions": {"gsopt": "1"}, "seeds": {}}'

TARGETS = {
    **{f"splats{suffix}": Target(f"a{suffix}", reads_or_refuses, saved(suffix)) for suffix in SUFFIXES},
    "splats.usda": Target("a.usda", usd, lambda folder: saved(".usda")(folder) + usd_texts(folder)),
    "splats.usdc": Target("a.usdc", usd, lambda folder: saved(".usdc")(folder) + usd_binaries(folder)),
    "sog meta.json": in_a_sog("meta.json"),
    "sog means": in_a_sog("means_l.webp"),
    "splats.ksplat": Target("short.ksplat", padded_ksplat, short_ksplats),
    "points.ply": Target("points.ply", clear(pointcloud.read_points_ply), saved(".ply")),
    "transforms.json": Target(
        "transforms_train.json",
        clear(lambda path: transforms.read_transforms(path.parent)),
        dataset("transforms_train.json"),
    ),
    "cameras.txt": Target("cameras.txt", clear(colmap_files.read_cameras), texts(CAMERAS)),
    "images.txt": Target("images.txt", clear(colmap_files.read_images), texts(IMAGES)),
    "points3D.txt": Target("points3D.txt", clear(colmap_files.read_points), texts(POINTS)),
    "cameras.bin": Target("cameras.bin", clear(colmap_files.read_cameras), texts("\1" + "\0" * 7 + "\1" + "\0" * 60)),
    "images.bin": Target("images.bin", clear(colmap_files.read_images), texts("\1" + "\0" * 80)),
    "points3D.bin": Target("points3D.bin", clear(colmap_files.read_points), texts("\1" + "\0" * 80)),
    "config.json": Target("config.json", clear(TrainConfig.read), lambda folder: [CONFIG]),
    "events.jsonl": Target("events.jsonl", clear(read_events), texts(EVENTS)),
    "report of metrics.json": Target("metrics.json", clear(report), texts(*METRICS), {"config.json": SHORT_CONFIG}),
    "report of events.jsonl": Target(
        "events.jsonl", clear(report), texts(EVENTS, TROUBLE), {"config.json": SHORT_CONFIG}
    ),
    "report of config.json": Target("config.json", clear(report), texts(RECORDED)),
    "report of parts": Target("parts.json", clear(report_of_parts), texts(*PARTS)),
    "checkpoint": Target("step_000001.safetensors", clear(read_checkpoint), checkpoint),
    "prompts.json": Target("prompts.json", clear(read_set), prompt_file),
    "reply": Target("reply.txt", never_raises, texts(REPLY)),
    "suite.toml": Target("own.toml", clear(lambda path: definition.load(str(path))), texts(SUITE)),
    "panel splats.ply": Target("a.ply", clear(ply.read_ply, PanelError), saved(".ply")),
    "panel splats.spz": Target("a.spz", clear(spz.read_spz, PanelError), saved(".spz")),
    "panel prompts.json": Target("prompts.json", clear(panel_prompts.read_prompts, PanelError), prompt_file),
    "panel job.json": Target(job.RECORD, clear(lambda path: job.read_job(path.parent), PanelError), texts(JOB)),
    "panel events.jsonl": Target("events.jsonl", clear(follow, PanelError), texts(EVENTS)),
    "panel transforms.json": Target(
        "transforms_train.json",
        clear(lambda path: cameras.from_transforms(path, "train"), PanelError),
        dataset("transforms_train.json"),
    ),
    "panel cameras.bin": Target(
        "cameras.bin",
        clear(lambda path: colmap.read_pictures(path.parent), PanelError),
        texts("\1" + "\0" * 7 + "\1" + "\0" * 3 + "\1" + "\0" * 60),
        {"images.bin": b"\0" * 8},
    ),
}


def place(target: Target, folder: Path) -> Path:
    """Writes the other files and returns the path of the input."""
    for name, content in target.beside.items():
        (folder / name).write_bytes(content)
    return folder / target.file


def seeds_of(target: Target) -> list[bytes]:
    """Valid inputs of a target."""
    with tempfile.TemporaryDirectory() as folder:
        return target.seeds(Path(folder))
