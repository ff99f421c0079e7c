"""--views, --view-ids and the held-out views."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from dataset_builders import nerf_synthetic, nerfstudio, read_document, write_json

from gsopt.config.train import DataConfig
from gsopt.data.scene import load_scene
from gsopt.data.split import telling_view
from gsopt.errors import InputError, UsageError
from gsopt.geometry.cameras import look_at


def names(root: Path, **settings: object) -> list[str]:
    return [view.name for view in load_scene(DataConfig(path=str(root), **settings)).train]  # type: ignore[arg-type]


def test_views_are_spread_and_in_list_order(tmp_path: Path) -> None:
    root = nerf_synthetic(tmp_path)
    chosen = names(root, views=4)
    assert len(set(chosen)) == 4
    assert chosen == sorted(chosen)
    assert names(root, views=10) == names(root)


@pytest.mark.parametrize("absent", [0, 2])
def test_view_ids_count_rows_of_the_file_for_nerf_synthetic_even_when_an_image_is_absent(
    absent: int, tmp_path: Path
) -> None:
    root = nerf_synthetic(tmp_path)
    (tmp_path / "train" / f"r_{absent}.png").unlink()
    assert names(root, view_ids=(5, 1)) == ["train/r_5.png", "train/r_1.png"]
    with pytest.raises(UsageError, match=f"names {absent}, but its image is absent"):
        names(root, view_ids=(absent,))


def test_view_ids_count_in_name_order_after_the_hold_out_elsewhere(tmp_path: Path) -> None:
    root = nerfstudio(tmp_path)
    assert names(root, view_ids=(0, 1)) == ["images/000.png", "images/001.png"]
    assert names(root, view_ids=(0, 1), eval=True) == ["images/001.png", "images/002.png"]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"view_ids": (10,)}, "names 10, but ids go from 0 to 9"),
        ({"view_ids": (-1,)}, "view_ids"),
        ({"view_ids": (3, 3)}, "twice"),
        ({"view_ids": ()}, "view_ids"),
        ({"views": 11}, "at most the 10 input views there are, got 11"),
    ],
)
def test_impossible_choices_are_refused(tmp_path: Path, settings: dict[str, object], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        names(nerf_synthetic(tmp_path), **settings)


def test_one_image_that_is_held_out_leaves_nothing_to_choose_from(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no input view left"):
        load_scene(DataConfig(path=str(nerfstudio(tmp_path, count=1)), eval=True, view_ids=(0,)))


def test_every_eighth_is_held_out_by_name_whatever_the_order_of_the_file(tmp_path: Path) -> None:
    root = nerf_synthetic(tmp_path)
    (root / "transforms_test.json").unlink()
    document = read_document(root, "transforms_train.json")
    document["frames"] = document["frames"][5:] + document["frames"][:5]
    write_json(root, document, "transforms_train.json")
    scene = load_scene(DataConfig(path=str(root), eval=True))
    assert [view.name for view in scene.test] == ["train/r_0.png", "train/r_8.png"]
    assert [view.name for view in scene.train] == [f"train/r_{i}.png" for i in (5, 6, 7, 9, 1, 2, 3, 4)]


def test_the_test_views_stay_whatever_is_chosen(tmp_path: Path) -> None:
    root = nerf_synthetic(tmp_path)
    for settings in ({}, {"views": 2}, {"view_ids": (1,)}, {"eval": True}):
        scene = load_scene(DataConfig(path=str(root), **settings))  # type: ignore[arg-type]
        assert [view.name for view in scene.test] == [f"test/r_{i}.png" for i in range(3)]


def test_one_view_is_taken_from_thirty_degrees_up_and_not_from_the_top() -> None:
    degrees = torch.tensor([80.0, 55.0, 33.0, 10.0, -20.0], dtype=torch.float64).deg2rad()
    azimuth = torch.arange(5, dtype=torch.float64)
    eyes = torch.stack([degrees.cos() * azimuth.cos(), degrees.cos() * azimuth.sin(), degrees.sin()], dim=1) * 3
    viewmats = look_at(eyes, torch.zeros(3, dtype=torch.float64), torch.tensor([0.0, 0, 1], dtype=torch.float64))
    assert telling_view(eyes, viewmats) == 2
    assert telling_view(eyes[:1], viewmats[:1]) == 0


@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e4])
def test_the_view_that_shows_most_is_the_same_in_any_unit_of_length(scale: float) -> None:
    """Cameras at 70, 28, -10 and 50 degrees above the object that they look at: the second is nearest to 30."""
    up = torch.tensor([0.0, 0, 1], dtype=torch.float64)
    viewmats = []
    for turn, degrees in enumerate((70.0, 28.0, -10.0, 50.0)):
        a, e = torch.tensor(1.5 * turn).double(), torch.tensor(degrees).double().deg2rad()
        eye = scale * torch.stack([a.cos() * e.cos(), a.sin() * e.cos(), e.sin()])
        viewmats.append(look_at(eye[None], torch.zeros(3).double(), up)[0])
    stacked = torch.stack(viewmats)
    centers = torch.stack([-viewmat[:3, :3].T @ viewmat[:3, 3] for viewmat in viewmats])
    assert telling_view(centers, stacked) == 1
