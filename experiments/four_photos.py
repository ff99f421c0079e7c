"""Draws docs/img/four-photos.jpg, the picture of the README: four objects reconstructed from 4 photos.

    python experiments/four_photos.py

Reads experiments/results/suite-sparse.json and its pictures, which `gsopt bench --suite sparse` writes. The objects are
chosen by rule: sorted by how many dB `ours-0` gains over `3dgs`, the (lower) median of each quarter. The view is the
held-out view farthest from all input views. The PSNR below a render is the object's mean over its 16 held-out views.
"""

from __future__ import annotations

import base64
import io
import json
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont

HERE = Path(__file__).resolve().parent
RESULTS = HERE / "results/suite-sparse.json"
PAGE = HERE.parent / "docs/img/four-photos.jpg"
GROUP, SEED, OBJECTS = "objects-4", 0, 4
STEPS = {"3dgs": 2000, "ours-0": 1400}
COLUMNS = {"input": "nearest input view", "3dgs": "3DGS", "ours-0": "gsopt", "truth": "truth"}
CELL, GAP, HEADER, CAPTION = 200, 8, 28, 24


def psnr_by_object(runs: list[dict], arm: str) -> dict[str, float]:
    """Mean PSNR over the held-out views for every object of the group, with the seed of the pictures."""
    case = (GROUP, arm, STEPS[arm], SEED)
    chosen = [run for run in runs if (run["group"], run["arm"], run["iterations"], run["seed"]) == case]
    return {run["scene"]: run["mean"]["psnr"] for run in chosen}


def quarter_medians(gains: dict[str, float]) -> list[str]:
    """The object with the median gain of each quarter, from the smallest gain to the largest."""
    ranked = sorted(gains, key=gains.__getitem__)
    size = len(ranked) // OBJECTS
    return [ranked[i * size + (size - 1) // 2] for i in range(OBJECTS)]


def image(uri: str) -> Image.Image:
    data = base64.b64decode(uri.partition(",")[2])
    return Image.open(io.BytesIO(data), formats=("WEBP",)).convert("RGB").resize((CELL, CELL), Image.Resampling.LANCZOS)


def sheet(scenes: list[str], psnr: dict[str, dict[str, float]], pictures: dict) -> Image.Image:
    """One row per object: nearest input view, 3dgs, ours-0, truth."""
    row = CELL + CAPTION + GAP
    canvas = Image.new("RGB", (len(COLUMNS) * (CELL + GAP) + GAP, HEADER + len(scenes) * row), "white")
    draw, font = ImageDraw.Draw(canvas), ImageFont.load_default(16)
    for x, (key, title) in enumerate(COLUMNS.items()):
        left = GAP + x * (CELL + GAP)
        draw.text((left + CELL / 2, HEADER / 2), title, "black", font, anchor="mm")
        for y, scene in enumerate(scenes):
            run = pictures.get(f"{GROUP}|{scene}|4|{key}|{STEPS.get(key)}|{SEED}")
            uri = run["render"] if run else pictures[f"{scene}|4"][key]
            canvas.paste(image(uri), (left, HEADER + y * row))
            text = f"{psnr[key][scene]:.1f} dB" if run else scene.rpartition("/")[2] if key == "input" else ""
            draw.text((left + CELL / 2, HEADER + y * row + CELL + CAPTION / 2), text, "black", font, anchor="mm")
    return canvas


def main() -> None:
    runs = json.loads(RESULTS.read_text(encoding="utf-8"))["runs"]
    pictures = json.loads(RESULTS.with_name("suite-sparse-pictures.json").read_text(encoding="utf-8"))
    psnr = {arm: psnr_by_object(runs, arm) for arm in STEPS}
    gains = {scene: psnr["ours-0"][scene] - before for scene, before in psnr["3dgs"].items()}
    scenes = quarter_medians(gains)
    sheet(scenes, psnr, pictures).save(PAGE, quality=88, optimize=True)
    print(f"Written: {PAGE}: {', '.join(f'{scene} {gains[scene]:+.1f} dB' for scene in scenes)}")


if __name__ == "__main__":
    main()
