"""Invented records of runs, for tests of statistics and pages."""

from __future__ import annotations

from typing import Any

MACHINE = {
    "cpu": "c",
    "cores": 2,
    "system": "s",
    "python": "3",
    "torch": "2",
    "gsopt": "0",
    "commit": None,
    "load": 1.0,
}


def record(arm: str, psnr: float, scene: str = "objects/a", seed: int = 0, steps: int = 2000) -> dict[str, Any]:
    """A run of objects-4 with one held-out view."""
    lpips = round(1 / psnr, 6)
    mean = {"psnr": psnr, "ssim": 0.5, "lpips_alex": lpips, "lpips_vgg": None, "mask_iou": 0.9, "depth_error": None}
    course = [(steps // 2, 5.0, psnr - 2), (steps, 10.0, psnr)]
    return {
        "group": "objects-4",
        "scene": scene,
        "views": "4",
        "arm": arm,
        "iterations": steps,
        "seed": seed,
        "key": "k",
        "flags": [],
        "views_in": 4,
        "views_out": ["v"],
        "per_view": {name: [value] for name, value in mean.items()},
        "mean": mean,
        "curve": [
            {"step": step, "cpu_seconds": cpu, "gaussians": 9, "psnr": value, "lpips_alex": lpips}
            for step, cpu, value in course
        ],
        "curve_views": 1,
        "setup_cpu_seconds": 1.0,
        "train_cpu_seconds": 9.0,
        "peak_memory_mb": 300.0,
        "n_gaussians": 9,
        "init": "hull",
        "guidance": {"prior": None, "reason": "", "factor": 0.5 if arm == "ours" else None, "guard": ""},
        "code": "c",
    }
