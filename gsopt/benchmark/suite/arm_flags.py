"""The arms of a suite: the flags that each adds to `gsopt train`."""

from __future__ import annotations

from gsopt import check

GUIDED = ("--lambda-sds", "0.2")
UNGUIDED = ("--lambda-sds", "0")
PUBLISHED_SETTINGS = (
    *UNGUIDED,
    *("--sparse.below-views", "0"),
    *("--init", "random"),
    *("--init-count", "100000"),
    *("--optimizer.lr-means", "1.6e-4"),
    *("--optimizer.lr-means-final", "1.6e-6"),
    *("--optimizer.lr-last", "1"),
    *("--optimizer.lr-quats", "1e-3"),
    *("--optimizer.lr-log-scales", "5e-3"),
    *("--optimizer.lr-sh0", "2.5e-3"),
    *("--optimizer.lr-shN", "1.25e-4"),
    *("--optimizer.sh-degree-every", "1000"),
    *("--density.refine-start", "500"),
    *("--density.refine-every", "100"),
    *("--density.grow-grad2d", "2e-4"),
    *("--density.turnover", "0"),
    *("--density.reset-every", "3000"),
    *("--density.haze-every", "0"),
    "--schedule.coarse-until",
    *("--max-gaussians", "1000000"),
)
"""The settings of Kerbl et al. 2023: 100,000 random points (groups of real captures add `--init points`), their
learning rates and density control, full resolution from the first step, no regularizer for few views, no guidance. Here
too, Gaussians that grow are halved and not cloned (docs/decisions/0019-fewer-steps.md)."""

ARMS: dict[str, tuple[str, ...]] = {
    "3dgs": PUBLISHED_SETTINGS,
    "ours-0": UNGUIDED,
    "ours": GUIDED,
    "ours-user": GUIDED,
    "ours-template": GUIDED,
    "ours-llm": GUIDED,
}
"""3dgs: published settings; ours-0: gsopt's defaults, unguided; ours: guided without prompts; the others: guided with
prompts of the user, of the template, of a language model. The guard checks all guidance."""

PROMPT_SOURCES = {"ours-user": "user", "ours-template": "template", "ours-llm": "llm:"}
"""Arms guided with prompts, and the prefix of their prompts' `source` in prompts.json."""


def is_guided(arm: str) -> bool:
    """True when a diffusion prior may guide this arm."""
    return ARMS[arm] == GUIDED


def require(arms: tuple[str, ...]) -> None:
    """UsageError for an arm that does not exist."""
    for arm in arms:
        check.one_of("--arms", arm, tuple(ARMS))
