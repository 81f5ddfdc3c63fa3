"""Sharp borders: a near surface's points reach over its border by half a window; keyframes tell what is there.

Around a step in the drawn depth a pixel may show the near surface or the far one. Each is a hypothesis: seen from a
keyframe, its point must lie at the depth which that keyframe measured there. The one that agrees better stays.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from sf_interfaces.geometry import se3
from sf_interfaces.types import Camera, Float32, Float64
from sf_recon.core.keyframe_view import KeyframeView
from sf_recon.core.observation import backproject

_WIDEST = 8  # px: farther than this over its border no surface is taken back
_DOUBT = 0.03  # of the depth: a keyframe whose own depth is off by so much supports a hypothesis half


def sharpen(
    z: Float32, half: Float32, gap: float, views: Sequence[KeyframeView], camera: Camera, T_map_camera: Float64
) -> Float32:
    """The depth image with near surfaces cut back to where the keyframes saw them.

    Args:
        z: [H, W] m, NaN = hole; pixels that change get the far surface's depth as a keyframe measured it.
        half: [H, W] px, half-width of the windows that drew it.
        gap: step in depth, m, between two surfaces.
        views: keyframes that decide, most trusted first: of two that agree equally the first gives the depth.
    """
    known = np.isfinite(z)
    if not views or not known.any():
        return z
    front = np.where(known, z, np.float32(0))
    width = int(np.clip(np.ceil(half[known].max()), 1, _WIDEST))
    behind = _far_neighbour(front, half, width)
    pixels = np.flatnonzero(behind > front * np.float32(1 + _DOUBT) + np.float32(gap))
    pixels = pixels[known.reshape(-1)[pixels]]
    if len(pixels) == 0:
        return z
    near, far = front.reshape(-1)[pixels], behind.reshape(-1)[pixels]
    for_near, for_far = np.zeros(len(pixels), np.float32), np.zeros(len(pixels), np.float32)
    measured, best = far.copy(), np.zeros(len(pixels), np.float32)
    for view in views:
        for_near += _support(view, camera, T_map_camera, near, pixels)[0]
        support, depth = _support(view, camera, T_map_camera, far, pixels)
        for_far += support
        better = support > best
        measured[better], best[better] = depth[better], support[better]
    out = z.copy()
    cut = (for_far > for_near) & (best > 0.5)
    out.reshape(-1)[pixels[cut]] = measured[cut]
    return out


def _far_neighbour(front: Float32, half: Float32, width: int) -> Float32:
    """The farthest depth within the reach of the windows, [H, W] m: rings are added while they are in reach."""
    kernel = cv2.getStructuringElement(cv2.MORPH_RECT, (3, 3))
    out, grown = front.copy(), front
    for ring in range(1, width + 1):
        grown = cv2.dilate(grown, kernel)
        reached = half > ring - 1
        out[reached] = grown[reached]
    return out


def _support(
    view: KeyframeView, camera: Camera, T_map_camera: Float64, z: Float32, pixels: NDArray[np.intp]
) -> tuple[Float32, Float32]:
    """How well a keyframe's depth supports z [M] m at flat pixels [M], 0..1; and z corrected to that depth, [M]."""
    T = se3.inverse(view.T_map_camera)
    points, _ = backproject(camera, T_map_camera, z, pixels)
    uv, d = view.camera.project(se3.transform(T, points.astype(np.float64)))
    inside = view.camera.sees(uv, d)
    column, row = np.floor(np.where(inside[:, None], uv, 0)).astype(np.intp).T
    seen = view.z[row, column].astype(np.float32) * np.float32(view.step)
    ratio = seen / np.where(inside, d, 1).astype(np.float32)
    support = (inside & (seen > 0)) / (1 + np.square((ratio - 1) * np.float32(1 / _DOUBT)))
    return support.astype(np.float32), z * ratio.astype(np.float32)
