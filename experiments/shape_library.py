"""What is a shape library worth where one photo shows an object: with words, with wrong words, without?

    python experiments/shape_library.py SCENES... [-o FILE.json] [--seeds 1] [--jobs 2]
    python experiments/shape_library.py SCENES... --arms template "language model" --llm URL --model NAME

SCENES are posed scenes of objects with alpha and held-out views, or folders of them. A seed is a choice of the photo,
as in few_photos.py. The arms see the same photo: not inflated, inflated (the rules), the library with the object's
name, with the name of another thing, without words, without words or entries that a word for the object finds, and
with the prompts that the template or a language model makes of an expert's notes (suite_notes.json; the template steps
in where the model writes nothing usable). Prompts are written once per object. Runs that have a record in FILE are not
made again. The table (held-out PSNR and LPIPS over the rules) is printed.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from few_photos import photos, scenes

from gsopt.benchmark.machine import machine
from gsopt.events import to_json, write_atomic
from gsopt.shape_library.library_file import BUNDLED, ShapeLibrary, packed, write_library
from gsopt.shape_library.words import word_scores

RESULT = Path(__file__).parent / "results" / "shape_library.json"
RIGHT, WRONG, SILENT, NONE_LEFT = "right words", "wrong words", "no words", "no words, category taken out"
TEMPLATE, MODEL = "template", "language model"
ARMS = ("photo alone", "rules", RIGHT, WRONG, SILENT, NONE_LEFT, TEMPLATE, MODEL)
NOTES = Path(__file__).parent / "suite_notes.json"
SMALL_MODELS = Path(__file__).parents[1] / "docs" / "howto" / "prompts" / "small-models.md"
METRICS = ("psnr", "ssim", "lpips_alex")
WORDS = {
    "bonsai-tree": ("a bonsai tree", "a chair"),
    "dafTruck": ("a truck", "a dog"),
    "doll": ("a doll", "a bottle"),
    "hamburger": ("a hamburger", "a lamp"),
    "medicoscopia_bottle2": ("a medicine bottle", "a horse"),
    "oakChair": ("an oak chair", "a bottle"),
    "old_jar": ("an old jar", "a truck"),
    "reflex_camera": ("a reflex camera", "a bed"),
    "shopping-basket": ("a shopping basket", "a man"),
    "siameseCat": ("a Siamese cat", "a table"),
    "sneakers": ("a pair of sneakers", "a vase"),
    "sofa3": ("a sofa", "a bicycle"),
    "stoneLantern": ("a stone lantern", "a sofa"),
    "table_lamp": ("a table lamp", "a car"),
    "teapot": ("a teapot", "a chair"),
    "teddyBear": ("a teddy bear", "a bookcase"),
    "basketball": ("a basketball", "a bottle"),
    "bulldog": ("a bulldog", "a chair"),
    "chair": ("an upholstered chair", "a potted plant"),
    "cup": ("a cup on a saucer", "a lamp"),
    "kitchenChair": ("a white kitchen chair", "a sofa"),
    "lantern": ("a stone lantern", "a chair"),
    "rabbit": ("a white rabbit", "a table"),
    "vase3": ("a vase with a long neck", "a man"),
}
"""Each object's name, as anybody would say it, and the name of another thing; written before any run."""


def written_prompts(arm: str, scene: str, options: argparse.Namespace) -> Path:
    """The prompts of an arm for an object, written by its first run."""
    path: Path = options.prompts / f"{scene}-{arm.replace(' ', '-')}.json"
    if not path.exists():
        notes = json.loads(NOTES.read_text())[f"objects/{scene}"]["notes"]
        command = [sys.executable, "-m", "gsopt", "prompts", "--notes", notes, "--prior", "library", "-o", str(path)]
        asked = ["--llm", options.llm, "--model", options.model, "--timeout", "900", "--fallback"]
        asked += ["--domain", str(SMALL_MODELS), "-n", "3", "--negatives", "0"]
        subprocess.run([*command, *(asked if arm == MODEL else [])], check=True, stdout=subprocess.DEVNULL)
    return path


def flags(arm: str, scene: str, folder: Path, options: argparse.Namespace) -> list[str]:
    """The flags of an arm."""
    if arm == "photo alone":
        return ["--sparse.inflate", "off", "--lambda_sds", "0"]
    if arm == "rules":
        return ["--lambda_sds", "0"]
    if arm in (TEMPLATE, MODEL):
        return ["--prior", "library", "--prompts", str(written_prompts(arm, scene, options))]
    right, wrong = WORDS[scene]
    prior = "library" if arm != NONE_LEFT else f"library:{without(right, folder)}"
    words = {RIGHT: ["--prompt", right], WRONG: ["--prompt", wrong]}.get(arm, [])
    return ["--prior", prior, *words]


def without(words: str, folder: Path) -> Path:
    """The bundled library without every entry that the words find at all."""
    library, out = ShapeLibrary(BUNDLED), folder / "without.safetensors"
    scores = word_scores(library.entries, [words])
    rows = [row for row, score in enumerate(scores) if score == 0]
    shapes = [library.shape(row) for row in rows]
    streams, sizes = [packed(shape) for shape in shapes], [shape.sizes for shape in shapes]
    write_library(out, [library.entries[row] for row in rows], streams, sizes)
    return out


def run(scene: Path, seed: int, arm: str, options: argparse.Namespace) -> dict[str, Any]:
    """One run in a process of its own, and its held-out figures."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        command = [sys.executable, "-m", "gsopt", "train", str(scene), "-m", f"{folder}/run", "--threads", "1"]
        command += ["--view-ids", str(photos(scene, 1, seed)[0]), "--seed", str(seed), "--checkpoint-every", "0"]
        command += ["--preview-every", "0", *flags(arm, scene.name, folder, options)]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        metrics = json.loads((folder / "run" / "metrics.json").read_text())
        config = json.loads((folder / "run" / "config.json").read_text())
    found = [{key: one[key] for key in ("id", "name", "share")} for one in config.get("library", {}).get("shapes", [])]
    figures = {name: metrics["mean"][name] for name in METRICS}
    record = {"scene": scene.name, "seed": seed, "arm": arm, **figures, "shapes": found[:3]}
    return {**record, "cpu_seconds": metrics["train_cpu_seconds"]}


def table(runs: list[dict[str, Any]]) -> str:
    """A row per object, seeds averaged, and the paired means with their standard errors over objects."""
    lines = ["| object | photo alone, dB | rules | " + " | ".join(ARMS[2:]) + " |", "|---" * (len(ARMS) + 1) + "|"]
    gains: dict[str, list[tuple[float, float]]] = {arm: [] for arm in ARMS}
    for name in sorted({one["scene"] for one in runs}):
        found = {(one["arm"], one["seed"]): one for one in runs if one["scene"] == name}
        cells = []
        for arm in ARMS:
            pairs = [(found[arm, s], found["rules", s]) for a, s in found if a == arm and ("rules", s) in found]
            if not pairs:
                cells.append("")
                continue
            gain = sum(one["psnr"] - rule["psnr"] for one, rule in pairs) / len(pairs)
            gains[arm].append((gain, sum(one["lpips_alex"] - rule["lpips_alex"] for one, rule in pairs) / len(pairs)))
            own = sum(one["psnr"] for one, _ in pairs) / len(pairs)
            cells.append(f"{own:.2f}" if arm in ARMS[:2] else f"{gain:+.2f}")
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join([*lines, "", *(summary(arm, gains[arm]) for arm in ARMS if gains[arm])])


def summary(arm: str, gains: list[tuple[float, float]]) -> str:
    """Mean gain over the rules, its standard error, the worst object and LPIPS."""
    psnr = [gain for gain, _ in gains]
    mean = sum(psnr) / len(psnr)
    error = math.sqrt(sum((gain - mean) ** 2 for gain in psnr) / max(1, len(psnr) - 1) / len(psnr))
    lpips = sum(one for _, one in gains) / len(gains)
    return (
        f"{arm}: {mean:+.2f} +- {error:.2f} dB over the rules, worst {min(psnr):+.2f}, LPIPS {lpips:+.3f} ({len(psnr)})"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="*")
    parser.add_argument("-o", type=Path, default=RESULT)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--arms", nargs="*", choices=ARMS, default=ARMS[:6])
    parser.add_argument("--prompts", type=Path, default=Path("build/prompts"))
    parser.add_argument("--llm", default="")
    parser.add_argument("--model", default="")
    options = parser.parse_args()
    options.prompts.mkdir(parents=True, exist_ok=True)
    document = json.loads(options.o.read_text()) if options.o.exists() else {"runs": []}
    known = {(one["scene"], one["seed"], one["arm"]) for one in document["runs"]}
    wanted = [(s, seed, arm) for seed in range(options.seeds) for arm in options.arms for s in scenes(options.scenes)]
    with ThreadPoolExecutor(options.jobs) as pool:
        missing = [one for one in wanted if (one[0].name, *one[1:]) not in known]
        for record in pool.map(lambda one: run(*one, options), missing):
            document["runs"].append(record)
            write_atomic(options.o, to_json({**document, "machine": machine()}))
    print(table(document["runs"]))


if __name__ == "__main__":
    main()
