"""The first Gaussians: from sparse points, silhouettes or stereo, or at random in view of the cameras."""

from gsopt.init.first_gaussians import first_gaussians

__all__ = ["first_gaussians"]
