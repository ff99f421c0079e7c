"""Distance between two sets of poses of the same photos, after the best similarity between them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from gsopt.data.sfm.placement import Similarity


@dataclass(frozen=True)
class TrajectoryError:
    """Errors of C cameras after the best similarity."""

    rotation_degrees: Float[np.ndarray, "C"]
    position: Float[np.ndarray, "C"]
    """Share of the radius of the path (its farthest camera's distance from the mean)."""

    def summary(self) -> dict[str, float]:
        """Median, root mean square and maximum of both."""
        return {
            f"{name}_{measure}": round(float(take(values)), 6)
            for name, values in (("rotation_degrees", self.rotation_degrees), ("position", self.position))
            for measure, take in (("median", np.median), ("rms", _rms), ("max", np.max))
        }


def compare(found: Float[np.ndarray, "C 4 4"], truth: Float[np.ndarray, "C 4 4"]) -> TrajectoryError:
    """Both cam_from_world in OpenCV axes, row by row the same photo; at least three cameras not on one line."""
    similarity = align(centers(found), centers(truth))
    moved = centers(found) @ (similarity.scale * similarity.rotation).T + similarity.translation
    radius = float(np.linalg.norm(centers(truth) - centers(truth).mean(axis=0), axis=1).max())
    turned = found[:, :3, :3] @ similarity.rotation.T  # cam_from_world in the truth's axes
    apart = np.einsum("cij,ckj->cik", turned, truth[:, :3, :3])
    sine = np.linalg.norm(apart - np.swapaxes(apart, 1, 2), axis=(1, 2)) / np.sqrt(8)
    cosine = (np.trace(apart, axis1=1, axis2=2) - 1) / 2
    return TrajectoryError(
        np.degrees(np.arctan2(sine, cosine)), np.linalg.norm(moved - centers(truth), axis=1) / radius
    )


def turns_apart(found: Float[np.ndarray, "C 4 4"], truth: Float[np.ndarray, "C 4 4"]) -> float:
    """Degrees between the turns from one camera to another in both, in the median pair; 0 for a single camera. No
    similarity between the two is needed."""
    turns = [np.einsum("bij,akj->abik", poses[:, :3, :3], poses[:, :3, :3]) for poses in (found, truth)]
    cosine = (np.einsum("abij,abij->ab", *turns)[np.triu_indices(len(found), 1)] - 1) / 2
    return float(np.degrees(np.arccos(np.median(np.clip(cosine, -1, 1))))) if len(found) > 1 else 0.0


def align(source: Float[np.ndarray, "C 3"], target: Float[np.ndarray, "C 3"]) -> Similarity:
    """The similarity that takes `source` closest to `target` in the least squares sense (Umeyama 1991, eq. 34-43)."""
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    U, D, Vt = np.linalg.svd(b.T @ a / len(a))
    S = np.diag([1, 1, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])
    rotation = U @ S @ Vt
    scale = float(np.trace(np.diag(D) @ S) / np.square(a).sum(axis=1).mean())
    return Similarity(scale, rotation, target.mean(axis=0) - scale * rotation @ source.mean(axis=0))


def centers(viewmats: Float[np.ndarray, "C 4 4"]) -> Float[np.ndarray, "C 3"]:
    """Camera positions in the world."""
    return -np.einsum("cij,ci->cj", viewmats[:, :3, :3], viewmats[:, :3, 3])


def _rms(values: Float[np.ndarray, "C"]) -> float:
    return float(np.sqrt(np.square(values).mean()))
