"""A configuration survives JSON, and refuses wrong settings by name."""

from __future__ import annotations

import dataclasses
import inspect
import json
import math
import typing
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsopt.check import Within
from gsopt.config import train as configuration
from gsopt.config.guidance import GuidanceConfig
from gsopt.config.train import DataConfig, DensityConfig, OptimizerConfig, ScheduleConfig, TrainConfig
from gsopt.errors import GsoptError, InputError, SettingError, UsageError

SECTIONS = [type(value) for value in vars(TrainConfig()).values() if dataclasses.is_dataclass(value)]
ALL = [(cls, field.name) for cls in (TrainConfig, *SECTIONS) for field in dataclasses.fields(cls)]


@settings(max_examples=50, deadline=None)
@given(
    views=st.none() | st.integers(1, 10**6),
    steps=st.lists(st.integers(1, 10**6), unique=True, max_size=4).map(sorted),
    rate=st.floats(0, 1e9),
    stop=st.none() | st.integers(0, 10**9),
    seed=st.integers(0, 2**31 - 1),
    path=st.text(st.characters(codec="utf-8")),
)
def test_json_and_back_is_the_identity(views, steps, rate, stop, seed, path) -> None:
    config = TrainConfig(
        data=DataConfig(path=path, views=views, view_ids=None if views else (2, 16)),
        optimizer=OptimizerConfig(lr_means=rate),
        density=DensityConfig(refine_stop=stop),
        schedule=ScheduleConfig(coarse_until=tuple(steps)),
        seed=seed,
    )
    text = json.dumps(config.to_dict(), allow_nan=False)
    assert TrainConfig.from_dict(json.loads(text)) == config


def test_a_run_of_an_older_version_is_read_without_settings_that_are_gone(tmp_path: Path) -> None:
    older = TrainConfig(iterations=12).to_dict()
    older["density"]["grow_scale3d"] = older["sparse"]["lambda_scale"] = 0.01
    (tmp_path / "config.json").write_text(json.dumps({"config": older}))
    assert TrainConfig.read(tmp_path / "config.json") == TrainConfig(iterations=12)
    with pytest.raises(InputError, match="grow_scale3d"):
        TrainConfig.from_dict(older)


def test_an_empty_object_is_the_default() -> None:
    assert TrainConfig.from_dict({}) == TrainConfig()


@pytest.mark.parametrize(
    ("document", "named"),
    [
        ({"iteratoins": 5}, "config.iteratoins"),
        ({"density": {"strategy": "best"}}, "config.density.strategy"),
        ({"density": {"growht": 1}}, "config.density.growht"),
        ({"density": 3}, "config.density"),
        ({"iterations": "7000"}, "config.iterations"),
        ({"iterations": 7000.0}, "config.iterations"),
        ({"iterations": True}, "config.iterations"),
        ({"iterations": None}, "config.iterations"),
        ({"antialiased": 1}, "config.antialiased"),
        ({"data": {"view_ids": [1, "2"]}}, "config.data.view_ids"),
        ({"data": {"path": 5}}, "config.data.path"),
        ({"loss": {"lambda_dssim": float("nan")}}, "config.loss.lambda_dssim"),
        ({"loss": {"lambda_alpha": float("inf")}}, "config.loss.lambda_alpha"),
        ({"loss": {"lambda_alpha": 10**400}}, "config.loss.lambda_alpha"),
        ([], "config"),
    ],
)
def test_a_wrong_key_or_type_is_named(document, named: str) -> None:
    with pytest.raises(InputError, match=rf"`{named}`|Unknown key `{named}`"):
        TrainConfig.from_dict(document)


@pytest.mark.parametrize(
    ("cls", "name", "value"),
    [
        (TrainConfig, "iterations", 0),
        (TrainConfig, "threads", -1),
        (TrainConfig, "seed", -1),
        (TrainConfig, "backend", "gpu"),
        (TrainConfig, "checkpoint_every", -1),
        (DataConfig, "downscale", 0),
        (DataConfig, "views", 0),
        (DataConfig, "view_ids", ()),
        (DataConfig, "view_ids", (3, -1)),
        (DataConfig, "background", "green"),
        (DataConfig, "cache_mb", -1),
        (OptimizerConfig, "lr_means", -1e-4),
        (OptimizerConfig, "lr_shN", float("nan")),
        (OptimizerConfig, "beta1", 1.0),
        (OptimizerConfig, "eps", 0.0),
        (OptimizerConfig, "sh_degree", 4),
        (DensityConfig, "max_gaussians", 0),
        (DensityConfig, "refine_every", 0),
        (DensityConfig, "growth", 0.9),
        (DensityConfig, "prune_opacity", 0.0),
        (configuration.LossConfig, "lambda_dssim", 1.1),
        (configuration.SparseConfig, "dropout", 1.0),
        (ScheduleConfig, "coarse_until", (500, 500)),
        (ScheduleConfig, "coarse_until", (0, 500)),
        (configuration.InitConfig, "count", 0),
        (configuration.InitConfig, "method", "magic"),
    ],
)
def test_a_value_out_of_range_is_a_usage_error_that_names_the_setting_and_the_remedy(cls, name: str, value) -> None:
    with pytest.raises(UsageError, match=rf"`[a-z.]*{name}` must .*, got .*\. [A-Z0-9]"):
        cls(**{name: value})


def bounds(cls: type, name: str) -> list[Within]:
    """Bounds in the type of a setting, those of an optional one included."""
    hint = typing.get_type_hints(cls, include_extras=True)[name]
    hints = [hint, *typing.get_args(hint)]
    return [bound for each in hints for bound in getattr(each, "__metadata__", ()) if isinstance(bound, Within)]


BOUNDED = [(cls, name, bound) for cls, name in ALL for bound in bounds(cls, name)]


@pytest.mark.parametrize(("cls", "name", "bound"), BOUNDED)
def test_bounds_belong_to_the_range_and_what_lies_beyond_is_refused_with_range_and_default(cls, name, bound) -> None:
    section = "" if cls is TrainConfig else next(k for k, v in vars(TrainConfig()).items() if type(v) is cls) + "."
    default = next(field.default for field in dataclasses.fields(cls) if field.name == name)
    remedy = "the default." if default is None else f"the default of {default}."
    for beyond in (bound.low - 1, bound.high * 1.01 + 1, math.nan):
        if beyond == math.inf:
            continue
        with pytest.raises(SettingError) as error:
            cls(**{name: beyond})
        assert str(error.value) == f"`{section}{name}` must {bound}, got {beyond}. Leave it out for {remedy}"


def test_every_number_of_a_run_has_bounds() -> None:
    free = {name for cls, name in ALL if isinstance(getattr(cls(), name), int | float) and not bounds(cls, name)}
    assert free == {name for cls, name in ALL if isinstance(getattr(cls(), name), bool)}
    assert len(BOUNDED) > 60


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"t_max": 0.01}, "`guidance.t_max` must not lie below `guidance.t_min`, got 0.01 and 0.02."),
        ({"t_max_end": 0.01}, "`guidance.t_max_end` must not lie below `guidance.t_min`"),
        ({"start": 0.5, "stop": 0.4}, "`guidance.stop` must not lie below `guidance.start`"),
        ({"size": 7}, "`guidance.size` must be 0 or at least 8, got 7."),
        ({"prior": ""}, "`guidance.prior` is empty."),
    ],
)
def test_settings_that_contradict_each_other_are_named_both(changes: dict[str, Any], text: str) -> None:
    with pytest.raises(SettingError) as error:
        GuidanceConfig(**changes)
    assert str(error.value).startswith(text)


@pytest.mark.parametrize("value", ["1e400", "-1e400", "NaN", "1" * 4000, "[]", '"x"', "true", '{"a": 1}', "[[[1]]]"])
@pytest.mark.parametrize("where", ['{"config": {"seed": %s}}', '{"config": {"optimizer": {"lr_last": %s}}}'])
def test_hostile_numbers_of_a_file_are_errors_of_gsopt(tmp_path: Path, value: str, where: str) -> None:
    (tmp_path / "config.json").write_text(where % value)
    with pytest.raises(GsoptError, match=r"seed|lr_last"):
        TrainConfig.read(tmp_path / "config.json")


def test_a_section_can_be_given_by_what_changes_in_it() -> None:
    config = TrainConfig.of("high", data={"views": 4}, schedule=ScheduleConfig(crop_masked=True), seed=3)
    assert config == TrainConfig(
        preset="high", iterations=15_000, data=DataConfig(views=4), schedule=ScheduleConfig(crop_masked=True), seed=3
    )
    assert TrainConfig.of(iterations=7000) == TrainConfig().with_steps(7000)


def test_views_and_view_ids_exclude_each_other() -> None:
    with pytest.raises(UsageError, match="Keep one"):
        DataConfig(views=3, view_ids=(1, 2))


def test_every_setting_has_a_docstring() -> None:
    """The command line shows these texts; a field without one would be a flag without help."""
    for cls in SECTIONS:
        source = inspect.getsource(cls).splitlines()
        for field in dataclasses.fields(cls):
            line = next(i for i, text in enumerate(source) if text.startswith(f"    {field.name}: "))
            assert source[line + 1].lstrip().startswith('"""'), f"{cls.__name__}.{field.name} has no docstring"


@pytest.mark.parametrize("text", ["", "{", "[]", '{"config": 3}', "{}", "[" * 100_000, "\udcff"])
def test_a_file_that_is_no_configuration_is_an_input_error(tmp_path: Path, text: str) -> None:
    path = tmp_path / "config.json"
    path.write_bytes(text.encode("utf-8", "surrogateescape"))
    with pytest.raises(InputError, match=r"config\.json"):
        TrainConfig.read(path)
    with pytest.raises(InputError, match="absent"):
        TrainConfig.read(tmp_path / "absent")


def test_a_run_records_its_configuration(tmp_path: Path) -> None:
    config = TrainConfig(iterations=5, data=DataConfig(view_ids=(4, 2)))
    (tmp_path / "config.json").write_text(json.dumps({"config": config.to_dict(), "versions": {}}))
    assert TrainConfig.read(tmp_path / "config.json") == config
