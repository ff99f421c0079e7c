"""Retrieval of similar photos. The vocabulary is made from the photos' own features: none has to be downloaded.

Each photo becomes one vector, the residuals of its features from the nearest of 64 words (VLAD, Jégou et al. 2010,
with the normalization of Arandjelović and Zisserman 2013); the words are k-means centers of the photos' own features.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32, Int, UInt8

WORDS = 64
WORD_FEATURES = 20_000
"""Features the words are made from."""
PHOTO_FEATURES = 1024
"""Features of each photo that count."""
KMEANS_STEPS = 10


def similar_pairs(descriptors: Sequence[UInt8[np.ndarray, "F 128"]], most: int, seed: int) -> set[tuple[int, int]]:
    """Rows (i, j), i < j, where one is among the `most` photos that look most like the other. Seeded."""
    generator = np.random.default_rng(seed)
    chosen = [_sampled(rows, PHOTO_FEATURES, generator).astype(np.float32) / 512 for rows in descriptors]
    words = _words(_sampled(np.concatenate(chosen), WORD_FEATURES, generator), generator)
    vectors = np.stack([vlad(rows, words) for rows in chosen])
    likeness = vectors @ vectors.T
    np.fill_diagonal(likeness, -np.inf)
    nearest = np.argsort(-likeness, axis=1, kind="stable")[:, : min(most, len(chosen) - 1)]
    return {(min(i, int(j)), max(i, int(j))) for i, row in enumerate(nearest) for j in row}


def vlad(rows: Float32[np.ndarray, "F 128"], words: Float32[np.ndarray, "W 128"]) -> Float32[np.ndarray, "D"]:
    """A unit vector for one photo; zero for a photo without features."""
    sums = np.zeros_like(words)
    if len(rows):
        nearest = _nearest(rows, words)
        np.add.at(sums, nearest, rows - words[nearest])
    norms = np.linalg.norm(sums, axis=1, keepdims=True)
    flat = (sums / np.maximum(norms, 1e-9)).ravel()
    return flat / max(float(np.linalg.norm(flat)), 1e-9)


def _words(rows: Float32[np.ndarray, "F 128"], generator: np.random.Generator) -> Float32[np.ndarray, "W 128"]:
    """k-means (Lloyd 1982); a word without features stays where it was."""
    words = _sampled(rows, WORDS, generator).copy()
    for _ in range(KMEANS_STEPS):
        nearest = _nearest(rows, words)
        for word in range(len(words)):
            members = rows[nearest == word]
            if len(members):
                words[word] = members.mean(axis=0)
    return words


def _nearest(rows: Float32[np.ndarray, "F 128"], words: Float32[np.ndarray, "W 128"]) -> Int[np.ndarray, "F"]:
    return (np.square(words).sum(axis=1) - 2 * rows @ words.T).argmin(axis=1)


def _sampled(rows: np.ndarray, most: int, generator: np.random.Generator) -> np.ndarray:
    if len(rows) <= most:
        return rows
    return rows[np.sort(generator.choice(len(rows), most, replace=False))]
