"""Alignment of two point sets with known correspondence (Umeyama 1991), for trajectories and for scale."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np

from sf_interfaces.errors import FormatError
from sf_interfaces.types import Float64


def align(source: Float64, target: Float64, with_scale: bool = False) -> tuple[float, Float64]:
    """Scale s and motion T that minimise ``sum |target - (s R source + t)|^2``.

    Args:
        source, target: corresponding points [N, 3].
        with_scale: solve for the scale too (Sim3); otherwise it is 1 (SE3).

    Returns:
        The scale and T_target_source [4, 4] with rotation R and translation t.

    Raises:
        FormatError: fewer than three correspondences.
    """
    if source.shape != target.shape or len(source) < 3:
        raise FormatError(f"alignment needs at least 3 corresponding positions, got {len(source)}")
    mean_s, mean_t = source.mean(axis=0), target.mean(axis=0)
    s0, t0 = source - mean_s, target - mean_t
    U, D, Vt = np.linalg.svd(t0.T @ s0 / len(source))
    sign = np.ones(3)
    sign[2] = np.sign(np.linalg.det(U) * np.linalg.det(Vt))
    R = (U * sign) @ Vt
    variance = (s0**2).sum() / len(source)
    scale = float((D * sign).sum() / variance) if with_scale and variance > 0 else 1.0
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = mean_t - scale * R @ mean_s
    return scale, T
