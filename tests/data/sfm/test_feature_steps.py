"""COLMAP is asked for features of photos, pairs to compare, and the graph that is read back."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from test_answers import photo

from gsopt.data.sfm import features
from gsopt.data.sfm.features import ColmapProject, ViewGraph
from gsopt.data.sfm.settings import SfmConfig


class Colmap:
    """COLMAP that writes down what it is asked for, in order."""

    class Opened(SimpleNamespace):
        def __enter__(self) -> Any:
            return self

        def __exit__(self, *_: object) -> None: ...

        def close(self) -> None: ...

    CameraMode = SimpleNamespace(SINGLE="single")
    Camera = SimpleNamespace(
        create_from_model_name=lambda number, *rest: SimpleNamespace(params_to_string=lambda: (number, *rest))
    )
    TwoViewGeometryConfiguration = SimpleNamespace(PANORAMIC=5, PLANAR_OR_PANORAMIC=6, PLANAR=4)

    def __init__(self, database: dict[str, Any] | None = None) -> None:
        self.asked: list[tuple[str, Any]] = []
        self.Database = SimpleNamespace(open=lambda path: self.Opened(**(database or {})))

    def FeatureExtractionOptions(self) -> Any:
        sift = SimpleNamespace(estimate_affine_shape=False, domain_size_pooling=False, peak_threshold="usual")
        return SimpleNamespace(sift=sift)

    def ImageReaderOptions(self) -> Any:
        return SimpleNamespace(mask_path=None)

    FeatureMatchingOptions = ImportedPairingOptions = SimpleNamespace

    def TwoViewGeometryOptions(self) -> Any:
        return SimpleNamespace(ransac=SimpleNamespace())

    def import_images(self, database: Path, photos: Path, mode: str, names: list[str], reader: Any) -> None:
        self.asked.append(("import", (names, mode, reader)))

    def extract_features(self, database: Path, photos: Path, **options: Any) -> None:
        self.asked.append(("extract", options))

    def match_image_pairs(self, database: Path, **options: Any) -> None:
        listed = options["pairing_options"].match_list_path.read_text(encoding="utf-8")
        self.asked.append((listed, options))

    def pair_id_to_image_pair(self, number: int) -> tuple[int, int]:
        return number // 100, number % 100


def project(colmap: Any, folder: Path = Path("work"), **settings: Any) -> ColmapProject:
    return ColmapProject(colmap, folder / "database.db", folder / "photos", SfmConfig(**settings))


@pytest.mark.parametrize("thorough", [False, True, None])
def test_a_thorough_look_finds_twice_as_many_features_also_faint_ones_and_from_the_side(thorough: bool | None) -> None:
    """The ordinary one is the usual one."""
    colmap = Colmap()
    looked = {} if thorough is None else {"thorough": thorough}
    features.extract(project(colmap, max_size=900, max_features=100), [photo("a.jpg")], None, **looked)
    (_, (names, mode, reader)), (kind, asked) = colmap.asked
    options = asked["extraction_options"]
    assert (names, mode, reader.mask_path, kind) == (["a.jpg"], "single", None, "extract")
    assert (options.max_image_size, options.num_threads) == (900, -1)
    assert options.sift.max_num_features == (200 if thorough else 100)
    assert options.sift.estimate_affine_shape == options.sift.domain_size_pooling == bool(thorough)
    assert options.sift.peak_threshold == (0.003 if thorough else "usual")


@pytest.mark.parametrize("kind", ["sift", "xfeat", "both"])
def test_photos_of_one_camera_are_listed_in_order_and_then_looked_at(kind: Any) -> None:
    """Learned features alone are not found by COLMAP."""
    colmap = Colmap()
    photos = [replace(photo(f"{i}.jpg"), camera="ab"[i % 2]) for i in range(3)]
    features.extract(project(colmap, features=kind, threads=3), photos, Path("masks"))
    listed = [asked[0] if step == "import" else asked["image_names"] for step, asked in colmap.asked]
    both = [["0.jpg", "2.jpg"]] * 2 + [["1.jpg"]] * 2
    assert listed == (both[::2] if kind == "xfeat" else both)
    for step, asked in colmap.asked:
        reader = asked[2] if step == "import" else asked["reader_options"]
        assert reader.mask_path == Path("masks")
        assert step == "import" or (asked["extraction_options"].num_threads, asked["camera_mode"]) == (3, "single")


def test_the_first_guess_of_a_lens_is_made_for_the_first_photos_focal_length_and_size() -> None:
    """Photos of one camera may differ where a lens tells its zoom in whole pixels."""
    shared = [replace(photo("a.jpg"), focal=50.0, width=40, height=30), replace(photo("b.jpg"), focal=51.0, width=41)]
    found: Any = features.reader_options(Colmap(), shared, SfmConfig())  # type: ignore[arg-type]
    assert found.camera_params == (0, "SIMPLE_RADIAL", 50.0, 40, 30)


def test_pairs_are_compared_in_batches_and_the_user_reads_how_long_it_takes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After 40 of 100 pairs in 80 s the other 60 take 2 min; below a minute nothing is said of it."""
    colmap, lines = Colmap(), list[str]()
    pairs = [(f"{i}.jpg", f"{i + 1}.jpg") for i in range(100)]
    times = iter([1000.0, 1080.0, 1160.0, 1170.0])
    monkeypatch.setattr(features, "_PAIRS_PER_BATCH", 40)
    monkeypatch.setattr(features, "pairs_to_match", lambda project, names, matching: pairs)
    monkeypatch.setattr(features, "read_graph", lambda project: "graph")
    monkeypatch.setattr(features.time, "monotonic", lambda: next(times))
    made = project(colmap, tmp_path, seed=9, threads=2)
    assert features.match(made, ["names"], "retrieval", lines.append) == "graph"
    assert lines == [
        "compared 40 of 100 pairs of photos (retrieval), about 2 min left",
        "compared 80 of 100 pairs of photos (retrieval)",
        "compared 100 of 100 pairs of photos (retrieval)",
    ]
    assert "".join(listed for listed, _ in colmap.asked) == "".join(f"{a} {b}\n" for a, b in pairs)
    assert [listed.count("\n") for listed, _ in colmap.asked] == [40, 40, 20]
    for _, options in colmap.asked:
        assert (options["matching_options"].num_threads, options["verification_options"].ransac.random_seed) == (2, 9)


def test_a_minute_that_is_left_is_told_and_all_threads_are_used_by_default(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    colmap, lines = Colmap(), list[str]()
    times = iter([0.0, 60.0, 60.0])
    monkeypatch.setattr(features, "_PAIRS_PER_BATCH", 1)
    monkeypatch.setattr(features, "pairs_to_match", lambda *_: [("a", "b"), ("b", "c")])
    monkeypatch.setattr(features, "read_graph", lambda project: "graph")
    monkeypatch.setattr(features.time, "monotonic", lambda: next(times))
    features.match(project(colmap, tmp_path), ["names"], "exhaustive", lines.append)
    assert lines[0] == "compared 1 of 2 pairs of photos (exhaustive), about 1 min left"
    assert colmap.asked[0][1]["matching_options"].num_threads == -1


def test_all_pairs_are_compared_where_that_is_asked_for() -> None:
    assert features.pairs_to_match(project(Colmap()), "abc", "exhaustive") == [("a", "b"), ("a", "c"), ("b", "c")]


@pytest.mark.parametrize(("matching", "partners"), [("sequential", 5), ("retrieval", 30)])
def test_photos_are_compared_with_those_near_in_time_and_with_lookalikes(
    matching: str, partners: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the order of the photos, each pair once. Up to ten photos are all near in time."""
    asked: list[Any] = []

    def similar(descriptors: Any, most: int, seed: int) -> list[tuple[int, int]]:
        asked.append((descriptors, most, seed))
        return [(0, 1), (0, 12)]

    monkeypatch.setattr(features, "read_descriptors", lambda project, names: f"of {len(names)}")
    monkeypatch.setattr(features, "similar_pairs", similar)
    made = project(Colmap(), seed=4)
    few, many = ([f"{i:02d}" for i in range(count)] for count in (10, 13))
    assert features.pairs_to_match(made, few, matching) == list(itertools.combinations(few, 2))
    assert asked == []
    near = [(a, b) for a, b in itertools.combinations(many, 2) if int(b) - int(a) <= 10]
    assert features.pairs_to_match(made, many, matching) == sorted([*near, ("00", "12")])
    assert asked == [("of 13", partners, 4)]


def test_the_order_of_pairs_is_that_of_the_photos_not_of_their_names() -> None:
    names = ["b", "c", "a"]
    assert features.pairs_to_match(project(Colmap()), names, "sequential") == [("b", "c"), ("b", "a"), ("c", "a")]


def test_neighbors_in_time_are_up_to_ten_photos_away_and_then_powers_of_two_up_to_256() -> None:
    pairs = list(features.neighbors_in_time([str(i) for i in range(600)]))
    assert len(pairs) == len(set(pairs))
    steps = {int(b) - int(a) for a, b in pairs}
    assert steps == {*range(1, 11), 16, 32, 64, 128, 256}
    assert sum(int(b) - int(a) == 256 for a, b in pairs) == 600 - 256


def test_a_graph_has_the_matches_that_were_verified_and_names_pairs_without_depth() -> None:
    """Configurations 4 to 6 are a plane, a turn on the spot, and either of both."""
    verified = {102: (30, 2), 103: (20, 4), 203: (1, 5), 204: (12, 6), 304: (0, 2), 305: (7, 3)}
    geometries = [SimpleNamespace(inlier_matches=range(count), config=kind) for count, kind in verified.values()]
    database = {
        "read_two_view_geometries": lambda: (list(verified), geometries),
        "read_all_images": lambda: [SimpleNamespace(image_id=i, name=f"{i}.jpg") for i in range(1, 6)],
        "num_keypoints_for_image": lambda number: 100 * number,
    }
    graph = features.read_graph(project(Colmap(database)))
    assert graph.features == {f"{i}.jpg": 100 * i for i in range(1, 6)}
    counts = {("1.jpg", "2.jpg"): 30, ("1.jpg", "3.jpg"): 20, ("2.jpg", "3.jpg"): 1, ("2.jpg", "4.jpg"): 12}
    assert graph.inliers == {**counts, ("3.jpg", "5.jpg"): 7}
    assert graph.still == {("1.jpg", "3.jpg"), ("2.jpg", "3.jpg"), ("2.jpg", "4.jpg")}


def test_descriptors_are_read_in_the_order_of_the_names() -> None:
    database = {
        "read_all_images": lambda: [SimpleNamespace(image_id=i, name=name) for i, name in ((1, "a"), (2, "b"))],
        "read_descriptors": lambda number: SimpleNamespace(data=number * 10),
    }
    assert features.read_descriptors(project(Colmap(database)), ["b", "a"]) == [20, 10]


def test_groups_of_equal_size_are_in_the_order_of_their_first_photos() -> None:
    matches = {("e", "c"): 1, ("c", "e"): 1, ("f", "d"): 1, ("a", "f"): 1}
    graph = ViewGraph(dict.fromkeys("fedcba", 9), matches, frozenset())
    assert graph.groups() == [{"a", "d", "f"}, {"c", "e"}, {"b"}]
    equal = ViewGraph(dict.fromkeys("dcba", 9), {("d", "a"): 1, ("c", "b"): 1}, frozenset())
    assert equal.groups() == [{"a", "d"}, {"b", "c"}]
