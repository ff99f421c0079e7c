"""The axes of a found scene: z up, the cameras' common focus at the origin, their typical distance to it 1.

Structure from motion leaves position, orientation and scale open. The similarity chosen here is recorded with the
scene, so that it can be taken back: x_placed = scale · rotation · x_found + translation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from gsopt.geometry.focus import across_axes, nearest_to_axes, up_direction

PARALLEL_SHARE = 0.02
"""Share of the cameras' x axes in a second direction below which all look the same way and fix no horizon."""


@dataclass(frozen=True)
class Similarity:
    """x_placed = scale · rotation · x_found + translation."""

    scale: float
    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]

    @property
    def matrix(self) -> Float[np.ndarray, "4 4"]:
        """placed_from_found, homogeneous."""
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = self.scale * self.rotation, self.translation
        return matrix

    @staticmethod
    def identity() -> Similarity:
        return Similarity(1.0, np.eye(3), np.zeros(3))


def place(viewmats: Float[np.ndarray, "C 4 4"], points: Float[np.ndarray, "P 3"]) -> Similarity:
    """The similarity for cameras (cam_from_world, OpenCV axes) and the points they saw."""
    rotation = rotation_to_z(level_up(viewmats))
    centers = -np.einsum("cij,ci->cj", viewmats[:, :3, :3], viewmats[:, :3, 3])
    focus = common_focus(centers, viewmats[:, 2, :3], points)
    scale = 1 / max(float(np.median(np.linalg.norm(centers - focus, axis=1))), 1e-12)
    return Similarity(scale, rotation, -scale * rotation @ focus)


def level_up(viewmats: Float[np.ndarray, "C 4 4"]) -> Float[np.ndarray, "3"]:
    """Unit vector perpendicular to the cameras' x axes, which people hold level, on the side of the image tops.

    It is the mean of the image tops when the x axes are parallel (all cameras look the same way) or contradict it
    (cameras that lie on their side).
    """
    right = viewmats[:, 0, :3]
    values = np.linalg.eigvalsh(right.T @ right)
    level = values[1] > PARALLEL_SHARE * values.sum()
    return up_direction(torch.from_numpy(viewmats), damping=0.0, least_cosine=0.3 if level else 1.0).numpy()


def common_focus(
    centers: Float[np.ndarray, "C 3"], forwards: Float[np.ndarray, "C 3"], points: Float[np.ndarray, "P 3"]
) -> Float[np.ndarray, "3"]:
    """The point closest to all optical axes; where it does not lie in front of the cameras, the points' median."""
    fallback = np.median(points, axis=0) if len(points) else centers.mean(axis=0)
    axes = torch.from_numpy(forwards)
    if float(torch.linalg.cond(across_axes(axes).sum(0))) > 1e4:
        return fallback
    focus = nearest_to_axes(torch.from_numpy(centers), axes, damping=0.0).numpy()
    depths = np.einsum("ci,ci->c", focus - centers, forwards)
    return focus if float((depths > 0).mean()) > 0.9 else fallback


def rotation_to_z(up: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """The smallest rotation that takes the unit vector `up` to +z (Rodrigues)."""
    z = np.array([0.0, 0.0, 1.0])
    cosine, squared_sine = float(up @ z), float(up[0] ** 2 + up[1] ** 2)
    if cosine < 0 and squared_sine < 1e-300:
        return np.diag([1.0, -1.0, -1.0])
    x, y, w = np.cross(up, z)
    cross = np.array([[0, -w, y], [w, 0, -x], [-y, x, 0]])
    # Equal, each exact where the other cancels.
    share = 1 / (1 + cosine) if cosine > 0 else (1 - cosine) / squared_sine
    return np.eye(3) + cross + share * cross @ cross
