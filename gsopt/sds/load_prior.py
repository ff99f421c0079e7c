"""Opens a prior by name and imports only the modules that this prior needs."""

from __future__ import annotations

from pathlib import Path

from gsopt.config.guidance import GuidanceConfig
from gsopt.sds.priors.protocol import Prior
from gsopt.sds.select_prior import EMBEDDED


def open_prior(name: str, config: GuidanceConfig) -> Prior:
    """Returns the prior of that name, checked but not yet loaded.

    Raises InputError for a missing or broken prior, UsageError for settings it does not support, MissingDependency
    without diffusers.
    """
    from gsopt.sds.priors.view_conditioned import ViewPrior, is_view_prior

    own = EMBEDDED if name == "embedded" else Path(name).expanduser()
    if is_view_prior(own):
        return ViewPrior(own, config)
    from gsopt.sds.priors.folder import find_folder
    from gsopt.sds.priors.stable_diffusion import DiffusersPrior

    return DiffusersPrior(find_folder(name), config)
