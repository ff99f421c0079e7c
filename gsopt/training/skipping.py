"""Views that have converged and bands that a scene does not use: what `ScheduleConfig` lets a run leave out."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gsopt.gaussians import Gaussians
from gsopt.geometry import sh
from gsopt.geometry.cameras import Cameras
from gsopt.geometry.precision import widest
from gsopt.raster.backend import Gradients


class Resting:
    """Views whose loss no longer falls rest for one epoch: their steps pass without being computed."""

    # A view goes on without rest while its loss falls by this share from one visit to the next.
    LEAST_GAIN = 0.01

    def __init__(self, views: int) -> None:
        self.last = [math.inf] * views
        """Loss at the last visit."""
        self.resting = [False] * views

    def skips(self, view: int) -> bool:
        """True when this visit is left out; the next one is not."""
        rests, self.resting[view] = self.resting[view], False
        return rests

    def note(self, view: int, loss: float) -> None:
        """Take the loss of a visit."""
        self.resting[view] = loss > (1 - self.LEAST_GAIN) * self.last[view]
        self.last[view] = loss

    def tensors(self) -> dict[str, Tensor]:
        last, resting = torch.tensor(self.last, dtype=torch.float64), torch.tensor(self.resting, dtype=torch.bool)
        return {"last": last, "resting": resting}

    def restore(self, tensors: dict[str, Tensor]) -> None:
        self.last, self.resting = tensors["last"].tolist(), tensors["resting"].tolist()


class Bands:
    """The band of the spherical harmonics that is drawn, raised only where the residual depends on the view.

    Over the last steps before a band is due, dLoss/dcolor of every Gaussian is correlated over the views with the
    functions of that band. Were a Gaussian's residuals g_v independent of the view, the squared correlation
    (Σ_v (Y_v - mean Y) g_v)² would be Var(g) Σ_v (Y_v - mean Y)² on average. The band is drawn from then on when the
    sum over all Gaussians is `LEAST_RATIO` times that; else it is asked for again when the next one would be due.
    """

    STEPS = 100
    LEAST_RATIO = 2.0

    def __init__(self, every: int, highest: int) -> None:
        self.degree = 0
        self._every, self._highest = every, highest
        self._sums: dict[str, Tensor] = {}

    def watches(self, step: int) -> bool:
        """True when this step's gradients count for the next decision."""
        return self.degree < self._highest and 0 <= -step % self._every < min(self.STEPS, self._every)

    def note(self, gaussians: Gaussians, camera: Cameras, gradients: Gradients) -> None:
        """Take one step's gradient with respect to the colors."""
        g = gradients.sh0[:, 0] / sh.C0
        seen = (g != 0).any(dim=1).float()
        directions = torch.nn.functional.normalize(gaussians.means - camera.centers.to(gaussians.means), dim=1)
        Y = sh.basis(directions, self.degree + 1)[:, (self.degree + 1) ** 2 :] * seen[:, None]
        new = {"n": seen, "g": g, "gg": g * g, "Y": Y, "YY": Y * Y, "Yg": Y[..., None] * g[:, None]}
        kept = self._sums if len(self._sums.get("n", ())) == len(gaussians) else {}
        self._sums = {name: kept[name] + value for name, value in new.items()} if kept else new

    def forget(self) -> None:
        """The rows have changed: what was summed belongs to others."""
        self._sums = {}

    def decide(self, step: int) -> None:
        """Raise the degree when a band is due after this step and wanted."""
        if self.degree >= self._highest or step % self._every != 0:
            return
        if self.ratio() > self.LEAST_RATIO:
            self.degree += 1
        self.forget()

    def ratio(self) -> float:
        """Squared correlation over what chance would give; 0 before two views of any Gaussian were drawn."""
        s = self._sums
        if not s or float(s["n"].max()) < 2:
            return 0.0
        n = s["n"].clamp_min(1)[:, None]
        variance = (s["gg"] - s["g"] ** 2 / n) / (n - 1).clamp_min(1)
        spread = (s["YY"] - s["Y"] ** 2 / n).clamp_min(0)
        correlation = s["Yg"] - s["Y"][..., None] * s["g"][:, None] / n[..., None]
        enough, wide = (s["n"] >= 2)[:, None].float(), widest(s["n"].device)
        expected = float((enough * spread.sum(dim=1, keepdim=True) * variance).sum(dtype=wide))
        found = float((enough[..., None] * correlation**2).sum(dtype=wide))
        return found / expected if expected > 0 else 0.0

    def tensors(self) -> dict[str, Tensor]:
        return {"degree": torch.tensor(self.degree), **self._sums}

    def restore(self, tensors: dict[str, Tensor], count: int, device: torch.device) -> None:
        """Take the sums over `count` Gaussians back."""
        self.degree = int(tensors["degree"])
        self._sums = {name: tensor.to(device) for name, tensor in tensors.items() if name != "degree"}
        self._require_shapes(count)

    def _require_shapes(self, count: int) -> None:
        """For `Trainer.resumed`, which turns this into an InputError that names the checkpoint."""
        band = 2 * self.degree + 3
        shapes = {"n": (count,), "g": (count, 3), "gg": (count, 3)}
        shapes |= {"Y": (count, band), "YY": (count, band), "Yg": (count, band, 3)}
        found = {name: tuple(tensor.shape) for name, tensor in self._sums.items()}
        if not 0 <= self.degree <= self._highest or found not in ({}, shapes):
            raise ValueError("the sums of the bands")
