"""Real photos of one object: is the hull worth it, how good are a network's masks, what does a wrong mask cost?

    python experiments/photos.py HEAD OUT --model u2netp.onnx     # writes experiments/results/photos.json

HEAD is the folder ethiopianHead_800 (66 photos, masks, poses_bounds.npy; CC BY-NC-SA, not part of gsopt). Every 8th
photo is held out; input views are well spread. Held-out views are evaluated with the hand-made masks. Runs that are
finished in OUT are not repeated.
"""

from __future__ import annotations

import argparse
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

import gsopt
from gsopt.data.mask_network import MaskNetwork
from gsopt.init.cut_out import cut_out

RESULTS = Path(__file__).parent / "results" / "photos.json"
VIEWS = (4, 6, 8)
DOWNSCALE = 4
WRONG = "DSC_0032"
"""The photo whose mask is broken: an input view with 4, 6 and 8 views."""
BREAKS = ("empty", "full", "plinth")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("head", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--model", type=Path, help="ONNX file of the mask network; without it no own masks")
    parser.add_argument("--only", nargs="*", default=[], metavar="VIEWS-ARM", help="these runs alone, such as 4-given")
    args = parser.parse_args()
    arms = ["given", "no_hull", *BREAKS, *(["own"] if args.model else [])]
    for views in VIEWS:
        for arm in arms:
            if not args.only or f"{views}-{arm}" in args.only:
                run(args.head, args.out, views, arm, args.model)
    write(args.out)


def run(head: Path, out: Path, views: int, arm: str, model: Path | None) -> None:
    """One reconstruction; nothing where it is finished."""
    folder = out / f"{views}-{arm}"
    if (folder / "metrics.json").exists():
        return
    settings: dict[str, Any] = {"guidance": {"lambda_sds": 0.0}, "preview_every": 0, "checkpoint_every": 0}
    data = {
        "path": str(head),
        "views": views,
        "eval": True,
        "downscale": DOWNSCALE,
        "masks": str(masks(head, out, arm, model)),
    }
    if arm == "no_hull":
        settings |= {"init": {"method": "random"}, "sparse": {"symmetry": "off"}}
    gsopt.reconstruct(None, folder, config=gsopt.TrainConfig.of(data=data, **settings))


def masks(head: Path, out: Path, arm: str, model: Path | None) -> Path:
    """The masks of an arm: hand-made, with one broken, or with those of the input views made by the network."""
    folder = out / f"masks-{arm}"
    if arm in ("given", "no_hull"):
        return head / "masks"
    if not folder.exists():
        shutil.copytree(head / "masks", folder)
        if arm == "own":
            assert model is not None
            shutil.copytree(own(head, out, model), folder, dirs_exist_ok=True)
        else:
            breakage(folder / f"{WRONG}.png", arm)
    return folder


def own(head: Path, out: Path, model: Path) -> Path:
    """Masks that the network makes of the 8 input photos alone, with their poses."""
    scene = gsopt.load_scene(gsopt.DataConfig(path=str(head), views=max(VIEWS), eval=True))
    names = sorted(Path(view.name).name for view in scene.train)
    photos = out / "photos"
    if not photos.exists():
        (photos / "images").mkdir(parents=True)
        for name in names:
            shutil.copyfile(head / "images" / name, photos / "images" / name)
        every = sorted(path.name for path in (head / "images").iterdir())
        rows = np.load(head / "poses_bounds.npy", allow_pickle=False)[[every.index(name) for name in names]]
        np.save(photos / "poses_bounds.npy", rows)
    if not (photos / "masks").exists():
        cut_out(gsopt.DataConfig(path=str(photos)), None, MaskNetwork.open(model), print)
    return photos / "masks"


def breakage(path: Path, kind: str) -> None:
    mask = np.array(Image.open(path, formats=("PNG",)).convert("L"))
    height, width = mask.shape
    if kind == "plinth":
        mask[height * 3 // 4 :, width // 10 : width * 9 // 10] = 255
    else:
        mask[:] = 255 if kind == "full" else 0
    Image.fromarray(mask).save(path)


def write(out: Path) -> None:
    """Collect what is finished into the result file, and print it."""
    rows = []
    for folder in sorted(out.glob("[0-9]*-*/")):
        if not (folder / "metrics.json").exists():
            continue
        metrics = json.loads((folder / "metrics.json").read_text())
        recorded = json.loads((folder / "config.json").read_text())
        views, _, arm = folder.name.partition("-")
        means = {name: round(metrics["mean"][name], 4) for name in ("psnr", "psnr_object", "ssim", "lpips_alex")}
        repaired = recorded.get("repaired_masks", [])
        rows.append({"views": int(views), "masks": arm, **means, "steps": metrics["steps"], "repaired": repaired})
    document = {
        "command": "python experiments/photos.py HEAD OUT --model u2netp.onnx",
        "downscale": DOWNSCALE,
        "rows": rows,
    }
    RESULTS.write_text(json.dumps(document, indent=1) + "\n")
    for row in rows:
        figures = f"{row['psnr']:.2f} | {row['psnr_object']:.2f} | {row['lpips_alex']:.3f}"
        print(f"| {row['views']} | {row['masks']} | {figures} |")


if __name__ == "__main__":
    main()
