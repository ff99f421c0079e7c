"""Points from photos with known poses: a plane is found for every pixel, and kept where two photos agree on it."""

from gsopt.init.stereo.points import stereo_points

__all__ = ["stereo_points"]
