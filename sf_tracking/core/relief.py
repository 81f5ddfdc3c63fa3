"""The surface round patches without measured depth, from the depths found for patches nearby."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from sf_interfaces.types import Float64
from sf_tracking.core.keyframes import TrackedKeyframe, reproject
from sf_tracking.core.patches import fit_planes

_KNOWN = 0.3  # relative deviation up to which a patch counts as known
_NEIGHBOURS = 12  # known patches to which a plane is fitted
_ROUNDS = 3  # of reweighting: patches of another surface must not tilt the plane
_ON_PLANE = 0.03  # deviation of inverse depths from their plane, relative
_FLAT = 0.01  # 1/px, relative slope that a surface has at most, by expectation
_SUPPORT = 4.0  # neighbours that must lie on the plane


def known_points(keyframes: Sequence[TrackedKeyframe], T_cw: Float64) -> tuple[Float64, Float64]:
    """Places [L, 2] px and inverse depths [L] of the known patches of some keyframes, in the view at T_cw."""
    spots, depths = [np.zeros((0, 2))], [np.zeros(0)]
    for keyframe in keyframes:
        at = reproject(keyframe, T_cw)
        known = at.visible & (keyframe.patches.sigma < _KNOWN * keyframe.patches.w)
        spots.append(at.uv[known])
        depths.append(at.w[known])
    return np.concatenate(spots), np.concatenate(depths)


def surface_at(uv: Float64, place: Float64, w: Float64) -> tuple[Float64, Float64]:
    """Inverse depth [M] and slope [M, 2] of the surface at ``uv`` [M, 2] px, from known points nearby.

    A plane in inverse depth is fitted to the nearest ones, robustly; where most of them lie on none, it is their
    median, without slope. Ones where hardly anything is known.

    Args:
        place: [L, 2] px and ``w`` [L] inverse depths of the known points.
    """
    if len(place) < _NEIGHBOURS:
        return np.ones(len(uv)), np.zeros((len(uv), 2))
    near = cKDTree(place).query(uv, k=_NEIGHBOURS)[1]
    offset, around = place[near] - uv[:, None], w[near]
    middle = np.median(around, axis=1)
    w0, slope, weight = middle, np.zeros((len(uv), 2)), np.ones_like(around)
    for step in range(_ROUNDS):
        left = around - w0[:, None] - np.einsum("ckj,cj->ck", offset, slope)
        width = (_ON_PLANE * 4.0 ** (_ROUNDS - 1 - step)) * middle[:, None]
        weight = 1.0 / (1.0 + (left / width) ** 2) ** 2
        w0, slope, _ = fit_planes(offset, around, weight, (_ON_PLANE / _FLAT) ** 2)
    on = (weight.sum(axis=1) > _SUPPORT) & (w0 > 0.5 * middle) & (w0 < 2.0 * middle)
    return np.where(on, w0, middle), np.where(on[:, None], slope, 0.0)
