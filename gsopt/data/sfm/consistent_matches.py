"""Matches checked over three photos: a feature followed from photo to photo must come back to where it began.

Repeated patterns (wallpaper, tiles, a symmetric object) give matches that agree with each other in every pair and are
wrong by a whole repeat. No pair shows that, three photos do (loop constraints: Zach, Klopschitz and Pollefeys 2010).
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from gsopt.data.sfm.pair_matches import ImagePair, PairMatches

TOLERANCE = 0.006
"""Distance at which two positions are the same place, a share of the photo's diagonal (6 px of 1000)."""
MIN_TESTED = 8
"""Votes on the matches of a pair from which on the pair as a whole is judged."""
MIN_AGREEMENT = 0.5
"""Share of the votes that must confirm a pair."""
MIN_INLIERS = 15
"""Matches that must lie on the epipolar lines of a pair."""
MAX_ERROR = 3.0
"""Farthest from the epipolar line, px."""
MAX_TRIALS = 5000
MAX_TURN_ERROR, MAX_TURN_DRIFT = 12.0, 4.0
"""Degrees by which a pair may turn otherwise than the chain of others between its photos, and more per link of it."""


@dataclass
class Votes:
    """Times that each match of each pair was confirmed and contradicted by a third photo."""

    confirmed: dict[ImagePair, Int[np.ndarray, "M"]] = field(default_factory=dict)
    contradicted: dict[ImagePair, Int[np.ndarray, "M"]] = field(default_factory=dict)

    def agreement(self, pair: ImagePair) -> float:
        """Share of the votes on a pair that confirm it; 1 where too few were cast."""
        yes, no = int(self.confirmed[pair].sum()), int(self.contradicted[pair].sum())
        return yes / (yes + no) if yes + no >= MIN_TESTED else 1.0


def consistent(pairs: PairMatches) -> PairMatches:
    """The matches that third photos do not contradict.

    First whole pairs go, the one of which the largest share is contradicted before the others, because a pair that is
    wrong contradicts the right ones too; then single matches.
    """
    matches = {pair: rows for pair, rows in pairs.matches.items() if len(rows)}
    while True:
        kept = replace(pairs, matches=dict(matches))
        votes = votes_of(kept)
        wrong = [pair for pair in matches if votes.agreement(pair) < MIN_AGREEMENT]
        if not wrong:
            break
        del matches[max(wrong, key=lambda pair: (int(votes.contradicted[pair].sum()) / len(matches[pair]), pair))]
    return kept.kept({pair: votes.confirmed[pair] >= votes.contradicted[pair] for pair in matches})


def on_epipolar_lines(pycolmap: Any, pairs: PairMatches, seed: int) -> PairMatches:
    """The matches that fit one fundamental matrix for each pair, so that chance matches have no vote."""
    options = pycolmap.RANSACOptions()
    options.max_error, options.max_num_trials, options.random_seed = MAX_ERROR, MAX_TRIALS, seed
    keep: dict[ImagePair, Bool[np.ndarray, "M"]] = {}
    for pair, rows in pairs.matches.items():
        keep[pair] = np.zeros(len(rows), dtype=bool)
        if len(rows) < MIN_INLIERS:
            continue
        found = pycolmap.estimate_fundamental_matrix(*pairs.points(pair), options)
        if found is not None and found["num_inliers"] >= MIN_INLIERS:
            keep[pair] = np.asarray(found["inlier_mask"], dtype=bool)
    return pairs.kept(keep)


def disagreeing(
    counts: Mapping[ImagePair, int], turns: Mapping[ImagePair, Float[np.ndarray, "3 3"]], least: float = 0.0
) -> list[ImagePair]:
    """Pairs that turn by less than `least` degrees, or otherwise than the chain of better pairs between their photos.

    The chains are those of the maximum spanning tree by number of matches, as far as it is built by then.
    """
    wrong = [pair for pair in counts if _degrees(turns[pair]) < least]
    tree: dict[int, dict[int, Float[np.ndarray, "3 3"]]] = {}
    for a, b in sorted(counts.keys() - set(wrong), key=lambda pair: (-counts[pair], pair)):
        chain = _chain(tree, a, b)
        if chain is None:
            tree.setdefault(a, {})[b] = turns[a, b]
            tree.setdefault(b, {})[a] = turns[a, b].T
            continue
        turn, links = chain
        if _degrees(turn.T @ turns[a, b]) > MAX_TURN_ERROR + MAX_TURN_DRIFT * links:
            wrong.append((a, b))
    return wrong


def _degrees(turn: Float[np.ndarray, "3 3"]) -> float:
    """The angle of a rotation."""
    return float(np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))))


def _chain(tree: Mapping[int, Mapping[int, Any]], start: int, end: int) -> tuple[Float[np.ndarray, "3 3"], int] | None:
    """The rotation along the tree from one photo to another and the number of its links, or None without a way."""
    reached = {start: (np.eye(3), 0)}
    waiting = [start]
    while waiting:
        here = waiting.pop()
        turn, links = reached[here]
        for following, step in tree.get(here, {}).items():
            if following not in reached:
                reached[following] = (step @ turn, links + 1)
                waiting.append(following)
    return reached.get(end)


def votes_of(pairs: PairMatches) -> Votes:
    """The votes of all triplets of photos."""
    votes = Votes()
    for pair, rows in pairs.matches.items():
        votes.confirmed[pair], votes.contradicted[pair] = np.zeros(len(rows), int), np.zeros(len(rows), int)
    for a, b, c in itertools.combinations(sorted(pairs.names), 3):
        if {(a, b), (b, c), (a, c)} <= pairs.matches.keys():
            _vote(pairs, votes, a, b, c)
    return votes


def _vote(pairs: PairMatches, votes: Votes, a: int, b: int, c: int) -> None:
    """Follows each match of (a, b) on to c, there directly and by way of b."""
    rows = pairs.matches[a, b]
    onward = _row_of(pairs.matches[b, c], len(pairs.keypoints[b]))[rows[:, 1]]
    direct = _row_of(pairs.matches[a, c], len(pairs.keypoints[a]))[rows[:, 0]]
    tested = np.flatnonzero((onward >= 0) & (direct >= 0))
    onward, direct = onward[tested], direct[tested]
    ends = (pairs.matches[b, c][onward, 1], pairs.matches[a, c][direct, 1])
    apart = np.linalg.norm(pairs.keypoints[c][ends[0]] - pairs.keypoints[c][ends[1]], axis=1)
    same = apart <= TOLERANCE * float(np.hypot(*pairs.sizes[c]))
    for marks, chosen in ((votes.confirmed, same), (votes.contradicted, ~same)):
        np.add.at(marks[a, b], tested[chosen], 1)
        np.add.at(marks[b, c], onward[chosen], 1)
        np.add.at(marks[a, c], direct[chosen], 1)


def _row_of(rows: Int[np.ndarray, "M 2"], features: int) -> Int[np.ndarray, "F"]:
    """The row in which each feature of the first photo stands, -1 where in none."""
    found = np.full(features, -1)
    found[rows[:, 0]] = np.arange(len(rows))
    return found
