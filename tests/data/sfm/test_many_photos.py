"""Two hundred photos and more: what is compared, how long it takes, and what is refused."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

from gsopt.data.sfm import features
from gsopt.data.sfm.features import EXHAUSTIVE_UP_TO, choose_matching
from gsopt.data.sfm.pose_search import PoseSearch
from gsopt.data.sfm.settings import SfmConfig
from gsopt.errors import UsageError


def test_all_pairs_are_compared_up_to_a_limit() -> None:
    config = SfmConfig()
    assert choose_matching(config, EXHAUSTIVE_UP_TO, is_video=False) == "exhaustive"
    assert choose_matching(config, EXHAUSTIVE_UP_TO + 1, is_video=False) == "retrieval"
    assert choose_matching(config, 3, is_video=True) == "sequential"
    assert choose_matching(SfmConfig(matching="exhaustive"), 10_000, is_video=False) == "exhaustive"


def test_comparing_200_photos_says_how_long_it_takes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Time passes a minute a batch."""
    now, compared, said = [0.0], [], []
    monkeypatch.setattr(features.time, "monotonic", lambda: now[0])

    def match_image_pairs(*_: object, pairing_options: SimpleNamespace, **__: object) -> None:
        now[0] += 60
        compared.append(pairing_options.match_list_path.read_text().splitlines())

    options = SimpleNamespace
    colmap = SimpleNamespace(
        FeatureMatchingOptions=options,
        TwoViewGeometryOptions=lambda: SimpleNamespace(ransac=SimpleNamespace()),
        ImportedPairingOptions=options,
        match_image_pairs=match_image_pairs,
    )
    monkeypatch.setattr(features, "read_graph", lambda _: "graph")
    project = SimpleNamespace(pycolmap=colmap, config=SfmConfig(), database=tmp_path / "database.db")
    names = [f"{number:03}.jpg" for number in range(200)]
    assert features.match(project, names, "exhaustive", said.append) == "graph"  # type: ignore[arg-type]
    assert sum(len(part) for part in compared) == 200 * 199 // 2
    assert len({pair for part in compared for pair in part}) == 200 * 199 // 2
    assert len(said) == len(compared) > 2
    assert f"about {len(compared) - 1} min left" in said[0]
    assert "min left" not in said[-1]


@pytest.mark.parametrize("matching", ["retrieval", "sequential"])
def test_learned_features_for_a_video_or_too_many_photos_are_refused(matching: str) -> None:
    run = SimpleNamespace(config=SfmConfig(features="both"), matching=matching)
    with pytest.raises(UsageError, match=f"compares all photos with all, which {EXHAUSTIVE_UP_TO}"):
        PoseSearch._matcher(run)  # type: ignore[arg-type]
