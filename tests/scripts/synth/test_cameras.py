"""Laws of settings and camera layouts; no Blender."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as examples
from hypothesis import strategies as st
from synth.cameras import camera_directions, frame_names, look_at_origin, shots
from synth.settings import ELEVATIONS, SPLITS, Settings

from gsopt.errors import InputError, UsageError

LAYOUTS = tuple(name for name in ELEVATIONS if name != "file")


def angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """[N, M] degrees between unit vectors."""
    return np.degrees(np.arccos(np.clip(a @ b.T, -1.0, 1.0)))


@pytest.mark.parametrize("layout", LAYOUTS)
@examples(max_examples=15, deadline=None)
@given(views=st.integers(1, 60), others=st.integers(0, 30), seed=st.integers(0, 2**31))
def test_directions_are_unit_and_held_out_views_never_leave_the_band(
    layout: Any, views: int, others: int, seed: int
) -> None:
    settings = Settings(views=views, test_views=others, val_views=others // 2, layout=layout)
    found = camera_directions(settings, seed)
    assert [len(found[split]) for split in SPLITS] == [views, others, others // 2]
    every = np.concatenate(list(found.values()))
    assert np.allclose(np.linalg.norm(every, axis=1), 1.0)
    low, high = settings.elevation_range
    elevations = np.degrees(np.arcsin(np.clip(every[:, 2], -1, 1)))
    assert elevations.min() >= low - 1e-5
    assert elevations.max() <= high + 1e-5


@pytest.mark.parametrize("layout", ["hemisphere", "sphere"])
@pytest.mark.parametrize("count", [8, 24, 100])
def test_views_are_spread_evenly(layout: Any, count: int) -> None:
    settings = Settings(views=count, layout=layout)
    train = camera_directions(settings, 3)["train"]
    low, high = (math.sin(math.radians(e)) for e in settings.elevation_range)
    between = angles(train, train) + 360.0 * np.eye(count)
    # Side of the square that has each view's share of the band's area, as an angle: an ideal spread comes close to it.
    share = math.degrees(math.sqrt(2.0 * math.pi * (high - low) / count))
    assert between.min() > 0.6 * share
    assert between.min(axis=1).max() < 1.5 * share


@pytest.mark.parametrize("layout", ["hemisphere", "sphere", "orbit", "spiral"])
def test_held_out_views_stand_between_all_others(layout: Any) -> None:
    found = camera_directions(Settings(views=8, test_views=6, val_views=5, layout=layout), 0)
    spacing = (angles(found["train"], found["train"]) + 360.0 * np.eye(8)).min()
    assert angles(found["test"], found["train"]).min() > 0.1 * spacing
    assert angles(found["val"], np.concatenate([found["train"], found["test"]])).min() > 0.02 * spacing


def test_seed_turns_the_cameras_about_z_and_nothing_else() -> None:
    settings = Settings(views=9, test_views=5)
    first, second = (camera_directions(settings, seed)["train"] for seed in (1, 2))
    assert np.array_equal(first, camera_directions(settings, 1)["train"])
    assert np.allclose(first[:, 2], second[:, 2])
    turns = (first[:, 0] + 1j * first[:, 1]) / (second[:, 0] + 1j * second[:, 1])
    assert np.allclose(turns, turns[0])
    assert abs(turns[0] - 1.0) > 1e-3


@examples(max_examples=15, deadline=None)
@given(st.tuples(*[st.floats(-3, 3)] * 3).filter(lambda e: math.hypot(*e) > 1e-3))
def test_cameras_look_at_the_origin_with_z_up(eye: tuple[float, float, float]) -> None:
    pose = look_at_origin(np.array([eye]))[0]
    R, t = pose[:3, :3], pose[:3, 3]
    assert np.allclose(R.T @ R, np.eye(3), atol=1e-9)
    assert np.linalg.det(R) == pytest.approx(1.0)
    assert np.allclose(-R.T @ t, [0.0, 0.0, -math.hypot(*eye)], atol=1e-9)
    assert R[2, 1] >= -1e-9
    assert abs(R[2, 0]) < 1e-9


def test_a_camera_over_the_pole_is_still_a_rotation() -> None:
    for pose in look_at_origin(np.array([(0.0, 0.0, 2.0), (0.0, 0.0, -2.0)])):
        assert np.allclose(pose[:3, :3].T @ pose[:3, :3], np.eye(3))
        assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)


@examples(max_examples=40, deadline=None)
@given(
    fov=st.floats(10, 120),
    jitter=st.floats(0, 0.5),
    size=st.tuples(st.integers(20, 99), st.integers(20, 99)),
    normalize=st.sampled_from(["sphere", "cube"]),
    seed=st.integers(0, 99),
)
def test_nothing_is_cut_off_at_the_default_distance(
    fov: float, jitter: float, size: tuple[int, int], normalize: Any, seed: int
) -> None:
    """The outline of the bounding sphere stays in every frame: any lens, aspect, shift and way to normalize."""
    settings = Settings(
        views=6, test_views=0, fov=fov, lens_jitter=jitter, resolution=size, normalize=normalize, layout="random"
    )
    for view in shots(settings, seed):
        distance = np.linalg.norm(view.eye)
        outline = view.focal * settings.bound / math.sqrt(distance**2 - settings.bound**2)
        for extent, middle in zip(size, view.center, strict=True):
            assert outline <= min(middle, extent - middle) + 1e-9


def test_a_file_of_cameras_gives_its_poses_back(tmp_path: Path) -> None:
    poses = look_at_origin(np.array([(2.0, 1.0, 1.0), (0.0, -3.0, 1.0), (1.0, 1.0, 2.0)]))
    frames = [
        {"transform_matrix": p.tolist(), "split": s} for p, s in zip(poses, ("train", "test", "train"), strict=True)
    ]
    path = tmp_path / "cameras.json"
    path.write_text(json.dumps({"frames": frames}))
    found = shots(Settings(layout="file", camera_file=str(path)), 0)
    assert [view.name for view in found] == ["train_000", "train_001", "test_000"]
    assert np.array_equal([view.world_from_cam for view in found], poses[[0, 2, 1]])


@pytest.mark.parametrize(
    "content",
    [
        "",
        "[]",
        '{"frames": []}',
        '{"frames": [{"transform_matrix": 3}]}',
        json.dumps({"frames": [{"transform_matrix": (2 * np.eye(4)).tolist()}]}),
        json.dumps({"frames": [{"transform_matrix": np.eye(4).tolist(), "split": "../x"}]}),
        json.dumps({"frames": [{"transform_matrix": np.eye(4).tolist(), "split": "test"}]}),
    ],
)
def test_a_file_without_cameras_is_an_input_error(content: str, tmp_path: Path) -> None:
    path = tmp_path / "cameras.json"
    path.write_text(content)
    with pytest.raises(InputError, match=r"cameras\.json"):
        shots(Settings(layout="file", camera_file=str(path)), 0)


def test_names_sort_as_they_are_numbered() -> None:
    names = frame_names("test", 1200)
    assert names == sorted(names)


@pytest.mark.parametrize(
    "wrong",
    [
        {"views": 0},
        {"test_views": -1},
        {"resolution": (0, 8)},
        {"samples": 0},
        {"fov": math.nan},
        {"fov": 179.0},
        {"radius": 0.5},
        {"layout": "cube"},
        {"layout": "file"},
        {"camera_file": "x.json"},
        {"elevations": (40.0, 10.0)},
        {"elevations": (-91.0, 0.0)},
        {"elevations": (math.nan, 0.0)},
        {"lens_jitter": 0.9},
        {"engine": "eevee"},
        {"engine": "workbench", "depth": True},
        {"lighting": "hdri"},
        {"background": "#12345"},
        {"background": "mauve"},
        {"formats": ()},
        {"formats": ("nerf", "nerf")},
        {"formats": ("blender",)},
        {"points": -1},
    ],
)
def test_settings_out_of_range_are_usage_errors(wrong: dict[str, Any]) -> None:
    with pytest.raises(UsageError, match=r"must|go together|needs its image|draws colors"):
        Settings(**wrong)
