"""`gsopt bench --suite`: declarations, keys, statistics and pages. The runs themselves: test_suite_runs.py."""

from __future__ import annotations

import json
import math
import re
import statistics
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from suite_records import MACHINE, record

from gsopt import cli
from gsopt.benchmark.suite import aggregate, arm_flags, definition, html_page, result_file, run_key, tables
from gsopt.errors import InputError, UsageError

ROOT = Path(__file__).resolve().parents[2]
COMMITTED = sorted((ROOT / "experiments" / "results").glob("suite-*.json"))


def document(*records: dict[str, Any], name: str = "sparse") -> dict[str, Any]:
    made = result_file.empty(name, "gsopt bench")
    for one in records:
        made = result_file.with_run(made, one, MACHINE, "protocol; background white")
    return made


# Declarations


@pytest.mark.parametrize("name", definition.BUILT_IN_SUITES)
def test_a_suite_declares_runs_that_differ_and_arms_that_exist(name: str) -> None:
    cases = list(definition.cases(definition.load(name), 2))
    assert len({case.id for case in cases}) == len(cases) > 0
    assert {case.arm for case in cases} <= set(arm_flags.ARMS)
    for case in cases:
        assert (case.flags.count("--iterations"), case.flags.count("--seed")) == (1, 1)
        assert case.flags[case.flags.index("--iterations") + 1] == str(case.iterations)


def test_the_first_seed_of_everything_comes_before_the_second() -> None:
    seeds = [case.seed for case in definition.cases(definition.load("sparse"), 3)]
    assert seeds == sorted(seeds)


def test_views_are_a_number_ids_or_all() -> None:
    whole = definition.load("sparse")
    group = replace(whole.groups[0], views=("4", "2,16", "all"), scenes=("a",), runs=(("ours", 5),))
    flags = [case.flags for case in definition.cases(replace(whole, groups=(group,)), 1)]
    tail = ("--iterations", "5", "--seed", "0")
    chosen = [("--views", "4"), ("--view-ids", "2,16"), ()]
    assert flags == [("--lambda-sds", "0.2", *views, *tail) for views in chosen]
    assert [definition.view_count(views) for views in group.views] == ["4", "2", "all"]


def test_the_published_settings_are_defined_once() -> None:
    source = (ROOT / "experiments" / "scenes.py").read_text()
    assert "import PUBLISHED_SETTINGS" in source
    assert "1.25e-4" not in source
    assert arm_flags.ARMS["3dgs"] == arm_flags.PUBLISHED_SETTINGS


@pytest.mark.parametrize("text", ["", "groups = 3\ntitle='a'\nabout='b'", "title = ", "[[groups]]\nname = 'x'"])
def test_a_broken_declaration_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="must be"):
        definition.parse(text, "mine")


# Refusals of the command line


@pytest.mark.parametrize(
    ("flags", "code", "words"),
    [
        (["--suite", "spares"], 2, "`--suite` must be one of sparse, paper, smoke"),
        (["--suite", "smoke", "--arms", "theirs"], 2, "`--arms` must be one of 3dgs, ours-0"),
        (["--suite", "smoke", "--groups", "x"], 2, "`--groups` must be one of demo"),
        (["--suite", "smoke", "--seeds", "0"], 2, "`--seeds` must lie in"),
        (["--suite", "sparse"], 2, "needs `--root`"),
        (["--suite", "sparse", "--groups", "fox", "--root", "."], 3, "lacks fox, wanted by the group fox"),
    ],
)
def test_what_cannot_be_run_is_refused_before_anything_is_written(
    flags: list[str], code: int, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["bench", *flags, "-o", str(tmp_path / "new" / "r.json")]) == code
    assert words in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("text", "code", "words"),
    [
        ("{", 3, "not valid JSON"),
        ("[]", 3, "must hold a JSON object"),
        ("{}", 3, "must hold results of a suite"),
        ('{"suite": "smoke"}', 3, "must be the keys"),
        (result_file.compact(result_file.empty("paper", "c")).decode(), 2, "holds results of the suite paper"),
    ],
)
def test_a_result_file_of_something_else_is_refused_and_left_alone(
    text: str, code: int, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "r.json"
    file.write_text(text)
    assert cli.main(["bench", "--suite", "smoke", "-o", str(file)]) == code
    assert words in capsys.readouterr().err
    assert file.read_text() == text


# Keys


def test_the_key_changes_with_settings_data_and_code() -> None:
    base = run_key.key(["--a", "1"], "data", "code")
    assert base == run_key.key(["--a", "1"], "data", "code")
    others = [(["--a", "2"], "data", "code"), (["--a", "1"], "other", "code"), (["--a", "1"], "data", "other")]
    assert len({base, *(run_key.key(*other) for other in others), run_key.key(["--a1"], "data", "code")}) == 5


def test_data_is_names_and_bytes(tmp_path: Path) -> None:
    def hashed(files: dict[str, bytes]) -> str:
        folder = tmp_path / str(len(list(tmp_path.iterdir())))
        for name, data in files.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(data)
        return run_key.folder_hash(folder)

    base = hashed({"a/b": b"1", "c": b"23"})
    assert base == hashed({"c": b"23", "a/b": b"1"})
    others = [{"a/b": b"2", "c": b"23"}, {"a/d": b"1", "c": b"23"}, {"a/b": b"12", "c": b"3"}, {"a/b": b"1"}]
    assert len({base, *(hashed(files) for files in others)}) == 5


def test_code_is_what_takes_part_in_a_run_and_not_what_draws_it(tmp_path: Path) -> None:
    def hashed(changed: str = "") -> str:
        run_key.code_hash.cache_clear()
        for name in (
            "losses.py",
            "raster/_cpu.so",
            "weights/w.npz",
            "results/report/page.py",
            "benchmark/suite/tables.py",
            "x.md",
        ):
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / name).write_text("changed" if name == changed else "")
        return run_key.code_hash(tmp_path)

    base = hashed()
    matters = {hashed(name) for name in ("losses.py", "raster/_cpu.so", "weights/w.npz")}
    assert len(matters | {base}) == 4
    assert {hashed(name) for name in ("results/report/page.py", "benchmark/suite/tables.py", "x.md")} == {base}
    run_key.code_hash.cache_clear()


def test_what_only_draws_exists() -> None:
    package = run_key.PACKAGE
    assert all((package / name).exists() for name in run_key.PRESENTATION_FILES)


# Statistics


@pytest.mark.parametrize(("degrees", "t"), [(1, 12.7062), (2, 4.3027), (3, 3.1824), (10, 2.2281), (30, 2.0423)])
def test_quantiles_of_students_t_are_those_of_printed_tables(degrees: int, t: float) -> None:
    assert aggregate.t_quantile(0.975, degrees) == pytest.approx(t, abs=5e-5)
    assert aggregate.t_probability(t, degrees) == pytest.approx(0.95, abs=1e-5)


def test_a_paired_interval_is_the_one_computed_by_hand() -> None:
    # Differences +1, +2, +3, +6: mean 3, deviation sqrt(14 / 3) = 2.160247, its error 1.080123, t(3) = 3.182446.
    pairs = [("a", 20, 21), ("b", 25, 27), ("c", 22, 25), ("d", 30, 36)]
    runs = [record("3dgs", low, scene) for scene, low, _ in pairs] + [record("ours", high, s) for s, _, high in pairs]
    found = aggregate.summarized(aggregate.differences(runs, ("ours", 2000), ("3dgs", 2000), "psnr"))
    assert found is not None
    assert (found.mean, found.lowest, found.highest, found.positive, found.count) == (3, 1, 6, 4, 4)
    assert found.half == pytest.approx(3.182446 * 1.080123, abs=1e-5)


def test_seeds_of_a_scene_are_averaged_before_scenes_are_compared() -> None:
    runs = [record("3dgs", 20, scene, seed) for scene in "ab" for seed in (0, 1)]
    runs += [record("ours", 20 + 1, "a", 0), record("ours", 20 + 3, "a", 1), record("ours", 20 - 1, "b", 0)]
    assert aggregate.differences(runs, ("ours", 2000), ("3dgs", 2000), "psnr") == [2, -1]
    alone = [run for run in runs if run["scene"] == "a"]
    assert aggregate.differences(alone, ("ours", 2000), ("3dgs", 2000), "psnr") == [1, 3]


@settings(deadline=None)
@given(st.lists(st.floats(-5, 5), min_size=2, max_size=9), st.floats(-3, 3))
def test_a_shift_of_all_values_shifts_the_mean_and_leaves_the_interval(values: list[float], shift: float) -> None:
    one, other = aggregate.summarized(values), aggregate.summarized([value + shift for value in values])
    assert one is not None
    assert other is not None
    assert other.mean == pytest.approx(one.mean + shift, abs=1e-9)
    assert other.half == pytest.approx(one.half, abs=1e-6)
    assert one.mean == pytest.approx(statistics.fmean(values))


def test_seconds_to_a_quality_lie_on_the_course() -> None:
    course = [{"cpu_seconds": 10.0, "psnr": 20.0}, {"cpu_seconds": 30.0, "psnr": 24.0}]
    assert [aggregate.seconds_to_psnr(course, psnr) for psnr in (19, 20, 21, 24, 25)] == [10, 10, 15, 30, None]
    runs = [record("3dgs", 20), record("ours", 21), record("ours", 22, "b")]
    assert aggregate.times_to_match(runs, ("ours", 2000), ("3dgs", 2000)) == ([7.5], 1)


def test_a_mean_course_leaves_out_looks_that_some_run_lacks() -> None:
    short = record("ours", 20)
    short["curve"] = short["curve"][1:]
    assert aggregate.mean_curve([short, record("ours", 22, "b")], "psnr") == [(10, 21)]


# Result files and pages


def test_a_run_replaces_its_older_record_and_an_entry_among_the_skipped() -> None:
    named = {name: record("ours", 20)[name] for name in result_file.CASE}
    made = result_file.with_skip(document(record("3dgs", 19)), {**named, "reason": "no prior"})
    assert [skip["arm"] for skip in made["skipped"]] == ["ours"]
    made = result_file.with_run(made, record("ours", 21), {**MACHINE, "cpu": "other"}, "protocol; background white")
    made = result_file.with_run(made, record("ours", 22), {**MACHINE, "load": 2.0}, "another")
    assert [(run["arm"], run["mean"]["psnr"], run["machine"], run["protocol"]) for run in made["runs"]] == [
        ("3dgs", 19, 0, 0),
        ("ours", 22, 0, 1),
    ]
    assert made["skipped"] == []
    assert [machine["cpu"] for machine in made["machines"]] == ["c", "other"]


def test_a_file_is_read_as_it_was_written_and_nothing_half_done_reaches_it(tmp_path: Path) -> None:
    file = tmp_path / "r.json"
    made = document(record("ours", 20))
    result_file.write(file, made)
    assert result_file.read(file) == made
    before = file.read_bytes()
    broken = document({**record("ours", 20), "key": 3})
    with pytest.raises(InputError, match="must be str, got 3"):
        result_file.write(file, broken)
    with pytest.raises(ValueError, match="not JSON compliant"):
        result_file.compact({"a": math.nan})
    assert file.read_bytes() == before
    assert len(before.splitlines()) == 2 + 2 + 3 * 3 + 2 * 1  # braces, texts, three lists of one record, two scalars


def test_two_writers_of_one_file_are_refused(tmp_path: Path) -> None:
    with (
        result_file.locked(tmp_path / "r.json"),
        pytest.raises(UsageError, match="one writer"),
        result_file.locked(tmp_path / "r.json"),
    ):
        pass


def page_of(made: dict[str, Any], folder: Path) -> str:
    page = folder / "results.md"
    page.write_text("above\n<!-- begin sparse -->\nold\n<!-- end sparse -->\nbelow\n")
    file = folder / "r.json"
    result_file.write(file, made)
    assert cli.main(["bench", "draw", "--json", str(file), "--page", str(page)]) == 0
    return page.read_text()


def test_tables_come_from_the_file_alone(tmp_path: Path) -> None:
    scenes = {"objects/oakChair": (20, 21, 20.5), "objects/teapot": (25, 26, 27.5)}
    runs = [
        record(arm, psnr, scene)
        for scene, values in scenes.items()
        for arm, psnr in zip(("3dgs", "ours-0", "ours"), values, strict=True)
    ]
    text = page_of(document(*runs), tmp_path)
    assert text.startswith("above\n")
    assert text.endswith("below\n")
    assert "old" not in text
    assert "| 3dgs, 2,000 | 2 | 22.50 | 0.5000 |" in text
    # Differences +0.5 and +2.5: mean 1.5, error 1, t(1) = 12.706; -0.5 and +1.5 against ours-0.
    assert "| ours, 2,000 minus 3dgs, 2,000 | 2 | +1.50 ± 12.71 |" in text
    assert "| ours, 2,000 minus ours-0, 2,000 | 2 | +0.50 ± 12.71 |" in text
    assert "| -0.50 | 1 of 2 |" in text
    assert "| oakChair | 20.00 | 21.00 | 20.50 | 0.5 |" in text
    assert "Not run yet: objects-4, 4 views, seed 0" in text
    shown = {line.split("(img/")[1].rstrip(")") for line in text.splitlines() if line.startswith("![")}
    assert shown == {path.name for path in (tmp_path / "img").iterdir()}
    html = (tmp_path / "results-sparse.html").read_text()
    assert "ours, 2,000 minus 3dgs, 2,000" in html
    assert page_of(document(*runs), tmp_path) == text


def test_arms_are_averaged_over_what_all_of_them_have(tmp_path: Path) -> None:
    runs = [record("3dgs", 20), record("ours", 21), record("3dgs", 40, "objects/teapot")]
    text = page_of(document(*runs), tmp_path)
    assert "| 3dgs, 2,000 | 1 | 20.00 |" in text


def test_an_arm_that_lacks_scenes_does_not_narrow_the_others() -> None:
    runs = [
        record(arm, 20.0 + i, scene) for i, arm in enumerate(("3dgs", "ours-0")) for scene in ("objects/a", "objects/b")
    ]
    runs.append(record("ours-llm", 30.0, "objects/b"))
    made = tables.group_section(definition.load("sparse"), definition.load("sparse").groups[0], "4", runs)
    note, (_, rows) = made.tables[0]
    assert [row[:3] for row in rows] == [["3dgs, 2,000", "2", "20.00"], ["ours-0, 2,000", "2", "21.00"]]
    assert "ours-llm" in note
    assert any(row[0].startswith("ours-llm, 2,000 minus") and row[1] == "1" for row in made.tables[1][1][1])


def test_rows_of_scenes_are_of_the_seeds_that_all_arms_have(tmp_path: Path) -> None:
    """Else two arms of the same bits would seem to differ, because one of them has a second seed."""
    page = page_of(
        document(
            *(
                record(arm, 20.0, scene)
                for arm in ("ours-0", "ours")
                for scene in ("objects/oakChair", "objects/teapot")
            ),
            record("ours-0", 30.0, "objects/oakChair", seed=1),
        ),
        tmp_path,
    )
    assert "| oakChair | 20.00 | 20.00 | 0.5 |" in page


def test_a_page_says_why_an_arm_was_left_out_and_that_versions_differ(tmp_path: Path) -> None:
    named = {name: record("ours-user", 20)[name] for name in result_file.CASE}
    made = result_file.with_skip(
        document(record("3dgs", 20), {**record("ours", 20), "code": "d"}), {**named, "reason": "r!"}
    )
    text = page_of(made, tmp_path)
    assert "- Skipped: ours-user (1): r!." in text
    assert "of 2 versions of the code" in text


def test_the_page_of_pictures_loads_nothing_and_repeats_no_markup() -> None:
    made = document(record("3dgs", 20, "objects/oakChair"))
    bad = {"view": "<b>", "input": "https://example.org/x.webp", "truth": '"><script>'}
    html = html_page.page(made, {"objects/oakChair|4": bad})
    assert "example.org" not in html
    assert "<script" not in html
    with pytest.raises(InputError, match="cannot be read"):
        html_page.decoded("data:image/webp;base64,AAAA")


@pytest.mark.parametrize("file", COMMITTED, ids=lambda path: path.stem)
def test_the_committed_results_keep_the_schema_and_name_no_folder(file: Path) -> None:
    if file.stem.endswith("-pictures"):
        images = json.loads(file.read_text())
        assert all(html_page.decoded(value["error"]).size for value in images.values() if "error" in value)
        return
    made = result_file.read(file)
    assert tables.group_sections(made)
    assert file.stat().st_size < 2_700 * len(made["runs"])
    assert not re.search(r"\s/\w", made["command"])
