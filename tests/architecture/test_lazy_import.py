"""Importing gsopt or asking for help costs nothing: no torch, no numpy, no optional package."""

from __future__ import annotations

import pytest

from gsopt.cli import VERBS

HEAVY = {"torch", "numpy", "PIL", "jaxtyping", "diffusers", "transformers", "viser", "av", "pycolmap", "bpy"}


@pytest.mark.parametrize(
    "code",
    [
        "import gsopt",
        "import gsopt; dir(gsopt); gsopt.GsoptError; gsopt.TrainConfig",
        "import gsopt.cli; assert gsopt.cli.main(['--help']) == 0",
        "import gsopt.cli; assert gsopt.cli.main(['--version']) == 0",
        "import gsopt.config.train, gsopt.errors, gsopt.events, gsopt.check, gsopt._optional",
    ],
)
def test_the_bottom_row_and_help_load_nothing_heavy(clean_python, code: str) -> None:
    assert clean_python.loaded_after(code) & (HEAVY | {"tyro", "rich"}) == set()


@pytest.mark.parametrize("verb", VERBS)
def test_help_of_a_verb_answers_without_torch(clean_python, verb: str) -> None:
    code = f"import gsopt.cli; assert gsopt.cli.main([{verb!r}, '--help']) == 0"
    assert clean_python.loaded_after(code) & HEAVY == set()


def test_the_check_notices_a_heavy_import(clean_python) -> None:
    assert "torch" in clean_python.loaded_after("import gsopt; gsopt.Gaussians")
