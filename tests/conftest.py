"""Fixtures that every folder of tests may use."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


def pytest_make_parametrize_id(config: pytest.Config, val: object, argname: str) -> str | None:
    """Bytes are named by their argument: packed, they hold the time, and workers must agree on the names of tests."""
    return argname if isinstance(val, bytes) else None


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests that share a fixture of their module go to one worker (`--dist loadgroup`): it is built once, not twice.
    They come first, so that no worker is left with a long one at the end."""
    for item in items:
        known = item._fixtureinfo.name2fixturedefs if isinstance(item, pytest.Function) else {}
        if any(found.scope == "module" for defs in known.values() for found in defs[-1:]):
            item.add_marker(pytest.mark.xdist_group(item.nodeid.partition("::")[0]))
    items.sort(key=lambda item: item.get_closest_marker("xdist_group") is None)


@pytest.fixture(scope="session", autouse=True)
def no_prior_at_hand() -> Iterator[None]:
    """Runs are not guided unless a test says so: most tests are about something else, and the embedded prior takes
    seconds to load. Only in this process: what starts another says --lambda_sds 0."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("gsopt.sds.select_prior.EMBEDDED", ROOT / "no-prior")
        yield


@pytest.fixture
def embedded(monkeypatch: pytest.MonkeyPatch) -> Path:
    """The prior that ships, at its place."""
    folder = ROOT / "gsopt" / "sds" / "embedded"
    monkeypatch.setattr("gsopt.sds.select_prior.EMBEDDED", folder)
    return folder


@pytest.fixture
def coarse_hull(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hulls of an eighth of the voxels, for tests of something else: a hull takes seconds."""
    monkeypatch.setattr("gsopt.init.hull._MAX_SIDE", 56)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Real captures and meshes that may not ship with the project; tests that need them skip where they are absent."""
    folder = ROOT.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"no real data beside the checkout ({folder.name} folder absent)")
    return folder
