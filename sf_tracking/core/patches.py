"""Patches: textured places whose depth is measured, spread over the image (P in the paper, Sec. III-A)."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sf_interfaces.types import Camera, Float32, Float64, Frame, SparseDepth, UInt8
from sf_tracking.config import TrackingConfig

_NEIGHBOURHOOD = 9  # px, within which a step in depth disqualifies a patch
_FAR = 1e6  # m, stands for no depth where the nearest is sought
_GRADIENT_NOISE = 1e-3  # keeps the structure tensor of a flat patch invertible


@dataclass(frozen=True, slots=True)
class Patches:
    """The patches of one keyframe; their inverse depth is measured and stays fixed."""

    uv: Float64  # [M, 2] continuous px
    points: Float64  # [M, 3] m, camera frame
    tensor: Float64  # [M, 2, 2] mean structure tensor, (grey level / px)^2

    def __len__(self) -> int:
        return len(self.uv)


def to_gray(image: UInt8) -> UInt8:
    """Luminance [H, W] of an RGB or mono image."""
    return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))


def structure_tensor(gray: UInt8, side: int) -> Float32:
    """Mean over a window of the gradient's outer product, [H, W, 3] as (xx, xy, yy)."""
    gx = cv2.Scharr(gray, cv2.CV_32F, 1, 0, scale=1 / 32)
    gy = cv2.Scharr(gray, cv2.CV_32F, 0, 1, scale=1 / 32)
    return np.asarray(cv2.blur(np.dstack([gx * gx, gx * gy, gy * gy]), (side, side)))


def _smallest_eigenvalue(t: Float32) -> Float32:
    half_trace, half_difference = (t[..., 0] + t[..., 2]) / 2, (t[..., 0] - t[..., 2]) / 2
    return np.asarray(half_trace - np.sqrt(half_difference**2 + t[..., 1] ** 2))


def _continuous_depth(z: Float32, gap: float) -> NDArray[np.bool_]:
    """Pixels in whose neighbourhood the known depths differ by less than the relative gap, [H, W]."""
    known = np.isfinite(z)
    kernel = np.ones((_NEIGHBOURHOOD, _NEIGHBOURHOOD), np.uint8)
    far = cv2.dilate(np.where(known, z, 0.0).astype(np.float32), kernel)
    near = cv2.erode(np.where(known, z, _FAR).astype(np.float32), kernel)
    return np.asarray(known & (far < (1.0 + gap) * near))


def _measured(frame: Frame, camera: Camera) -> tuple[SparseDepth, Float32]:
    """Candidate places with depth, and the depth map they came from."""
    if frame.sparse_depth is not None:
        return frame.sparse_depth, frame.sparse_depth.to_map(camera.height, camera.width).z
    if frame.depth is not None:
        return SparseDepth.from_map(frame.depth), np.where(frame.depth.valid, frame.depth.z, np.nan)
    return SparseDepth(np.zeros((0, 2)), np.zeros(0)), np.full((camera.height, camera.width), np.nan, np.float32)


def _spread(score: Float64, uv: Float64, camera: Camera, count: int) -> NDArray[np.int64]:
    """The best candidate of each cell, then the second best of each, until ``count`` are taken."""
    cell = max(4.0, np.sqrt(camera.width * camera.height / count))
    col, row = np.floor(uv / cell).astype(np.int64).T
    key = row * (int(camera.width / cell) + 2) + col
    order = np.lexsort((np.arange(len(score)), -score, key))
    starts = np.r_[True, np.diff(key[order]) != 0]
    first = np.maximum.accumulate(np.where(starts, np.arange(len(order)), 0))
    rank = np.arange(len(order)) - first
    by_rank = np.lexsort((-score[order], rank))[:count]
    return np.sort(order[by_rank])


def extract(frame: Frame, gray: UInt8, config: TrackingConfig) -> Patches:
    """Choose the patches of a new keyframe among the pixels that carry a depth.

    Dense depth is thinned to corners, sparse depth to its best textured points; places beside a step in
    depth are left out, since there the texture and the depth may belong to different surfaces.
    """
    camera = frame.camera
    assert camera is not None
    tensor = structure_tensor(gray, config.patch_px)
    corner = _smallest_eigenvalue(tensor)
    candidates, z_map = _measured(frame, camera)
    col, row = np.floor(candidates.uv).astype(np.int64).T
    border = config.patch_px // 2 + 1
    inside = (col >= border) & (col < camera.width - border) & (row >= border) & (row < camera.height - border)
    col, row, uv, z = col[inside], row[inside], candidates.uv[inside], candidates.z[inside]
    steady = _continuous_depth(z_map, config.depth_gap)
    score = corner[row, col].astype(np.float64)
    good = steady[row, col] & (z < config.max_depth) & (score > config.min_quality * float(corner.max()))
    if frame.sparse_depth is None:
        peaks = cv2.dilate(corner, np.ones((5, 5), np.uint8))
        good &= corner[row, col] >= peaks[row, col]
    uv, z, score, col, row = uv[good], z[good], score[good], col[good], row[good]
    chosen = _spread(score, uv, camera, config.patches) if len(uv) else np.zeros(0, dtype=np.int64)
    t = tensor[row[chosen], col[chosen]].astype(np.float64)
    matrices = np.stack([t[:, 0], t[:, 1], t[:, 1], t[:, 2]], axis=-1).reshape(-1, 2, 2)
    matrices = matrices + _GRADIENT_NOISE * np.eye(2)
    return Patches(uv[chosen], camera.unproject(uv[chosen], z[chosen]), matrices)
