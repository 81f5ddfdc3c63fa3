"""Depth of one camera as another sees it."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np

from sf_interfaces.geometry import se3
from sf_interfaces.types import Camera, DepthMap, Float64


def register_depth(
    depth: DepthMap, source: Camera, target: Camera, T_target_source: Float64, splat: int = 2
) -> DepthMap:
    """Carry each pixel of a depth map over into another camera; the nearest surface wins.

    Args:
        splat: side of the square each pixel covers in the target, px; at least the ratio of focal lengths.
    """
    valid = depth.valid
    z = depth.z[valid].astype(np.float64)
    points = se3.transform(T_target_source, source.unproject(source.pixel_grid()[valid], z))
    uv, z = target.project(points[points[:, 2] > 0])
    corner = np.floor(uv - (splat - 1) / 2).astype(np.int64)
    out = np.full(target.height * target.width, np.inf)
    for dv in range(splat):
        for du in range(splat):
            u, v = corner[:, 0] + du, corner[:, 1] + dv
            inside = (u >= 0) & (u < target.width) & (v >= 0) & (v < target.height)
            np.minimum.at(out, v[inside] * target.width + u[inside], z[inside])
    out[np.isinf(out)] = np.nan
    return DepthMap(out.reshape(target.height, target.width).astype(np.float32))
