"""Scale of a depth map that was recovered without poses (paper Sec. Recover Scale to Global).

Given translations hold the global scale; one wrong pose does not move it. Every threshold is relative, so there is no
limit on distance. (Depth of SLAM's keyframes needs no such step: it is swept at their poses.)
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sf_interfaces.errors import InsufficientParallax
from sf_interfaces.types import DepthMap, Float64

_TOLERANCE = 0.05  # relative difference of an inlier
_CHI2_MEDIAN = 2.366  # of three degrees of freedom: a squared length per component
_FEW = 1.6  # what few translations, as one, tell of their own spread: 1 + this / count is that of Student's quantile


@dataclass(frozen=True, slots=True)
class GlobalScale:
    """Factor from the own unit to the global one, and its relative deviation: what the references disagree on."""

    factor: float
    deviation: float


def consensus(ratios: Float64) -> tuple[float, np.ndarray]:
    """The scale most ratios agree on, and which do: RANSAC with every ratio as a hypothesis, then their median."""
    logs = np.log(ratios)
    near = np.abs(logs[None] - logs[:, None]) < _TOLERANCE
    best = int(near.sum(axis=1).argmax())
    return float(np.exp(np.median(logs[near[best]]))), near[best]


def from_translations(estimated: Float64, given: Float64) -> GlobalScale:
    """What brings estimated translations [S, 3] to given ones; those without motion do not count.

    Raises:
        InsufficientParallax: no translation to compare.
    """
    own, true = np.linalg.norm(estimated, axis=1), np.linalg.norm(given, axis=1)
    moving = (own > 1e-9) & (true > 0.1 * true.max(initial=0.0)) & (true > 0)
    if not moving.any():
        raise InsufficientParallax("the given poses have no baseline, so the scale of the depth stays unknown")
    ratios = true[moving] / own[moving]
    scale, _ = consensus(ratios)
    # What directions and lengths leave says how good the translations are. The errors of one source of poses are
    # alike, so their number does not make the scale surer.
    left = np.linalg.norm(scale * estimated[moving] - given[moving], axis=1) / true[moving]
    deviation = float(np.sqrt(np.median(left**2) / _CHI2_MEDIAN)) * (1.0 + _FEW / len(ratios))
    return GlobalScale(scale, max(deviation, _TOLERANCE) if len(ratios) == 1 else deviation)


def in_unit(depth: DepthMap, scale: GlobalScale) -> DepthMap:
    """Depth with variance in the global unit."""
    assert depth.variance is not None
    z = depth.z * np.float32(scale.factor)
    variance = depth.variance * np.float32(scale.factor**2) + (z * np.float32(scale.deviation)) ** 2
    return DepthMap(z, variance, depth.scale)
