"""Opens a prior by name. What only some priors need is imported when that prior is asked for."""

from __future__ import annotations

from pathlib import Path

from gsopt.guidance_config import GuidanceConfig
from gsopt.sds.choice import EMBEDDED
from gsopt.sds.prior import Prior


def open_prior(name: str, config: GuidanceConfig) -> Prior:
    """The prior of that name, checked but not yet loaded.

    Raises InputError for one that is missing or broken, UsageError for settings it cannot have, MissingDependency
    without diffusers.
    """
    from gsopt.sds.view_prior import ViewPrior, is_view_prior

    own = EMBEDDED if name == "embedded" else Path(name).expanduser()
    if is_view_prior(own):
        return ViewPrior(own, config)
    from gsopt.sds.diffusers_prior import DiffusersPrior
    from gsopt.sds.folder import find_folder

    return DiffusersPrior(find_folder(name), config)
