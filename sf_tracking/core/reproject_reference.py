"""What the compiled reprojection of a keyframe's patches computes, in numpy; the tests hold one against the other."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np

from sf_interfaces.geometry import se3
from sf_interfaces.types import Float64
from sf_tracking.core.bundle import project
from sf_tracking.core.keyframes import SHEAR, Reprojection, TrackedKeyframe


def reproject(keyframe: TrackedKeyframe, T_cw: Float64) -> Reprojection:
    """See :func:`.keyframes.reproject`."""
    camera, patches = keyframe.camera, keyframe.patches
    T = T_cw @ se3.inverse(keyframe.T_cw)
    uv, X = project(camera, T, patches.rays(camera), patches.w)
    z = np.where(np.isfinite(uv[:, 0]), X[:, 2], 1.0)
    focal = np.array([camera.fx, camera.fy])
    along = T[:3, :2] / focal + T[:3, 3][:, None] * patches.slope[:, None, :]  # [M, 3, 2] dX/d(uv)
    scaled = focal / z[:, None]  # [M, 2]
    on_axis = X[:, :2] / z[:, None]  # [M, 2]
    warp = scaled[..., None] * (along[:, :2] - on_axis[..., None] * along[:, 2:])
    J_w = scaled * (T[:2, 3] - on_axis * T[2, 3])
    area = warp[:, 0, 0] * warp[:, 1, 1] - warp[:, 0, 1] * warp[:, 1, 0]
    with np.errstate(invalid="ignore"):
        visible = (uv >= 0).all(axis=1) & (uv < (camera.width, camera.height)).all(axis=1)
    visible &= (area > SHEAR[0]) & (area < SHEAR[1])
    return Reprojection(uv, warp, J_w, patches.w / z, visible)
