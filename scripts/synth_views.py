"""Render multi-view datasets from meshes with Blender: posed images, depth, normals, masks, points and captions.

Either with the `bpy` wheel (`pip install bpy`) or inside Blender 4.2 or newer:

    python scripts/synth_views.py chair.glb -o data --views 24 --depth --format nerf,colmap
    blender -b -P scripts/synth_views.py -- chair.glb -o data --views 24 --depth --format nerf,colmap

Every object becomes a folder of `data` that `gsopt train` takes; docs/howto/synth_views.md tells what is in it.
`synth.render_object.render_object` renders one object, `synth.render_dataset.run` a list; both import without bpy.
"""

from __future__ import annotations

import argparse
import signal
import sys
from collections.abc import Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from types import FrameType
from typing import Any, get_args

# Blender's own Python knows neither this folder nor the project; the script runs from a checkout.
sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
sys.path.insert(0, str(Path(__file__).resolve().parent))

from synth import mesh_items
from synth.render_dataset import run
from synth.render_object import require_blender
from synth.settings import Engine, Layout, Lighting, Normalize, Settings
from synth.worker_pool import serve

from gsopt import check
from gsopt.errors import GsoptError, InputError, UsageError, refused
from gsopt.farm.open import available_cores, open_farm

INTERRUPTED = 130


def own_arguments(argv: Sequence[str]) -> list[str]:
    """Returns the arguments of this script: all after `--` inside Blender, all after the script's name otherwise."""
    if "--" in argv:
        return list(argv[argv.index("--") + 1 :])
    return list(argv[1:]) if argv and argv[0].endswith(".py") else []


def make_parser() -> argparse.ArgumentParser:
    default = Settings()
    parser = argparse.ArgumentParser(prog="synth_views.py", description="Render multi-view datasets from meshes.")

    def setting(flag: str, meaning: str, **options: Any) -> None:
        name = options.pop("dest", flag[2:].replace("-", "_"))
        parser.add_argument(flag, dest=name, default=getattr(default, name), help=meaning, **options)

    what = parser.add_argument_group("what")
    what.add_argument("meshes", nargs="*", type=Path, metavar="MESH", help="OBJ GLB GLTF PLY STL FBX BLEND or folder")
    what.add_argument("--shapenet", type=Path, metavar="ROOT", help="ShapeNetCore v1 or v2: ROOT/synset/model")
    what.add_argument("--synsets", type=comma_list, default=(), metavar="ID,...", help="of ShapeNet; default: all")
    what.add_argument("--manifest", type=Path, metavar="FILE", help=".json, .jsonl or .csv, a mesh a row")
    what.add_argument("--limit", type=int, metavar="N", help="only the first N objects")
    parser.add_argument("-o", "--out", type=Path, required=True, help="folder for the objects; new, or with --resume")
    setting("--views", "input views", type=int)
    setting("--test-views", "held-out views", type=int)
    setting("--val-views", "more held-out views", type=int)
    setting("--resolution", "px: 256, or 320x240 for width and height", type=pixels)
    setting("--layout", "where the cameras stand", choices=get_args(Layout))
    setting("--elevations", "degrees; own of each layout", type=float, nargs=2, metavar=("LOW", "HIGH"))
    setting("--cameras", "poses of --layout file, as transforms.json", dest="camera_file", metavar="FILE")
    setting("--radius", "camera distance; by default the object just fits the frame", type=float)
    setting("--fov", "horizontal field of view, degrees", type=float)
    setting("--lens-jitter", "share by which focal length and principal point vary from view to view", type=float)
    setting("--samples", "light paths per pixel", type=int)
    setting("--engine", "cycles, or workbench for a quick draft", choices=get_args(Engine))
    setting("--lighting", "studio, flat, or: hdri FILE", choices=get_args(Lighting))
    setting("--hdri", argparse.SUPPRESS)
    setting("--background", "transparent, white, black, gray or #rrggbb", metavar="COLOR")
    setting("--normalize", "fill the unit sphere or the unit cube", choices=get_args(Normalize))
    setting("--format", "nerf,nerfstudio,colmap: one or several", type=comma_list, dest="formats", metavar="NAME,...")
    setting("--points", "colored surface samples for PLY and COLMAP", type=int, metavar="N")
    for flag, meaning in (
        ("--depth", "camera z, float32 .npy"),
        ("--normals", "world normals, float16 .npy"),
        ("--masks", "hard and soft masks, PNG"),
        ("--position", "world positions, float32 .npy"),
        ("--captions", "captions.json"),
        ("--preview", "a contact sheet per object"),
    ):
        setting(flag, meaning, action="store_true")
    parser.add_argument("--seed", type=int, default=0, help="turns the cameras, jitters the lens, seeds the noise")
    parser.add_argument("--workers", type=int, default=1, help="Blender processes; the files do not depend on it")
    setting("--threads", "per worker; 0: the cores, shared among the workers", type=int)
    parser.add_argument("--farm", default="local", metavar="local|ray[://HOST:PORT]", help="where the workers run")
    parser.add_argument("--memory-limit", metavar="8GB", help="memory that a worker may hold")
    parser.add_argument("--time-limit", type=float, default=3600.0, metavar="S", help="seconds an object may take")
    parser.add_argument("--resume", action="store_true", help="go on with the run in --out")
    return parser


def with_hdri(arguments: Sequence[str]) -> list[str]:
    """`--lighting hdri FILE`, the one choice that takes a file, as argparse can read it."""
    words = list(arguments)
    for at, (flag, choice, file) in enumerate(zip(words, words[1:], words[2:], strict=False)):
        if (flag, choice) == ("--lighting", "hdri") and not file.startswith("-"):
            return [*words[: at + 2], "--hdri", *words[at + 2 :]]
    return words


def comma_list(text: str) -> tuple[str, ...]:
    return tuple(part.strip() for part in text.split(",") if part.strip())


def pixels(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    if not width.isdecimal() or not (height or width).isdecimal():
        raise argparse.ArgumentTypeError(f"give pixels as 256, or 320x240 for width and height, got {text!r}")
    return int(width), int(height or width)


def parse(arguments: Sequence[str]) -> tuple[list[mesh_items.Item], Settings, dict[str, Any]]:
    """Items, settings and the other arguments of `render_dataset.run` from the command line."""
    words = with_hdri(arguments)
    given = vars(make_parser().parse_intermixed_args(words))
    sources = [mesh_items.of_paths(given.pop("meshes"))]
    shapenet, synsets, manifest = (given.pop(name) for name in ("shapenet", "synsets", "manifest"))
    if synsets and not shapenet:
        raise UsageError(f"`--synsets` chooses from `--shapenet ROOT`, got {','.join(synsets)} without. Give both.")
    sources += [mesh_items.of_shapenet(shapenet, synsets)] if shapenet else []
    sources += [mesh_items.of_manifest(manifest)] if manifest else []
    limit = given.pop("limit")
    check.at_least("--limit", 1 if limit is None else limit, 1, "Drop the flag to render all.")
    how = {name: given.pop(name) for name in ("seed", "out", "resume", "time_limit")}
    farm, workers, memory = (given.pop(name) for name in ("farm", "workers", "memory_limit"))
    check.within("--seed", how["seed"], 0, 2**31 - 1, "Any whole number from 0 on will do.")
    check.within("--workers", workers, 1, 1024, "One per core is a good start.")
    check.at_least("--time-limit", how["time_limit"], 1.0, "Give seconds.")
    given["elevations"] = tuple(given["elevations"]) if given["elevations"] else None
    settings = Settings(**given)
    if not settings.threads:
        settings = replace(settings, threads=max(1, available_cores() // workers))
    how["memory_limit"] = check.byte_count("--memory-limit", memory) if memory else None
    how["farm"] = open_farm(farm, workers * settings.threads)
    chosen = islice((item for source in sources for item in source), limit)
    return mesh_items.unique(chosen), settings, how


def stop(signum: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt


def main(argv: Sequence[str]) -> int:
    arguments = own_arguments(argv)
    if arguments == ["--worker"]:
        serve()
    signal.signal(signal.SIGTERM, stop)
    try:
        chosen, settings, how = parse(arguments)
        require_blender()
        return run(chosen, settings, **how)
    except GsoptError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    except OSError as error:
        print(f"error: {refused(error)} The same command with --resume goes on.", file=sys.stderr)
        return InputError.exit_code
    except KeyboardInterrupt:
        print("Interrupted. The same command with --resume goes on.", file=sys.stderr)
        return INTERRUPTED


if __name__ == "__main__":
    sys.exit(main(sys.argv))
