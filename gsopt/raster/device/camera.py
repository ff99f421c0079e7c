"""A camera as the kernels take it: `Camera` of common/projection.h."""

from __future__ import annotations

import ctypes

from gsopt.geometry.cameras import Cameras
from gsopt.raster.backend import RasterSettings
from gsopt.raster.device.layout import Layout, filled

PIVOT_GRID = 32
VIEW_MARGIN = 0.3
MOST_VIEWS = 1024


def camera_numbers(camera: Cameras, settings: RasterSettings) -> dict[str, object]:
    """The fields of the one camera of `camera`. The center is found in double: far-away scenes keep their precision."""
    V, K = camera.viewmats[0].double().tolist(), camera.Ks[0].double().tolist()
    R, t = [row[:3] for row in V[:3]], [row[3] for row in V[:3]]
    center = [-sum(R[i][j] * t[i] for i in range(3)) for j in range(3)]
    pivot = [_rounded(c / PIVOT_GRID) * PIVOT_GRID for c in center]
    fx, fy, cx, cy = K[0][0], K[1][1], K[0][2], K[1][2]
    margin_x, margin_y = VIEW_MARGIN * 0.5 * camera.width / fx, VIEW_MARGIN * 0.5 * camera.height / fy
    return {
        "R": [R[i][j] for i in range(3) for j in range(3)],
        "t": [t[i] + sum(R[i][j] * pivot[j] for j in range(3)) for i in range(3)],
        "pivot": pivot,
        "center": [c - p for c, p in zip(center, pivot, strict=True)],
        "fx": fx,
        "fy": fy,
        "cx": cx,
        "cy": cy,
        "x_min": -(cx / fx + margin_x),
        "x_max": (camera.width - cx) / fx + margin_x,
        "y_min": -(cy / fy + margin_y),
        "y_max": (camera.height - cy) / fy + margin_y,
        "near_plane": settings.near_plane,
        "far_plane": settings.far_plane,
        "eps2d": settings.eps2d,
        "width": camera.width,
        "height": camera.height,
        "antialiased": settings.antialiased,
    }


def _rounded(x: float) -> float:
    """To the nearest whole number, halves away from zero, as C++ does."""
    whole = float(int(x))
    return whole + (1.0 if x > 0 else -1.0) * (abs(x - whole) >= 0.5)


class Views(dict[tuple[object, ...], ctypes.Structure]):
    """Cameras as kernels take them, by everything that makes them."""

    def __init__(self, layout: Layout) -> None:
        super().__init__()
        self._layout = layout

    def of(self, camera: Cameras, settings: RasterSettings) -> ctypes.Structure:
        """The one camera of `camera`."""
        tensors = [tensor[0].detach().cpu().numpy() for tensor in (camera.viewmats, camera.Ks)]
        drawn_by = settings.near_plane, settings.far_plane, settings.eps2d, settings.antialiased
        key = *((t.tobytes(), t.dtype) for t in tensors), camera.width, camera.height, drawn_by
        if key not in self:
            if len(self) >= MOST_VIEWS:
                self.clear()
            self[key] = filled(self._layout, camera_numbers(camera, settings))
        return self[key]
