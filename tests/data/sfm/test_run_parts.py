"""Small parts of a run: stage times, refusals, known poses, the answers of its child, errors of a trajectory."""

from __future__ import annotations

import io
import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from test_answers import CHAIN, graph

from gsopt.data.lens import Lens
from gsopt.data.posed_images import PosedImage
from gsopt.data.sfm import child_process, known_poses, stage_times
from gsopt.data.sfm.diagnosis import Diagnosis, UnplacedPhoto
from gsopt.data.sfm.features import ColmapProject, ViewGraph
from gsopt.data.sfm.refusal import too_few
from gsopt.data.sfm.settings import SfmConfig
from gsopt.data.sfm.trajectory import TrajectoryError, compare, turns_apart
from gsopt.errors import InputError, UsageError
from gsopt.geometry.rigid_motion import rigid_motion


def test_the_time_of_a_stage_is_the_sum_of_its_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter([10.0, 12.5, 20.0, 21.0, 30.0, 37.0])
    monkeypatch.setattr(stage_times, "time", SimpleNamespace(perf_counter=lambda: next(clock)))
    times = stage_times.StageTimes()
    for stage in ("matching", "writing", "matching"):
        with times.of(stage):
            pass
    assert times.seconds == {"matching": 9.5, "writing": 1.0}


def refusal(given: int, broken: int, found: ViewGraph | None) -> str:
    left = [UnplacedPhoto(f"{number}.jpg", "refused", "is empty") for number in range(broken)]
    return str(too_few(Diagnosis(given, [], left), found)).splitlines()[-1]


def test_advice_for_too_few_photos_counts_those_that_can_be_used() -> None:
    """Files that are broken are none of them, and features in common are added up."""
    assert "Mend or replace them" in refusal(2, 2, None)
    assert "One photo alone has no parallax" in refusal(3, 2, None)
    assert "Two photos: they have nothing in common" in refusal(3, 1, None)
    assert "Take 20 or more photos" in refusal(3, 0, None)
    pair = ViewGraph({"a": 9, "b": 9}, {("a", "b"): 17}, frozenset())
    assert "Two photos: they have 17 features in common" in refusal(5, 0, pair)
    assert "Two photos: they have nothing" in refusal(2, 0, ViewGraph({"a": 9, "b": 9}, {}, frozenset()))
    assert "Take 20 or more photos" in refusal(2, 0, graph(CHAIN))


@pytest.mark.parametrize(
    "wrong",
    [
        {"poses": "keep"},
        {"threads": -1},
        {"mapper": "held-lens"},
        {"matching": "all"},
        {"max_size": 63},
        {"frames": 2},
        {"seed": -1},
    ],
)
def test_settings_of_a_run_are_refused_that_it_does_not_know(wrong: dict[str, Any]) -> None:
    with pytest.raises(UsageError):
        SfmConfig(**wrong)
    assert SfmConfig(threads=0, max_size=64, frames=3, seed=0).undistort


def frame(name: str, lens: Lens, shift: float = 0.0) -> PosedImage:
    K = torch.tensor([[50.0, 0, 20], [0, 60, 15], [0, 0, 1]], dtype=torch.float64)
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[0, 3] = shift
    return PosedImage(f"images/{name}", Path(name), None, viewmat, K, 40, 30, lens, 0)


@pytest.mark.parametrize(
    ("lens", "model", "terms"),
    [
        (Lens(), "PINHOLE", []),
        (Lens(radial=(0.1, 0.2), tangential=(0.3, 0.4)), "FULL_OPENCV", [0.1, 0.2, 0.3, 0.4, 0, 0, 0, 0]),
        (Lens(tangential=(0.3, 0.4)), "FULL_OPENCV", [0, 0, 0.3, 0.4, 0, 0, 0, 0]),
        (Lens(radial=(0.1, 0.2, 0.5)), "FULL_OPENCV", [0.1, 0.2, 0, 0, 0.5, 0, 0, 0]),
        (Lens(fisheye=True), "OPENCV_FISHEYE", [0, 0, 0, 0]),
        (Lens(radial=(0.1, 0.2, 0.3, 0.4), fisheye=True), "OPENCV_FISHEYE", [0.1, 0.2, 0.3, 0.4]),
    ],
)
def test_a_known_lens_has_the_terms_of_colmaps_model(lens: Lens, model: str, terms: list[float]) -> None:
    """k1, k2, p1, p2, k3 and then the rational terms; a fisheye has four radial ones."""
    assert known_poses.lens_parameters(frame("a.png", lens)) == (model, [50, 60, 20, 15, *terms])


def test_known_lenses_and_poses_are_taken_as_they_are(tmp_path: Path) -> None:
    """They replace what the database guessed; points come from the matches alone, with the seed of the run."""
    pycolmap = pytest.importorskip("pycolmap")
    database = tmp_path / "database.db"
    guess = pycolmap.Camera(model="SIMPLE_RADIAL", width=40, height=30, params=[99.0, 1, 2, 0.5], camera_id=1)
    with pycolmap.Database.open(database) as db:
        db.write_camera(guess, use_camera_id=True)
        for number, name in enumerate(("a.png", "b.png"), 1):
            db.write_image(pycolmap.Image(name=name, camera_id=1, image_id=number), use_image_id=True)
    frames = [frame("b.png", Lens(), 2.0), frame("a.png", Lens(), 1.0)]
    done: list[Any] = []

    def triangulate(made: Any, *given: Any, options: Any) -> str:
        done.append((made, given, options.random_seed))
        return "points"

    class Colmap:
        def __getattr__(self, name: str) -> Any:
            return getattr(pycolmap, name)

        triangulate_points = staticmethod(triangulate)
        set_random_seed = staticmethod(done.append)

    colmap: Any = Colmap()
    project = ColmapProject(colmap, database, tmp_path / "photos", SfmConfig(seed=6))
    known_poses.write_cameras(project, frames)
    with pycolmap.Database.open(database) as db:
        (camera,) = db.read_all_cameras()
    assert (camera.model.name, camera.params.tolist(), camera.has_prior_focal_length) == (
        "PINHOLE",
        [50, 60, 20, 15],
        True,
    )
    assert known_poses.triangulate(project, frames) == "points"
    seed, (made, given, options_seed) = done
    assert (seed, options_seed, given) == (6, 6, (database, tmp_path / "photos", tmp_path / "prior"))
    assert (tmp_path / "prior").is_dir()
    assert made.camera(1).params.tolist() == [50, 60, 20, 15]
    shifts = [made.image(i).cam_from_world().matrix()[0, 3] for i in sorted(made.reg_image_ids())]
    assert shifts == [1, 2]


CHILD = """
import os, sys, time
from gsopt.data.sfm import child_process
def done(job, report):
    print("noise", flush=True)
    os.write(1, b"more noise")
    report("half")
    time.sleep(job["hangs"])
    return job
child_process._done = done
child_process.main()
"""


def child(hangs: int) -> subprocess.Popen[bytes]:
    job = json.dumps({"hangs": hangs})
    pipe = subprocess.PIPE
    return subprocess.Popen([sys.executable, "-c", CHILD, job], stdin=pipe, stdout=pipe, stderr=pipe)


def test_the_child_answers_on_one_stream_and_colmap_writes_to_another() -> None:
    with child(hangs=0) as started:
        assert started.stdout is not None
        assert started.stderr is not None
        answers, log = started.stdout.read(), started.stderr.read()
        assert started.wait() == 0
    assert [json.loads(line) for line in answers.splitlines()] == [{"line": "half"}, {"hangs": 0}]
    assert b"noise" in log
    assert b"more noise" in log


def test_the_child_ends_when_its_parent_is_gone() -> None:
    """Its input ends then. What it does takes an hour."""
    with child(hangs=3600) as started:
        assert started.stdout is not None
        assert started.stdin is not None
        assert json.loads(started.stdout.readline()) == {"line": "half"}
        started.stdin.close()
        assert started.wait(60) == 1


def test_lines_of_the_child_are_passed_on_until_its_answer(tmp_path: Path) -> None:
    """A crash names the last of them; half a line is none."""
    said: list[str] = []
    lines = [{"line": "one"}, {"line": "two"}]
    report = {"given": 3, "registered": ["a"], "left": [{"name": "b", "kind": "weak", "reason": "is weak"}]}
    answer = {"diagnosis": report, "seconds": {"photos": 1.5}}
    text = "".join(json.dumps(message) + "\n" for message in [*lines, answer])
    done: Any = SimpleNamespace(stdout=io.StringIO(text))
    found, seconds = child_process._answer(done, tmp_path, said.append)
    assert (found.registered, found.left[0].reason, seconds) == (["a"], "is weak", {"photos": 1.5})
    assert said == ["one", "two"]
    for code, how in ((0, "exit code 0"), (7, "exit code 7"), (-9, "SIGKILL")):
        cut: Any = SimpleNamespace(stdout=io.StringIO(text[: text.index("diagnosis")]), wait=lambda code=code: code)
        with pytest.raises(InputError, match=rf"COLMAP crashed \({how}\) after: two"):
            child_process._answer(cut, tmp_path, said.append)


def cameras_at(centers: np.ndarray, turns: list[np.ndarray]) -> np.ndarray:
    """cam_from_world of cameras at these places, turned so."""
    made = np.tile(np.eye(4), (len(centers), 1, 1))
    for viewmat, center, turn in zip(made, centers, turns, strict=True):
        viewmat[:3, :3], viewmat[:3, 3] = turn, -turn @ center
    return made


def about_z(degrees: float) -> np.ndarray:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])


SQUARE = np.array([[1.0, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]])


def test_errors_of_a_path_are_those_after_the_best_turn_shift_and_scale() -> None:
    """Cameras turned where they stand are off by just these angles; a saddle of height d is off by s d up and down and
    by (1 - s) inwards, where s = 2 / (2 + d^2) brings it nearest."""
    given = torch.tensor([0.4, -0.7, 0.2, 0.0, 0.0, 0.0], dtype=torch.float64)
    world = rigid_motion(given)[:3, :3].numpy()
    angles, height = [0.0, 30.0, 90.0, 170.0], 0.5
    saddle = SQUARE + height * np.array([[0, 0, 1], [0, 0, -1]] * 2)
    truth = cameras_at(SQUARE + np.array([3, -2, 1]), [about_z(10.0 * i) for i in range(4)])
    turns = [about_z(angle + 10 * i) @ world.T for i, angle in enumerate(angles)]
    found = cameras_at(3 * saddle @ world.T + [5, 6, 7], turns)
    error = compare(found, truth)
    assert error.rotation_degrees.tolist() == pytest.approx(angles, abs=1e-5)
    s = 2 / (2 + height**2)
    off = np.hypot((1 - s) * np.sqrt(2), s * height) / np.sqrt(2)
    assert error.position.tolist() == pytest.approx([off] * 4)
    assert error.summary()["rotation_degrees_median"] == pytest.approx(60)


def test_a_summary_has_median_root_mean_square_and_maximum() -> None:
    found = TrajectoryError(np.array([3.0, 4.0, 0.0]), np.array([1.0, 1.0, 1.0])).summary()
    assert found["rotation_degrees_median"] == 3
    assert found["rotation_degrees_rms"] == pytest.approx(np.sqrt(25 / 3), abs=1e-6)
    assert (found["rotation_degrees_max"], found["position_rms"]) == (4, 1)


@pytest.mark.parametrize("degrees", [0.0, 20.0, 120.0, 180.0])
def test_turns_are_apart_by_what_one_camera_is_turned_more(degrees: float) -> None:
    """No world is shared. Of three pairs the median one counts; a single camera has no turn."""
    truth = cameras_at(SQUARE[:2], [about_z(0), about_z(50)])
    found = cameras_at(SQUARE[:2], [about_z(30), about_z(80 + degrees)])
    assert turns_apart(found, truth) == pytest.approx(degrees, abs=1e-5)
    assert turns_apart(found[:1], truth[:1]) == 0
    third = [cameras_at(SQUARE[:1], [about_z(turn)]) for turn in (0, 30)]
    wider = [np.concatenate([pair, more]) for pair, more in zip((truth, found), third, strict=True)]
    assert turns_apart(wider[1], wider[0]) == pytest.approx(degrees, abs=1e-5)
