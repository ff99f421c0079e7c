"""The window of a masked image outside of which there is only background, which need not be drawn."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from gsopt.geometry.cameras import Cameras

# Around the opaque pixels: SSIM's window reaches 5 px, and splats that stick out must feel the background.
MARGIN = 16
# The window begins at a multiple of this, px, so that the kernels' tiles lie where they lie in the whole image.
TILE = 16
# A window larger than this share of the image is not worth the copy.
MAX_SHARE = 0.9
# One step in this many draws the whole image: what hangs far beside the object is seen and goes.
WHOLE_EVERY = 8


@dataclass(frozen=True)
class Window:
    """Rows y0 to y1 and columns x0 to x1 of an image, px, half open."""

    y0: int
    y1: int
    x0: int
    x1: int

    def crop(self, image: Tensor) -> Tensor:
        """This part of an image [H, W, ...], a copy."""
        return image[self.y0 : self.y1, self.x0 : self.x1].contiguous()

    def camera(self, camera: Cameras) -> Cameras:
        """The camera whose image is this part: only the principal point moves."""
        offset = torch.tensor([[0.0, 0.0, self.x0], [0.0, 0.0, self.y0], [0.0, 0.0, 0.0]]).to(camera.Ks)
        return replace(camera, Ks=camera.Ks - offset, width=self.x1 - self.x0, height=self.y1 - self.y0)


def content_window(alphas: Float[Tensor, "H W"] | None) -> Window | None:
    """The box of all that is not fully transparent, with a margin, unless it is empty or nearly everything."""
    if alphas is None:
        return None
    shown = alphas > 0
    rows, columns = (torch.nonzero(shown.any(dim=axis))[:, 0].tolist() for axis in (1, 0))
    if not rows:
        return None
    height, width = alphas.shape
    y0, x0 = (max(0, found[0] - MARGIN) // TILE * TILE for found in (rows, columns))
    y1, x1 = min(height, rows[-1] + 1 + MARGIN), min(width, columns[-1] + 1 + MARGIN)
    return Window(y0, y1, x0, x1) if (y1 - y0) * (x1 - x0) < MAX_SHARE * height * width else None


def draws_whole(step: int) -> bool:
    """True when this step draws the whole image although masked images are cropped."""
    return step % WHOLE_EVERY == 0
