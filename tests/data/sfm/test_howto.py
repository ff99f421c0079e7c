"""docs/howto/photos.md says only what the program says and offers only what it has."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

from gsopt.data import sfm
from gsopt.data.sfm.settings import SfmConfig

HOWTO = Path(__file__).parents[3] / "docs/howto/photos.md"
SOURCES = Path(sfm.__file__).parent
OTHER_VERBS = {
    "--refine-poses",
    "--lambda-sds",
    "--threads",
    "--out",
    "--seed",
    "--model",
    "--mask-model",
    "--exposure",
    "--depth",
    "--depth-kind",
    "--loss",
}


def said() -> str:
    """All sources that read photos, with implicitly joined string literals joined and photos' names taken out."""
    folders = (SOURCES, SOURCES.parent, SOURCES.parents[1] / "init")
    text = "".join(path.read_text(encoding="utf-8") for folder in folders for path in sorted(folder.glob("*.py")))
    return re.sub(r'"\n\s+f?"', "", text).replace("{twin.name}", "room_00.jpg")


def rows() -> list[str]:
    table = HOWTO.read_text(encoding="utf-8").split("## When the input is bad")[1].split("\n\n")[1]
    return table.splitlines()[2:]


def test_every_message_in_the_table_is_one_that_the_program_gives() -> None:
    quoted = [message for row in rows() for message in re.findall(r"`([^`]+)`", row.split("|")[3])]
    assert len(quoted) > 20
    assert [message for message in quoted if message not in said()] == []


def test_every_flag_in_the_text_exists() -> None:
    flags = {"--" + name for name in re.findall(r"--(?:no-)?([a-z][a-z-]+)", HOWTO.read_text(encoding="utf-8"))}
    known = {"--" + field.name.replace("_", "-") for field in dataclasses.fields(SfmConfig)}
    assert flags <= known | OTHER_VERBS
    assert known <= flags | {"--seed"}, "every option is explained"
