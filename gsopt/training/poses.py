"""Camera poses learned beside the Gaussians: one small rigid motion per input view (`--refine-poses`).

A view with cam_from_world V is replaced by exp(xi) V, xi = (omega, tau): the world as this camera sees it is turned by
omega about the camera and shifted by tau. No kernel has to differentiate a camera: turning and shifting the Gaussians
as the view sees them draws the same picture, so dL/dxi follows from dL/dmeans and dL/dquats (docs/math.md, eq. 23).
Color is the one thing that does not move along: it is looked up in the world's direction from camera to Gaussian,
which a camera that turns on the spot does not change. Its share of dL/dmeans is taken out for omega; for tau it
belongs in. Nothing is neglected but the edges of the rasterizer's culling.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gsopt.config.train import PoseConfig
from gsopt.data.scene import Scene
from gsopt.gaussians import Gaussians
from gsopt.geometry import quats, sh
from gsopt.geometry.cameras import Cameras
from gsopt.geometry.precision import widest
from gsopt.geometry.rigid_motion import rigid_motion
from gsopt.raster.backend import Gradients

TENSORS = ("viewmats", "whitening", "exp_avg", "exp_avg_sq", "steps")
BETA1, BETA2, EPS = 0.9, 0.99, 1e-15
"""Adam's constants. A view is seen once per epoch: a memory of 100 visits is long enough."""
DAMPING = 0.01
"""Share of each motion's own effect that is added to it before whitening: holds what the picture hardly shows."""
TOO_NEAR = 0.2
"""Share of the median depth below which a Gaussian is left out of the whitening: one at the lens would decide it."""


class PoseRefinement:
    """The poses of the input views, and what Adam remembers of them; float64, so that small steps are not lost."""

    def __init__(self, config: PoseConfig, scene: Scene, iterations: int) -> None:
        self.config, self.iterations = config, iterations
        self.names = [view.name for view in scene.train]
        self.given = torch.cat([view.camera.viewmats for view in scene.train]).double()
        self.viewmats = self.given.clone()
        self._whitening = torch.zeros(len(self.given), 6, 6, dtype=torch.float64)
        self._exp_avg = torch.zeros(len(self.given), 6, dtype=torch.float64)
        self._exp_avg_sq = torch.zeros_like(self._exp_avg)
        self._steps = torch.zeros(len(self.given), dtype=torch.int64)

    def camera(self, index: int, camera: Cameras) -> Cameras:
        """View `index`, which the scene has at `camera`, where it is thought to stand now."""
        return replace(camera, viewmats=self.viewmats[index : index + 1].clone().to(camera.viewmats))

    def update(self, index: int, step: int, gaussians: Gaussians, gradients: Gradients, sh_degree: int) -> None:
        """One Adam step of view `index` from the gradients of the frame that it drew at its present pose."""
        if step <= self.config.start:
            return
        rows = seen_rows(gradients)
        if not bool(rows.any()):
            return
        if self._steps[index] == 0:
            self._whitening[index] = whitening(self.viewmats[index], gaussians.means[rows].cpu().double())
        self._steps[index] += 1
        seen, W = int(self._steps[index]), self._whitening[index]
        v_u = W @ pose_gradient(self.viewmats[index], gaussians, gradients, sh_degree)  # W is symmetric
        self._exp_avg[index].lerp_(v_u, 1 - BETA1)
        self._exp_avg_sq[index].lerp_(v_u.square(), 1 - BETA2)
        root = (self._exp_avg_sq[index] / (1 - BETA2**seen)).sqrt()
        u = self._exp_avg[index] / (1 - BETA1**seen) / (root + EPS)
        self.viewmats[index] = rigid_motion(-self.rate(step) * W @ u) @ self.viewmats[index]

    def rate(self, step: int) -> float:
        """Radians the picture may shift in a step: log-linear from `lr` to `lr_final`."""
        share = (step - self.config.start) / max(1, self.iterations - self.config.start)
        return math.exp((1 - share) * math.log(self.config.lr) + share * math.log(self.config.lr_final))

    def tensors(self) -> dict[str, Tensor]:
        """The state, for a checkpoint."""
        own = (self.viewmats, self._whitening, self._exp_avg, self._exp_avg_sq, self._steps)
        return dict(zip(TENSORS, own, strict=True))

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Inverse of `tensors`."""
        for name, own in self.tensors().items():
            own.copy_(_of_shape(tensors[name], own, name))

    def moved(self) -> tuple[Float[Tensor, "C"], Float[Tensor, "C"]]:
        """Distance of each view from where it was given: degrees, scene units."""
        apart = self.viewmats[:, :3, :3] @ self.given[:, :3, :3].mT
        sine = (apart - apart.mT).square().sum((1, 2)).div(8).sqrt()
        cosine = (apart.diagonal(dim1=1, dim2=2).sum(1) - 1) / 2
        return torch.rad2deg(torch.atan2(sine, cosine)), (_centers(self.viewmats) - _centers(self.given)).norm(dim=1)

    def record(self, origin: tuple[float, float, float]) -> dict[str, Any]:
        """poses.json: every view's cam_from_world in the source's frame (OpenCV axes), and how far it went."""
        degrees, distances = self.moved()
        viewmats = self.viewmats.clone()  # the scene was loaded less `origin`
        viewmats[:, :3, 3] -= viewmats[:, :3, :3] @ torch.tensor(origin, dtype=torch.float64)
        rows = zip(self.names, viewmats.tolist(), degrees.tolist(), distances.tolist(), strict=True)
        return {
            "version": 1,
            "views": [
                {"name": name, "cam_from_world": matrix, "turned_degrees": turned, "moved": moved}
                for name, matrix, turned, moved in rows
            ],
        }


def pose_gradient(
    viewmat: Float[Tensor, "4 4"], gaussians: Gaussians, gradients: Gradients, sh_degree: int
) -> Float[Tensor, "6"]:
    """dL/d(omega, tau) at 0 of the picture that exp(xi) · viewmat sees (docs/math.md, eq. 23); float64."""
    rows = seen_rows(gradients)
    device, wide = gaussians.means.device, widest(gaussians.means.device)
    means, rotations = gaussians.means[rows].to(wide), gaussians.quats[rows].to(wide)
    v_means, v_quats = gradients.means[rows].to(wide), gradients.quats[rows].to(wide)
    R, t = viewmat[:3, :3].to(means), viewmat[:3, 3].to(means)
    v_tau = R @ v_means.sum(0)
    v_geometry = v_means - _through_color(gaussians, gradients, rows, -R.T @ t, sh_degree)
    arms = torch.linalg.cross(means @ R.T + t, v_geometry @ R.T).sum(0)
    axes = torch.eye(3, 4, dtype=wide, device=device).roll(1, 1)[:, None]  # the quaternions i, j, k
    turned = (quats.multiply(axes, rotations[None]) / 2 * v_quats).sum((1, 2))  # omega in the world's axes
    return torch.cat([arms + R @ turned, v_tau]).cpu().double()


def seen_rows(gradients: Gradients) -> Bool[Tensor, "N"]:
    """Gaussians that the frame's loss depends on."""
    return (gradients.means != 0).any(1) | (gradients.quats != 0).any(1)


def _through_color(
    gaussians: Gaussians, gradients: Gradients, rows: Tensor, center: Float[Tensor, "3"], sh_degree: int
) -> Float[Tensor, "M 3"]:
    """The part of dL/dmeans that comes from the direction colors are looked up in, in the widest numbers."""
    wide = widest(gaussians.means.device)
    means = gaussians.means[rows].to(wide)
    count = (sh_degree + 1) ** 2 - 1
    if count == 0 or gaussians.shN.shape[1] == 0:
        return torch.zeros_like(means)
    v_colors = gradients.sh0[rows, 0].to(wide) / sh.C0
    weights = torch.einsum("nkc,nc->nk", gaussians.shN[rows, :count].to(wide), v_colors)
    with torch.enable_grad():
        free = means.detach().requires_grad_()
        directions = torch.nn.functional.normalize(free - center, dim=1)
        shown = sh.basis(directions, round(math.sqrt(weights.shape[1] + 1)) - 1)[:, 1:]
        (through,) = torch.autograd.grad((shown * weights).sum(), free)
    return through


def whitening(viewmat: Float[Tensor, "4 4"], means: Float[Tensor, "M 3"]) -> Float[Tensor, "6 6"]:
    """(S + damping · diag S)^(-1/2) where S = mean of J^T J over the Gaussians seen, J = d(direction)/d(xi).

    Turning about the camera and shifting it nearly look the same; in xi = W u every direction of u shifts the picture
    by about as much, and Adam goes straight (docs/math.md, eq. 24; preconditioned cameras: Park et al. 2023, "CamP").
    """
    points = means @ viewmat[:3, :3].T + viewmat[:3, 3]
    points = points[points[:, 2] >= TOO_NEAR * points[:, 2].median()]
    x, y, z = points.unbind(1)
    zero, one = torch.zeros_like(z), torch.ones_like(z)
    perspective = torch.stack([torch.stack([one, zero, -x / z], 1), torch.stack([zero, one, -y / z], 1)], 1)
    turning = torch.stack([zero, z, -y, -z, zero, x, y, -x, zero], 1).view(-1, 3, 3)  # d(omega x p)/d(omega)
    J = perspective / z[:, None, None] @ torch.cat([turning, torch.eye(3).to(z).expand_as(turning)], dim=2)
    S = torch.einsum("nic,nid->cd", J, J) / len(J)
    values, vectors = torch.linalg.eigh(S + DAMPING * torch.diag(S.diagonal()))
    return vectors @ torch.diag(values.clamp_min(1e-12).rsqrt()) @ vectors.T


def _centers(viewmats: Float[Tensor, "C 4 4"]) -> Float[Tensor, "C 3"]:
    return -torch.einsum("cij,ci->cj", viewmats[:, :3, :3], viewmats[:, :3, 3])


def _of_shape(found: Tensor, own: Tensor, name: str) -> Tensor:
    """For `Trainer.resumed`, which turns this into an InputError that names the checkpoint."""
    if found.shape != own.shape:
        raise ValueError(f"the shape of poses.{name}")
    return found
