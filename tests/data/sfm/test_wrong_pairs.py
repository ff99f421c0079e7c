"""Which pair of photos goes first where several contradict each other."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gsopt.data.sfm import consistent_matches
from gsopt.data.sfm.pair_matches import PairMatches


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_the_pair_goes_first_of_which_the_largest_share_is_contradicted(
    order: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Half of 40 matches, not 30 of 100: without it, nothing speaks against the other pair but single matches."""
    sizes, against = {(1, 2): 40, (2, 3): 100}, {(1, 2): 20, (2, 3): 30}
    pairs = [list(sizes)[i] for i in order]
    rows = {pair: np.zeros((sizes[pair], 2), np.uint32) for pair in pairs}

    def votes(given: PairMatches) -> Any:
        marks = {pair: np.arange(sizes[pair]) < against[pair] for pair in given.matches}
        alone = len(given.matches) == 1
        return SimpleNamespace(
            contradicted=marks,
            confirmed={pair: np.zeros(len(mark), bool) for pair, mark in marks.items()},
            agreement=lambda pair: 1.0 if alone else 0.0,
        )

    monkeypatch.setattr(consistent_matches, "votes_of", votes)
    found = consistent_matches.consistent(PairMatches({}, {}, {}, {**rows, (1, 3): rows[1, 2][:0]}))
    assert list(found.matches) == [(2, 3)]
    assert len(found.matches[2, 3]) == 70
