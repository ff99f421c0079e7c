"""Notes of an evaluation, and the limits of what it reads and compares."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from gsopt.errors import InputError
from gsopt.results import evaluation
from gsopt.results.evaluation import evaluate_views, evenly_spread, read_metrics


def views(*sizes: tuple[int, int]) -> Any:
    return [SimpleNamespace(camera=SimpleNamespace(width=w, height=h)) for w, h in sizes]


@pytest.mark.parametrize(
    ("sizes", "told"),
    [
        ([(8, 6), (8, 6)], "8x6"),
        ([(9, 1), (8, 6), (8, 7)], "8x6, 8x7, 9x1"),
        ([(9, 1), (8, 6), (8, 7), (7, 7)], "7x7, 8x6, 8x7 and others"),
    ],
)
def test_up_to_three_sizes_of_images_are_named(sizes: list[tuple[int, int]], told: str) -> None:
    assert evaluation._sizes(views(*sizes)) == told


def finished(background: str, color: tuple[float, float, float] = (0.25, 0.5, 1.0)) -> Any:
    data = SimpleNamespace(background=background)
    return SimpleNamespace(
        config=SimpleNamespace(data=data), background=torch.tensor(color), backend=SimpleNamespace(name="cpu")
    )


@pytest.mark.parametrize(
    ("background", "told"),
    [("random", "white (trained on random)"), ("auto", "(0.25, 0.5, 1)"), ("black", "black"), ("white", "white")],
)
def test_the_protocol_names_the_background(background: str, told: str) -> None:
    scene: Any = SimpleNamespace(train=views((4, 3)), test=views((8, 6), (8, 6)))
    text = evaluation._protocol(finished(background), scene, {"per_view": [{}, {}], "train": None})
    assert (
        f"; background {told}; split: trained on 1 views, held out 2, evaluated on 2 held-out views; images 8x6" in text
    )


def test_the_protocol_says_which_views_and_networks_were_used() -> None:
    scene: Any = SimpleNamespace(train=views((4, 3), (4, 3)), test=())
    rows = [{"lpips_vgg": 0.1}]
    text = evaluation._protocol(finished("black"), scene, {"per_view": [], "train": {"per_view": rows}})
    assert "held out 0, evaluated on 1 training views; images 4x3" in text
    assert "Alex and VGG" in text
    plain = evaluation._protocol(finished("black"), scene, {"per_view": [], "train": {"per_view": [{}]}})
    assert "VGG" not in plain


@pytest.mark.parametrize(
    ("count", "most", "rows"), [(5, 16, [0, 1, 2, 3, 4]), (16, 16, list(range(16))), (5, 2, [0, 2]), (7, 3, [0, 2, 4])]
)
def test_views_are_evenly_spread(count: int, most: int, rows: list[int]) -> None:
    given: Any = list(range(count))
    assert evenly_spread(given, most) == rows


def test_metrics_are_read_up_to_a_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert read_metrics(tmp_path) == {}
    (tmp_path / "metrics.json").write_text(json.dumps({"a": 1}))
    monkeypatch.setattr(evaluation, "LARGEST_METRICS", 8)
    assert read_metrics(tmp_path) == {"a": 1}
    monkeypatch.setattr(evaluation, "LARGEST_METRICS", 7)
    with pytest.raises(InputError, match="Move it away"):
        read_metrics(tmp_path)
    (tmp_path / "metrics.json").write_text("[]")
    monkeypatch.setattr(evaluation, "LARGEST_METRICS", 8)
    with pytest.raises(InputError, match="must hold an object, got list"):
        read_metrics(tmp_path)


@pytest.mark.parametrize(("threads", "cores", "workers"), [(3, 99, 3), (0, 2, 2), (0, 99, 8), (20, 99, 8)])
def test_views_are_compared_by_a_worker_for_each_thread_up_to_eight(
    monkeypatch: pytest.MonkeyPatch, threads: int, cores: int, workers: int
) -> None:
    asked: list[int] = []
    pool = evaluation.ThreadPoolExecutor

    def opened(count: int) -> Any:
        asked.append(count)
        return pool(1)

    monkeypatch.setattr(evaluation, "networks", lambda vgg: {})
    monkeypatch.setattr(evaluation, "available_cores", lambda: cores)
    monkeypatch.setattr(evaluation, "ThreadPoolExecutor", opened)
    nothing: Any = None
    found = evaluate_views(nothing, [], nothing, nothing, torch.ones(3), None, threads=threads)
    assert found == {"mean": None, "per_view": []}
    assert asked == [workers]


def test_a_mean_is_of_the_metrics_that_all_views_have_and_has_six_decimals() -> None:
    rows = [
        {"psnr": 1.0, "ssim": None, "psnr_object": 3.0},
        {"psnr": 2.0, "ssim": 0.5},
        {"psnr": 2.0000019, "ssim": 1.0},
    ]
    assert evaluation._mean(rows) == {"psnr": 1.666667, "ssim": None}
    assert evaluation._mean([]) is None
    random = torch.Generator().manual_seed(0)
    image, other = (torch.randint(0, 256, (8, 8, 3), dtype=torch.uint8, generator=random) for _ in range(2))
    found = evaluation._image_metrics(image, other, 0.123456789, {})
    assert found["ssim"] == 0.123457
    assert found["psnr"] == round(found["psnr"] or 0.0, 6) > 1
