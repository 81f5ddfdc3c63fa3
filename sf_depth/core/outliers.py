"""Removes points without company: the radius grows with depth, so a room and a town are treated alike."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np

from sf_interfaces.types import Float32

_OFFSETS = [(r, c) for r in (-4, -2, 0, 2, 4) for c in (-4, -2, 0, 2, 4) if (r, c) != (0, 0)]
_RADIUS = 0.02  # relative difference of inverse depth between points that keep each other company
_COMPANY = 0.4  # share of the surrounding pixels that have to be near


def lonely(d: Float32) -> np.ndarray:
    """Pixels of an inverse depth image [H, W] with too few of 24 surrounding pixels near them in depth."""
    height, width = d.shape
    padded = np.pad(d, 4, constant_values=np.nan)
    near = np.zeros(d.shape, np.uint8)
    for r, c in _OFFSETS:
        other = padded[4 + r : 4 + r + height, 4 + c : 4 + c + width]
        with np.errstate(invalid="ignore"):
            near += np.abs(other - d) < _RADIUS * d
    return near < _COMPANY * len(_OFFSETS)
