"""Points from photos: they lie on what was photographed, or there are none."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import textured_room as room
import torch
from rooms import distance_to_the_room, room_scene

from gsopt.config.train import InitConfig
from gsopt.data.scene import AgreedPoints, Scene
from gsopt.errors import UsageError
from gsopt.init import first_gaussians
from gsopt.init.first_gaussians import ENOUGH_AGREED
from gsopt.init.stereo import stereo_points
from gsopt.init.stereo.depths import with_stereo_depths
from gsopt.raster.threads import one_torch_thread

COUNT = 4000


def points_of(scene: Scene, seed: int = 0) -> AgreedPoints:
    return stereo_points(scene, COUNT, torch.Generator().manual_seed(seed))


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return room_scene(tmp_path_factory.mktemp("scene") / "room", room.arc(4))


def test_points_lie_on_the_surfaces(scene: Scene) -> None:
    """Some four units away, and a pixel of the matched images is two hundredths of a unit wide there."""
    found = points_of(scene)
    assert len(found.xyz) == COUNT
    assert found.photos == 4
    assert found.share > 0.5
    distance = distance_to_the_room(found.xyz)
    assert float(distance.median()) < 0.01
    assert float(distance.quantile(0.95)) < 0.06


def test_points_have_the_colors_of_the_photos(scene: Scene) -> None:
    from gsopt.init.thumbnails import mean_colors, small_photos

    found = points_of(scene)
    shown = mean_colors(small_photos(scene.train, 4), found.xyz)
    assert float((shown - found.rgb).abs().mean()) < 0.08


def test_the_same_bits_for_any_number_of_threads(scene: Scene) -> None:
    runs = []
    for threads in (1, 3):
        with one_torch_thread(threads):
            runs.append(points_of(scene))
    assert torch.equal(runs[0].xyz, runs[1].xyz)
    assert torch.equal(runs[0].rgb, runs[1].rgb)


def test_photos_that_were_matched_are_not_matched_again(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    matched = with_stereo_depths(scene, 0.04, seed=0)
    assert matched.agreed is not None
    monkeypatch.setattr("gsopt.init.stereo.points.match_photos", pytest.fail)
    found = points_of(matched)
    assert len(found.xyz) == COUNT
    assert (found.photos, found.share) == (4, matched.agreed.share)
    every = torch.cat([matched.agreed.xyz, matched.agreed.rgb], 1)
    drawn = torch.cat([found.xyz, found.rgb], 1)
    assert len(torch.cat([every, drawn]).unique(dim=0)) == len(every.unique(dim=0)), "some of them, in their colors"
    assert not torch.equal(found.xyz, matched.agreed.xyz[:COUNT]), "at random"


def test_photos_of_different_rooms_agree_on_next_to_nothing(tmp_path: Path) -> None:
    strangers = points_of(room_scene(tmp_path / "rooms", room.arc(4), seeds=[0, 1, 2, 3]))
    assert strangers.share < ENOUGH_AGREED


def test_a_camera_that_only_turns_says_nothing_of_depth(tmp_path: Path) -> None:
    viewmats = room.arc(1).repeat(3, 1, 1)
    for index, angle in enumerate((0.0, 0.1, -0.1)):
        turn = torch.tensor(angle, dtype=torch.float64)
        R = torch.eye(4, dtype=torch.float64)
        R[0, 0], R[0, 2], R[2, 0], R[2, 2] = turn.cos(), turn.sin(), -turn.sin(), turn.cos()
        viewmats[index] = R @ viewmats[index]
    assert len(points_of(room_scene(tmp_path / "turned", viewmats)).xyz) == 0


def test_one_photo_has_nothing_to_agree_with(scene: Scene) -> None:
    assert len(points_of(replace(scene, train=scene.train[:1])).xyz) == 0


def test_auto_takes_stereo_where_there_are_no_masks_and_says_so(scene: Scene) -> None:
    gaussians, said = first_gaussians(scene, InitConfig(count=COUNT), 2, 0)
    assert "stereo" in said
    assert "\n" not in said
    assert len(gaussians.validate()) == 2 * COUNT  # half of them in the background
    again, _ = first_gaussians(scene, InitConfig(count=COUNT), 2, 0)
    assert torch.equal(gaussians.means, again.means)


def test_photos_that_agree_on_nothing_start_at_random(tmp_path: Path) -> None:
    strangers = room_scene(tmp_path / "rooms", room.arc(3), seeds=[0, 1, 2])
    _, said = first_gaussians(strangers, InitConfig(count=200), 2, 0)
    assert "random points" in said
    assert "agree on nothing" in said
    with pytest.raises(UsageError, match="overlap"):
        first_gaussians(strangers, InitConfig(method="stereo", count=200), 2, 0)


def test_an_object_with_masks_can_ask_for_it(scene: Scene) -> None:
    _, said = first_gaussians(replace(scene, has_alpha=True), InitConfig(method="stereo", count=200), 2, 0)
    assert "as asked" in said
