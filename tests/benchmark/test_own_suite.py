"""`gsopt bench --suite FILE.toml`: a suite of one's own scenes runs like a built-in one; a wrong file is refused."""

from __future__ import annotations

from pathlib import Path

import pytest
from finished_runs import ring, splats, write_split

from gsopt import cli
from gsopt.benchmark.suite import definition, result_file
from gsopt.errors import InputError, UsageError

GROUP = """
[[groups]]
name = "blobs"
title = "Blobs"
scenes = ["scenes/blobs"]
views = ["all"]
runs = ["3dgs 6"]
flags = ["--init-count", "50"]
"""
SUITE = f'title = "Mine"\nabout = "A few blobs."\n{GROUP}'


def write_suite(folder: Path, text: str = SUITE) -> Path:
    file = folder / "mine.toml"
    file.write_text(text)
    return file


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """A declaration with its scene beside it."""
    for name, count, phase in (("train", 3, 0.0), ("test", 1, 0.4)):
        write_split(tmp_path / "scenes" / "blobs", name, ring(count, phase), splats())
    return write_suite(tmp_path)


def test_scenes_beside_the_file_are_trained_and_drawn_from_the_result_alone(file: Path, tmp_path: Path) -> None:
    output = tmp_path / "out" / "figures.json"
    assert cli.main(["bench", "--suite", str(file), "--seeds", "1", "-o", str(output)]) == 0
    found = result_file.read(output)
    assert [(run["scene"], run["arm"], run["iterations"]) for run in found["runs"]] == [("scenes/blobs", "3dgs", 6)]
    assert str(tmp_path) not in output.read_text()
    assert "Blobs" in output.with_suffix(".html").read_text()
    assert sorted(path.name for path in output.parent.iterdir() if path.name[0] != ".") == [
        *("figures-pictures.json", "figures-runs", "figures.html", "figures.json")
    ]
    file.unlink()
    page = tmp_path / "page.md"
    page.write_text("<!-- begin mine -->\n<!-- end mine -->\n")
    assert cli.main(["bench", "draw", "--json", str(output), "--page", str(page)]) == 0
    assert "### Blobs" in page.read_text()


def test_a_root_takes_the_place_of_the_folder_of_the_file(file: Path, tmp_path: Path) -> None:
    suite = definition.load(str(file))
    assert definition.find_root(suite, None) == tmp_path
    (tmp_path / "other").mkdir()
    with pytest.raises(InputError, match=r"other lacks scenes/blobs, wanted by the group blobs of the suite mine"):
        definition.find_root(suite, tmp_path / "other")


def test_a_scene_that_is_missing_is_an_error_before_any_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    argv = ["bench", "--suite", str(write_suite(tmp_path)), "-o", str(tmp_path / "r.json")]
    assert cli.main(argv) == InputError.exit_code
    assert "lacks scenes/blobs" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["mine.toml"]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('title = "Mine"', 'title = "Mine"\nlength = 3', "must be the keys about, groups, root, title"),
        ('name = "blobs"', 'name = "blobs"\nseed = 3', r"groups\[0\].* must be the keys"),
        ('about = "A few blobs."', "", "must be the keys"),
        ('about = "A few blobs."', "about = 3", "about` must be str, got 3"),
        ('title = "Mine"', 'title = "Mine', "must be valid TOML"),
        ('title = "Mine"', 'title = "Mine"\nroot = "/etc"', "root` must be \"package\" or absent, .* got '/etc'"),
        ('name = "blobs"', 'name = "../../blobs"', "name` must be letters, digits"),
        ('["scenes/blobs"]', '["../blobs"]', "scenes` must be folders below the root, got '../blobs'"),
        ('["scenes/blobs"]', '["/etc"]', "scenes` must be folders below the root"),
        ('["scenes/blobs"]', '["a|b"]', "scenes` must be folders below the root"),
        ('["all"]', "[0]", "views` must be .*, got '0'"),
        ('["all"]', '["../2"]', "views` must be"),
        ('["3dgs 6"]', '["3dgs"]', "runs` must be an arm and its steps"),
        ('["3dgs 6"]', '["3dgs 0"]', "runs` must be an arm and its steps"),
        ('["--init-count", "50"]', '["--model_path=x"]', "flags` must be flags of `gsopt train`"),
        (GROUP, GROUP + GROUP, "groups with different names"),
        (GROUP, "groups = []", "groups with different names"),
        (GROUP, "groups = [1]", r"groups\[0\]` must be dict"),
    ],
)
def test_a_wrong_declaration_names_the_entry(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in SUITE
    with pytest.raises(InputError, match=message):
        definition.load(str(write_suite(tmp_path, SUITE.replace(old, new))))


def test_a_file_that_is_none_is_refused(tmp_path: Path) -> None:
    for name, body in (("sparse.toml", SUITE.encode()), ("a b.toml", SUITE.encode()), ("binary.toml", b"\xff\xfe\x00")):
        (tmp_path / name).write_bytes(body)
        with pytest.raises(InputError):
            definition.load(str(tmp_path / name))
    (tmp_path / "folder.toml").mkdir()
    for name in ("folder.toml", "missing.toml"):
        with pytest.raises(InputError, match="must be a file"):
            definition.load(str(tmp_path / name))
    with pytest.raises(UsageError, match=r"`--suite` must be one of sparse, paper, smoke, FILE\.toml; got 'mine'"):
        definition.load("mine")
    with pytest.raises(UsageError, match="`--arms`"):
        definition.load(str(write_suite(tmp_path, SUITE.replace("3dgs 6", "4dgs 6"))))
