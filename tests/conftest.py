"""Fixtures that every folder of tests may use."""

from __future__ import annotations

from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(autouse=True)
def no_prior_at_hand(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs are not guided unless a test says so: most tests are about something else, and the embedded prior takes
    seconds to load. Tests marked `embedded` meet the package as it ships."""
    if request.node.get_closest_marker("embedded") is None:
        monkeypatch.setattr("gsopt.sds.choice.EMBEDDED", ROOT / "no-prior")


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Real captures and meshes that may not ship with the project; tests that need them skip where they are absent."""
    folder = ROOT.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"no real data beside the checkout ({folder.name} folder absent)")
    return folder
