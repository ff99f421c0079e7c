"""Exact distances to the nearest neighbors, for any density, many points at a time.

A balanced k-d tree (Friedman, Bentley and Finkel 1977) is descended breadth first by many points at once: a list of
(point, cell) pairs, from which a pair goes when the cell's box lies farther than the point's k-th neighbor can.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

LEAF_POINTS = 16
"""Most points of a leaf."""
_LEAVES_AT_ONCE = 1 << 11
"""Bounds the memory of the list of pairs."""
_MAX_MERGED_LEAVES = 64
"""Leaves per point up to which points are merged side by side."""
_DISTANCE_FLOOR = 1e-3
"""Smallest distance returned, as a share of the median: points all but on top of each other must not vanish."""


def mean_neighbor_distance(points: Float[Tensor, "N 3"], k: int = 3) -> Float[Tensor, "N"]:
    """Mean distance of each point to the `k` nearest other places where points are (fewer where there are fewer).

    Points on top of each other count as one place and share its distance, so the result is positive. It is 1 for a
    single place.
    """
    if len(points) == 0:
        return torch.ones(0)
    center = torch.from_numpy(points.double().numpy().mean(0))
    places, place = torch.unique((points.double() - center).float(), dim=0, return_inverse=True)
    if len(places) < 2:
        return torch.ones(len(points))
    distances = nearest_distances(places, min(k, len(places) - 1)).mean(dim=1)
    return distances.clamp(min=max(_DISTANCE_FLOOR * float(distances.median()), 1e-20))[place]


def nearest_distances(points: Float[Tensor, "N 3"], k: int) -> Float[Tensor, "N k"]:
    """Distances to the k < N nearest other points, ascending. Exact up to float32 rounding; points must differ."""
    tree = _build(points)
    result = points.new_empty(len(points), k)
    for start in range(0, len(tree.leaves), _LEAVES_AT_ONCE):
        members = tree.leaves[start : start + _LEAVES_AT_ONCE]
        own_leaf, place = torch.nonzero(members >= 0, as_tuple=True)
        rows = members[own_leaf, place]
        result[rows] = _search(tree, points[rows], rows, own_leaf + start, k)
    return result


@dataclass(frozen=True)
class _Tree:
    leaves: Int[Tensor, "L M"]
    """Point indices, -1 for padding."""
    coordinates: Float[Tensor, "L 3M"]
    """x of the leaf's points, then y, then z; infinite for padding."""
    boxes: list[tuple[Float[Tensor, "C 6"], Int[Tensor, "C"]]]
    """Per level, root first: lowest and highest corner of the cells, and how many points they hold."""


def _build(points: Float[Tensor, "N 3"]) -> _Tree:
    """Halve every cell along its widest axis until it fits a leaf."""
    depth = max(0, math.ceil(math.log2(len(points) / LEAF_POINTS)))
    order = torch.full((1, math.ceil(len(points) / 2**depth) * 2**depth), -1)
    order[0, : len(points)] = torch.arange(len(points))
    boxes = []
    for level in range(depth + 1):
        valid = order >= 0
        cell = points[order.clamp(min=0)]
        low = torch.where(valid[..., None], cell, math.inf).amin(1)
        high = torch.where(valid[..., None], cell, -math.inf).amax(1)
        boxes.append((torch.cat([low, high], dim=1), valid.sum(1)))
        if level == depth:
            break
        axis = (high - low).numpy().argmax(axis=1)  # numpy: the first of equals, on every machine
        along = cell.gather(2, torch.from_numpy(axis)[:, None, None].expand(-1, cell.shape[1], 1))[..., 0]
        rank = torch.where(valid, along, math.inf).argsort(dim=1, stable=True)
        order = order.gather(1, rank).view(2 * len(order), -1)
    placed = torch.where((order >= 0)[..., None], points[order.clamp(min=0)], math.inf)
    return _Tree(order, placed.transpose(1, 2).reshape(len(order), -1), boxes)


def _search(tree: _Tree, queries: Float[Tensor, "R 3"], rows: Tensor, own_leaf: Tensor, k: int) -> Float[Tensor, "R k"]:
    """The query's own leaf first, for a first bound, then every other leaf that can still hold a nearer point."""
    best = _merge(queries.new_full((k, len(queries)), math.inf), tree, queries, own_leaf, rows)
    query, leaf = _descend(tree, queries, best[-1], k)
    other = leaf != own_leaf[query]
    query, leaf = query[other], leaf[other]
    counts = torch.bincount(query, minlength=len(queries))
    first = counts.cumsum(0) - counts
    # Few points see many leaves: lone ones beside a tight cluster, all at one distance in float32. One by one, then.
    for lone in torch.nonzero(counts > _MAX_MERGED_LEAVES)[:, 0].tolist():
        leaves = leaf[first[lone] : first[lone] + counts[lone]]
        alone = _squared_distances(tree, queries[lone].expand(len(leaves), 3), leaves, rows[lone]).flatten()
        best[:, lone] = torch.cat([best[:, lone], alone]).topk(k, largest=False).values
    rank = torch.arange(len(query)) - first[query]  # which of its query's leaves this one is
    usual = torch.nonzero(counts[query] <= _MAX_MERGED_LEAVES)[:, 0]
    by_rank = usual[rank[usual].argsort(stable=True)]
    for pairs in by_rank.split(torch.bincount(rank[usual]).tolist()):
        here = query[pairs]
        best[:, here] = _merge(best[:, here], tree, queries[here], leaf[pairs], rows[here])
    return best.T.sqrt()


def _descend(tree: _Tree, queries: Float[Tensor, "R 3"], reach: Float[Tensor, "R"], k: int) -> tuple[Tensor, Tensor]:
    """(query, leaf) pairs, ordered by query, whose box begins within the query's `reach` (squared); it is tightened."""
    query, cell = torch.arange(len(queries)), torch.zeros(len(queries), dtype=torch.long)
    reach = reach.clone()
    for level, (box, members) in enumerate(tree.boxes):
        if level > 0:
            query = query.repeat_interleave(2)
            cell = (2 * cell).repeat_interleave(2)
            cell[1::2] += 1
        position, corners = queries.index_select(0, query), box.index_select(0, cell)
        below, above = corners[:, :3] - position, position - corners[:, 3:]
        nearest = _squared_length(torch.maximum(below, above).clamp_(min=0))
        # A cell of more than k points has k others within its farthest corner.
        farthest = _squared_length(torch.minimum(below, above))
        farthest = torch.where(members.index_select(0, cell) > k, farthest, math.inf)
        reach.scatter_reduce_(0, query, farthest, "amin")
        kept = torch.nonzero(nearest <= reach.index_select(0, query))[:, 0]
        query, cell = query.index_select(0, kept), cell.index_select(0, kept)
    return query, cell


def _squared_length(v: Float[Tensor, "P 3"]) -> Float[Tensor, "P"]:
    return v[:, 0] * v[:, 0] + v[:, 1] * v[:, 1] + v[:, 2] * v[:, 2]


def _merge(
    best: Float[Tensor, "k P"], tree: _Tree, queries: Tensor, leaf: Tensor, rows: Tensor
) -> Float[Tensor, "k P"]:
    """The k smallest squared distances after the points of one leaf per query are counted in, by insertion."""
    smallest = list(best)
    for candidate in _squared_distances(tree, queries, leaf, rows):
        for i in range(len(smallest)):
            nearer = torch.minimum(smallest[i], candidate)
            candidate = torch.maximum(smallest[i], candidate)
            smallest[i] = nearer
    return torch.stack(smallest)


def _squared_distances(tree: _Tree, queries: Tensor, leaf: Tensor, rows: Tensor) -> Float[Tensor, "M P"]:
    """To the points of one leaf per query; infinite to the query itself (`rows`: the index of each query)."""
    x, y, z = (
        tree.coordinates.index_select(0, leaf).T.reshape(3, tree.leaves.shape[1], len(leaf)) - queries.T[:, None]
    ).unbind(0)
    return torch.where(rows == tree.leaves.index_select(0, leaf).T, math.inf, x * x + y * y + z * z)
