"""The flags of `gsopt train`: a table from settings to flags; type, default, bounds and help stand in the setting."""

from __future__ import annotations

import ast
import functools
import inspect
import itertools
import re
import typing
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from tyro.conf import Positional, UseAppendAction, arg
from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    StructConstructorSpec,
    StructFieldSpec,
    StructTypeInfo,
)

from gsopt.config.presets import chosen, with_preset
from gsopt.config.train import TrainConfig
from gsopt.errors import SettingError, UsageError

FLAGS = {
    "iterations": "--iterations N",
    "data.masks": "--masks given|auto|none|DIR",
    "data.mask_model": "--mask-model FILE",
    "data.features": "--features",
    "data.depth": "--depth DIR",
    "data.depth_kind": "--depth-kind",
    "data.views": "--views N",
    "data.view_ids": "--view-ids I,J,...",
    "data.downscale": "--resolution -r",
    "data.eval": "--eval",
    "data.background": "--background",
    "data.cache_mb": "--cache-mb",
    "init.method": "--init",
    "init.count": "--init-count",
    "density.strategy": "--strategy",
    "density.max_gaussians": "--max-gaussians N",
    "guidance.lambda_sds": "--lambda-sds W",
    "guidance.prior": "--prior PRIOR",
    "guidance.prompt": "--prompt TEXT",
    "guidance.negative": "--negative TEXT",
    "guidance.prompts": "--prompts FILE",
    "guidance.ref_image": "--ref-image FILE",
    "poses.refine": "--refine-poses",
    "exposure.learn": "--exposure",
    "cells": "--cells auto|N",
    "max_memory": "--max-memory 8GB",
}
"""Flag, short form and metavar of a setting; every other one is its own flag: --optimizer.lr-last."""
POSITIONAL = "data.path"
SECTIONS = {hint: name for name, hint in typing.get_type_hints(TrainConfig).items() if is_dataclass(hint)}


@dataclass(frozen=True)
class Flags:
    """Learn Gaussians from the posed images in DATA and write splats, metrics and a report to a run directory."""

    data: Annotated[Positional[Path | None], arg(metavar="DATA")] = None
    """Dataset folder: NeRF-synthetic, nerfstudio/instant-ngp, COLMAP, LLFF or IDR; or photos or a video (see gsopt
    sfm)."""
    source_path: Annotated[Path | None, arg(aliases=["-s"], metavar="DATA")] = None
    """The same as DATA, for those who know Inria's train.py."""
    run: Annotated[Path | None, arg(aliases=["-m", "--model-path"], metavar="RUN")] = None
    """Folder to write to; by default the first free runs/<dataset>-<n>."""
    resume: bool = False
    """Continue the run in that folder from its newest checkpoint, with the same result as if it had never stopped."""
    vgg: bool = False
    """Also compute LPIPS (VGG) on the held-out views, at many times the cost of the rest; needs its weights."""
    white_background: Annotated[bool, arg(aliases=["-w"])] = False
    """The same as --background white."""
    farm: Annotated[str, arg(metavar="local[:CORES]|ray[://HOST:PORT]")] = "local"
    """Machines of the runs of `--cells`; one at a time on this one when not given."""
    settings: Annotated[TrainConfig, arg(name="")] = field(default_factory=TrainConfig)


def parse(argv: Sequence[str]) -> Flags:
    """The flags in `argv`; what they leave open is the preset's. Leaves the program after --help or a wrong flag."""
    registry = ConstructorRegistry()
    registry.struct_rule(_settings_rule)
    start = Flags(settings=with_preset(TrainConfig(), chosen(argv)))
    return tyro.cli(Flags, default=start, prog="gsopt train", args=list(argv), registry=registry)


@contextmanager
def flags_in_errors() -> Iterator[None]:
    """Errors about a setting name the flag that sets it."""
    try:
        yield
    except SettingError as error:
        raise UsageError(re.sub(r"`([\w.]+)`", lambda name: f"`{flag_of(name[1])}`", str(error))) from error


def flag_of(setting: str) -> str:
    """The flag that sets a setting: --resolution for data.downscale."""
    return FLAGS.get(setting, f"--{setting.replace('_', '-')}").split()[0]


def read_ids(text: str) -> tuple[int, ...]:
    """2,16,26 as numbers."""
    try:
        return tuple(int(part) for part in text.replace(",", " ").split())
    except ValueError as error:
        raise UsageError(f"`--view-ids` must be whole numbers and commas, got {text!r}. Try 2,16,26.") from error


def _settings_rule(info: StructTypeInfo) -> StructConstructorSpec | None:
    """tyro's view of TrainConfig and its sections."""
    if info.type is not TrainConfig and info.type not in SECTIONS:
        return None
    section, hints = SECTIONS.get(info.type, ""), typing.get_type_hints(info.type)
    flags = []
    for item in fields(info.type):
        name = f"{section}.{item.name}" if section else item.name
        if name == POSITIONAL:
            continue
        hint, default = _flag_type(name, hints[item.name]), getattr(info.default, item.name)
        if name == "iterations":  # given ones hold for few views too, those of a preset do not
            hint, default = Annotated[int | None, *typing.get_args(hint)[1:]], None
        flags.append(StructFieldSpec(item.name, hint, default, functools.partial(_docstring, info.type, item.name)))
    return StructConstructorSpec(TrainConfig.of if info.type is TrainConfig else info.type, tuple(flags))


def _flag_type(setting: str, hint: Any) -> Any:
    """The type of a setting with what tyro must know about its flag."""
    if setting in ("data", "init"):
        return Annotated[hint, arg(name="")]
    if setting not in FLAGS:
        return hint
    words = FLAGS[setting].split()
    metavar = next((word for word in words if not word.startswith("-")), None)
    aliases = [word for word in words[1:] if word.startswith("-")]
    flag = arg(name=words[0].removeprefix("--"), prefix_name=False, aliases=aliases, metavar=metavar)
    if hint == tuple[str, ...]:
        return Annotated[hint, UseAppendAction, flag]
    return Annotated[hint, _view_ids(), flag] if setting == "data.view_ids" else Annotated[hint, flag]


def _view_ids() -> PrimitiveConstructorSpec[Any]:
    """2,16,26 as one word."""
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="I,J,...",
        instance_from_str=lambda words: read_ids(words[0]),
        is_instance=lambda value: value is None or isinstance(value, tuple),
        str_from_instance=lambda ids: [",".join(map(str, ids)) if ids else "None"],
    )


def _docstring(cls: type, name: str) -> str | None:
    """The docstring of a field, read when it is printed."""
    return _docstrings(cls).get(name)


@functools.cache
def _docstrings(cls: type) -> dict[str, str]:
    """The docstring of each field, on one line."""
    body = ast.parse(inspect.getsource(cls)).body[0].body  # type: ignore[attr-defined]
    return {
        ast.unparse(node.target): " ".join(ast.literal_eval(text.value).split())
        for node, text in itertools.pairwise(body)
        if isinstance(node, ast.AnnAssign) and isinstance(text, ast.Expr)
    }
