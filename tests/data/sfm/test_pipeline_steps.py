"""Steps from photos to a scene: what is said of them, which known poses they get, what marks a scene out of date."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from test_answers import CHAIN, NAMES, graph, photo

from gsopt.data.lens import Lens
from gsopt.data.posed_images import PosedImage
from gsopt.data.sfm import pipeline
from gsopt.data.sfm.mapping import MappingResult
from gsopt.data.sfm.pose_search import FoundPoses
from gsopt.data.sfm.settings import SfmConfig
from gsopt.errors import InputError


def run(folder: Path, lines: list[str], **settings: Any) -> pipeline._Run:
    return pipeline._Run(SimpleNamespace(), folder, folder, SfmConfig(**settings), lines.append)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("read", "refused", "line"),
    [(3, 0, "read 3 photos"), (2, 1, "read 2 photos, refused 1"), (0, 2, "read 0 photos, refused 2")],
)
def test_photos_that_are_read_and_refused_are_counted(
    read: int, refused: int, line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lines: list[str] = []
    monkeypatch.setattr(pipeline, "find_photos", lambda source: ["path"])
    monkeypatch.setattr(pipeline, "read_photos", lambda paths, work: (["photo"] * read, ["file"] * refused))
    assert run(tmp_path, lines)._photos() == (["photo"] * read, ["file"] * refused)
    assert lines == [line]


def test_frames_of_a_video_are_counted_and_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lines: list[str] = []
    chosen = SimpleNamespace(paths=["a", "b"], decoded=1234, seconds=41.15)
    asked: list[Any] = []
    monkeypatch.setattr(pipeline, "is_video", lambda source: True)
    monkeypatch.setattr(pipeline, "extract_frames", lambda *given: asked.append(given) or chosen)
    monkeypatch.setattr(pipeline, "read_photos", lambda paths, work: (list(paths), []))
    assert run(tmp_path, lines, frames=7)._photos() == (["a", "b"], [])
    assert asked == [(tmp_path, tmp_path / "frames", 7)]
    assert lines == ["took 2 of 1,234 frames (41.1 s of video)", "read 2 photos"]


def posed(name: str, focal: float) -> PosedImage:
    K = torch.tensor([[focal, 0, 20], [0, focal, 15], [0, 0, 1]], dtype=torch.float64)
    return PosedImage(f"images/{name}", Path(name), None, torch.eye(4, dtype=torch.float64), K, 40, 30, Lens(), 0)


@pytest.mark.parametrize("held_out", [True, False])
def test_known_poses_are_found_by_file_among_all_views(
    held_out: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each photo gets the lens of its frame; one without a pose is named."""
    frames = [posed("0.png", 50), posed("1.png", 60)]
    dataset = SimpleNamespace(frames=frames[:1], held_out=frames[1:] if held_out else None)
    monkeypatch.setattr(pipeline, "read_dataset", lambda source: dataset)
    photos: Any = [pipeline.replace(photo(f"{i}.jpg"), source=Path(f"{i}.png")) for i in (1, 0)]
    prior = run(tmp_path, [], poses="prior")
    if not held_out:
        with pytest.raises(InputError, match=r"1 have none: 1.jpg"):
            prior._prior_frames(photos)
        return
    found = prior._prior_frames(photos)
    assert found is not None
    assert [(frame.name, frame.K[0, 0].item()) for frame in found] == [("1.jpg", 60), ("0.jpg", 50)]
    assert [one.camera for one in photos] == [f"PINHOLE 40x30 [{f}, {f}, 20.0, 15.0]" for f in (60.0, 50.0)]
    assert run(tmp_path, [])._prior_frames(photos) is None


def test_the_figures_of_a_reconstruction_and_all_advice_are_in_its_diagnosis(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: Any = SimpleNamespace(
        compute_mean_reprojection_error=lambda: 0.5, compute_mean_track_length=lambda: 4.5, num_points3D=lambda: 77
    )
    monkeypatch.setattr(MappingResult, "names", set(NAMES[:4]))
    monkeypatch.setattr(pipeline, "poses", lambda found: (list(NAMES[:4]), "viewmats"))
    monkeypatch.setattr(pipeline.diagnosis, "split_groups", lambda graph, placed: [f"{len(placed)} in a group"])
    monkeypatch.setattr(pipeline.diagnosis, "wide_gaps", lambda names, viewmats: [f"{len(names)} with {viewmats}"])
    monkeypatch.setattr(pipeline, "shared_points", lambda found, names: len(names))
    monkeypatch.setattr(pipeline.diagnosis, "weak_links", lambda names, shared: [f"{len(names)} share {shared}"])
    mapped = MappingResult(made, "global", [])
    found = FoundPoses(graph(CHAIN), mapped, "sift", ["note"])
    report = run(tmp_path, [])._diagnose([photo(name) for name in NAMES[:4]], [], found, mapped)
    assert (report.mapper, report.reprojection_error, report.track_length, report.points) == ("global", 0.5, 4.5, 77)
    assert report.advice[-4:] == ["note", "4 in a group", "4 with viewmats", "4 share 4"]


def test_points_are_positions_and_colors_also_where_there_are_none() -> None:
    point = SimpleNamespace(xyz=[1.0, 2.0, 3.0], color=[4, 5, 6])
    xyz, rgb = pipeline.points(SimpleNamespace(points3D={7: point, 9: point}))
    assert (xyz.tolist(), rgb.tolist()) == ([[1, 2, 3]] * 2, [[4, 5, 6]] * 2)
    assert (xyz.dtype, rgb.dtype) == (np.float64, np.uint8)
    assert [found.shape for found in pipeline.points(SimpleNamespace(points3D={}))] == [(0, 3), (0, 3)]


def test_shared_points_are_counted_once_per_pair_in_the_order_of_the_names() -> None:
    tracks = [(3, 5), (5, 3, 3), (5, 8)]
    seen = [[SimpleNamespace(image_id=i) for i in ids] for ids in tracks]
    points = [SimpleNamespace(track=SimpleNamespace(elements=elements)) for elements in seen]
    names = {3: "c.jpg", 5: "a.jpg", 8: "b.jpg"}
    made = SimpleNamespace(
        reg_image_ids=lambda: list(names),
        image=lambda i: SimpleNamespace(name=names[i]),
        points3D=dict(enumerate(points)),
    )
    assert pipeline.shared_points(made, ["a.jpg", "b.jpg", "c.jpg"]).tolist() == [[3, 1, 2], [1, 1, 0], [2, 0, 2]]


def test_a_fingerprint_has_name_size_and_time_of_photos_and_of_files_in_the_folder_of_masks(tmp_path: Path) -> None:
    (tmp_path / "masks" / "more").mkdir(parents=True)
    for name, size in (("b.png", 3), ("a.png", 5)):
        (tmp_path / name).write_bytes(b"x" * size)
        (tmp_path / "masks" / name).write_bytes(b"y" * 2 * size)
    stamps = pipeline.fingerprint(tmp_path)
    assert [stamp[:2] for stamp in stamps] == [["a.png", 5], ["b.png", 3]]
    assert stamps[0][2] == (tmp_path / "a.png").stat().st_mtime_ns
    film = tmp_path / "film.mp4"
    film.write_bytes(b"z")
    assert [stamp[:2] for stamp in pipeline.fingerprint(film)] == [["film.mp4", 1]]
    chosen = pipeline.mask_fingerprint(str(tmp_path / "masks"), tmp_path)
    assert [stamp[:2] for stamp in chosen] == [["a.png", 10], ["b.png", 6]]
    assert pipeline.mask_fingerprint("none", tmp_path) == []
