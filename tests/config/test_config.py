"""A configuration survives JSON, and refuses by name what it cannot mean."""

from __future__ import annotations

import dataclasses
import inspect
import json
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsopt.config import train as configuration
from gsopt.config.train import DataConfig, DensityConfig, OptimizerConfig, ScheduleConfig, TrainConfig
from gsopt.errors import InputError, UsageError


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
def test_a_value_out_of_range_is_a_usage_error_that_tells_what_to_do(cls, name: str, value) -> None:
    with pytest.raises(UsageError, match=r"got .*\. [A-Z0-9]"):
        cls(**{name: value})


def test_views_and_view_ids_exclude_each_other() -> None:
    with pytest.raises(UsageError, match="Keep one"):
        DataConfig(views=3, view_ids=(1, 2))


def test_every_setting_says_what_it_means() -> None:
    """The command line shows these texts; a field without one would be a flag without help."""
    for cls in vars(configuration).values():
        if not dataclasses.is_dataclass(cls) or cls is TrainConfig:
            continue
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


def test_a_run_tells_its_configuration(tmp_path: Path) -> None:
    config = TrainConfig(iterations=5, data=DataConfig(view_ids=(4, 2)))
    (tmp_path / "config.json").write_text(json.dumps({"config": config.to_dict(), "versions": {}}))
    assert TrainConfig.read(tmp_path / "config.json") == config
