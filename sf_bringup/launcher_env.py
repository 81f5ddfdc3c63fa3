"""The environment of spawned nodes: transports and memory tuned for images."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os
from pathlib import Path

_LARGE = str(1 << 30)  # bytes; keeps image buffers on the heap instead of mapping each one afresh


def node_environment(domain_id: int | None = None) -> dict[str, str]:
    """The inherited environment with what nodes need; values the user has set are kept.

    Args:
        domain_id: ROS_DOMAIN_ID of the graph, or None for the inherited one.
    """
    defaults = {
        "FASTRTPS_DEFAULT_PROFILES_FILE": str(Path(__file__).parent / "config" / "fastdds.xml"),
        "MALLOC_MMAP_THRESHOLD_": _LARGE,
        "MALLOC_TRIM_THRESHOLD_": _LARGE,
        "OMP_NUM_THREADS": str(max(1, (os.cpu_count() or 1) // 3)),  # the nodes share the cores; more threads fight
        "OMP_WAIT_POLICY": "PASSIVE",  # threads that wait sleep; spinning, they take the cores of the other nodes
        "PYTHONUNBUFFERED": "1",
    }
    environment = {**defaults, **os.environ}
    if domain_id is not None:
        environment["ROS_DOMAIN_ID"] = str(domain_id)
    return environment
