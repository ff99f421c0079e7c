"""Depth maps as files: found by name, read at any size, and refused in one line where they are none."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from dataset_builders import nerf_synthetic, nerfstudio
from PIL import Image

from gsopt import cli
from gsopt.config.train import DataConfig
from gsopt.data.depth_maps import MAX_FILE_SIDE, MAX_SIDE, DepthFolder, read_map
from gsopt.data.scene import load_scene
from gsopt.errors import InputError

WIDTH, HEIGHT = 40, 30
SIZE = (WIDTH, HEIGHT)


@pytest.fixture
def values() -> np.ndarray:
    return np.random.default_rng(3).uniform(1, 4, (HEIGHT, WIDTH)).astype(np.float32)


def read(path: Path, size: tuple[int, int] = SIZE, inverse: bool = False) -> torch.Tensor:
    return DepthFolder(path.parent, inverse).read(path, size, None, size)


def test_distances_are_inverted_inverse_ones_are_kept_and_0_is_unknown(tmp_path: Path, values: np.ndarray) -> None:
    values[4, 5] = 0
    np.save(tmp_path / "a.npy", values)
    found = read(tmp_path / "a.npy")
    assert bool(torch.isnan(found[4, 5]))
    torch.testing.assert_close(1 / found.nan_to_num(1e9), torch.from_numpy(values), atol=1e-6, rtol=1e-6)
    kept = read(tmp_path / "a.npy", inverse=True)
    torch.testing.assert_close(kept.nan_to_num(), torch.from_numpy(values))


def test_a_png_of_16_bits_has_its_full_range(tmp_path: Path) -> None:
    wide = (np.arange(HEIGHT * WIDTH, dtype=np.uint16) * 50 + 7).reshape(HEIGHT, WIDTH)
    Image.fromarray(wide).save(tmp_path / "a.png")
    assert torch.equal(read_map(tmp_path / "a.png"), torch.from_numpy(wide.astype(np.float32)))


def test_maps_of_other_sizes_are_sampled_and_large_ones_are_kept_small(tmp_path: Path) -> None:
    """Nearest samples: no depth between two surfaces is made up."""
    edge = np.ones((60, 80), dtype=np.float32)
    edge[:, 40:] = 3
    np.save(tmp_path / "a.npy", edge)
    found = read(tmp_path / "a.npy", inverse=True)
    assert found.shape == (HEIGHT, WIDTH)
    assert torch.equal(found[:, :20], torch.ones(30, 20))
    assert torch.equal(found[:, 20:], torch.full((30, 20), 3.0))
    assert read(tmp_path / "a.npy", (2048, 1536)).shape == (MAX_SIDE * 3 // 4, MAX_SIDE)


def test_maps_are_found_by_path_or_file_name(tmp_path: Path, values: np.ndarray) -> None:
    folder = tmp_path / "depth"
    (folder / "train").mkdir(parents=True)
    np.save(folder / "train" / "r_1.npy", values)
    np.save(folder / "r_2.npy", values)
    np.save(tmp_path / "outside.npy", values)
    names = ["train/r_1.png", "train/r_2.png", "other/r_1.png", "../outside.png"]
    found = DepthFolder(folder, False).find(names)
    assert found == [folder / "train" / "r_1.npy", folder / "r_2.npy", None, None]


def test_a_lens_bends_the_map_as_it_bends_the_photo(tmp_path: Path) -> None:
    """A gray photo whose values are the map's: both must agree after undistortion, but for what sampling does."""
    root = nerfstudio(tmp_path / "data", count=3, size=(64, 48), k1=0.2, fl_x=60.0, fl_y=60.0)
    ramp = np.linspace(20, 220, 64, dtype=np.float32)[None].repeat(48, 0)
    (tmp_path / "depth").mkdir()
    for path in sorted((root / "images").iterdir()):
        Image.fromarray(ramp.astype(np.uint8)).convert("RGB").save(path)
        np.save(tmp_path / "depth" / f"{path.stem}.npy", ramp)
    scene = load_scene(DataConfig(path=str(root), depth=str(tmp_path / "depth"), depth_kind="inverse"))
    depth, photo = scene.train[0].inverse_depths(48, 64), scene.train[0].pixels()[..., 0].float()
    assert depth is not None
    bent = (photo - torch.from_numpy(ramp)).abs().max()
    assert float(bent) > 6, "the lens must do something"
    assert float((depth - photo).abs().max()) < 5, "a pixel is 3.2 wide"


def bad_files() -> dict[str, tuple[object, str]]:
    flat = np.ones((HEIGHT, WIDTH), dtype=np.float32)
    nan, negative = flat.copy(), flat.copy()
    nan[3, 3], negative[3, 3] = np.nan, -1
    return {
        "nan.npy": (nan, "not finite"),
        "infinite.npy": (flat * np.inf, "not finite"),
        "negative.npy": (negative, "--depth-kind inverse"),
        "nothing.npy": (flat * 0, "0 everywhere"),
        "portrait.npy": (flat.T.copy(), "another aspect"),
        "colors.npy": (np.ones((HEIGHT, WIDTH, 3), dtype=np.float32), r"shape \[H, W\]"),
        "empty.npy": (np.ones((0, 4), dtype=np.float32), r"shape \[H, W\]"),
        "words.npy": (np.full((HEIGHT, WIDTH), "far"), r"shape \[H, W\]"),
        "pickled.npy": (np.full((HEIGHT, WIDTH), None), "reads safely"),
        "broken.npy": (b"\x93NUMPY\x01\x00\xff\xff", "reads safely"),
        "text.png": (b"no picture", "Cannot read the depth map"),
        "bytes.png": (Image.new("L", SIZE), "16 bits"),
        "photo.png": (Image.new("RGB", SIZE), "16 bits"),
    }


@pytest.mark.parametrize("name", bad_files())
def test_a_file_that_is_no_depth_map_is_refused_in_one_line(tmp_path: Path, name: str) -> None:
    content, words = bad_files()[name]
    path = tmp_path / name
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif isinstance(content, Image.Image):
        content.save(path)
    else:
        np.save(path, content, allow_pickle=True)
    with pytest.raises(InputError, match=words) as error:
        read(path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("axis", [0, 1])
def test_a_map_at_the_limit_of_its_side_is_read_and_one_beyond_is_not(tmp_path: Path, axis: int) -> None:
    for side, read in ((MAX_FILE_SIDE, True), (MAX_FILE_SIDE + 1, False)):
        np.save(tmp_path / "a.npy", np.ones((side, 1) if axis == 0 else (1, side), np.uint8))
        if read:
            assert read_map(tmp_path / "a.npy").numel() == side
        else:
            with pytest.raises(InputError, match=r"a\.npy"):
                read_map(tmp_path / "a.npy")


def test_a_folder_that_fits_no_image_is_refused_before_any_work(
    tmp_path: Path, values: np.ndarray, capsys: pytest.CaptureFixture[str]
) -> None:
    root = nerf_synthetic(tmp_path / "data")
    assert cli.main(["train", str(root), "-m", str(tmp_path / "run"), "--depth", str(tmp_path / "absent")]) == 3
    assert "`--depth` names no folder" in capsys.readouterr().err
    folder = tmp_path / "depth"
    folder.mkdir()
    np.save(folder / "somebody.npy", values)
    assert cli.main(["train", str(root), "-m", str(tmp_path / "run2"), "--depth", str(folder)]) == 3
    assert "has a depth map for none of the 10 input images" in capsys.readouterr().err
    assert not (tmp_path / "run" / "splat.ply").exists()
