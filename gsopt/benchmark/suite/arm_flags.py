"""The arms of a suite: what each adds to `gsopt train`, in flags a person could type."""

from __future__ import annotations

from gsopt import check

PUBLISHED_SETTINGS = (
    *("--lambda-sds", "0"),
    *("--sparse.below-views", "0"),
    *("--init", "random"),
    *("--init-count", "100000"),
    *("--optimizer.lr-means", "1.6e-4"),
    *("--optimizer.lr-means-final", "1.6e-6"),
    *("--optimizer.lr-last", "1"),
    *("--optimizer.lr-log-scales", "5e-3"),
    *("--optimizer.lr-sh0", "2.5e-3"),
    *("--optimizer.lr-shN", "1.25e-4"),
    "--schedule.coarse-until",
    *("--max-gaussians", "1000000"),
)
"""The settings of Kerbl et al. 2023, nothing of ours: 100,000 random points (a group of real captures says `--init
points`), their rates, full resolution from the first step, no regularizer for few views, no guidance."""

ARMS: dict[str, tuple[str, ...]] = {
    "3dgs": PUBLISHED_SETTINGS,
    "ours-0": ("--lambda-sds", "0"),
    "ours": (),
    "ours-user": (),
    "ours-template": (),
    "ours-llm": (),
}
"""3dgs: published settings; ours-0: ours without guidance; ours: the default, guided without words; the others: guided
with the user's own words, those of the template, those of a language model."""

PROMPT_SOURCES = {"ours-user": "user", "ours-template": "template", "ours-llm": "llm:"}
"""Arms that guide with words, and how the source of their prompts begins in prompts.json."""


def is_guided(arm: str) -> bool:
    """Whether a diffusion prior has a say in this arm."""
    return not {"--lambda-sds", "--lambda_sds"} & set(ARMS[arm])


def require(arms: tuple[str, ...]) -> None:
    """UsageError for an arm that does not exist."""
    for arm in arms:
        check.one_of("--arms", arm, tuple(ARMS))
