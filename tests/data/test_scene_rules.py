"""Rules of a scene: which folders are posed, what is warned about, and sizes that are just too far off."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from dataset_builders import colmap, nerf_synthetic, nerfstudio, save_image

from gsopt.config.train import DataConfig
from gsopt.data.scene import Points, is_posed, load_scene
from gsopt.errors import InputError


def test_a_folder_with_a_model_or_with_a_file_of_poses_is_posed(tmp_path: Path) -> None:
    for build in (colmap, nerf_synthetic, nerfstudio):
        assert is_posed(build(tmp_path / build.__name__))
    (tmp_path / "photos").mkdir()
    assert not is_posed(tmp_path / "photos")
    (tmp_path / "photos" / "transforms.json").mkdir()
    assert not is_posed(tmp_path / "photos"), "a folder of that name is no file of poses"


def test_a_scene_stands_where_its_source_does_unless_that_is_far_away(tmp_path: Path) -> None:
    scene = load_scene(nerf_synthetic(tmp_path))
    assert scene.origin == (0.0, 0.0, 0.0)
    assert replace(scene, origin=(1.0, 0.0, 0.0)).extent == scene.extent
    assert (scene.mirrored, scene.guessed, scene.body, scene.body_colors) == ((), (), None, None)


def test_cameras_that_stand_in_their_only_point_have_some_extent(tmp_path: Path) -> None:
    """A rate of zero would learn nothing; without points it is 1."""
    scene = load_scene(nerf_synthetic(tmp_path))
    one = replace(scene, train=scene.train[:1])
    center = one.train[0].camera.centers
    assert one.extent == 1.0
    assert replace(one, points=Points(center[:0], torch.zeros(0, 3, dtype=torch.uint8))).extent == 1.0
    assert replace(one, points=Points(center, torch.zeros(1, 3, dtype=torch.uint8))).extent == 1e-6


def test_input_images_without_a_depth_map_are_named(tmp_path: Path) -> None:
    """Held-out ones need none."""
    root = nerf_synthetic(tmp_path / "scene")
    for i in (0, 1, 2):
        (tmp_path / "depths" / "train").mkdir(parents=True, exist_ok=True)
        np.save(tmp_path / "depths" / "train" / f"r_{i}.npy", np.full((16, 16), 2.0, np.float32))
    scene = load_scene(DataConfig(path=str(root), depth=str(tmp_path / "depths")))
    (warning,) = scene.warnings
    assert "has no depth map for 7 of 10 input images" in warning
    assert "train/r_3.png" in warning
    assert [view.depth is not None for view in scene.train] == [True] * 3 + [False] * 7
    inverse = load_scene(DataConfig(path=str(root), depth=str(tmp_path / "depths"), depth_kind="inverse"))
    found = [one.train[0].depth for one in (scene, inverse)]
    assert [float(depth.mean()) for depth in found if depth is not None] == [0.5, 2.0]


@pytest.mark.parametrize(("side", "fine"), [(8, True), (9, False), (7, False)])
def test_a_published_smaller_image_is_off_by_less_than_a_pixel(tmp_path: Path, side: int, fine: bool) -> None:
    """Half of 16 is 8, and 7 and 9 are other images."""
    root = colmap(tmp_path)
    for width, height in ((side, 8), (8, side)):
        save_image(root / "images_2" / "im 000.png", np.zeros((height, width, 3), np.uint8))
        config = DataConfig(path=str(root), downscale=2)
        if fine:
            assert load_scene(config).train
        else:
            with pytest.raises(InputError, match="pixels, but the dataset declares 8x8"):
                load_scene(config)


def test_photos_are_completed_by_guesses_and_one_by_any_image_that_nobody_took(tmp_path: Path) -> None:
    scene = load_scene(nerf_synthetic(tmp_path))
    one, images = replace(scene, train=scene.train[:1]), scene.train[1:3]
    assert [replace(each, guessed=images).completed for each in (scene, one)] == [True, True]
    assert [replace(each, mirrored=images).completed for each in (scene, one)] == [False, True]
    assert [each.completed for each in (scene, one)] == [False, False]
    whole = replace(scene, mirrored=images, guessed=scene.train[4:5])
    assert whole.observed == (*scene.train, *images)
    assert whole.drawn == (*scene.train, *images, scene.train[4])
