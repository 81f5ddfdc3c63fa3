"""Removes points without company: the radius grows with depth and with its deviation.

So a room and a town are treated alike, and noisy depth is not taken for lonely.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np

from sf_interfaces.types import Float32

_OFFSETS = [(r, c) for r in (-4, -2, 0, 2, 4) for c in (-4, -2, 0, 2, 4) if (r, c) != (0, 0)]
_RADIUS = 0.02  # relative difference of inverse depth between points that keep each other company, at least
_DEVIATIONS = 2.0  # and this many of their own deviations
_FARTHEST = 0.1  # but no more than this
_COMPANY = 0.4  # share of the surrounding pixels that have to be near


def lonely(d: Float32, variance: Float32) -> np.ndarray:
    """Pixels of an inverse depth image [H, W] with too few of 24 surrounding pixels near them in depth.

    Args:
        variance: of the inverse depth [H, W].
    """
    height, width = d.shape
    radius = np.clip(_DEVIATIONS * np.sqrt(variance), _RADIUS * d, _FARTHEST * d)
    padded = np.pad(d, 4, constant_values=np.nan)
    near = np.zeros(d.shape, np.uint8)
    for r, c in _OFFSETS:
        other = padded[4 + r : 4 + r + height, 4 + c : 4 + c + width]
        near += np.abs(other - d) < radius
    return near < _COMPANY * len(_OFFSETS)
