"""The table of the stress suite: what each case strains, what must come out, how close to the float64 reference.

`test_stress.py` holds the laws; `experiments/stress.py` measures the same cases and writes docs/performance.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from raster_scenes import Case
from stress_scenes import (
    antialiased,
    around_the_camera,
    at_one_depth,
    at_the_rim,
    bright,
    coincident,
    dots,
    far_survey,
    layers,
    of_count,
    of_size,
    opacities_at_both_ends,
    quaternions_of_norm,
    quaternions_with_denormal_parts,
    recentered_survey,
    scaled,
    scales_of_all_sizes,
    through_a_lens,
    trained,
)
from tolerances import FAR, GRADIENT, IMAGE, MANY_LAYERS, SHEARED, SLANT


@dataclass(frozen=True)
class Stress:
    """One hostile scene."""

    name: str
    risk: str
    """What could go wrong."""
    outcome: str
    """What happens."""
    make: Callable[[], Case]
    image: float = IMAGE
    """Permitted error of colors and alphas, as a share of the largest value or 1; of depths, of the largest depth."""
    gradient: float = GRADIENT
    """Permitted relative error (L2) of the worst of the gradients."""


NEEDLE = "the determinant of the projected covariance is a difference of large squares"
DRAWN = "drawn as by the reference"
STRESSES = (
    Stress("scales 1e-12", "the covariance underflows", "dots as wide as the filter", scaled(1e-12)),
    Stress("scales 1e6", "the determinant overflows", "each covers the image", scaled(1e6)),
    Stress("scales from 1e-12 to 1e6 in each", NEEDLE, DRAWN, scales_of_all_sizes, SHEARED, SHEARED),
    Stress("needles 1e6 : 1, 1 unit long", NEEDLE, DRAWN, scaled(1.0, 1e-6, 1e-6)),
    Stress("needles 1e6 : 1, 1000 units long", NEEDLE, DRAWN, scaled(1e3, 1e-3, 1e-3), SLANT, SLANT),
    Stress("discs 1e6 : 1", "seen edge-on they are needles", DRAWN, scaled(1.0, 1.0, 1e-6)),
    Stress("discs 1e6 : 1, antialiased", "a quotient of areas", DRAWN, antialiased(scaled(1.0, 1.0, 1e-6))),
    Stress(
        "dots 1e-4, antialiased", "a quotient of areas near 0", "fainter than 1/255: none", antialiased(scaled(1e-4))
    ),
    Stress("quaternions of norm 1e-20", "the square underflows", DRAWN, quaternions_of_norm(1e-20)),
    Stress("quaternions of norm 1e18", "the square overflows", DRAWN, quaternions_of_norm(1e18)),
    Stress("quaternions with denormal parts", "parts are lost", DRAWN, quaternions_with_denormal_parts),
    Stress("logits +80 and -80", "exp overflows, log of 0", "opaque (0.99), or none", opacities_at_both_ends),
    Stress(
        "in and behind the camera, on its near plane", "division by 0", "drawn beyond that plane", around_the_camera
    ),
    Stress("at the rim of 179 degrees", "the Jacobian explodes", "it is clamped", at_the_rim),
    Stress(
        "a survey 2.4e6 m from its origin",
        "float32 knows 0.1 m there",
        "0.1 m off",
        far_survey,
        FAR,
        FAR,
    ),
    Stress("the same after `load_scene`", "", "the origin was moved, and recorded", recentered_survey),
    Stress("10,000 faint ones in one place", "errors add up", DRAWN, coincident(-5.3), gradient=MANY_LAYERS),
    Stress("10,000 half opaque ones in one place", "errors add up", DRAWN, coincident(0.0), gradient=MANY_LAYERS),
    Stress("200 at one depth", "a sort that is not stable", "ties go by index", at_one_depth),
    Stress("1500 of a thousandth of a pixel", "none reaches a center", DRAWN, dots),
    Stress("each covers the image", "every tile lists all of them", DRAWN, scaled(100.0)),
    Stress("focal length 1e-3 px", "all in a thousandth of a pixel", DRAWN, through_a_lens(1e-3)),
    Stress("focal length 1 px", "the Jacobian is clamped", DRAWN, through_a_lens(1.0)),
    Stress("focal length 1e6 px", "pixels from large differences", DRAWN, through_a_lens(1e6)),
    Stress("image 1 x 1", "a tile that is mostly outside", DRAWN, of_size(1, 1)),
    Stress("image 1 x 4096", "a column of such tiles", DRAWN, of_size(1, 4096)),
    Stress("image 4096 x 1", "a row of such tiles", DRAWN, of_size(4096, 1)),
    Stress("image 17 x 33", "one pixel in the last tile", DRAWN, of_size(17, 33)),
    Stress("no Gaussian", "empty arrays", "the background", of_count(0)),
    Stress("one Gaussian", "all lanes but one are padding", DRAWN, of_count(1)),
    Stress("SH coefficients 1e4", "colors of 1e4", DRAWN, bright(1e4)),
    Stress("1500 opaque layers, one lane alive", "1 / T of a saturated lane", "each lane stops itself", layers),
    Stress("after 17,885 training steps", "what no random scene holds", DRAWN, trained, gradient=MANY_LAYERS),
)
