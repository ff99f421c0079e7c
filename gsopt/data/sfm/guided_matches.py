"""More matches once poses are known: near the epipolar line of a feature few others look like its partner.

A photo of the same thing from 40 degrees to the side shares few features that are the best match in the whole photo,
and many that are the best match on their epipolar line. They make the poses of few photos exact.
"""

from __future__ import annotations

import copy
import shutil
from typing import Any

import numpy as np
from jaxtyping import Float, UInt32

from gsopt.data.sfm.features import ColmapProject
from gsopt.data.sfm.mapping import bundle_adjusted, incremental_options
from gsopt.data.sfm.pair_matches import PairMatches

BANDS = (0.006,)
"""Distance from the epipolar line in which partners are looked for, round by round, a share of the diagonal."""
MAX_TURN_DEGREES, LEAST_FAR = 60.0, 18
"""Photos whose directions differ more show other sides: partners are not looked for, and earlier matches are kept from
this number on, as of what lies flat on a table."""
RATIO = 0.85
MAX_DISTANCE = 0.75
"""Farthest two descriptors may be apart, of unit length."""
NOTHING: UInt32[np.ndarray, "0 2"] = np.zeros((0, 2), np.uint32)
ROWS_AT_ONCE = 256
"""Features compared with all of the other photo at once, which then fit into the processor's cache."""


def with_guided_matches(project: ColmapProject, pairs: PairMatches, model: Any) -> Any:
    """The reconstruction after rounds of matching along epipolar lines, triangulation and adjustment."""
    descriptors = _descriptors(project, pairs)
    for band in BANDS:
        _write_guided(project, pairs, model, descriptors, band)
        target = project.database.with_name("guided")
        shutil.rmtree(target, ignore_errors=True)
        target.mkdir()
        options = incremental_options(project)
        options.triangulation.ignore_two_view_tracks = False
        bare = copy.deepcopy(model)
        bare.delete_all_points2D_and_points3D()
        model = project.pycolmap.triangulate_points(
            bare, project.database, project.photos, target, options=options, refine_intrinsics=False
        )
        model = bundle_adjusted(project, model, lens=False)
    return model


def _descriptors(project: ColmapProject, pairs: PairMatches) -> dict[int, Float[np.ndarray, "F 128"]]:
    """Unit descriptors by photo."""
    found = {}
    with project.opened() as db:
        for number in pairs.names:
            has = db.exists_descriptors(number)
            rows = db.read_descriptors(number).data.astype(np.float32) if has else np.zeros((0, 128), np.float32)
            found[number] = rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-9)
    return found


def _write_guided(project: ColmapProject, pairs: PairMatches, model: Any, descriptors: Any, band: float) -> None:
    """Puts the guided matches of all pairs of placed photos into the database, as verified ones."""
    pycolmap = project.pycolmap
    placed = sorted(model.reg_image_ids())
    with project.opened() as db:
        db.clear_two_view_geometries()
        for i, a in enumerate(placed):
            for b in placed[i + 1 :]:
                first, second = model.image(a), model.image(b)
                relative = second.cam_from_world() * first.cam_from_world().inverse()
                near = relative.rotation.matrix()[2, 2] >= np.cos(np.radians(MAX_TURN_DEGREES))  # rolled or not
                fundamental = fundamental_matrix(
                    relative, model.camera(first.camera_id), model.camera(second.camera_id)
                )
                points = pairs.keypoints[a][: len(descriptors[a])], pairs.keypoints[b][: len(descriptors[b])]
                limit = band * float(np.hypot(*pairs.sizes[a]))
                rows = guided(fundamental, *points, descriptors[a], descriptors[b], limit) if near else NOTHING
                rows = _with_verified(rows, pairs, (a, b), fundamental, limit)
                if len(rows) < (1 if near else LEAST_FAR):
                    continue
                geometry = pycolmap.TwoViewGeometry()
                geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
                geometry.cam2_from_cam1 = relative
                geometry.E = pycolmap.essential_matrix_from_pose(relative)
                geometry.inlier_matches = rows
                db.write_two_view_geometry(a, b, geometry)


def _with_verified(
    rows: UInt32[np.ndarray, "M 2"], pairs: PairMatches, pair: tuple[int, int], fundamental: Any, limit: float
) -> UInt32[np.ndarray, "N 2"]:
    """Guided matches, and the earlier ones that agree with the poses."""
    earlier = pairs.matches.get(pair)
    if earlier is None or len(earlier) == 0:
        return rows
    first, second = pairs.points(pair)
    lines = _homogeneous(first) @ fundamental.T
    distance = np.abs((lines * _homogeneous(second)).sum(1)) / np.linalg.norm(lines[:, :2], axis=1)
    agreeing = earlier[distance < limit]
    new = ~(np.isin(rows[:, 0], agreeing[:, 0]) | np.isin(rows[:, 1], agreeing[:, 1]))
    return np.concatenate([agreeing, rows[new]]).astype(np.uint32)


def fundamental_matrix(relative: Any, first: Any, second: Any) -> Float[np.ndarray, "3 3"]:
    """F with second^T F first = 0 for pixels of two pinhole cameras (Hartley and Zisserman 2004, eq. 9.11)."""
    x, y, z = relative.translation
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    essential = cross @ relative.rotation.matrix()
    return np.linalg.inv(second.calibration_matrix()).T @ essential @ np.linalg.inv(first.calibration_matrix())


def guided(
    fundamental: Float[np.ndarray, "3 3"],
    first: Float[np.ndarray, "F 2"],
    second: Float[np.ndarray, "G 2"],
    a: Float[np.ndarray, "F 128"],
    b: Float[np.ndarray, "G 128"],
    limit: float,
) -> UInt32[np.ndarray, "M 2"]:
    """Mutual best matches within `limit` px of the epipolar line that are clearly better than the next best there."""
    if not len(a) or not len(b):
        return NOTHING
    lines = (_homogeneous(first) @ fundamental.T).astype(np.float32)
    lines /= np.maximum(np.linalg.norm(lines[:, :2], axis=1, keepdims=True), 1e-12)
    points = _homogeneous(second).T.astype(np.float32)
    best = np.zeros(len(a), np.int64)
    top, next_best, top_back = (np.full(count, -1.0, np.float32) for count in (len(a), len(a), len(b)))
    for start in range(0, len(a), ROWS_AT_ONCE):
        block = slice(start, start + ROWS_AT_ONCE)
        likeness = a[block] @ b.T
        likeness[np.abs(lines[block] @ points) > limit] = -1.0
        rows = np.arange(len(likeness))
        np.maximum(top_back, likeness.max(axis=0), out=top_back)
        best[block] = likeness.argmax(axis=1)
        top[block] = likeness[rows, best[block]]
        likeness[rows, best[block]] = -1.0
        next_best[block] = likeness.max(axis=1)
    distance, next_distance = (np.sqrt(np.maximum(2 - 2 * value, 0)) for value in (top, next_best))
    mutual = (top > 0) & (top == top_back[best])
    rows = np.flatnonzero(mutual & (distance < MAX_DISTANCE) & (distance < RATIO * next_distance))
    firsts = np.sort(np.unique(best[rows], return_index=True)[1])  # equal features have one partner at most
    return np.stack([rows[firsts], best[rows[firsts]]], axis=1).astype(np.uint32)


def _homogeneous(points: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 3"]:
    return np.column_stack([points, np.ones(len(points))])
