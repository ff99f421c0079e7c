"""Masks by a network: what it is shown, what is written, and what is said when it cannot be opened."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from balls import Ball, picture, ring, write_balls
from PIL import Image
from test_mask_agreement import BALLS, SIZE, photos

from gsopt.cli import main
from gsopt.config.train import DataConfig
from gsopt.data.mask_network import MODEL_VARIABLE, MaskNetwork, find_model
from gsopt.data.scene import load_scene
from gsopt.errors import InputError, MissingDependency, UsageError
from gsopt.geometry.focus import find_focus
from gsopt.init.cut_out import RECORD, cut_out, with_made_masks
from gsopt.init.object_box import box_around, box_of_points, object_points, overlap
from gsopt.init.thumbnails import small_photos

pytestmark = pytest.mark.usefixtures("coarse_hull")

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data"
MODEL = SHARED / "weights" / "u2netp.onnx"
HEAD = SHARED / "views" / "ethiopianHead_800" / "images"
needs_model = pytest.mark.skipif(not MODEL.is_file(), reason=f"{MODEL} is not on this machine")


class BrownIsTheObject:
    """A network that knows the balls' color, and takes a white plinth along where it sees the whole photo."""

    def __init__(self, path: Path) -> None:
        path.write_bytes(b"weights")
        self.path = path
        self.sizes: list[tuple[int, ...]] = []

    def probabilities(self, pixels: np.ndarray) -> np.ndarray:
        self.sizes.append(pixels.shape[:2])
        found = (pixels[..., 0].astype(int) > pixels[..., 1]).astype(np.float32)
        if pixels.shape[:2] == (SIZE, SIZE):
            found[pixels.min(axis=2) == 255] = 1
        return found


class CropIsTheMask(BrownIsTheObject):
    """Says by its answer which crop it was shown."""

    def probabilities(self, pixels: np.ndarray) -> np.ndarray:
        height, width = pixels.shape[:2]
        return super().probabilities(pixels) * (0.6 + 0.4 * (height * width % 97) / 97)


@pytest.fixture
def unmasked(tmp_path: Path) -> Path:
    root = Path(photos(tmp_path / "data", 6).path)
    for path in (root / "masks" / "train").iterdir():
        path.unlink()
    (root / "masks" / "train").rmdir()
    (root / "masks").rmdir()
    return root


def put_plinths(root: Path, *indices: int) -> None:
    """White below the balls, which the network takes along where it sees the whole photo."""
    for index in indices:
        path = root / "train" / f"r_{index}.png"
        pixels = np.array(Image.open(path))
        pixels[84:] = 255
        Image.fromarray(pixels).save(path)


def test_a_second_look_at_the_hull_of_the_others_loses_the_plinth(unmasked: Path, tmp_path: Path) -> None:
    put_plinths(unmasked, 1, 3)
    network = BrownIsTheObject(tmp_path / "net.onnx")
    made = cut_out(DataConfig(path=str(unmasked)), None, network)
    assert made.path == unmasked / "masks"
    assert made.checked
    assert made.disagreeing == []
    scene = load_scene(DataConfig(path=str(unmasked)))
    assert scene.has_alpha
    for index, view in enumerate(scene.train):
        true = picture(ring(6)[index], BALLS)[..., 3] > 127
        found = view.pixels()[..., 3].numpy() > 127
        true[84:] &= index not in (1, 3)  # hidden by the plinth
        assert (true & found).sum() / (true | found).sum() > 0.93
    assert any(size != (SIZE, SIZE) for size in network.sizes)


def test_held_out_photos_decide_nothing_about_input_views(unmasked: Path, tmp_path: Path) -> None:
    """Whatever a held-out photo shows, the masks of the input views keep their bytes; photos that are no input view and
    not held out get none."""
    put_plinths(unmasked, 3)
    data = DataConfig(path=str(unmasked), eval=True, view_ids=(1, 2, 3, 4))
    scene = load_scene(data)
    assert len(scene.test) == 1
    made = []
    for color in (None, (200, 40, 40), (40, 40, 200)):
        if color is not None:
            Image.new("RGB", (SIZE, SIZE), color).save(unmasked / scene.test[0].name)
        out = tmp_path / f"cut-{color}"
        assert cut_out(data, out, CropIsTheMask(tmp_path / "net.onnx")).count == 5
        made.append([(out / "train" / Path(view.name).name).read_bytes() for view in scene.train])
    assert made[0] == made[1] == made[2]


def test_photos_without_poses_get_masks_under_their_names(unmasked: Path, tmp_path: Path) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    for name in ("a b.JPG", "c.png"):
        large = Image.open(unmasked / "train" / "r_0.png").resize((200, 240))
        large.rotate(1 + len(name), fillcolor=(20, 150, 60)).save(folder / name)
    made = cut_out(DataConfig(path=str(folder)), tmp_path / "cut", BrownIsTheObject(tmp_path / "net.onnx"))
    assert sorted(path.name for path in made.path.iterdir()) == ["a b.png", "c.png", RECORD]
    assert Image.open(made.path / "c.png").size == (200, 240)
    assert not made.checked


def test_nothing_is_overwritten(unmasked: Path, tmp_path: Path) -> None:
    network = BrownIsTheObject(tmp_path / "net.onnx")
    cut_out(DataConfig(path=str(unmasked)), None, network)
    before = (unmasked / "masks" / RECORD).read_bytes()
    with pytest.raises(UsageError, match="must not exist yet"):
        cut_out(DataConfig(path=str(unmasked)), None, network)
    assert (unmasked / "masks" / RECORD).read_bytes() == before


def test_a_failure_leaves_nothing_behind(unmasked: Path, tmp_path: Path) -> None:
    (unmasked / "train" / "r_3.png").write_bytes(b"no image")
    with pytest.raises(InputError, match=r"r_3\.png"):
        cut_out(DataConfig(path=str(unmasked)), tmp_path / "cut", BrownIsTheObject(tmp_path / "net.onnx"))
    assert not (tmp_path / "cut").exists()
    assert not [path for path in tmp_path.iterdir() if path.name.endswith(".tmp")]


def test_a_photo_without_the_object_is_named(unmasked: Path, tmp_path: Path) -> None:
    Image.new("RGB", (SIZE, SIZE), (0, 90, 0)).save(unmasked / "train" / "r_4.png")
    network = BrownIsTheObject(tmp_path / "net.onnx")
    network.probabilities = lambda pixels: (pixels[..., 0].astype(int) > pixels[..., 1]).astype(np.float32)  # type: ignore[method-assign]
    made = cut_out(DataConfig(path=str(unmasked)), None, network)
    assert made.empty == ["train/r_4.png"]
    assert any("r_4.png" in line and "no object" in line for line in made.lines())


def test_masks_that_were_made_are_taken_again(unmasked: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    network = BrownIsTheObject(tmp_path / "net.onnx")
    monkeypatch.setattr(MaskNetwork, "open", staticmethod(lambda path: network))
    config = DataConfig(path=str(unmasked), masks="auto", mask_model=str(network.path))
    first = with_made_masks(config, tmp_path, print)
    looked = len(network.sizes)
    assert with_made_masks(config, tmp_path, print) == first
    assert len(network.sizes) == looked
    network.path.write_bytes(b"other weights")
    assert with_made_masks(config, tmp_path, print).masks != first.masks


def test_given_masks_win_over_made_ones(tmp_path: Path) -> None:
    config = photos(tmp_path / "data", 4)
    asked = DataConfig(path=config.path, masks="auto", mask_model=str(tmp_path / "nowhere.onnx"))
    assert with_made_masks(asked, tmp_path, print).masks == "given"


def test_right_masks_say_where_other_photos_show_the_object(tmp_path: Path) -> None:
    scene = load_scene(photos(tmp_path, 6))
    shown = small_photos(scene.train, 6)
    focus = find_focus([photo.camera for photo in shown], scene.extent)
    points = object_points(shown[:4], focus)
    for photo in shown:
        solid = photo.planes[3] > 127
        left, top, right, bottom = box_of_points(photo.camera, points) or (0, 0, 0, 0)
        assert not bool(solid[:top].any() or solid[bottom:].any() or solid[:, :left].any() or solid[:, right:].any())
        assert (right - left) * (bottom - top) < 0.7 * SIZE**2


def test_silhouettes_that_share_nothing_hold_no_point(tmp_path: Path) -> None:
    """Of a ball on the left and a ball on the right, seen from the same places."""
    cameras = ring(4, size=SIZE)
    sides = [write_balls(tmp_path / f"{x}", [Ball((x, x, x), 0.1)], cameras) for x in (-0.5, 0.5)]
    left, right = (small_photos(load_scene(DataConfig(path=str(root))).train, 4) for root in sides)
    shown = [*left[:2], *right[2:]]
    points = object_points(shown, find_focus([photo.camera for photo in shown], 1.0))
    assert points.shape == (0, 3)
    assert box_of_points(shown[0].camera, points) is None


def test_boxes_have_a_margin_and_stay_in_the_image() -> None:
    solid = torch.zeros(50, 100, dtype=torch.bool)
    solid[10:30, 0:40] = True
    left, top, right, bottom = box_around(solid, 1000, 500) or (0, 0, 0, 0)
    assert (left, top) == (0, 52)
    assert (right, bottom) == (448, 348)
    assert box_around(solid.T, 500, 1000) == (52, 0, 348, 448)
    assert box_around(torch.zeros(5, 5, dtype=torch.bool), 10, 10) is None
    assert overlap((0, 0, 2, 2), (1, 1, 3, 3)) == pytest.approx(1 / 7)
    assert overlap((0, 0, 2, 2), (2, 2, 3, 3)) == 0
    assert overlap((0, 5, 4, 8), (1, 5, 7, 7)) == pytest.approx(1 / 3)
    assert overlap((0, 0, 2, 9), (5, 0, 7, 9)) == 0 == overlap((0, 0, 9, 2), (0, 5, 9, 7))


def test_without_a_model_the_remedy_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv(MODEL_VARIABLE, raising=False)
    monkeypatch.setenv("U2NET_HOME", str(tmp_path))
    with pytest.raises(MissingDependency, match="rembg d u2net"):
        find_model()
    (tmp_path / "u2netp.onnx").write_bytes(b"")
    assert find_model() == tmp_path / "u2netp.onnx"
    monkeypatch.setenv(MODEL_VARIABLE, "/a/b.onnx")
    assert find_model() == Path("/a/b.onnx")
    assert find_model("c.onnx") == Path("c.onnx")


def test_without_the_runtime_the_pip_line_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(MissingDependency, match=r"pip install 'gsopt\[masks\]'"):
        MaskNetwork.open(tmp_path / "a.onnx")


@pytest.mark.parametrize("content", [None, b"", b"\x08\x07not a model", os.urandom(4096)])
def test_a_file_that_is_no_model_is_refused(tmp_path: Path, content: bytes | None) -> None:
    pytest.importorskip("onnxruntime")
    path = tmp_path / "a.onnx"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match="ONNX file of U2-Net"):
        MaskNetwork.open(path)


@needs_model
def test_the_verb_writes_masks_of_a_real_photo(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("onnxruntime")
    if not HEAD.is_dir():
        pytest.skip(f"{HEAD} is private test data and not on this machine")
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "one.jpg").write_bytes((HEAD / "DSC_0009.JPG").read_bytes())
    assert main(["masks", str(tmp_path / "photos"), "--model", str(MODEL)]) == 0
    assert "1 masks in" in capsys.readouterr().out
    found = np.asarray(Image.open(tmp_path / "photos" / "masks" / "one.png")) > 127
    true = np.asarray(Image.open(HEAD.parent / "masks" / "DSC_0009.png").convert("L")) > 127
    assert (found & true).sum() / (found | true).sum() > 0.95
