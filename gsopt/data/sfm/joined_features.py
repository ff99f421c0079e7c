"""Learned features beside SIFT in one database: each photo has the rows of SIFT first, then the learned ones.

One geometric verification then judges the matches of both.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from PIL import Image

from gsopt.data.image_files import IMAGE_FORMATS
from gsopt.data.sfm.consistent_matches import consistent, on_epipolar_lines
from gsopt.data.sfm.features import ColmapProject, Pair, ViewGraph, read_graph
from gsopt.data.sfm.learned_features import LearnedFeatures, lookalikes, turned_lookalikes
from gsopt.data.sfm.pair_matches import Matches, PairMatches, Points, inside, match_features, read_matches
from gsopt.events import Report

PARTNERS = 6
"""Photos that each photo is compared with: those with most lookalikes."""
MIN_LOOKALIKES = 20
"""Lookalikes without which two photos are not compared."""


class Matcher(Protocol):
    """A detector and matcher of features; a test has one without networks."""

    def features(self, pixels: Any, mask: Any = None, *, turned: bool = False) -> LearnedFeatures: ...

    def match(self, first: LearnedFeatures, second: LearnedFeatures) -> Matches: ...

    def match_turned(self, first: LearnedFeatures, second: LearnedFeatures, upright: Matches) -> Matches: ...


@dataclass(frozen=True)
class LearnedMatches:
    """Learned keypoints and matches by the names of photos."""

    keypoints: dict[str, Points]
    matches: dict[Pair, Matches]
    turned: dict[Pair, Matches]
    """Those with photos turned by quarters too: more, of which more are wrong."""


def learned_matches(
    matcher: Matcher,
    photos: Path,
    masks: Path | None,
    names: Sequence[str],
    threads: int,
    report: Report,
    *,
    turned: bool,
) -> LearnedMatches:
    """Matches of the photos that look alike: of the whole photos (`turned`: by quarters too), and again of the objects
    that masks cut out.

    Cut out, an object fills the picture, so that more and finer features lie on it. The work of each photo and of each
    pair is done by one thread, which keeps the bits for any number of them.
    """
    keypoints = {name: np.zeros((0, 2)) for name in names}
    matches: dict[Pair, Matches] = {}
    more: dict[Pair, Matches] = {}
    for kind in ("whole photos",) if masks is None else ("whole photos", "objects in the masks"):
        folder = masks if kind != "whole photos" else None
        turns = turned and folder is None
        found = _each(partial(_features, matcher, photos, folder, turns), names, threads)
        features = dict(zip(names, found, strict=True))
        pairs = alike(features, lookalikes)
        rows = dict(zip(pairs, _each(partial(_matched, matcher, features), pairs, threads), strict=True))
        _append(matches, rows, keypoints)
        if turns:
            pairs = sorted({*pairs, *alike(features, turned_lookalikes)})
            found = _each(partial(_matched_turned, matcher, features, rows), pairs, threads)
            rows = dict(zip(pairs, found, strict=True))
        _append(more, rows, keypoints)
        keypoints = {name: np.concatenate([keypoints[name], features[name].keypoints]) for name in names}
        report(f"compared learned features of {len(pairs):,} pairs of {kind}")
    return LearnedMatches(keypoints, matches, more)


def _append(matches: dict[Pair, Matches], rows: dict[Pair, Matches], keypoints: dict[str, Points]) -> None:
    """Adds the matches of further keypoints, which come after those that photos have."""
    for pair, found in rows.items():
        shifted = found + np.array([len(keypoints[name]) for name in pair], np.uint32)
        matches[pair] = np.concatenate([matches.get(pair, found[:0]), shifted]).astype(np.uint32)


def alike(
    features: dict[str, LearnedFeatures], measure: Callable[[LearnedFeatures, LearnedFeatures], int]
) -> list[Pair]:
    """The pairs worth comparing: each photo with those that look most like it, in the order of the photos."""
    counts = {(a, b): measure(features[a], features[b]) for a, b in itertools.combinations(features, 2)}
    chosen: set[Pair] = set()
    for name in features:
        own = sorted((pair for pair in counts if name in pair), key=lambda pair: (-counts[pair], pair))
        chosen |= {pair for pair in own[:PARTNERS] if counts[pair] >= MIN_LOOKALIKES}
    return [pair for pair in counts if pair in chosen]


def match_joined(project: ColmapProject, learned: LearnedMatches, masks: Path | None) -> ViewGraph:
    """The graph of all matches inside the masks that three photos do not contradict, verified pair by pair."""
    pycolmap = project.pycolmap
    pairs = joined_matches(project, learned)
    pairs = pairs if masks is None else inside(pairs, masks)
    pairs = consistent(on_epipolar_lines(pycolmap, pairs, project.config.seed))
    with project.opened() as db:
        db.clear_matches()
        for pair, rows in pairs.matches.items():
            db.write_matches(*pair, rows)
    listed = project.database.with_name("pairs.txt")
    listed.write_text("".join(f"{pairs.names[a]} {pairs.names[b]}\n" for a, b in pairs.matches), encoding="utf-8")
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = project.config.seed
    pycolmap.verify_matches(project.database, listed, options)
    return read_graph(project)


def joined_matches(project: ColmapProject, learned: LearnedMatches, *, turned: bool = False) -> PairMatches:
    """The matches of SIFT, unless learned features replace it, and the learned ones, those of turned photos too where
    asked for; not verified."""
    if project.config.features == "both":
        match_features(project)
    join(project, replace(learned, matches=learned.turned) if turned else learned)
    return read_matches(project)


def join(project: ColmapProject, learned: LearnedMatches) -> None:
    """Adds learned keypoints and matches to those of a database."""
    with project.opened() as db:
        numbers = {image.name: image.image_id for image in db.read_all_images()}
        first = {name: _append_keypoints(db, numbers[name], learned.keypoints[name]) for name in learned.keypoints}
        for (a, b), rows in learned.matches.items():
            shifted = rows + np.array([first[a], first[b]], np.uint32)
            pair = (numbers[a], numbers[b])
            if pair[0] > pair[1]:
                pair, shifted = pair[::-1], shifted[:, ::-1]
            if db.exists_matches(*pair):
                shifted = np.concatenate([db.read_matches(*pair), shifted])
                db.delete_matches(*pair)
            db.write_matches(*pair, np.ascontiguousarray(shifted, np.uint32))


def _append_keypoints(db: Any, number: int, keypoints: Points) -> int:
    """Writes keypoints behind those that a photo has, and returns how many it had."""
    if not db.exists_keypoints(number):
        db.write_keypoints(number, keypoints.astype(np.float32))
        return 0
    before = db.read_keypoints(number)
    columns = before.shape[1]  # x, y, then scale and angle, or a 2x2 matrix: here size 1 and no turn
    rest = np.array([1.0, 0.0, 0.0, 1.0] if columns == 6 else [1.0, 0.0])[: columns - 2]
    rows = np.column_stack([keypoints, np.tile(rest, (len(keypoints), 1))])
    db.update_keypoints(number, np.concatenate([before, rows]).astype(np.float32))
    return len(before)


def _features(matcher: Matcher, photos: Path, masks: Path | None, turned: bool, name: str) -> LearnedFeatures:
    """Features of a photo, inside its mask where `masks` has one."""
    with Image.open(photos / name, formats=IMAGE_FORMATS) as image:
        pixels = np.asarray(image.convert("RGB"))
    path = None if masks is None else masks / f"{name}.png"
    if path is None or not path.is_file():
        return matcher.features(pixels, turned=turned)
    with Image.open(path, formats=IMAGE_FORMATS) as image:
        return matcher.features(pixels, np.asarray(image.convert("L")) > 127)


def _matched(matcher: Matcher, features: dict[str, LearnedFeatures], pair: Pair) -> Matches:
    return matcher.match(features[pair[0]], features[pair[1]])


def _matched_turned(
    matcher: Matcher, features: dict[str, LearnedFeatures], upright: dict[Pair, Matches], pair: Pair
) -> Matches:
    rows = upright.get(pair, np.zeros((0, 2), np.uint32))
    return matcher.match_turned(features[pair[0]], features[pair[1]], rows)


def _each(work: Callable[[Any], Any], items: Sequence[Any], threads: int) -> list[Any]:
    """The results of `work` for all items, in order."""
    import torch

    most = threads or os.cpu_count() or 1
    with ThreadPoolExecutor(most, initializer=torch.set_num_threads, initargs=(1,)) as pool:
        return list(pool.map(work, items))
