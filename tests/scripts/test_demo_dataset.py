"""The embedded dataset is complete, small, uncut and judged only between its input views."""

from __future__ import annotations

import json
from pathlib import Path

from PIL import Image

DEMO = Path(__file__).resolve().parents[2] / "gsopt" / "demo"


def test_the_demo_is_what_its_json_says() -> None:
    sizes = sum(p.stat().st_size for p in DEMO.rglob("*") if p.is_file())
    assert sizes <= 3_000_000
    for split, count in (("train", 8), ("test", 12)):
        content = json.loads((DEMO / f"transforms_{split}.json").read_text())
        assert len(content["frames"]) == count
        for frame in content["frames"]:
            image = Image.open(DEMO / (frame["file_path"] + ".png"))
            assert (image.mode, image.size) == ("RGBA", (content["w"], content["h"]))
            box = image.getchannel("A").getbbox()
            assert box is not None
            left, top, right, bottom = box
            assert left > 0
            assert top > 0
            assert right < image.width
            assert bottom < image.height


def test_the_demo_holds_out_nothing_beyond_its_inputs() -> None:
    heights = []
    for split in ("train", "test"):
        content = json.loads((DEMO / f"transforms_{split}.json").read_text())
        heights.append([f["transform_matrix"][2][3] for f in content["frames"]])
    assert min(heights[0]) - 1e-9 <= min(heights[1])
    assert max(heights[1]) <= max(heights[0]) + 1e-9
