"""Shared fixtures: where recordings for tests may lie, and what to do when they do not."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # before torch: threads that wait must not spin
SHARED = Path(os.environ.get("SF_SHARED", Path(__file__).resolve().parents[2] / "shared"))


@pytest.fixture(scope="session")
def shared_data() -> Callable[[str], Path]:
    """``shared_data("name")`` is the folder of a real recording; the test skips where it is absent."""

    def find(name: str) -> Path:
        path = SHARED / "data" / name
        if not path.is_dir():
            pytest.skip(f"recording {name} is not on this machine (set SF_SHARED to its parent folder)")
        return path

    return find
