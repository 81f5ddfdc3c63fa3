"""How noisy depth is, as far as flexion cares: the error of a surface's direction over a given step."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np

from sf_interfaces.types import Camera, Float32

TOLERANCE = 0.15  # rad; a plane then has a flexion of about 0.97
MAX_STEP = 8  # px
_LAG = 4  # px; beyond the plateaus of quantised depth and the reach of the median filter
_HYSTERESIS = 1.5  # the step in use stays while it would also suit a tolerance this much tighter or wider
_LINES = 60  # rows and columns that are looked at, about
_MAD = 1.4826  # median absolute deviation -> standard deviation of a normal distribution
_LEAST = 100  # second differences that make an estimate


def direction_error(z: Float32, camera: Camera) -> float:
    """Standard error of the direction of a central difference with step 1 px, rad; it falls as 1 / step.

    The inverse depth of a plane is linear in the image, so its second difference is noise alone, whatever
    the slant; the median over the image leaves edges out. Nearest neighbours would not do: filtered or
    quantised depth (structured light) is alike there, and its noise shows only a few pixels further.

    Args:
        z: filtered depth [H, W] m, NaN = none.

    Returns:
        The error; 0 where too few pixels are measured to tell.
    """
    stride = max(1, min(z.shape) // _LINES)
    bend = np.concatenate([_bend(z[stride // 2 :: stride]), _bend(z[:, stride // 2 :: stride].T)])
    if len(bend) < _LEAST:
        return 0.0
    return _MAD * float(np.median(bend)) / np.sqrt(6) * camera.fx / np.sqrt(2)


def _bend(z: Float32) -> Float32:
    """Second differences of the inverse depth along the rows, relative to it: sigma_w / w = sigma_z / z."""
    with np.errstate(divide="ignore"):
        w = 1.0 / z
    here = w[:, _LAG:-_LAG]
    bend = np.abs(w[:, 2 * _LAG :] - 2 * here + w[:, : -2 * _LAG]) / here
    finite: Float32 = bend[np.isfinite(bend)]
    return finite


def choose_step(z: Float32, camera: Camera, before: int | None = None) -> int:
    """The smallest step whose direction error is tolerable; the step ``before`` stays while it fits nearly."""
    ideal = direction_error(z, camera) / TOLERANCE
    if before is not None and ideal / _HYSTERESIS <= before <= ideal * _HYSTERESIS + 1:
        return before
    return int(np.clip(np.ceil(ideal), 1, MAX_STEP))
