"""The compiled kernels, or a clear error when they have not been built. ``*_reference.py`` says what each computes."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import Any

import numpy as np

from sf_interfaces.native import kernels
from sf_interfaces.types import Camera, Float64


def native() -> Any:
    """The module ``sf_tracking._native``.

    Raises:
        ConfigError: it is not installed.
    """
    return kernels("sf_tracking")


def intrinsics(camera: Camera) -> Float64:
    """(fx, fy, cx, cy) as the kernels take them."""
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy])


def dense(values: Any) -> Float64:
    """Values as the kernels take them: double, row after row; copied only where they are not yet."""
    return np.ascontiguousarray(values, dtype=np.float64)
