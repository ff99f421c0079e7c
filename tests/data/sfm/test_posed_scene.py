"""Laws of a scene that was found: true poses, formats that agree, the same bits again, nothing half-written."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import textured_room as room
from PIL import Image

from gsopt import cli
from gsopt.data.colmap import read_colmap
from gsopt.data.posed_images import PosedImage
from gsopt.data.scene import load_scene
from gsopt.data.sfm.pipeline import PosedScene, pose_photos
from gsopt.data.sfm.reuse import made_from, needs_poses, posed_scene
from gsopt.data.sfm.trajectory import compare
from gsopt.data.transforms import read_transforms
from gsopt.errors import InputError, UsageError

ROTATION, POSITION = 0.3, 0.005
"""Degrees, and share of the path: pictures of 400 px carry no more."""


def viewmats(frames: list[PosedImage]) -> np.ndarray:
    return np.stack([frame.viewmat.numpy() for frame in frames])


def contents(folder: Path) -> dict[str, bytes]:
    files = (path for path in sorted(folder.rglob("*")) if path.is_file() and path.name != "sfm.json")
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


def test_found_poses_are_the_true_ones(posed_room: PosedScene) -> None:
    error = compare(viewmats(read_colmap(posed_room.path).frames), room.arc(6).numpy())
    assert error.rotation_degrees.max() < ROTATION
    assert error.position.max() < POSITION


def test_colmap_and_transforms_describe_the_same_cameras_and_points(posed_room: PosedScene) -> None:
    ours, theirs = read_colmap(posed_room.path), read_transforms(posed_room.path)
    assert [frame.name for frame in ours.frames] == [frame.name for frame in theirs.frames]
    np.testing.assert_allclose(viewmats(ours.frames), viewmats(theirs.frames), atol=1e-12)
    np.testing.assert_allclose(ours.frames[0].K, theirs.frames[0].K)
    assert ours.frames[0].lens.is_pinhole
    assert len(ours.xyz) == len(theirs.xyz) == posed_room.diagnosis.points


def test_the_placement_can_be_taken_back(posed_room: PosedScene) -> None:
    placed = json.loads((posed_room.path / "sfm.json").read_text())["placed_from_found"]
    rotation = np.array(placed["rotation"])
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    document = json.loads((posed_room.path / "transforms.json").read_text())
    assert document["applied_scale"] == placed["scale"]
    applied = placed["scale"] * np.array(document["applied_transform"])
    np.testing.assert_allclose(applied, np.column_stack([placed["scale"] * rotation, placed["translation"]]))


def test_points_have_the_colors_that_the_photos_show(posed_room: PosedScene) -> None:
    scene = load_scene(posed_room.path)
    view = scene.train[2]
    t = scene.points.xyz @ view.camera.viewmats[0, :3, :3].T + view.camera.viewmats[0, :3, 3]
    pixels = (t @ view.camera.Ks[0].T)[:, :2] / t[:, 2:]
    inside = (pixels > 2).all(1) & (pixels[:, 0] < room.WIDTH - 2) & (pixels[:, 1] < room.HEIGHT - 2)
    shown = view.pixels()[pixels[inside, 1].long(), pixels[inside, 0].long(), :3].float()
    assert float((shown - scene.points.rgb[inside].float()).abs().median()) < 25


def test_the_same_photos_give_the_same_bits_for_any_number_of_threads(
    posed_room: PosedScene, room_photos: Path, tmp_path: Path
) -> None:
    again = pose_photos(room_photos, tmp_path / "again", replace(room.QUICK, threads=2))
    assert contents(again.path) == contents(posed_room.path)


@pytest.mark.parametrize("mapper", ["global", "hybrid"])
def test_the_other_mappers_find_the_same_poses(room_photos: Path, tmp_path: Path, mapper: str) -> None:
    posed = pose_photos(room_photos, tmp_path / "scene", replace(room.QUICK, mapper=mapper))
    assert posed.diagnosis.mapper == mapper
    error = compare(viewmats(read_colmap(posed.path).frames), room.arc(6).numpy())
    assert error.rotation_degrees.max() < ROTATION


def test_global_mapping_finds_the_lens_where_exif_tells_none(tmp_path: Path) -> None:
    room.photograph(tmp_path / "photos", room.arc(8), exif=False)
    posed = pose_photos(tmp_path / "photos", tmp_path / "scene", replace(room.QUICK, mapper="global"))
    assert len(posed.diagnosis.registered) == 8
    frames = read_colmap(posed.path).frames
    assert compare(viewmats(frames), room.arc(8).numpy()).rotation_degrees.max() < 2 * ROTATION
    assert abs(float(frames[0].K[0, 0]) / room.FOCAL - 1) < 0.05


def test_photos_stored_sideways_and_in_other_sizes_find_their_place(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    names = room.photograph(photos, room.arc(6))
    for name, tag, turn in ((names[1], 6, Image.Transpose.ROTATE_90), (names[3], 3, Image.Transpose.ROTATE_180)):
        exif = room.focal_exif()
        exif[0x112] = tag
        with Image.open(photos / name) as image:
            turned = image.transpose(turn)
        turned.save(photos / name, quality=95, exif=exif)
    with Image.open(photos / names[4]) as image:
        smaller = image.resize((320, 240), Image.Resampling.BOX)
    smaller.save(photos / names[4], quality=95, exif=room.focal_exif())
    posed = pose_photos(photos, tmp_path / "scene", room.QUICK)
    assert len(posed.diagnosis.registered) == 6
    source = read_colmap(posed.path)
    assert compare(viewmats(source.frames), room.arc(6).numpy()).rotation_degrees.max() < ROTATION
    assert [(frame.width, frame.height) for frame in source.frames][3:5] == [(400, 300), (320, 240)]


def test_known_poses_are_kept_and_get_points(posed_room: PosedScene, tmp_path: Path) -> None:
    known = tmp_path / "known"
    (known / "images").mkdir(parents=True)
    for path in (posed_room.path / "images").iterdir():
        shutil.copy(path, known / "images")
    shutil.copy(posed_room.path / "transforms.json", known)
    posed = pose_photos(known, tmp_path / "scene", replace(room.QUICK, poses="prior"))
    before, after = read_transforms(known), read_colmap(posed.path)
    np.testing.assert_allclose(viewmats(after.frames), viewmats(before.frames), atol=1e-9)
    np.testing.assert_allclose(after.frames[0].K, before.frames[0].K)
    assert len(after.xyz) > 300


def test_masks_become_alpha_and_keep_features_out(room_photos: Path, tmp_path: Path) -> None:
    masks = tmp_path / "masks"
    masks.mkdir()
    left = Image.new("L", (room.WIDTH, room.HEIGHT), 0)
    left.paste(255, (0, 0, 260, room.HEIGHT))
    for photo in room_photos.iterdir():
        left.save(masks / f"{photo.name}.png")
    posed = pose_photos(room_photos, tmp_path / "scene", replace(room.QUICK, masks=str(masks)))
    view = load_scene(posed.path).train[0]
    pixels = view.pixels()
    assert pixels.shape[2] == 4
    assert int(pixels[:, :240, 3].min()) == 255
    assert int(pixels[:, 290:, 3].max()) == 0


def test_two_rooms_and_a_broken_file_in_one_folder_are_told_apart(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    room.photograph(photos, room.arc(5))
    (photos / "broken.jpg").write_bytes(b"not a photo")
    others = room.photograph(photos, room.arc(4), seed=7, first=5)
    report = pose_photos(photos, tmp_path / "scene", room.QUICK).diagnosis
    assert len(report.registered) == 5
    assert {left.name: left.kind for left in report.left} == {**dict.fromkeys(others, "apart"), "broken.jpg": "refused"}
    assert any("4 photos match only each other" in text for text in report.advice)


def test_too_few_photos_leave_nothing_behind(tmp_path: Path) -> None:
    room.photograph(tmp_path / "photos", room.arc(8)[[0, 1]])
    with pytest.raises(InputError, match=r"fewer than 3 of 2(.|\n)*Two photos: they have \d+ features in common"):
        pose_photos(tmp_path / "photos", tmp_path / "scene", room.QUICK)
    assert [path.name for path in tmp_path.iterdir()] == ["photos"]


def test_an_output_that_exists_is_left_alone(posed_room: PosedScene, room_photos: Path) -> None:
    before = contents(posed_room.path)
    with pytest.raises(UsageError, match="must not exist yet"):
        pose_photos(room_photos, posed_room.path, room.QUICK)
    assert contents(posed_room.path) == before


def test_poses_are_looked_for_only_where_there_are_none(
    posed_room: PosedScene, room_photos: Path, tmp_path: Path
) -> None:
    assert needs_poses(room_photos)
    assert not needs_poses(posed_room.path)
    assert not needs_poses(tmp_path)
    said: list[str] = []
    shutil.copytree(posed_room.path, tmp_path / "room-posed")
    assert posed_scene(room_photos, tmp_path, room.QUICK, said.append) == tmp_path / "room-posed"
    assert said == [f"poses found earlier: {tmp_path / 'room-posed'}"]


def test_a_scene_of_other_features_or_masks_is_not_taken_again(room_photos: Path, tmp_path: Path) -> None:
    masks = tmp_path / "masks"
    masks.mkdir()
    for photo in room_photos.iterdir():
        Image.new("L", (room.WIDTH, room.HEIGHT), 255).save(masks / f"{photo.name}.png")
    chosen = replace(room.QUICK, masks=str(masks))
    scene = pose_photos(room_photos, tmp_path / "scene", chosen).path
    assert made_from(scene, room_photos, chosen)
    assert made_from(scene, room_photos, replace(chosen, features="auto"))
    for other in (replace(chosen, features="both"), replace(chosen, masks="auto"), replace(chosen, seed=1)):
        assert not made_from(scene, room_photos, other)
    next(masks.iterdir()).unlink()
    assert not made_from(scene, room_photos, chosen)


def test_the_command_reports_and_answers_with_exit_codes(tmp_path: Path, capsys) -> None:
    room.photograph(tmp_path / "one", room.arc(6)[:1])
    assert cli.main(["sfm", str(tmp_path / "one"), "-o", str(tmp_path / "scene")]) == InputError.exit_code
    err = capsys.readouterr().err
    assert "One photo alone has no parallax" in err
    assert "--lambda-sds" in err
    assert not (tmp_path / "scene").exists()
