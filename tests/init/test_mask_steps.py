"""Steps of masks by a network: names and boxes of crops, when a look is worth it, and what is made again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from gsopt.config.train import DataConfig
from gsopt.errors import InputError, MissingDependency, UsageError
from gsopt.geometry.cameras import Cameras
from gsopt.init import cut_out as steps
from gsopt.init.cut_out import RECORD, MaskedPhoto, MaskFolder, cut_out
from gsopt.init.object_box import Box, area, box_around, box_of_points


class Network:
    """Answers as it is told, and counts how often it is asked."""

    def __init__(self, path: Path, answer: Callable[[np.ndarray], np.ndarray]) -> None:
        path.write_bytes(b"weights")
        self.path, self.answer, self.shapes = path, answer, list[tuple[int, ...]]()

    def probabilities(self, pixels: np.ndarray) -> np.ndarray:
        self.shapes.append(pixels.shape[:2])
        return self.answer(pixels).astype(np.float32)


def photo(tmp_path: Path, width: int = 40, height: int = 20, name: str = "a") -> MaskedPhoto:
    Image.new("RGB", (width, height), (10, 20, 30)).save(tmp_path / f"{name}.png")
    return MaskedPhoto(name, tmp_path / f"{name}.png", tmp_path / "masks" / f"{name}.png")


@pytest.mark.parametrize(
    ("name", "inner"),
    [
        ("images/a/b.jpg", "a/b.png"),
        ("image/b.jpg", "b.png"),
        ("train/b.jpg", "train/b.png"),
        ("images", "images.png"),
        ("../x/b.jpg", "b.png"),
        ("a/../b.jpg", "b.png"),
        ("/abs/images/b.jpg", "b.png"),
    ],
)
def test_a_mask_lies_under_the_name_of_its_photo_within_the_folder(tmp_path: Path, name: str, inner: str) -> None:
    assert steps._mask_path(tmp_path, name) == tmp_path / "masks" / inner


@pytest.mark.parametrize(
    ("box", "before", "new"),
    [
        (None, None, False),
        ((0, 0, 10, 10), None, True),
        ((0, 0, 10, 10), (0, 0, 10, 10), False),
        ((0, 0, 10, 10), (0, 0, 10, 9), True),
        ((0, 0, 20, 10), (0, 0, 19, 10), False),
        ((0, 0, 32, 20), None, False),
        ((0, 0, 31, 20), None, True),
        ((0, 0, 40, 20), (0, 0, 4, 2), False),
    ],
)
def test_a_crop_is_looked_at_where_it_moved_and_leaves_a_fifth_of_the_photo_out(
    tmp_path: Path, box: Box | None, before: Box | None, new: bool
) -> None:
    assert steps._is_new(photo(tmp_path), box, before) == new


def test_around_a_crop_there_is_no_object(tmp_path: Path) -> None:
    network: Any = Network(tmp_path / "net", lambda pixels: np.full(pixels.shape[:2], 0.75))
    found = steps._cropped(photo(tmp_path), (3, 4, 9, 12), network)
    assert network.shapes == [(8, 6)]
    assert found.shape == (20, 40)
    assert np.flatnonzero(found.any(axis=0)).tolist() == list(range(3, 9))
    assert np.flatnonzero(found.any(axis=1)).tolist() == list(range(4, 12))
    assert set(np.unique(found)) == {0.0, 0.75}


def test_probabilities_are_rounded_to_the_nearest_of_256_values(tmp_path: Path) -> None:
    one = photo(tmp_path)
    steps._write(one, np.array([[0.0, 1.0, 0.5 / 255 + 1e-4, 0.5 / 255 - 1e-4, 100.4 / 255]], np.float32))
    assert np.asarray(Image.open(one.mask)).tolist() == [[0, 255, 1, 0, 100]]


@pytest.mark.parametrize("settles", [False, True])
def test_a_crop_is_looked_at_thrice_at_most_and_not_again_where_it_stays(tmp_path: Path, settles: bool) -> None:
    """Each answer is the red part, or half of the width that was shown."""

    def answer(pixels: np.ndarray) -> np.ndarray:
        left = np.broadcast_to(np.arange(pixels.shape[1]) < pixels.shape[1] // 2, pixels.shape[:2])
        return pixels[..., 0] > 200 if settles else left

    folder = tmp_path / "photos"
    folder.mkdir()
    shown = Image.new("RGB", (400, 300), (90, 80, 70))
    shown.paste((255, 0, 0), (100, 100, 220, 200))
    shown.save(folder / "a.png")
    network: Any = Network(tmp_path / "net", answer)
    told: list[str] = []
    made = cut_out(DataConfig(path=str(folder)), tmp_path / "cut", network, told.append)
    assert len(network.shapes) == (2 if settles else 1 + 3)
    assert told.count("looking closer at 1 photos") == len(network.shapes) - 1
    assert (made.count, made.checked, made.disagreeing) == (1, False, [])


@pytest.mark.parametrize(("value", "empty"), [(127, ["a"]), (128, [])])
def test_a_mask_that_is_nowhere_more_likely_than_not_is_empty(tmp_path: Path, value: int, empty: list[str]) -> None:
    one, other = photo(tmp_path), photo(tmp_path, name="b")
    for each, level in ((one, value), (other, 255)):
        each.mask.parent.mkdir(exist_ok=True)
        Image.new("L", (4, 3), level).save(each.mask)
    network: Any = Network(tmp_path / "net", lambda pixels: pixels)
    data = DataConfig(path=str(tmp_path))
    made = steps._finished([one, other], ["a", "b"], tmp_path / "out", network, data, tmp_path)
    assert made.empty == empty
    assert made.disagreeing == [name for name in ("a", "b") if name not in empty]
    assert made.checked
    assert not steps._finished([one, other], None, tmp_path / "out", network, data, tmp_path).checked


def test_the_boxes_of_photos_without_poses_lie_around_their_own_masks(tmp_path: Path) -> None:
    """Of what is more likely than not; a photo without that has no box."""
    one, none = photo(tmp_path, 400, 300), photo(tmp_path, 400, 300, "b")
    soft = np.zeros((300, 400), np.float32)
    soft[100:200, 50:150] = 128 / 255
    soft[10:20, 300:310] = 127 / 255
    steps._write(one, soft)
    steps._write(none, np.minimum(soft, 127 / 255))
    found = steps._boxes(DataConfig(path=str(tmp_path)), [one, none], tmp_path)
    assert found == (None, {"a": (38, 88, 162, 212)})


def test_the_report_tells_whether_masks_were_checked() -> None:
    plain = MaskFolder(Path("out"), 3)
    assert plain.lines() == ["3 masks in out (not checked: that takes poses and 3 that agree)"]
    told = MaskFolder(Path("out"), 3, ["a"], ["b"], checked=True).lines()
    assert told[0] == "3 masks in out (checked against each other)"
    assert "a" in told[1]
    assert "b disagrees" in told[2]


def test_masks_are_written_into_an_empty_folder_and_into_no_other(tmp_path: Path) -> None:
    folder, out = tmp_path / "photos", tmp_path / "cut"
    folder.mkdir()
    Image.new("RGB", (300, 200), (90, 80, 70)).save(folder / "a.png")
    network: Any = Network(tmp_path / "net", lambda pixels: np.ones(pixels.shape[:2]))
    out.write_bytes(b"")
    with pytest.raises(UsageError, match="must not exist yet"):
        cut_out(DataConfig(path=str(folder)), out, network)
    out.unlink()
    out.mkdir()
    cut_out(DataConfig(path=str(folder)), out, network)
    assert sorted(path.name for path in out.iterdir()) == ["a.png", RECORD]
    (folder / "a.png").write_bytes(b"")
    with pytest.raises(InputError, match="no photo that can be used"):
        cut_out(DataConfig(path=str(folder)), tmp_path / "other", network)
    assert not (tmp_path / "other").exists()


def test_images_whose_masks_would_share_a_file_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    frames = [SimpleNamespace(name=name, path=tmp_path / name) for name in ("images/a.jpg", "a.png")]
    monkeypatch.setattr(steps, "is_posed", lambda path: True)
    monkeypatch.setattr(steps, "_frames", lambda data: frames)
    with pytest.raises(InputError, match="differ by suffix or folder alone"):
        steps._photos(DataConfig(path=str(tmp_path)), tmp_path)


def made(folder: Path, model: Path, photos: Path) -> tuple[Path, DataConfig]:
    data, network = DataConfig(path=str(photos)), Network(model, lambda pixels: np.ones(pixels.shape[:2]))
    return cut_out(data, folder, network).path, data  # type: ignore[arg-type]


def test_masks_are_made_again_for_another_photo_another_model_or_without_a_record(tmp_path: Path) -> None:
    photos, model = tmp_path / "photos", tmp_path / "net"
    photos.mkdir()
    Image.new("RGB", (300, 200), (90, 80, 70)).save(photos / "a.png")
    folder, data = made(tmp_path / "cut", model, photos)
    record = (folder / RECORD).read_text()
    assert steps.made_from(folder, data, model)
    (tmp_path / "other").write_bytes(b"other weights")
    assert not steps.made_from(folder, data, tmp_path / "other")
    for broken in ("{}", "[", ""):
        (folder / RECORD).write_text(broken)
        assert not steps.made_from(folder, data, model)
    (folder / RECORD).unlink()
    assert not steps.made_from(folder, data, model)
    (folder / RECORD).write_text(record)
    Image.new("RGB", (300, 200), (90, 80, 71)).save(photos / "b.png")
    assert not steps.made_from(folder, data, model)


def test_made_masks_get_a_number_where_their_name_is_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And those that were made earlier are found under their number."""
    model, asked = tmp_path / "net", list[Path]()
    network: Any = Network(model, lambda pixels: pixels)

    def write(config: DataConfig, out: Path, *_: object) -> MaskFolder:
        asked.append(out)
        return MaskFolder(out, 1)

    monkeypatch.setattr(steps, "load_scene", lambda config: None)
    monkeypatch.setattr(steps, "has_masks", lambda scene: False)
    monkeypatch.setattr(steps.MaskNetwork, "open", staticmethod(lambda path: network))
    monkeypatch.setattr(steps, "cut_out", write)
    monkeypatch.setattr(steps, "made_from", lambda folder, *_: folder.name.endswith("-3"))
    config = DataConfig(path=str(tmp_path / "scene"), masks="auto", mask_model=str(model))
    told: list[str] = []
    for name in ("scene-masks", "scene-masks-2"):
        assert steps.with_made_masks(config, tmp_path, told.append).masks == str(tmp_path / name)
        assert asked[-1] == tmp_path / name
        (tmp_path / name).mkdir()
    (tmp_path / "scene-masks-3").mkdir()
    assert steps.with_made_masks(config, tmp_path, told.append).masks == str(tmp_path / "scene-masks-3")
    assert len(asked) == 2
    assert told[-1] == f"masks made earlier: {tmp_path / 'scene-masks-3'}"


@pytest.mark.parametrize(("masked", "views", "has"), [(0, 3, False), (1, 2, False), (2, 3, True), (1, 1, True)])
def test_a_scene_has_masks_where_most_of_its_views_do(masked: int, views: int, has: bool) -> None:
    shapes = [(2, 2, 4)] * masked + [(2, 2, 3)] * (views - masked)
    train = [SimpleNamespace(pixels=lambda shape=shape: torch.zeros(shape)) for shape in shapes]
    assert steps.has_masks(SimpleNamespace(train=train)) == has  # type: ignore[arg-type]


def test_photos_bring_masks_by_their_alpha_or_beside_them(tmp_path: Path) -> None:
    """A network is asked for only where neither can be, before poses are sought."""
    Image.new("RGB", (64, 64)).save(tmp_path / "a.jpg")
    Image.new("RGB", (64, 64)).save(tmp_path / "b.JPEG")
    config = DataConfig(path=str(tmp_path), masks="auto", mask_model=str(tmp_path / "nowhere.onnx"))
    assert not steps.may_bring_masks(tmp_path)
    asked: list[str] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(steps, "find_model", asked.append)
        steps.require_mask_model(replace(config, masks="given"))
        assert asked == []
        steps.require_mask_model(config)
        assert asked == [str(tmp_path / "nowhere.onnx")]
        Image.new("RGB", (64, 64)).save(tmp_path / "c.png")
        assert steps.may_bring_masks(tmp_path)
        (tmp_path / "c.png").unlink()
        (tmp_path / "masks").mkdir()
        assert steps.may_bring_masks(tmp_path)
        steps.require_mask_model(config)
        assert len(asked) == 1
    (tmp_path / "masks").rmdir()
    film = tmp_path / "film.mp4"
    film.write_bytes(b"")
    assert not steps.may_bring_masks(film)


def test_no_model_is_missed_before_poses_are_sought(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(given: str) -> None:
        raise MissingDependency("no model")

    Image.new("RGB", (64, 64)).save(tmp_path / "a.jpg")
    monkeypatch.setattr(steps, "find_model", missing)
    monkeypatch.setattr(steps, "needs_poses", lambda photos: False)
    steps.require_mask_model(DataConfig(path=str(tmp_path), masks="auto"))


@pytest.mark.parametrize(("width", "height", "box"), [(100, 100, (15, 25, 45, 75)), (200, 50, (35, 10, 85, 40))])
def test_a_box_grows_by_twelve_hundredths_of_its_longer_side(width: int, height: int, box: Box) -> None:
    """20 x 40 pixels of a mask of 100 x 100 in images of other sizes: 4.8 of 40 each, rounded outwards on the left."""
    solid = torch.zeros(100, 100, dtype=torch.bool)
    solid[30:70, 20:40] = True
    found = box_around(solid, width, height)
    assert found == box
    assert area(box) == (box[2] - box[0]) * (box[3] - box[1])


def test_a_box_of_points_holds_those_that_the_camera_sees() -> None:
    K = torch.tensor([[50.0, 0, 50], [0, 50, 40], [0, 0, 1]])
    camera = Cameras(torch.eye(4)[None], K[None], 100, 80)
    points = torch.tensor([[-0.2, -0.1, 1.0], [0.2, 0.3, 1.0], [9.0, 0, 1.0], [0, 0, -1.0]])
    assert box_of_points(camera, points) == (37, 32, 62, 57)
    assert box_of_points(camera, points[2:]) is None
    wide = torch.tensor([[-1.0, -0.8, 1.0], [0.99, 0.79, 1.0]])
    assert box_of_points(camera, wide) == (0, 0, 100, 80)


def test_a_network_sees_colors_alone_and_masks_of_one_folder_lie_together(tmp_path: Path) -> None:
    Image.new("RGBA", (300, 200), (90, 80, 70, 9)).save(tmp_path / "a.png")
    one = MaskedPhoto("a", tmp_path / "a.png", tmp_path / "masks" / "sub" / "a.png")
    assert steps._colors(one).shape == (200, 300, 3)
    assert set(np.unique(steps._colors(one))) == {90, 80, 70}
    steps._write(one, np.zeros((2, 2), np.float32))
    steps._write(replace(one, mask=one.mask.with_name("b.png")), np.zeros((2, 2), np.float32))
    assert len(list(one.mask.parent.iterdir())) == 2


@pytest.mark.parametrize("many", [False, True])
def test_photos_whose_masks_disagree_are_looked_at_where_the_others_show_the_object(
    tmp_path: Path, many: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of three input views the second disagrees; held-out views are looked at too, a view without a box is not. Of 33
    views 32 are checked, those farthest apart."""
    count = 33 if many else 3
    camera = SimpleNamespace(centers=torch.zeros(1, 3))
    train = [SimpleNamespace(name=f"t{i}", camera=camera) for i in range(count)]
    scene = SimpleNamespace(train=train, test=[SimpleNamespace(name="h0", camera=camera)], extent=1.0)
    asked: list[Any] = []
    monkeypatch.setattr(steps, "load_scene", lambda config: (asked.append(config), scene)[1])
    monkeypatch.setattr(steps, "farthest_points", lambda centers, most: range(count - 1, count - 1 - most, -1))
    monkeypatch.setattr(steps, "small_photos", lambda views, most: list(views))
    monkeypatch.setattr(steps, "find_focus", lambda cameras, extent: "focus")
    found: Any = SimpleNamespace(agreeing=[0, 2], disagreeing=[1])
    monkeypatch.setattr(
        steps, "mask_agreement", lambda photos, focus: (asked.append([p.name for p in photos]), found)[1]
    )
    monkeypatch.setattr(
        steps, "object_points", lambda photos, focus: (asked.append([p.name for p in photos]), torch.zeros(1, 3))[1]
    )
    left = iter([(1, 2, 3, 4), None, *[(5, 6, 7, 8)] * count])
    monkeypatch.setattr(steps, "box_of_points", lambda camera, points: next(left))
    disagreeing, boxes = steps._agreed(DataConfig(path="scene", downscale=4, cache_mb=99, depth="d"), tmp_path) or (
        [],
        {},
    )
    config, checked, agreeing = asked
    assert (config.masks, config.downscale, config.depth, config.cache_mb) == (str(tmp_path / "masks"), 1, None, 0)
    first = 1 if many else 0
    assert checked == [f"t{i}" for i in range(first, count)]
    assert agreeing == [f"t{first}", f"t{first + 2}"]
    assert disagreeing == [f"t{first + 1}"]
    expected = {f"t{i}" for i in range(count)} - {f"t{first}", f"t{first + 2}", "t1"} | {"h0"}
    assert set(boxes) == (expected | {"t0"} if many else {"h0"})
    monkeypatch.setattr(steps, "mask_agreement", lambda photos, focus: None)
    assert steps._agreed(DataConfig(path="scene"), tmp_path) is None
