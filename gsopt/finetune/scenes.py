"""The posed scenes that a prior is trained on and evaluated on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from gsopt import check
from gsopt.data.scene import is_posed
from gsopt.errors import InputError, UsageError
from gsopt.sds.priors.view_conditioned import side_multiple


@dataclass(frozen=True)
class TrainingScenes:
    """Training scenes, held-out scenes, and how often each is reconstructed."""

    train: tuple[Path, ...]
    val: tuple[Path, ...]
    """Held out: used for evaluation only."""
    reconstructions: int = 3
    size: int = 128
    """Side of the renders, px."""
    seed: int = 0

    def __post_init__(self) -> None:
        check.at_least("--fits", self.reconstructions, 1, "3 is usual.")
        check.within("--size", self.size, 64, 512, "The default is 128.")
        if self.size % side_multiple():
            near = round(self.size / side_multiple()) * side_multiple()
            raise UsageError(f"`--size` must be a multiple of {side_multiple()}, got {self.size}. Try {near}.")


def find_scenes(roots: Sequence[Path], val: Sequence[str]) -> tuple[tuple[Path, ...], tuple[Path, ...]]:
    """Returns training scenes and held-out scenes (named by `val`, else every tenth) among and below `roots`."""
    found: dict[str, Path] = {}
    for path in (p for root in roots for p in (root, *sorted(root.iterdir() if root.is_dir() else ())) if _is_scene(p)):
        if found.setdefault(path.name, path) != path:
            raise UsageError(f"{found[path.name]} and {path} have the same name. Rename one, or give only one of them.")
    unknown = [name for name in val if name not in found]
    if unknown:
        raise UsageError(f"`--val` names {unknown[0]!r}, which is none of the {len(found)} scenes found. Correct it.")
    names = sorted(found)
    held = list(val) or names[9::10]
    train = tuple(found[name] for name in names if name not in held)
    if not train:
        raise InputError(
            f"No posed scene to train on in {', '.join(map(str, roots))}. Give folders with transforms.json or "
            "COLMAP models, or a folder of such folders (scripts/synth_views.py makes them)."
        )
    return train, tuple(found[name] for name in held)


def _is_scene(path: Path) -> bool:
    return path.is_dir() and is_posed(path)
