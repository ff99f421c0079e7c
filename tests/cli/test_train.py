"""`gsopt train`: what its flags mean, what it prints, and how it ends."""

from __future__ import annotations

import dataclasses
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from finished_runs import ring, splats, write_split

from gsopt import cli
from gsopt.cli.console import clock, progress_line
from gsopt.cli.train import make_config, read_flags, summary
from gsopt.cli.train_flags import FLAGS, Flags, flag_of, parse
from gsopt.config.train import TrainConfig
from gsopt.errors import InputError, UsageError
from gsopt.events import read_events

SMALL = "--lambda_sds 0 --iterations 20 --init random --init-count 40 --preview-every 10"


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("dataset") / "blobs"
    write_split(folder, "train", ring(3), splats())
    write_split(folder, "test", ring(2, 0.4), splats())
    return folder


@pytest.fixture(scope="module")
def finished(data: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A run made by the program itself, and what it printed."""
    run = tmp_path_factory.mktemp("finished") / "run"
    done = subprocess.run(
        [sys.executable, "-m", "gsopt", "train", *small(data, run)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return run, done.stdout


def small(data: Path, run: Path) -> list[str]:
    return [*SMALL.split(), "-s", str(data), "-m", str(run)]


def parsed(text: str) -> Flags:
    return parse(text.split())


def config_of(text: str) -> TrainConfig:
    return read_flags(parsed(f"DATA -m RUN {text}"))[0]


def kinds(run: Path) -> list[str]:
    return [event["kind"] for event in read_events(run / "events.jsonl")[0]]


def test_no_flag_is_the_default_configuration() -> None:
    config, run = read_flags(parsed("DATA -m RUN"))
    default = TrainConfig()
    assert dataclasses.replace(config, data=dataclasses.replace(config.data, path="")) == default
    assert config.data.path == str(Path.cwd() / "DATA")
    assert run == Path("RUN")


@pytest.mark.parametrize(
    ("flags", "key", "value"),
    [
        ("-r 2", "data.downscale", 2),
        ("--resolution 4", "data.downscale", 4),
        ("-w", "data.background", "white"),
        ("--white_background", "data.background", "white"),
        ("--background random", "data.background", "random"),
        ("--eval", "data.eval", True),
        ("--views 8", "data.views", 8),
        ("--view-ids 2,16,26", "data.view_ids", [2, 16, 26]),
        ("--view_ids 5", "data.view_ids", [5]),
        ("--cache-mb 9", "data.cache_mb", 9),
        ("--init hull", "init.method", "hull"),
        ("--init-count 9", "init.count", 9),
        ("--seed 9", "seed", 9),
        ("--threads 9", "threads", 9),
        ("--antialiased", "antialiased", True),
        ("--backend reference", "backend", "reference"),
        ("--max-gaussians 9", "density.max_gaussians", 9),
        ("--max_gaussians 9", "density.max_gaussians", 9),
        ("--strategy mcmc", "density.strategy", "mcmc"),
        ("--density.refine-every 9", "density.refine_every", 9),
        ("--density.refine_every 9", "density.refine_every", 9),
        ("--loss.lambda-alpha 0.5", "loss.lambda_alpha", 0.5),
        ("--optimizer.sh-degree 1", "optimizer.sh_degree", 1),
        ("--sparse.below-views 0", "sparse.below_views", 0),
        ("--schedule.coarse-until 5 10", "schedule.coarse_until", [5, 10]),
        ("--lambda_sds 0", "guidance.lambda_sds", 0),
        ("--prior sd21", "guidance.prior", "sd21"),
        ("--guidance.every 9", "guidance.every", 9),
    ],
)
def test_every_flag_sets_its_setting_and_no_other(flags: str, key: str, value: object) -> None:
    expected = config_of("").to_dict()
    *groups, name = key.split(".")
    group = expected
    for part in groups:
        group = group[part]
    group[name] = value
    assert config_of(flags).to_dict() == expected


def test_steps_that_are_given_are_meant_and_those_of_a_preset_are_what_few_views_may_shorten() -> None:
    for flags, steps, bound in (("", 4000, None), ("--preset high", 15_000, None), ("--iterations 7000", 7000, 0)):
        config = config_of(flags)
        assert (config.iterations, config.sparse.steps_per_view) == (steps, bound)


def test_inria_spells_source_and_model_path() -> None:
    for text in ("-s D -m R", "--source-path D --model-path R", "--source_path D --model_path R", "D --run R"):
        config, run = read_flags(parsed(text))
        assert (Path(config.data.path).name, run) == ("D", Path("R"))


def settings_of(values: dict[str, object], section: str = "") -> list[str]:
    """Names of all settings, as an error writes them."""
    names: list[str] = []
    for key, value in values.items():
        names += settings_of(value, f"{section}{key}.") if isinstance(value, dict) else [f"{section}{key}"]
    return names


def test_every_setting_has_one_flag_with_its_default_and_help(capsys: pytest.CaptureFixture[str]) -> None:
    settings = settings_of(TrainConfig().to_dict())
    assert set(FLAGS) < set(settings)
    with pytest.raises(SystemExit):
        parse(["--help"])
    lines = re.sub("[│╭╮╰╯]", " ", capsys.readouterr().out)
    text = " ".join(lines.split())
    for setting in set(settings) - {"data.path"}:
        assert re.search(rf"{re.escape(flag_of(setting))}[ ,]", text), setting


@pytest.mark.parametrize(
    ("argv", "error"),
    [
        ("--resolution 0", "`--resolution` must be at least 1, got 0. Leave it out for the default."),
        ("--iterations 0", "`--iterations` must be at least 1, got 0. Leave it out for the default of 4000."),
        ("--optimizer.lr_last 2", "`--optimizer.lr-last` must lie in [1e-06, 1], got 2.0."),
        ("--views 2 --view-ids 1", "`--views` and `--view-ids` were both given. Keep one of them."),
        ("--guidance.t-max 0.01", "`--guidance.t-max` must not lie below `--guidance.t-min`, got 0.01 and 0.02."),
        ("--lambda_sds -1", "`--lambda-sds` must lie in [0, 1000000000.0], got -1.0. Leave it out for the default."),
    ],
)
def test_an_error_names_the_flag_and_not_the_setting(argv: str, error: str, capsys) -> None:
    assert cli.main(["train", "DATA", *argv.split()]) == UsageError.exit_code
    assert error in capsys.readouterr().err


@pytest.mark.parametrize(
    ("argv", "told"),
    [
        ("", "dataset folder is needed"),
        ("A -s B", "Two dataset folders"),
        ("A --lambda_sds 0.1", "guidance"),
        ("A --view-ids 1,x", "--view-ids"),
        ("A --view-ids 1 --views 3", "Keep one"),
        ("A --iterations 0", "--iterations"),
        ("A --max-gaussians 0", "--max-gaussians"),
        ("A -w --background black", "contradict"),
        ("A --resume", "-m RUN"),
        ("--resume -m RUN --iterations 5", "`iterations`"),
        ("--resume -m RUN --density.growth 2", "`density.growth`"),
    ],
)
def test_flags_that_make_no_sense_are_usage_errors(capsys, argv: str, told: str) -> None:
    assert cli.main(["train", *argv.split()]) == 2
    assert told in capsys.readouterr().err


def test_data_that_does_not_exist_is_an_input_error(capsys, tmp_path: Path) -> None:
    assert cli.main(["train", str(tmp_path / "absent"), "-m", str(tmp_path / "run")]) == InputError.exit_code
    assert "absent" in capsys.readouterr().err
    assert kinds(tmp_path / "run") == ["error"]
    assert "absent" in (tmp_path / "run" / "log.txt").read_text()


def test_the_default_folder_is_the_first_free_one(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs" / "lego-1").mkdir(parents=True)
    assert read_flags(parsed("some/lego/"))[1] == Path("runs/lego-2")


def test_a_run_ends_with_metrics_a_report_and_done(finished: tuple[Path, str]) -> None:
    run, printed = finished
    assert kinds(run)[-1] == "done"
    assert (run / "report.html").stat().st_size > 0
    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics["train_seconds"] > 0
    assert metrics["peak_memory_mb"] > 50
    assert metrics["n_gaussians"] == read_events(run / "events.jsonl")[0][-1]["n"]
    assert len(metrics["per_view"]) == 2
    assert f"PSNR {metrics['mean']['psnr']:.2f} dB" in printed
    assert str(run / "report.html") in printed.splitlines()[-1]


def test_what_is_printed_is_plain_and_stands_in_the_log(finished: tuple[Path, str]) -> None:
    run, printed = finished
    lines = printed.splitlines()
    assert (run / "log.txt").read_text().splitlines() == lines
    assert "\x1b" not in printed
    first = lines[0]
    assert "backend cpu" in first
    assert "3 input views, 2 held out" in first
    assert "random" in first
    assert sum(line.startswith("step ") for line in lines) <= 10
    assert any(line.startswith("step 20/20") for line in lines)


def test_a_folder_with_a_run_is_refused_and_resume_needs_only_the_folder(
    finished: tuple[Path, str], data: Path, capsys
) -> None:
    run, _ = finished
    before = (run / "splat.ply").read_bytes()
    assert cli.main(["train", *small(data, run)]) == UsageError.exit_code
    assert "--resume" in capsys.readouterr().err
    assert cli.main(["train", "--resume", "-m", str(run)]) == 0
    assert "resumed at step 20" in capsys.readouterr().out
    assert (run / "splat.ply").read_bytes() == before
    for flags, name in (("--strategy mcmc", "density.strategy"), ("--lambda-sds 0.1", "guidance.lambda_sds")):
        assert cli.main(["train", "--resume", "-m", str(run), *flags.split()]) == UsageError.exit_code
        assert f"`{name}` was given with --resume" in capsys.readouterr().err
    assert cli.main(["train", "--resume", *small(data, run), "--seed", "1"]) == UsageError.exit_code
    assert "`seed` was 0, now 1" in capsys.readouterr().err


def test_a_log_that_is_already_stdout_is_not_written_twice(tmp_path: Path) -> None:
    run = tmp_path / "run"
    run.mkdir()
    with open(run / "log.txt", "w") as log:
        command = [sys.executable, "-m", "gsopt", "train", str(tmp_path / "absent"), "-m", str(run)]
        subprocess.run(command, stdout=log, stderr=log, check=False)
    lines = (run / "log.txt").read_text().splitlines()
    assert len([line for line in lines if "absent" in line]) == 1


def test_a_stop_file_ends_well_without_an_evaluation(data: Path, tmp_path: Path, monkeypatch, capsys) -> None:
    from gsopt.training.trainer import Trainer

    original = Trainer.advance

    def advance(trainer: Trainer) -> tuple[float, str]:
        if trainer.step == 4:
            (tmp_path / "run" / "stop").touch()
        return original(trainer)

    monkeypatch.setattr(Trainer, "advance", advance)
    assert cli.main(["train", *small(data, tmp_path / "run")]) == 0
    assert kinds(tmp_path / "run")[-1] == "stopped"
    assert not (tmp_path / "run" / "metrics.json").exists()
    assert "stopped after step 5" in capsys.readouterr().out


def test_a_failing_evaluation_is_the_last_event(data: Path, tmp_path: Path, monkeypatch, capsys) -> None:
    def fail(*args: object, **kwargs: object) -> None:
        raise InputError("the test image vanished. Restore it.")

    monkeypatch.setattr("gsopt.training.reconstruct.evaluate", fail)
    assert cli.main(["train", *small(data, tmp_path / "run")]) == 3
    assert "vanished" in capsys.readouterr().err
    assert kinds(tmp_path / "run")[-1] == "error"
    assert (tmp_path / "run" / "splat.ply").is_file()


def test_a_run_outlives_the_reader_of_its_output(data: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run(
        [sys.executable, "-m", "gsopt", "train", *small(data, run)], stdout=writer, stderr=writer, check=False
    )
    os.close(writer)
    assert done.returncode == 0
    assert kinds(run)[-1] == "done"
    assert "step 20/20" in (run / "log.txt").read_text()


@pytest.mark.parametrize(("seconds", "text"), [(0, "0:00"), (59.6, "1:00"), (3599, "59:59"), (7322, "2:02:02")])
def test_time_is_readable(seconds: float, text: str) -> None:
    assert clock(seconds) == text


def test_a_line_without_psnr_or_rate_has_no_gap() -> None:
    event = {"step": 1, "total": 9, "loss": 0.25, "psnr": None, "n": 1234, "steps_per_second": 0.0, "eta_seconds": None}
    assert progress_line(event) == "step 1/9  loss 0.2500  N 1,234  0.0 steps/s"


def test_nothing_is_called_held_out_that_was_not() -> None:
    judged = {"mean": {"psnr": 30.0, "ssim": 0.9, "lpips_alex": None}, "per_view": [{}]}
    facts = {"n_gaussians": 5, "peak_memory_mb": None}
    assert summary({**judged, **facts, "train": None}) == "PSNR 30.00 dB  SSIM 0.9000 over 1 held-out view; 5 Gaussians"
    assert "none was held out" in summary({"mean": None, "per_view": [], "train": judged, **facts})


def test_flags_become_settings_without_touching_the_disk(tmp_path: Path) -> None:
    make_config(parsed("DATA"), tmp_path / "absent")
    assert list(tmp_path.iterdir()) == []


def test_a_resumed_run_keeps_its_own_pace_unless_told_otherwise(tmp_path: Path) -> None:
    flags = ["scene", "-m", str(tmp_path), "--threads", "1", "--preview-every", "0"]
    config, _ = read_flags(parse(flags))
    (tmp_path / "config.json").write_text(json.dumps({"config": config.to_dict()}))
    again, _ = read_flags(parse(["--resume", "-m", str(tmp_path), "--checkpoint-every", "7"]))
    assert again == dataclasses.replace(config, checkpoint_every=7)
