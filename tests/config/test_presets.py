"""Presets: recorded, and beaten by any flag that is given."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest

from gsopt.cli.train import read_flags
from gsopt.cli.train_flags import parse
from gsopt.config.presets import PRESETS, chosen, with_preset
from gsopt.config.train import TrainConfig
from gsopt.errors import UsageError


@pytest.fixture
def resolved(tmp_path: Path):
    """The configuration that `gsopt train` would run with."""

    def resolve(*flags: str) -> TrainConfig:
        return read_flags(parse([str(tmp_path), "-m", str(tmp_path / "run"), "--lambda-sds", "0", *flags]))[0]

    return resolve


def settings(config: TrainConfig) -> dict[str, Any]:
    return {key: value for key, value in config.to_dict().items() if key not in ("data", "guidance")}


@pytest.mark.parametrize("name", PRESETS)
def test_the_command_line_and_python_agree_on_a_preset(name: str, resolved) -> None:
    assert settings(resolved("--preset", name)) == settings(with_preset(TrainConfig(), name))
    assert resolved(f"--preset={name}").preset == name


def test_without_a_preset_it_is_the_default_one(resolved) -> None:
    assert settings(resolved()) == settings(TrainConfig()) == settings(with_preset(TrainConfig(), "default"))


def test_presets_differ_and_a_higher_one_takes_more_steps() -> None:
    steps = [with_preset(TrainConfig(), name).iterations for name in ("draft", "default", "high")]
    assert steps == sorted(set(steps))


@pytest.mark.parametrize("flags", ["--iterations 321 --preset draft", "--preset high --iterations=321"])
def test_a_flag_that_is_given_wins(flags: str, resolved) -> None:
    config = resolved(*flags.split())
    assert config.iterations == 321
    assert config.preset in flags.split()


def test_a_switch_of_the_preset_can_be_switched_back(resolved) -> None:
    config = resolved("--preset", "draft", "--schedule.no-stop-when-flat")
    draft = with_preset(TrainConfig(), "draft")
    assert not config.schedule.stop_when_flat
    assert settings(config) == settings(
        dataclasses.replace(draft, schedule=dataclasses.replace(draft.schedule, stop_when_flat=False))
    )


def test_what_is_no_preset_is_left_to_the_parser() -> None:
    assert chosen(["--preset"]) == chosen(["--preset", "best"]) == chosen([]) == "default"
    assert chosen(["--preset", "high", "--preset", "draft"]) == "draft"
    with pytest.raises(UsageError, match="`preset` must be one of draft, default, high"):
        TrainConfig(preset="best")  # type: ignore[arg-type]
