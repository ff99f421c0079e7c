"""A folder belongs to one training: what a killed one left is no reason to refuse it, what somebody else left is."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from gsopt.errors import InputError
from gsopt.finetune.claimed_folder import claim

HALF_WRITTEN = (".finetune.json.4194305.tmp", ".tmpq1W2e3")


def claimed(out: Path, plan: dict[str, object] | None = None, beside: str = "pairs") -> list[str]:
    claim(out / "finetune.json", plan or {"seed": 0}, "a prior", "other scenes", beside)
    return sorted(path.relative_to(out).as_posix() for path in out.rglob("*"))


def test_a_training_that_was_killed_at_its_first_write_goes_on(tmp_path: Path) -> None:
    for name in HALF_WRITTEN:
        (tmp_path / name).write_bytes(b"{")
    assert claimed(tmp_path) == ["finetune.json"]
    assert json.loads((tmp_path / "finetune.json").read_text()) == {"seed": 0}


def test_what_was_left_half_written_later_goes_too_and_the_rest_stays(tmp_path: Path) -> None:
    claimed(tmp_path / "new")
    (tmp_path / "new" / "pairs").mkdir()
    for name in (*HALF_WRITTEN, "mine.tmp"):
        (tmp_path / "new" / "pairs" / name).write_bytes(b"")
    assert claimed(tmp_path / "new") == ["finetune.json", "pairs", "pairs/mine.tmp"]


@pytest.mark.parametrize("name", ["letter.txt", "mine.tmp", "pairs"])
def test_files_of_others_are_left_alone(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text("dear")
    (tmp_path / HALF_WRITTEN[0]).write_text("half")
    with pytest.raises(InputError, match="is not empty and holds no training of a prior"):
        claimed(tmp_path, beside="")
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([name, HALF_WRITTEN[0]])


def test_another_plan_is_refused_and_what_was_measured_is_no_part_of_it(tmp_path: Path) -> None:
    claimed(tmp_path)
    (tmp_path / "finetune.json").write_text(json.dumps({"seed": 0, "measured": {"loss": 1}}))
    claimed(tmp_path)
    with pytest.raises(InputError, match="belongs to a training with other scenes or flags"):
        claimed(tmp_path, {"seed": 1})


def test_a_file_in_the_place_of_the_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("dear")
    with pytest.raises(InputError, match="is not empty"):
        claimed(tmp_path / "out")
    with pytest.raises(InputError, match="Cannot make"):
        claimed(tmp_path / "out" / "deeper")
