"""A run with a wrong mask: it is trained on the repaired one, recorded and reported."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

import gsopt
from gsopt.config.train import TrainConfig
from gsopt.data.mask_network import MaskNetwork
from gsopt.errors import UsageError

sys.path.insert(0, str(Path(__file__).parents[1] / "init"))
from test_cut_out import BrownIsTheObject
from test_mask_agreement import WRONG, photos

pytestmark = pytest.mark.usefixtures("coarse_hull")


def short(data: str, **changes: object) -> TrainConfig:
    settings = {"path": data, **changes}
    return TrainConfig.of(iterations=3, data=settings, init={"count": 200}, guidance={"lambda_sds": 0.0})


def test_a_wrong_mask_stands_in_config_events_and_report(tmp_path: Path) -> None:
    config = short(photos(tmp_path / "data", 4, "empty").path)
    result = gsopt.reconstruct(None, tmp_path / "run", config=config)
    (recorded,) = json.loads((result.run / "config.json").read_text())["repaired_masks"]
    assert recorded["name"] == f"train/r_{WRONG}.png"
    assert recorded["kind"] == "empty"
    events = [json.loads(line) for line in (result.run / "events.jsonl").read_text().splitlines()]
    assert any(event["kind"] == "warning" and "disagrees with the others" in event["message"] for event in events)
    assert result.report is not None
    assert "disagrees with the others" in result.report.read_text()


def test_masks_auto_makes_them_beside_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import shutil

    data = Path(photos(tmp_path / "data", 4).path)
    shutil.rmtree(data / "masks")
    network = BrownIsTheObject(tmp_path / "net.onnx")
    monkeypatch.setattr(MaskNetwork, "open", staticmethod(lambda path: network))
    config = short(str(data), masks="auto", mask_model=str(network.path))
    result = gsopt.reconstruct(None, tmp_path / "runs" / "a", config=config)
    recorded = json.loads((result.run / "config.json").read_text())["config"]["data"]["masks"]
    assert recorded == str(tmp_path / "runs" / "data-masks")
    assert not (data / "masks").exists()


def test_masks_auto_needs_the_whole_pipeline(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="gsopt masks"):
        gsopt.load_scene(gsopt.DataConfig(path=photos(tmp_path, 4).path, masks="auto"))
