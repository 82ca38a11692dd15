"""Two nodes of a Ray cluster on this machine, with one CPU each."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

_TRIES = 3


@contextmanager
def two_nodes() -> Iterator[tuple[Any, Any]]:
    """Start the cluster; yields it and its second node."""
    from ray.cluster_utils import Cluster

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", os.pathsep.join(p for p in sys.path if p))  # as an installed program is found
        patch.setenv("RAY_memory_monitor_refresh_ms", "0")
        patch.setenv("RAY_worker_niceness", "0")  # with its 15 anything else starves the tasks
        for left in reversed(range(_TRIES)):
            try:
                cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
                node = cluster.add_node(num_cpus=1)
                break
            except Exception:  # a busy machine may need longer than Ray's fixed 30 seconds
                if not left:
                    raise
        try:
            yield cluster, node
        finally:
            cluster.shutdown()
