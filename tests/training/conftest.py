"""The dataset that the tests of this folder train on."""

from __future__ import annotations

from pathlib import Path

import pytest
from tiny_scenes import write_dataset


@pytest.fixture(scope="session")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_dataset(tmp_path_factory.mktemp("tiny") / "cloud")
