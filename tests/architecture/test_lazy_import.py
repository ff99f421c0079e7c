"""Importing gsopt or asking for help costs nothing: no torch, no numpy, no optional package."""

from __future__ import annotations

from pathlib import Path

import pytest
from tiny_scenes import write_dataset

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


OF_OTHER_RUNS = {
    "diffusers",
    "transformers",
    "gsopt.data.sfm.pipeline",
    "gsopt.llm_prompts",
    "gsopt.sds.conditioning",
    "gsopt.sds.guidance_step",
    "gsopt.shape_library",
    "gsopt.training.guided.guard",
}
"""A run imports these only for photos without poses, or for a prior."""


def test_a_run_without_a_prior_imports_nothing_of_guidance(clean_python, tmp_path: Path) -> None:
    write_dataset(tmp_path / "scene")
    words = ["--iterations", "2", "--init", "random", "--init-count", "20"]
    command = ["train", str(tmp_path / "scene"), "-m", str(tmp_path / "run"), *words]
    loaded = clean_python.modules_after(f"import gsopt.cli; assert gsopt.cli.main({command!r}) == 0")
    assert "gsopt.training.trainer" in loaded
    assert loaded & OF_OTHER_RUNS == set()


def test_the_check_notices_a_heavy_import(clean_python) -> None:
    assert "torch" in clean_python.loaded_after("import gsopt; gsopt.Gaussians")
