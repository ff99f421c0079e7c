"""Laws of poses on which silhouettes agree."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import textured_room as room
import torch
from balls import Ball, ring, write_balls
from PIL import Image

from gsopt.data.scene import View, load_scene
from gsopt.data.sfm import pipeline, pose_search, silhouettes
from gsopt.data.sfm.held_by_silhouettes import REFUTED, held_by_silhouettes, loosely_held, outline_misses
from gsopt.data.sfm.mapping import registered
from gsopt.data.sfm.masks import FeatureInput
from gsopt.data.sfm.photos import find_photos
from gsopt.data.sfm.settings import SfmConfig
from gsopt.data.sfm.silhouettes import COHERENT, Coherence, coherent_poses, contradicting
from gsopt.data.sfm.trajectory import compare
from gsopt.errors import InputError
from gsopt.geometry.rigid_motion import rigid_motion

THING = [
    Ball((0.0, 0.0, 0.0), 0.5),
    Ball((0.5, 0.2, 0.3), 0.3),
    Ball((-0.4, 0.3, -0.35), 0.25),
    Ball((0.1, -0.55, 0.2), 0.2),
]
COUNT, SIZE = 8, 192


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_balls(tmp_path_factory.mktemp("thing") / "scene", THING, ring(COUNT, size=SIZE))


@pytest.fixture(scope="module")
def views(folder: Path) -> tuple[View, ...]:
    return load_scene(folder).train


def disturbed(views: tuple[View, ...], degrees: float) -> list[View]:
    """Views whose cameras see the world turned about its origin and shifted."""
    generator = torch.Generator().manual_seed(1)
    moved = []
    for view in views:
        turn = torch.nn.functional.normalize(torch.randn(3, generator=generator, dtype=torch.float64), dim=0)
        shift = torch.randn(3, generator=generator, dtype=torch.float64) * 0.01
        motion = rigid_motion(torch.cat([math.radians(degrees) * turn, torch.zeros(3, dtype=torch.float64)]))
        viewmat = view.camera.viewmats[0].double() @ motion
        viewmat[:3, 3] += shift
        moved.append(replace(view, camera=replace(view.camera, viewmats=viewmat[None].float())))
    return moved


def viewmats(views: Any) -> np.ndarray:
    return np.stack([view.camera.viewmats[0].double().numpy() for view in views])


def test_disturbed_cameras_come_nearer_to_where_they_stood(views: tuple[View, ...]) -> None:
    wrong = disturbed(views, 0.7)
    found = coherent_poses(wrong)
    assert found is not None
    assert found.better
    assert found.after < 0.3 * found.before
    before, after = (compare(poses, viewmats(views)) for poses in (viewmats(wrong), found.viewmats.numpy()))
    assert np.square(after.position).sum() < 0.85 * np.square(before.position).sum()
    assert np.square(after.rotation_degrees).sum() < 0.95 * np.square(before.rotation_degrees).sum()


def test_exact_cameras_stay(views: tuple[View, ...]) -> None:
    found = coherent_poses(views)
    assert found is not None
    assert not found.better
    assert torch.equal(found.viewmats.float(), torch.cat([view.camera.viewmats for view in views]))


@pytest.mark.parametrize(
    ("before", "after", "better", "contradicted"),
    [
        (0.3, 0.1, False, False),
        (0.31, 0.155, True, False),
        (0.4, 0.21, False, False),
        (3.0, 1.99, False, False),
        (3.0, 2.0, False, True),
        (5.0, 2.5, True, True),
    ],
)
def test_poses_are_better_where_half_of_the_misses_go(
    before: float, after: float, better: bool, contradicted: bool
) -> None:
    found = silhouettes.CoherentPoses(torch.eye(4)[None], before, after)
    assert (found.better, found.contradicted) == (better, contradicted)


def test_any_number_of_threads_gives_the_same_bits(views: tuple[View, ...]) -> None:
    wrong, before = disturbed(views, 0.5), torch.get_num_threads()
    found = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        found.append(coherent_poses(wrong))
    torch.set_num_threads(before)
    assert found[0] is not None
    assert found[1] is not None
    assert torch.equal(found[0].viewmats, found[1].viewmats)


def test_masks_of_another_thing_move_nothing(tmp_path: Path, views: tuple[View, ...]) -> None:
    """Half of the photos show a larger ball beside it: no poses make these outlines agree."""
    other = write_balls(tmp_path / "other", [Ball((0.5, 0.5, 0.4), 0.7)], ring(COUNT, size=SIZE))
    mixed = [*views[: COUNT // 2], *load_scene(other).train[COUNT // 2 :]]
    found = coherent_poses(mixed)
    assert found is not None
    assert found.before > COHERENT
    assert not found.better


def test_photos_without_an_outline_move_nothing(views: tuple[View, ...]) -> None:
    class Opaque:
        def get(self, index: int) -> torch.Tensor:
            return torch.full((SIZE, SIZE, 4), 255, dtype=torch.uint8)

    wrong = disturbed(views, 0.7)
    assert coherent_poses([replace(wrong[0], store=Opaque()), *wrong[1:]]) is None


def test_the_derivatives_are_those_of_the_misses_among_the_same_points(views: tuple[View, ...]) -> None:
    coherence = Coherence([silhouettes.outline(view) for view in disturbed(views, 0.7)])
    depths = coherence.near_optima(coherence.viewmats)
    J = coherence.jacobian(coherence.viewmats, depths, coherence.distances(coherence.viewmats, depths))
    for column in (0, 4, 11, 25):
        change = torch.zeros(J.shape[1], dtype=torch.float64)
        change[column] = silhouettes.STEP
        ahead, behind = (
            coherence.misses(coherence.distances(coherence.moved(coherence.viewmats, way * change), depths))
            for way in (1, -1)
        )
        torch.testing.assert_close(J[:, column], (ahead - behind) / (2 * silhouettes.STEP), atol=1e-6, rtol=1e-6)


@pytest.fixture
def work(tmp_path: Path, folder: Path) -> Path:
    """Photos and their masks as the pipeline lays them out."""
    (tmp_path / "photos").mkdir()
    for path in sorted((folder / "train").iterdir()):
        Image.open(path).save(tmp_path / "photos" / path.name)
    return tmp_path


def names_of(views: tuple[View, ...]) -> list[str]:
    return [f"{Path(view.name).stem}.png" for view in views]


def reconstruction(pycolmap: Any, truth: Any, cameras: Any, names: list[str]) -> Any:
    """Points on the thing that every photo sees, where `truth` sees them, and cameras that may stand elsewhere."""
    K = truth[0].camera.Ks[0].double().numpy()
    made = pycolmap.Reconstruction()
    lens = pycolmap.Camera(
        model="PINHOLE", width=SIZE, height=SIZE, params=[K[0, 0], K[1, 1], K[0, 2], K[1, 2]], camera_id=1
    )
    made.add_camera_with_trivial_rig(lens)
    generator = np.random.default_rng(0)
    points = generator.uniform(-0.5, 0.5, (200, 3))
    for number, (view, camera, name) in enumerate(zip(truth, cameras, names, strict=True), start=1):
        seen = points @ viewmats([view])[0][:3, :3].T + viewmats([view])[0][:3, 3]
        pixels = (seen @ K.T)[:, :2] / seen[:, 2:]
        image = pycolmap.Image(name=name, keypoints=pixels, camera_id=1, image_id=number)
        made.add_image_with_trivial_frame(image, pycolmap.Rigid3d(np.ascontiguousarray(viewmats([camera])[0][:3])))
    for row, point in enumerate(points):
        track = pycolmap.Track()
        for number in range(1, len(names) + 1):
            track.add_element(number, row)
        made.add_point3D(point, track, np.zeros(3, np.uint8))
    made.update_point_3d_errors()
    return made


def held(work: Path, made: Any, pycolmap: Any, **changed: Any) -> tuple[Any, list[str], list[str]]:
    """The reconstruction, the advice and the progress."""
    said: list[str] = []
    inputs = replace(FeatureInput(work / "photos", work / "photos", "alpha", []), **changed)
    project: Any = SimpleNamespace(pycolmap=pycolmap, config=SfmConfig())
    return *held_by_silhouettes(project, made, inputs, work / "held", said.append), said


def test_a_reconstruction_follows_its_silhouettes_and_its_points_follow_too(
    work: Path, views: tuple[View, ...]
) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    names = names_of(views)
    made = reconstruction(pycolmap, views, disturbed(views, 0.5), names)
    before = made.compute_mean_reprojection_error()
    moved, advice, said = held(work, made, pycolmap)
    assert moved is not made
    assert advice == []
    assert "silhouettes moved poses" in said[0]
    assert moved.num_points3D() > 150
    poses = {moved.image(number).name: moved.image(number).cam_from_world().matrix() for number in range(1, COUNT + 1)}
    coherent = coherent_poses(disturbed(views, 0.5))
    assert coherent is not None
    for name, viewmat in zip(names, coherent.viewmats.numpy(), strict=True):
        np.testing.assert_allclose(poses[name], viewmat[:3], atol=2e-3)
    assert moved.compute_mean_reprojection_error() < 0.6 * before


def test_photos_without_masks_keep_their_poses(work: Path, views: tuple[View, ...]) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    names = names_of(views)
    made = reconstruction(pycolmap, views, disturbed(views, 0.5), names)
    assert held(work, made, pycolmap, masks=None, kind="none") == (made, [], [])
    assert held(work, made, pycolmap, unmasked=[names[2]]) == (made, [], [])


@pytest.mark.parametrize(("lost", "moves"), [(40, True), (41, False)])
def test_points_that_contradict_the_silhouettes_win(
    lost: int, moves: bool, work: Path, views: tuple[View, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A fifth of 200 points may be lost where the cameras move."""
    pycolmap = pytest.importorskip("pycolmap")
    made = reconstruction(pycolmap, views, disturbed(views, 0.5), names_of(views))

    def without(project: Any, model: Any, *, lens: bool, poses: bool) -> Any:
        assert (lens, poses) == (False, False)
        for number in sorted(model.points3D)[:lost]:
            model.delete_point3D(number)
        return model

    monkeypatch.setattr("gsopt.data.sfm.held_by_silhouettes.bundle_adjusted", without)
    assert (held(work, made, pycolmap)[0] is not made) == moves


@pytest.mark.parametrize(("misses", "believed"), [(4.0, False), (3.99, True)])
def test_advice_or_refusal_follows_where_no_poses_near_fit_the_masks(
    misses: float, believed: bool, work: Path, views: tuple[View, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Half of the photos stand where others were taken from."""
    pycolmap = pytest.importorskip("pycolmap")
    wrong = misplaced(views, (0, 2, 4, 6))
    real = coherent_poses(wrong)
    assert real is not None
    assert real.after > REFUTED
    monkeypatch.setattr("gsopt.data.sfm.held_by_silhouettes.coherent_poses", lambda views: replace(real, after=misses))
    found, advice, said = held(work, made := reconstruction(pycolmap, wrong, wrong, names_of(views)), pycolmap)
    assert (found is made, found is None, said) == (believed, not believed, [])
    assert "do not fit these poses" in advice[0]


def test_misses_of_a_reconstruction_are_those_of_the_best_poses_near_it(
    work: Path, views: tuple[View, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """In pixels of the photos, whatever size they are learned at."""
    pycolmap = pytest.importorskip("pycolmap")
    names, folder = names_of(views), work / "held"
    inputs = FeatureInput(work / "photos", work / "photos", "alpha", [])
    near = reconstruction(pycolmap, views, disturbed(views, 0.5), names)
    misses = outline_misses(near, inputs, folder)
    assert 0 < misses < 0.5
    monkeypatch.setattr("gsopt.data.scene.LONGEST_SIDE", 20)
    assert outline_misses(near, inputs, folder) == misses
    wrong = misplaced(views, (0, 2, 4, 6))
    assert outline_misses(reconstruction(pycolmap, wrong, wrong, names), inputs, folder) > REFUTED
    one = misplaced(views, (2,))
    for share, left_out in ((0.1, True), (0.9, False)):
        made = with_points_seen(reconstruction(pycolmap, one, one, names), 3, share)
        assert (outline_misses(made, inputs, folder) < COHERENT) == left_out
    assert outline_misses(near, replace(inputs, unmasked=[names[1]]), folder) is None
    assert outline_misses(near, replace(inputs, masks=None), folder) is None


def misplaced(views: tuple[View, ...], wrong: tuple[int, ...]) -> list[View]:
    """Some photos stand a quarter of the ring from where they were taken."""
    cameras = [views[(row + 2) % COUNT if row in wrong else row].camera for row in range(COUNT)]
    return [replace(view, camera=camera) for view, camera in zip(views, cameras, strict=True)]


@pytest.mark.parametrize("wrong", [(1,), (0, 3), (1, 4, 6)])
def test_the_photos_whose_outlines_contradict_the_others_are_named(
    wrong: tuple[int, ...], views: tuple[View, ...]
) -> None:
    assert contradicting(misplaced(views, wrong)) == list(wrong)


def test_nobody_is_named_among_three(views: tuple[View, ...]) -> None:
    assert contradicting(misplaced(views, (1,))[:4]) == [1]
    assert contradicting(misplaced(views, (1,))[:3]) == []


def test_nobody_is_named_where_half_contradicts_half(views: tuple[View, ...]) -> None:
    assert contradicting(misplaced(views, (0, 2, 4, 6))) == []


def with_points_seen(made: Any, number: int, share: float) -> Any:
    """The reconstruction after a photo has lost sight of most points."""
    for point_id in sorted(made.points3D)[int(share * made.num_points3D()) :]:
        row = next(
            element.point2D_idx for element in made.point3D(point_id).track.elements if element.image_id == number
        )
        made.delete_observation(number, row)
    return made


@pytest.mark.parametrize(("share", "loose"), [(0.245, True), (0.25, False)])
def test_less_than_a_quarter_of_the_usual_points_hold_loosely(
    share: float, loose: bool, views: tuple[View, ...]
) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    made = with_points_seen(reconstruction(pycolmap, views, views, names_of(views)), 3, share)
    assert loosely_held(made, {3}) == loose
    assert not loosely_held(made, {3, 4})


def test_a_photo_with_a_wrong_outline_and_few_points_is_left_out(work: Path, views: tuple[View, ...]) -> None:
    """The others are then held by their silhouettes as ever."""
    pycolmap = pytest.importorskip("pycolmap")
    names = names_of(views)
    wrong = misplaced(views, (2,))
    made = with_points_seen(reconstruction(pycolmap, wrong, wrong, names), 3, 0.1)
    found, advice, _ = held(work, made, pycolmap)
    assert registered(found) == set(names) - {names[2]}
    assert registered(made) == set(names)
    assert len(advice) == 1
    assert f"Left out: {names[2]}. " in advice[0]
    right = [view for row, view in enumerate(views) if row != 2]
    poses = {
        found.image(number).name: found.image(number).cam_from_world().matrix() for number in found.reg_image_ids()
    }
    poses_of_others = np.stack([np.vstack([poses[f"{Path(view.name).stem}.png"], [0, 0, 0, 1]]) for view in right])
    assert compare(poses_of_others, viewmats(right)).rotation_degrees.max() < 0.2


def test_a_photo_with_a_wrong_outline_and_many_points_is_named(work: Path, views: tuple[View, ...]) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    wrong = misplaced(views, (2,))
    made = reconstruction(pycolmap, wrong, wrong, names_of(views))
    found, advice, said = held(work, made, pycolmap)
    assert (found is made, said) == (True, [])
    assert f"The outlines in the masks of {names_of(views)[2]} contradict" in advice[0]


@pytest.mark.parametrize("believed", [True, False])
def test_few_photos_are_held_by_their_masks(
    believed: bool, room_photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The note of a contradiction is advice in the diagnosis, or in the refusal."""
    seen: list[FeatureInput] = []

    def contradicted(project: Any, made: Any, inputs: FeatureInput, folder: Path, report: Any) -> tuple[Any, list[str]]:
        seen.append(inputs)
        return made if believed else None, ["They do not fit."]

    monkeypatch.setattr(pose_search, "held_by_silhouettes", contradicted)
    masks = tmp_path / "masks"
    masks.mkdir()
    for photo in find_photos(room_photos):
        Image.new("L", Image.open(photo).size, 255).save(masks / f"{photo.stem}.png")
    (tmp_path / "work").mkdir()
    config = replace(room.QUICK, masks=str(masks))
    if not believed:
        with pytest.raises(InputError, match=r"(?s)No scene: .*They do not fit."):
            pipeline.write_posed_scene(room_photos, tmp_path / "work", config, lambda line: None)
        return
    diagnosis, _ = pipeline.write_posed_scene(room_photos, tmp_path / "work", config, lambda line: None)
    assert [inputs.kind for inputs in seen] == ["folder"]
    assert diagnosis.advice[0] == "They do not fit."
