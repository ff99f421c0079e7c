"""Renders for a prior, with everything known about them: uncertainty, depth, and the nearest input views."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt.data.scene import Scene
from gsopt.gaussians import Gaussians
from gsopt.geometry.cameras import Cameras
from gsopt.raster.api import expected_depth
from gsopt.raster.backend import Backend, RasterSettings, RenderedFrame
from gsopt.sds import coverage
from gsopt.sds.candidate_views import guidance_cameras, nearest, square_views
from gsopt.sds.guidance_memory import CoverageRecord
from gsopt.sds.guidance_plan import GuidancePlan
from gsopt.sds.priors.protocol import Images, Prior, References


@dataclass(frozen=True)
class ObservedRender:
    """A render and what is known about it."""

    camera: Cameras
    images: Images
    """One, 0..1."""
    alphas: Float[Tensor, "S S"]
    uncertainty: Float[Tensor, "S S"]
    depth: Float[Tensor, "S S"] | None = None
    references: References | None = None


class Observer:
    """Draws the current Gaussians from the guidance cameras of one scene."""

    def __init__(self, scene: Scene, backend: Backend, prior: Prior, plan: GuidancePlan, front: Cameras) -> None:
        self.backend = backend
        self.inputs = [view.camera for view in scene.observed]
        self.cameras = guidance_cameras(self.inputs, scene.extent, prior.size, front)
        self.references = square_views(scene.train, prior.size, plan.background.fixed())
        self._count = plan.references
        self._depths = prior.aligned

    def coverage(self, step: int, gaussians: Gaussians) -> CoverageRecord:
        """Coverage of the Gaussians, and the uncertainty of each candidate's view, at a low resolution."""
        covered = coverage.coverage(gaussians, self.inputs, self.backend)
        small = self.cameras.candidates.resized(32, 32)
        mean_u = coverage.mean_uncertainty(gaussians, coverage.uncertainty(covered), small, self.backend)
        return CoverageRecord(step, covered, mean_u)

    def uncertainty(self, gaussians: Gaussians, covered: Float[Tensor, "N"], camera: Cameras) -> Float[Tensor, "H W"]:
        return coverage.uncertainty_map(gaussians, coverage.uncertainty(covered), camera, self.backend)

    def draw(
        self,
        gaussians: Gaussians,
        camera: Cameras,
        background: Float[Tensor, "3"],
        settings: RasterSettings,
        covered: Float[Tensor, "N"],
    ) -> tuple[RenderedFrame, ObservedRender]:
        """A frame for the backward pass, and what the prior gets of it: on the CPU, wherever it is drawn."""
        frame = self.backend.forward(gaussians, camera, settings, background, depth=self._depths)
        alphas = frame.alphas.detach().cpu()
        return frame, ObservedRender(
            camera=camera,
            images=frame.colors.detach().cpu().permute(2, 0, 1)[None],
            alphas=alphas,
            uncertainty=self.uncertainty(gaussians, covered, camera),
            depth=None if frame.depths is None else expected_depth(frame.depths.detach().cpu(), alphas),
            references=self._nearest(gaussians, camera),
        )

    def _nearest(self, gaussians: Gaussians, camera: Cameras) -> References | None:
        """The input views nearest to a camera, with the depth of the current Gaussians in them."""
        chosen = nearest(self.references, camera, self._count)
        if chosen is None or not self._depths:
            return chosen
        depths = [depth_in(gaussians, chosen.cameras[k], self.backend) for k in range(len(chosen.cameras))]
        return replace(chosen, depths=torch.stack(depths))


def depth_in(gaussians: Gaussians, camera: Cameras, backend: Backend) -> Float[Tensor, "H W"]:
    """Expected z of the Gaussians, 0 where there is nothing."""
    frame = backend.forward(gaussians, camera, coverage.PLAIN, depth=True)
    assert frame.depths is not None
    return expected_depth(frame.depths, frame.alphas).cpu()
