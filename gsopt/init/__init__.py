"""The first Gaussians: from sparse points, silhouettes or stereo, or at random where the cameras look."""

from gsopt.init.first_gaussians import first_gaussians

__all__ = ["first_gaussians"]
