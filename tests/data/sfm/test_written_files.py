"""Files that a search for poses writes, without COLMAP: masks and opaque copies, photos as taken, the record."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from gsopt.data.sfm import masks, pipeline, write_scene
from gsopt.data.sfm.masks import FeatureInput, mask_folder, prepare_masks
from gsopt.data.sfm.photos import Photo
from gsopt.data.sfm.placement import Similarity
from gsopt.data.sfm.settings import SfmConfig
from gsopt.errors import InputError, UsageError

RED, CLEAR = (200, 30, 10, 255), (7, 7, 7, 0)


def photo(work: Path, name: str, alpha: bool) -> Photo:
    """A red photo of 6 x 4 px; one with alpha has an empty left half."""
    image = Image.new("RGBA", (6, 4), RED)
    if alpha:
        image.paste(CLEAR, (0, 0, 3, 4))
    (work / "photos").mkdir(exist_ok=True)
    path = work / "photos" / f"{name}.png"
    (image if alpha else image.convert("RGB")).save(path)
    return Photo(f"{name}.png", Path(f"/source/{name}.tif"), path, 6, 4, "c", None, 1.0, alpha, np.zeros((32, 32)))  # type: ignore[arg-type]


def gray(path: Path) -> Any:
    with Image.open(path) as image:
        return np.asarray(image.convert("L"))


@pytest.mark.parametrize(
    ("choice", "alpha", "kind", "unmasked"),
    [
        ("auto", [True, False], "alpha", ["b.png"]),
        ("alpha", [True, True], "alpha", []),
        ("auto", [False, False], "none", []),
        ("none", [True, False], "none", []),
        ("none", [False, False], "none", []),
    ],
)
def test_masks_are_the_photos_own_alpha_where_somebody_wants_them_and_some_have_it(
    tmp_path: Path, choice: str, alpha: list[bool], kind: str, unmasked: list[str]
) -> None:
    """Features are found in opaque copies, in which gray stands for what is transparent."""
    photos = [photo(tmp_path, name, has) for name, has in zip("ab", alpha, strict=True)]
    found = prepare_masks(choice, tmp_path / "nowhere", photos, tmp_path)
    assert (found.kind, found.unmasked) == (kind, unmasked)
    assert found.masks == (tmp_path / "masks" if kind == "alpha" else None)
    assert found.photos == tmp_path / ("opaque" if any(alpha) else "photos")
    if kind == "alpha":
        assert gray(tmp_path / "masks" / "a.png.png").tolist() == [[0] * 3 + [255] * 3] * 4
    for one in photos:
        with Image.open(found.photos / one.name) as image:
            pixels = np.asarray(image)
        assert pixels.shape == (4, 6, 3)
        assert pixels[0, 5].tolist() == list(RED[:3])
        assert pixels[0, 0].tolist() == ([128, 128, 128] if one.has_alpha else list(RED[:3]))
        assert (found.photos / one.name).is_symlink() == (any(alpha) and not one.has_alpha)


def test_alpha_that_no_photo_has_and_a_folder_that_is_not_there_are_refused(tmp_path: Path) -> None:
    photos = [photo(tmp_path, "a", False)]
    with pytest.raises(InputError, match="needs photos with transparency, got 1 without"):
        prepare_masks("alpha", tmp_path, photos, tmp_path)
    with pytest.raises(InputError, match="names no folder: got /no/such"):
        prepare_masks("/no/such", tmp_path, photos, tmp_path)


@pytest.mark.parametrize("choice", ["auto", "named"])
@pytest.mark.parametrize(("inside", "white"), [(1, 255), (2, 2), (255, 255)])
def test_masks_of_a_folder_are_copied_and_those_of_ones_become_white(
    tmp_path: Path, choice: str, inside: int, white: int
) -> None:
    """They lie in masks/ beside the photos, or where the flag says; photos without one are named."""
    source = tmp_path / "in"
    folder = source / "masks" if choice == "auto" else tmp_path / "elsewhere"
    folder.mkdir(parents=True)
    mask = np.zeros((4, 6), np.uint8)
    mask[:, 2:] = inside
    Image.fromarray(mask).save(folder / "a.png")
    photos = [photo(tmp_path, "a", False), photo(tmp_path, "b", True)]
    found = prepare_masks("auto" if choice == "auto" else str(folder), source, photos, tmp_path)
    assert (found.kind, found.unmasked, found.masks) == ("folder", ["b.png"], tmp_path / "masks")
    assert gray(tmp_path / "masks" / "a.png.png").tolist() == [[0, 0] + [white] * 4] * 4
    assert [path.name for path in (tmp_path / "masks").iterdir()] == ["a.png.png"]
    assert mask_folder("none", source) is None
    assert mask_folder("alpha", source) is None


def test_a_folder_with_a_mask_for_none_of_the_photos_is_refused(tmp_path: Path) -> None:
    (tmp_path / "masks-of-others").mkdir()
    with pytest.raises(InputError, match="has a mask for none of the 2 photos"):
        masks._from_folder(tmp_path / "masks-of-others", [photo(tmp_path, n, False) for n in "ab"], tmp_path / "masks")


class Model:
    """A reconstruction of photos 1 and 2, whose file is its own text; COLMAP's writers may lose the end of it."""

    def __init__(
        self, names: tuple[str, ...] = ("a.jpg", "b.jpg"), lost: Callable[[int], bool] = lambda k: False
    ) -> None:
        self.images = {i + 1: SimpleNamespace(name=name, camera_id=1, points2D=[]) for i, name in enumerate(names)}
        self.moved: list[Any] = []
        self.writes, self.lost = 0, lost
        self.cameras = {1: SimpleNamespace(model="OPENCV", params=[])}
        self.updated = 0

    def reg_image_ids(self) -> list[int]:
        return list(self.images)

    def image(self, number: int) -> Any:
        return self.images[number]

    def camera(self, number: int) -> Any:
        return self.cameras[number]

    def transform(self, similarity: Any) -> None:
        self.moved.append(similarity)

    def _text(self) -> str:
        self.writes += 1
        return "whole"[: 3 if self.lost(self.writes) else 5]

    def write(self, folder: Path) -> None:
        (folder / "images.bin").write_text(self._text())

    def export_PLY(self, path: Path) -> None:
        path.write_text(self._text())

    def update_point_3d_errors(self) -> None:
        self.updated += 1


@pytest.mark.parametrize("lost", [0, 1, 2])
def test_a_model_that_the_disk_took_in_part_is_told_from_a_second_copy(tmp_path: Path, lost: int) -> None:
    model = Model(lost=lambda k: k == lost)
    if lost:
        with pytest.raises(InputError, match=r"The disk took only a part of (points\.ply|images\.bin)"):
            write_scene.export_model(model, tmp_path / "scene", tmp_path / "again")
    else:
        write_scene.export_model(model, tmp_path / "scene", tmp_path / "again")
        assert (tmp_path / "scene" / "sparse" / "0" / "images.bin").read_text() == "whole"
        assert (tmp_path / "scene" / "points.ply").read_text() == "whole"


def taken(work: Path, kind: str) -> FeatureInput:
    """Photos a and b as they were taken; of a there is a mask."""
    for folder in ("photos", "masks"):
        (work / folder).mkdir()
    for name in ("a.jpg", "b.jpg"):
        (work / "photos" / name).write_text(f"photo {name}")
    (work / "masks" / "a.jpg.png").write_text("mask of a")
    return FeatureInput(work / "photos", work / "masks", kind, [])


@pytest.mark.parametrize("kind", ["folder", "alpha", "none"])
@pytest.mark.parametrize("undistort", [False, True])
def test_a_scene_is_placed_then_written_with_its_photos_and_the_masks_of_a_folder(
    tmp_path: Path, kind: str, undistort: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Alpha stays with the photos. With undistorted photos another writer does both."""
    told: list[Any] = []
    monkeypatch.setattr(write_scene, "_write_undistorted", lambda colmap, model, found, scene: told.append(found.name))
    monkeypatch.setattr(write_scene, "read_colmap", lambda scene: SimpleNamespace(frames=[]))
    colmap: Any = SimpleNamespace(Sim3d=lambda *parts: parts, Rotation3d=lambda matrix: matrix.tolist())
    similarity, model = Similarity(2.0, np.eye(3), np.array([2.0, 4.0, 6.0])), Model()
    scene = write_scene.write_scene(colmap, model, tmp_path, taken(tmp_path, kind), similarity, undistort)
    assert scene == tmp_path / "scene"
    ((scale, rotation, translation),) = model.moved
    assert (scale, rotation, translation.tolist()) == (2.0, np.eye(3).tolist(), [2, 4, 6])
    assert told == ["found"] * undistort
    if not undistort:
        assert (scene / "images" / "b.jpg").read_text() == "photo b.jpg"
        assert (scene / "masks" / "a.jpg.png").is_file() == (kind == "folder")
    document = json.loads((scene / "transforms.json").read_text())
    assert document["applied_transform"] == [[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3]]
    assert (scene / "sparse" / "0" / "images.bin").is_file()


def test_undistorted_photos_have_pinholes_and_end_in_png_where_they_have_alpha(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those of a lens without distortion and without a mask keep their bytes."""
    found, scene = tmp_path / "found", tmp_path / "scene"
    for folder in (found / "images", scene / "images"):
        folder.mkdir(parents=True)
    names = ("plain.jpg", "bent.jpg", "masked.jpg")
    for name in names:
        (found / "images" / name).write_text(name)
    K = np.array([[[5.0, 0, 3], [0, 6, 2], [0, 0, 1]]])
    import torch

    sources = [
        SimpleNamespace(undistortion=None, mask=None),
        SimpleNamespace(undistortion="lens", mask=None),
        SimpleNamespace(undistortion=None, mask="mask"),
    ]
    store = object.__new__(write_scene.ImageStore)
    store.sources = tuple(sources)  # type: ignore[assignment]
    shown = [torch.full((4, 6, 3), 90, dtype=torch.uint8), torch.full((4, 6, 3), 80, dtype=torch.uint8),
             torch.full((4, 6, 4), 70, dtype=torch.uint8)]  # fmt: skip
    views = [
        SimpleNamespace(
            name=f"images/{name}", store=store, index=i, pixels=lambda i=i: shown[i],
            camera=SimpleNamespace(Ks=torch.from_numpy(K)),
        )
        for i, name in enumerate(names)
    ]  # fmt: skip
    asked: list[Any] = []
    monkeypatch.setattr(
        write_scene, "load_scene", lambda config: (asked.append(config.path), SimpleNamespace(train=views))[1]
    )
    monkeypatch.setattr(write_scene, "straighten", lambda colmap, model, pinholes: asked.append(pinholes))
    model = Model(names)
    write_scene._write_undistorted(None, model, found, scene)  # type: ignore[arg-type]
    assert asked == [str(found), {1: [5.0, 6.0, 3.0, 2.0]}]
    assert [image.name for image in model.images.values()] == ["plain.jpg", "bent.jpg", "masked.png"]
    assert (scene / "images" / "plain.jpg").read_text() == "plain.jpg"
    with Image.open(scene / "images" / "bent.jpg") as image:
        assert (image.format, image.size) == ("JPEG", (6, 4))
        assert np.abs(np.asarray(image).astype(int) - 80).max() <= 2
        assert image.layer[0][1:3] == (1, 1), "colors are not halved"  # type: ignore[attr-defined]
    with Image.open(scene / "images" / "masked.png") as image:
        assert (image.format, image.mode) == ("PNG", "RGBA")
        assert np.asarray(image)[0, 0].tolist() == [70] * 4


def test_observations_move_to_where_a_pinhole_sees_them() -> None:
    """A photo without any is passed over; the camera becomes the pinhole."""
    points = [SimpleNamespace(xy=np.array([1.0, 2.0])), SimpleNamespace(xy=np.array([3.0, 4.0]))]
    model = Model()
    model.images[1].points2D = points

    def rays(pixels: Any) -> Any:
        assert len(pixels) == 2
        return pixels / 10

    model.cameras[1].cam_from_img = rays
    colmap: Any = SimpleNamespace(CameraModelId=SimpleNamespace(PINHOLE="pinhole"))
    write_scene.straighten(colmap, model, {1: [100.0, 50.0, 7.0, 9.0]})
    assert [point.xy.tolist() for point in points] == [[17.0, 19.0], [37.0, 29.0]]
    assert (model.cameras[1].model, model.cameras[1].params) == ("pinhole", [100.0, 50.0, 7.0, 9.0])
    assert model.updated == 1


def test_a_scene_appears_whole_and_overwrites_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The remains of a killed search beside it are swept away; an empty folder is no obstacle."""
    (tmp_path / "in").mkdir()
    swept: list[Path] = []

    def child(source: Path, work: Path, config: Any, report: Any) -> tuple[str, dict[str, float]]:
        (work / "scene").mkdir()
        (work / "scene" / "sfm.json").write_text("{}")
        return "diagnosis", {"photos": 1.5}

    monkeypatch.setattr(pipeline, "run_in_child", child)
    monkeypatch.setattr(pipeline, "sweep", swept.append)
    for name in ("new", "empty"):
        if name == "empty":
            (tmp_path / name).mkdir()
        found = pipeline.pose_photos(tmp_path / "in", tmp_path / name, SfmConfig())
        assert (found.path, found.diagnosis, found.seconds) == (tmp_path / name, "diagnosis", {"photos": 1.5})
        assert [path.name for path in (tmp_path / name).iterdir()] == ["sfm.json"]
    assert swept == []
    with pytest.raises(UsageError, match="must not exist yet"):
        pipeline.pose_photos(tmp_path / "in", tmp_path / "new", SfmConfig())
    assert swept == [tmp_path / "new"]
    shutil.rmtree(tmp_path / "new")
    (tmp_path / "new").write_text("a file")
    with pytest.raises(UsageError, match="must not exist yet"):
        pipeline.pose_photos(tmp_path / "in", tmp_path / "new", SfmConfig())
    with pytest.raises(InputError, match="does not exist"):
        pipeline.pose_photos(tmp_path / "gone", tmp_path / "other", SfmConfig())


def test_the_record_holds_what_a_later_command_asks_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from gsopt.data.sfm.diagnosis import Diagnosis

    scene = tmp_path / "scene"
    scene.mkdir()
    run = pipeline._Run(SimpleNamespace(__version__="4.1"), tmp_path, tmp_path, SfmConfig(), print)  # type: ignore[arg-type]
    run.times.seconds["photos"] = 1.23456
    monkeypatch.setattr(pipeline, "write_scene", lambda *_: scene)
    monkeypatch.setattr(pipeline, "poses", lambda model: (["a"], np.eye(4)[None]))
    monkeypatch.setattr(pipeline, "points", lambda model: (np.zeros((0, 3)), np.zeros((0, 3), np.uint8)))
    monkeypatch.setattr(pipeline, "draw_scene", lambda viewmats, names, xyz, rgb, headline: headline.encode())
    monkeypatch.setattr(pipeline, "fingerprint", lambda source: [["a", 1, 2]])
    monkeypatch.setattr(pipeline, "mask_fingerprint", lambda choice, source: [[choice]])
    report = Diagnosis(3, ["a", "b"], [], mapper="global", points=77)
    inputs = FeatureInput(tmp_path, None, "none", [])
    how, moved = SfmConfig(features="both"), Similarity(2.0, np.eye(3), np.array([1.0, 2, 3]))
    mapped: Any = SimpleNamespace(reconstruction=None)
    run._write(report, mapped, inputs, how, "exhaustive", moved)
    record = json.loads((scene / "sfm.json").read_text())
    assert (scene / "sfm.png").read_text() == report.headline()
    assert (record["version"], record["pycolmap"], record["source"]) == (1, "4.1", str(tmp_path))
    assert (record["fingerprint"], record["mask_fingerprint"]) == ([["a", 1, 2]], [["auto"]])
    assert (record["settings"]["features"], record["matching"], record["masks"]) == ("both", "exhaustive", "none")
    assert (record["report"], record["mapper"], record["points"]) == (report.lines(), "global", 77)
    assert record["placed_from_found"] == {
        "scale": 2.0, "rotation": np.eye(3).tolist(), "translation": [1.0, 2.0, 3.0],
    }  # fmt: skip
    assert record["seconds"] == {"photos": 1.23}


@pytest.mark.parametrize("known", [True, False])
def test_known_poses_stay_where_they_are_and_found_ones_are_placed(
    tmp_path: Path, known: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = pipeline._Run(SimpleNamespace(), tmp_path, tmp_path, SfmConfig(), print)  # type: ignore[arg-type]
    monkeypatch.setattr(pipeline, "poses", lambda model: ("names", "viewmats"))
    monkeypatch.setattr(pipeline, "points", lambda model: ("xyz", "rgb"))
    monkeypatch.setattr(pipeline, "place", lambda viewmats, xyz: (viewmats, xyz))
    found: Any = run._placed(SimpleNamespace(reconstruction=None), [] if known else None)  # type: ignore[arg-type]
    if known:
        assert (found.scale, found.translation.tolist()) == (1.0, [0, 0, 0])
    else:
        assert found == ("viewmats", "xyz")
