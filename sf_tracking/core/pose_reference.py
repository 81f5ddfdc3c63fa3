"""What the compiled robust pose computes, in numpy; the tests hold one against the other."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sf_interfaces.geometry import se3
from sf_interfaces.types import Camera, Float64
from sf_tracking.core.bundle import information_root
from sf_tracking.core.bundle_reference import jacobians, robust, whiten
from sf_tracking.core.pose import PRIOR, STEPS, Solution

_STILL = 1e-6  # step of the pose, m and rad, that ends the iterations
_MEDIAN_CHI2 = 1.386  # of two degrees of freedom
_BEHIND = 1e-3  # of the unit ray, up to which a point counts as behind the camera


def solve_pose(
    camera: Camera, T_cw: Float64, X: Float64, w: Float64, uv: Float64, information: Float64, scales: Sequence[float]
) -> Solution:
    """See :func:`.pose.solve_pose`."""
    claimed, excess, support = information_root(information), 1.0, 0.0
    away, H, prior = np.zeros(6), np.zeros((6, 6)), np.diag(PRIOR)
    for scale in scales:
        # Errors beyond what alignment claims (rolling shutter, depth registered badly) widen the kernel.
        root = claimed / np.sqrt(excess)
        for _ in range(STEPS):
            r, Xc, good = _reprojection_error(camera, T_cw, X, w, uv, claimed)
            white = whiten(r[good], root[good])  # [2, E]
            weight = np.sqrt(robust((white**2).sum(axis=0), scale)[0])
            J, _ = jacobians(camera, Xc[good], w[good], np.zeros(3), root[good] * weight[:, None])
            J = J.reshape(6, -1)
            H = J @ J.T
            step = np.linalg.solve(H + prior, J @ (white * weight).ravel() - prior @ away)
            T_cw, away = se3.exp(step) @ T_cw, away + step
            if np.abs(step).max() < _STILL:
                break
        r, _, good = _reprojection_error(camera, T_cw, X, w, uv, claimed)
        squared = (whiten(r[good], claimed[good]) ** 2).sum(axis=0)
        excess = max(1.0, float(np.median(squared)) / _MEDIAN_CHI2) if good.any() else 1.0
        support = float(robust(squared, scale)[0].sum())
    r, _, good = _reprojection_error(camera, T_cw, X, w, uv, claimed)
    error = np.where(good, np.linalg.norm(np.where(good[:, None], r, 0.0), axis=1), np.inf)
    return Solution(se3.orthonormalise(T_cw), error, H, excess, support)


def _reprojection_error(
    camera: Camera, T_cw: Float64, X: Float64, w: Float64, uv: Float64, root: Float64
) -> tuple[Float64, Float64, NDArray[np.bool_]]:
    """Residual [E, 2] px, scaled points [E, 3], and which [E] are in front of the camera and finite."""
    Xc = X @ T_cw[:3, :3].T + w[:, None] * T_cw[:3, 3]
    with np.errstate(invalid="ignore", divide="ignore"):
        r = uv - (Xc[:, :2] / Xc[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy))
        good = (Xc[:, 2] > _BEHIND) & np.isfinite(r).all(axis=1) & np.isfinite(root).all(axis=1)
    return r, Xc, good
