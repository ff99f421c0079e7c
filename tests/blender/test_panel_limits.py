"""Limits of what the panel reads and writes, each met exactly and passed by one."""

from __future__ import annotations

import gzip
import json
import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_splats import random_splats

from blender_addon.core import arguments, camera_path, cameras, dataset, interpreter, prompts, units
from blender_addon.core.errors import InputError, UsageError
from blender_addon.core.placement import placed
from blender_addon.core.splats import logits
from blender_addon.core.spz import read_spz


def path_file(folder: Path, count: int = 1, pose: Any = None, **changed: Any) -> Path:
    fov = changed.pop("fov", 50.0)
    entry = {"camera_to_world": np.eye(4).tolist() if pose is None else pose, "fov": fov}
    document = {"render_width": 8, "render_height": 6, "fps": 24, "camera_path": [entry] * count, **changed}
    (folder / "p.json").write_text(json.dumps(document))
    return folder / "p.json"


@pytest.mark.parametrize(
    ("name", "fine", "refused"),
    [
        ("fov", (0.1, 179.0), (0.099, 179.1)),
        ("fps", (0.1, 1000, 1000.0), (0.099, 1000.1, None)),
        ("render_width", (1, 16384), (0, 16385, 8.0)),
        ("render_height", (1, 16384), (0, 16385)),
    ],
)
def test_values_of_a_path_may_be_their_bounds(
    tmp_path: Path, name: str, fine: tuple[Any, ...], refused: tuple[Any, ...]
) -> None:
    for value in fine:
        found = camera_path.read_path(path_file(tmp_path, **{name: value}))
        sizes = {"render_width": found.width, "render_height": found.height}
        assert {"fov": math.degrees(found.shots[0][1]), "fps": found.fps, **sizes}[name] == pytest.approx(value)
    for value in refused:
        with pytest.raises(InputError, match=r"p\.json"):
            camera_path.read_path(path_file(tmp_path, **{name: value}))


def test_as_many_cameras_as_are_allowed_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(camera_path, "MOST_SHOTS", 3)
    assert len(camera_path.read_path(path_file(tmp_path, count=3)).shots) == 3
    with pytest.raises(InputError, match="1 to 3 cameras"):
        camera_path.read_path(path_file(tmp_path, count=4))


def test_a_shot_is_a_rotation_and_no_mirror(tmp_path: Path) -> None:
    for sides, fine in (((1, 1, 1), True), ((1.0004, 1, 1), True), ((1.0006, 1, 1), False), ((1, 1, -1), False)):
        file = path_file(tmp_path, pose=np.diag([*sides, 1.0]).tolist())
        if fine:
            assert len(camera_path.read_path(file).shots) == 1
        else:
            with pytest.raises(InputError, match="no rotation"):
                camera_path.read_path(file)


def test_a_written_path_says_how_long_and_how_wide_it_is(tmp_path: Path) -> None:
    shots = [(np.eye(4) + np.eye(4, k=3) * i, math.radians(50)) for i in range(6)]
    camera_path.write_path(tmp_path / "p.json", camera_path.CameraPath(shots, 300, 200, 12.0))
    found = json.loads((tmp_path / "p.json").read_text())
    assert (found["seconds"], found["camera_path"][1]["aspect"]) == (0.5, 1.5)
    assert [entry["fov"] for entry in found["camera_path"]] == pytest.approx([50.0] * 6)
    assert camera_path.read_path(tmp_path / "p.json").shots[1][0].tolist() == shots[1][0].tolist()


def spz(folder: Path, degree: int = 0, fraction: int = 12, flags: int = 0, count: int = 1) -> Path:
    rest = bytes([128] * 3 * ((degree + 1) ** 2 - 1))
    row = struct.pack("<i", 1 << 8)[:3] * 3 + b"\x80" + bytes([128] * 3) + bytes([160] * 3) + bytes(4) + rest
    head = struct.pack("<4sIIBBBB", b"NGSP", 3, count, degree, fraction, flags, 0)
    (folder / "a.spz").write_bytes(gzip.compress(head + row * count))
    return folder / "a.spz"


@pytest.mark.parametrize(
    ("name", "fine", "refused"), [("degree", (0, 3), 4), ("fraction", (0, 23), 24), ("flags", (0, 1), 2)]
)
def test_the_header_of_an_spz_may_hold_its_bounds(
    tmp_path: Path, name: str, fine: tuple[int, int], refused: int
) -> None:
    for value in fine:
        assert len(read_spz(spz(tmp_path, **{name: value}))) == 1
    with pytest.raises(InputError, match="not known here"):
        read_spz(spz(tmp_path, **{name: refused}))
    position = read_spz(spz(tmp_path, fraction=8)).positions[0].tolist()
    assert position == [1, -1, -1]


def test_an_spz_may_unpack_to_64_mb_or_50_times_its_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from blender_addon.core import spz as module

    assert (module.ALWAYS, module.RATIO) == (64 << 20, 50)
    path = spz(tmp_path, count=1000)
    unpacked, size = 1000 * 20, path.stat().st_size
    monkeypatch.setattr(module, "RATIO", 0)
    for always, fine in ((unpacked, True), (unpacked - 1, False)):
        monkeypatch.setattr(module, "ALWAYS", always)
        if fine:
            assert len(read_spz(path)) == 1000
        else:
            with pytest.raises(InputError, match="claims 1,000 splats"):
                read_spz(path)
    monkeypatch.setattr(module, "ALWAYS", 0)
    monkeypatch.setattr(module, "RATIO", -(-unpacked // size))
    shares: list[float] = []
    assert len(read_spz(path, shares.append)) == 1000
    assert max(shares) == 1.0


@pytest.mark.parametrize(("shear", "fine"), [(0.9e-4, True), (1.1e-4, False)])
@pytest.mark.parametrize("scale", [0.01, 1.0, 100.0])
def test_a_frame_may_be_sheared_by_a_ten_thousandth(shear: float, fine: bool, scale: float) -> None:
    matrix = np.eye(4)
    matrix[0, 1] = shear
    matrix[:3] *= scale
    if fine:
        assert len(placed(random_splats(3), matrix)) == 3
    else:
        with pytest.raises(UsageError, match="scaled differently"):
            placed(random_splats(3), matrix)


def test_logits_stay_within_a_ten_millionth_of_nothing() -> None:
    splats = random_splats(3)
    splats.opacities[:] = [0, 1e-9, 1e-6]
    expected = [math.log(p / (1 - p)) for p in (1e-7, 1e-7, 1e-6)]
    assert logits(splats).tolist() == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("largest", [0.9e30, 1.1e30])
def test_the_pose_of_an_object_holds_numbers_of_blender(tmp_path: Path, largest: float) -> None:
    for matrix in (np.diag([largest, 1, 1, 1]), np.diag([1 / largest, 1, 1, 1])):
        (tmp_path / dataset.RECORD).write_text(json.dumps({"normalized_from_mesh": matrix.tolist()}))
        if largest < 1e30:
            found = dataset.scene_from_dataset(tmp_path)
            assert found is not None
            assert np.allclose(found @ matrix, np.eye(4))
        else:
            with pytest.raises(InputError, match=r"object\.json"):
                dataset.scene_from_dataset(tmp_path)


def test_the_first_failure_of_a_rendering_is_told(tmp_path: Path) -> None:
    assert dataset.failure(tmp_path) == ""
    for listed, told in (
        ([], ""),
        ([{"reason": "first"}, {"reason": "second"}], "first"),
        ([{"reason": "x" * 600}], "x" * 500),
    ):
        (tmp_path / "failures.json").write_text(json.dumps(listed))
        assert dataset.failure(tmp_path) == told


def test_the_limits_of_prompts_are_those_of_gsopt(tmp_path: Path) -> None:
    theirs = pytest.importorskip("gsopt.sds.prompts")
    ours = [prompts.LONGEST_TEXT, prompts.LONGEST_RATIONALE, prompts.LARGEST_WEIGHT, prompts.MOST_PROMPTS]
    assert ours == [theirs.MAX_TEXT_LENGTH, theirs.MAX_RATIONALE_LENGTH, theirs.MAX_WEIGHT, theirs.MAX_PROMPTS]
    assert prompts.LARGEST_FILE == theirs.MAX_FILE_BYTES
    listed = [{"text": "a"}] * prompts.MOST_PROMPTS
    text = json.dumps({"version": 1, "prompts": listed})
    (tmp_path / "a.json").write_text(text.ljust(prompts.LARGEST_FILE))
    assert len(prompts.read_prompts(tmp_path / "a.json").prompts) == 256
    (tmp_path / "a.json").write_text(text.ljust(prompts.LARGEST_FILE + 1))
    with pytest.raises(InputError, match="larger"):
        prompts.read_prompts(tmp_path / "a.json")


@pytest.mark.parametrize(
    ("training", "every"),
    [
        (arguments.Training(iterations=100), 25),
        (arguments.Training(iterations=519), 25),
        (arguments.Training(iterations=520), 26),
        (arguments.Training(iterations=9980), 499),
        (arguments.Training(iterations=20_000), 500),
        (arguments.Training(preset="draft"), 100),
        (arguments.Training(preset="default"), 200),
        (arguments.Training(preset="high"), 500),
        (arguments.Training(), 200),
    ],
)
def test_a_preview_comes_about_twenty_times(training: arguments.Training, every: int) -> None:
    words = arguments.train(Path("python"), Path("a"), Path("b"), training, arguments.Guidance())
    assert words[words.index("--preview-every") + 1] == str(every)


def test_what_the_panel_leaves_alone_is_no_flag() -> None:
    def words(training: arguments.Training, guidance: arguments.Guidance) -> set[str]:
        return set(arguments.train(Path("python"), Path("a"), Path("b"), training, guidance))

    silent = words(arguments.Training(), arguments.Guidance())
    optional = {"--resolution", "--max-gaussians", "--views", "--eval", "--prompts", "--ref-image", "--prior"}
    optional |= {"--lambda-sds", "--guidance.front-view", "--guidance.device"}
    assert not silent & optional
    given = arguments.Training(downscale=2, max_gaussians=1, views=1, hold_out=True)
    guided = arguments.Guidance("sd21", 0.25, Path("p.json"), (Path("r.png"),), "cpu", 0)
    assert optional <= words(given, guided)
    assert {"0.25", "p.json", "r.png", "0"} <= words(given, guided)


def test_words_of_an_interpreter_are_cut_to_what_the_panel_shows() -> None:
    with pytest.raises(InputError) as caught:
        interpreter.read_answer("first\n" + "x" * 300, "python")
    assert str(caught.value) == f"python has no working gsopt: {'x' * 200}. Choose another one."
    answer = {"gsopt": "9." + "1" * 60, "rasterizer": {"isa": "", "backend": "cuda", "ms_per_step": 1}}
    with pytest.raises(InputError) as caught:
        interpreter.read_answer(json.dumps(answer), "python")
    assert f"has gsopt 9.{'1' * 38}, this" in str(caught.value)
    answer["gsopt"] = "0.2"
    assert interpreter.read_answer(json.dumps(answer), "python").line == "gsopt 0.2: cuda, 1 ms a step"
    answer["rasterizer"] = {"isa": "avx2", "backend": "cpu", "ms_per_step": 1, "problem": "no kernels"}
    assert interpreter.read_answer(json.dumps(answer), "python").line == "gsopt 0.2: no kernels"


def test_the_scale_stands_in_the_first_16_kb_of_a_header(tmp_path: Path) -> None:
    for before, scale in ((16_384 - 64, 0.5), (16_384, 1.0)):
        (tmp_path / "a.ply").write_bytes(b"ply\ncomment " + b"x" * before + b"\ncomment meters per unit: 0.5\n")
        assert units.meters_per_unit(tmp_path / "a.ply") == scale


def test_a_folder_without_poses_has_no_views_and_one_that_is_absent_no_pictures(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no posed views"):
        cameras.read_views(tmp_path)
    assert dataset.count_png(tmp_path / "absent") == 0
    for name in ("a.png", "b.png", "c.jpg"):
        (tmp_path / name).touch()
    assert dataset.count_png(tmp_path) == 2
