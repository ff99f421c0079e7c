"""Two runs of one object become one, aligned by common photos, each place from the run that saw it; or are refused."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from finished_runs import make_run, splats

from gsopt.cli import main
from gsopt.data.scene import load_scene
from gsopt.data.sfm.placement import Similarity
from gsopt.errors import InputError
from gsopt.formats import load_splats, save_splats
from gsopt.formats.placement import placed
from gsopt.gaussians import Gaussians
from gsopt.geometry.quats import rotation_matrices
from gsopt.results.finished_run import open_run
from gsopt.results.merge import better, error_sums, merge, turned_degrees, with_degree

SCALE, TURN = 1.7, rotation_matrices(torch.tensor([0.8, 0.3, 0.5, -0.2], dtype=torch.float64))
SHIFT = torch.tensor([0.5, -1.0, 2.0], dtype=torch.float64)


def moved_run(folder: Path, learned: Gaussians, noise: float = 0.0) -> Path:
    """A run whose dataset and splats stand in another frame; `noise`: of the cameras' positions."""
    run = make_run(folder, learned=placed(learned, SCALE, TURN, SHIFT))
    generator = torch.Generator().manual_seed(0)
    for path in (folder / "data").glob("transforms_*.json"):
        document = json.loads(path.read_text())
        for frame in document["frames"]:
            pose = torch.tensor(frame["transform_matrix"], dtype=torch.float64)
            pose[:3, 3] = SCALE * TURN @ pose[:3, 3] + SHIFT + noise * torch.randn(3, generator=generator)
            pose[:3, :3] = TURN @ pose[:3, :3]
            frame["transform_matrix"] = pose.tolist()
        path.write_text(json.dumps(document))
    return run


def halves() -> tuple[Gaussians, Gaussians]:
    left = splats().means[:, 0] < 0
    return splats().select(left), splats().select(~left)


def folder(tmp_path: Path, name: str) -> Path:
    (tmp_path / name).mkdir()
    return tmp_path / name


def test_two_halves_in_two_frames_become_the_whole(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    left, right = halves()
    a, b = make_run(folder(tmp_path, "a"), learned=left), moved_run(folder(tmp_path, "b"), right)
    assert main(["merge", str(a), str(b), "-o", str(tmp_path / "both.ply")]) == 0
    both, whole = load_splats(tmp_path / "both.ply"), left.append(right)
    near, row = torch.cdist(both.means, whole.means).min(dim=1)
    assert float(near.max()) < 1e-4
    assert len(row.unique()) >= 11  # a cell may hold splats of both halves
    torch.testing.assert_close(both.log_scales, whole.log_scales[row], atol=1e-4, rtol=0)
    text = capsys.readouterr().out
    assert f"scaled by {1 / SCALE:.4g}" in text
    gains = [float(line.rsplit("(", 1)[1].rstrip(")")) for line in text.splitlines() if line.startswith("held-out")]
    assert len(gains) == 2
    assert min(gains) > 10
    assert main(["merge", str(a), str(b), "-o", str(tmp_path / "both.ply")]) == 2
    assert "--force" in capsys.readouterr().err


def test_a_run_merged_with_its_own_copy_is_itself(tmp_path: Path) -> None:
    a, b = make_run(folder(tmp_path, "a")), moved_run(folder(tmp_path, "b"), splats())
    found = merge(open_run(a), open_run(b))
    assert found.kept == (12, 0)
    assert torch.equal(found.gaussians.means, splats().means)
    back = found.alignment.place_back(found.gaussians)
    torch.testing.assert_close(back.means, open_run(b).gaussians.means, atol=1e-4, rtol=0)


def test_runs_that_share_no_photos_or_other_photos_of_the_same_names_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    a, b = make_run(folder(tmp_path, "a")), moved_run(folder(tmp_path, "b"), splats(), noise=1.5)
    assert main(["merge", str(a), str(b), "-o", str(tmp_path / "both.ply")]) == 3
    refusal = capsys.readouterr().err
    assert "stand otherwise" in refusal
    assert "three or more photos in common" in refusal
    config = json.loads((b / "config.json").read_text())
    data = Path(config["config"]["data"]["path"])
    for name in ("train", "test"):
        (data / name).rename(data / f"other-{name}")
        path = data / f"transforms_{name}.json"
        path.write_text(path.read_text().replace(f"./{name}/", f"./other-{name}/"))
    assert load_scene(open_run(b).config.data).train
    with pytest.raises(InputError, match="got 0"):
        merge(open_run(a), open_run(b))
    assert not (tmp_path / "both.ply").exists()


def test_runs_with_and_without_antialiasing_are_refused(tmp_path: Path) -> None:
    a, b = make_run(folder(tmp_path, "a")), make_run(folder(tmp_path, "b"))
    document = json.loads((b / "config.json").read_text())
    document["config"]["antialiased"] = True
    (b / "config.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match="Train both alike"):
        merge(open_run(a), open_run(b))


def test_each_cell_keeps_the_run_with_the_smaller_error() -> None:
    """Two clouds far apart, in both runs, each better in one of them; haze of b that no view sees is not taken."""
    here, there = splats(30), splats(30, seed=1)
    there.means[:, 0] += 100
    a, b = here.append(there), here.append(there).append(splats(1, seed=2))
    b.means[-1] = torch.tensor([50.0, 0, 0])
    weight, low, high = torch.full((30,), 4.0), torch.full((30,), 0.4), torch.full((30,), 0.8)
    sums_a = torch.stack([weight.repeat(2), torch.cat([low, high])], dim=1)
    sums_b = torch.cat([torch.stack([weight.repeat(2), torch.cat([high, low])], dim=1), torch.zeros(1, 2)])
    stays_a, stays_b = better(a, b, sums_a, sums_b)
    assert stays_a.tolist() == [True] * 30 + [False] * 30
    assert stays_b.tolist() == [False] * 30 + [True] * 30 + [False]


def test_errors_are_those_of_the_pixels_that_a_splat_shows(tmp_path: Path) -> None:
    """Splats that made the views have none beyond rounding; in another color, each has that of the colors."""
    run = open_run(make_run(tmp_path))
    views = load_scene(run.config.data).train
    right = error_sums(run, views, run.gaussians)
    assert float((right[:, 1] / right[:, 0].clamp_min(1)).max()) < 0.02
    wrong = error_sums(run, views, replace(run.gaussians, sh0=run.gaussians.sh0 + 0.5))
    assert bool((wrong[:, 1] > 3 * right[:, 1]).all())
    torch.testing.assert_close(wrong[:, 0], right[:, 0])


def test_bands_that_a_run_does_not_have_are_zero() -> None:
    found = with_degree(splats(), 2)
    assert found.shN.shape == (12, 8, 3)
    assert math.isclose(float(found.shN.abs().sum()), 0.0)
    assert torch.equal(with_degree(found, 2).shN, found.shN)


def test_the_merged_file_keeps_unit_and_format(tmp_path: Path) -> None:
    left, right = halves()
    a, b = make_run(folder(tmp_path, "a"), learned=left), moved_run(folder(tmp_path, "b"), right)
    (a / "units.json").write_text('{"meters_per_unit": 0.5}')
    assert main(["merge", str(a), str(b), "-o", str(tmp_path / "both.sog")]) == 0
    from gsopt.formats.units import read_units

    assert read_units(tmp_path / "both.sog").meters_per_unit == 0.5
    save_splats(tmp_path / "c.ply", load_splats(tmp_path / "both.sog"))


@pytest.mark.parametrize(("signs", "degrees"), [((1, 1, 1), 0.0), ((1, -1, -1), 180.0)])
def test_a_turn_that_rounding_made_larger_than_possible_is_still_an_angle(
    signs: tuple[int, ...], degrees: float
) -> None:
    rotation = np.diag(signs) * (1 + 1e-12)
    assert turned_degrees(Similarity(1.0, rotation, np.zeros(3))) == degrees
