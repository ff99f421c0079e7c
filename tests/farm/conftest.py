"""One Ray for a whole test run: three nodes on this machine, of which a test may kill one."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="session")
def ray() -> Any:
    return pytest.importorskip("ray", reason="Ray is not installed (pip install 'gsopt[ray]')")


@pytest.fixture(scope="session")
def cluster(ray: Any) -> Iterator[Any]:
    """A head of one core, to which `ray` is connected."""
    from ray.cluster_utils import Cluster, cluster_not_supported

    if cluster_not_supported:
        pytest.skip("Ray has no test cluster on this system")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")])))
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        patch.setenv("RAY_DEDUP_LOGS", "0")
        head = {"num_cpus": 1, "include_dashboard": False, "object_store_memory": 100 << 20}
        made = Cluster(initialize_head=True, head_node_args=head)
        ray.init(address=made.address, log_to_driver=False, logging_level="ERROR")
        try:
            yield made
        finally:
            ray.shutdown()
            made.shutdown()
