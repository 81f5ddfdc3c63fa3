"""Patches: textured places spread over the image, with an inverse depth each (P in the paper, Sec. III-A)."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sf_interfaces.types import Camera, Float64, Frame, UInt8
from sf_tracking.config import TrackingConfig

_PLANE_HALF = 4  # px, half side of the window of dense depth to which a plane is fitted
_PLANE_NEIGHBOURS = 12  # points of sparse depth to which a plane is fitted
_SPACING = 3.0  # px, side of the cells of which each gives one of them
_KNOWN_SHARE = 0.5  # of the window that must carry depth
_GRAZING = 0.04  # relative change of depth per px, above which a surface is seen too flat to be measured
_FREE = 3  # times as many patches where their depth has to be found as well
_SPARES = 1.6  # candidates per wanted patch, since some fail the test of their depth


@dataclass(frozen=True, slots=True)
class Measured:
    """Inverse depths measured at M places: a plane fitted to the inverse depths around each."""

    w: Float64  # [M] 1/m, NaN where no depth is measured
    sigma: Float64  # [M] its deviation
    slope: Float64  # [M, 2] d(inverse depth)/d(uv) of the surface, 1/m/px; 0 where unknown
    broken: NDArray[np.bool_]  # [M] beside a step in depth or seen at a grazing angle

    def take(self, index: NDArray[np.int64]) -> Measured:
        """The measurements at ``index``."""
        return Measured(self.w[index], self.sigma[index], self.slope[index], self.broken[index])


@dataclass(slots=True)
class Patches:
    """The patches of one keyframe; ``w`` and ``sigma`` are refined while it is in the window."""

    uv: Float64  # [M, 2] continuous px
    slope: Float64  # [M, 2] d(inverse depth)/d(uv), 1/m/px
    w: Float64  # [M] inverse depth, 1/m
    sigma: Float64  # [M] its deviation
    prior: Float64  # [M] inverse depth as measured, or as expected from its neighbours
    prior_sigma: Float64  # [M] its deviation
    measured: NDArray[np.bool_]  # [M] the prior is a measurement

    def __len__(self) -> int:
        return len(self.uv)

    def rays(self, camera: Camera) -> Float64:
        """(x, y) at unit depth, [M, 2]."""
        return (self.uv - (camera.cx, camera.cy)) / (camera.fx, camera.fy)

    def points(self, camera: Camera) -> Float64:
        """Patch centres in the camera frame, [M, 3] in the tracker's unit."""
        return camera.unproject(self.uv, 1.0 / np.maximum(self.w, 1e-9))


def to_gray(image: UInt8) -> UInt8:
    """Luminance [H, W] of an RGB or mono image."""
    return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))


def _spread(score: Float64, uv: Float64, camera: Camera, count: int) -> NDArray[np.int64]:
    """The best candidate of each cell, then the second best of each, until ``count`` are taken."""
    cell = max(4.0, np.sqrt(camera.width * camera.height / count))
    col, row = np.floor(uv / cell).astype(np.int64).T
    key = row * (int(camera.width / cell) + 2) + col
    order = np.lexsort((np.arange(len(score)), -score, key))
    starts = np.r_[True, np.diff(key[order]) != 0]
    first = np.maximum.accumulate(np.where(starts, np.arange(len(order)), 0))
    rank = np.arange(len(order)) - first
    return order[np.lexsort((-score[order], rank))[:count]]


def _candidates(frame: Frame, gray: UInt8, config: TrackingConfig) -> tuple[Float64, Float64]:
    """Places [C, 2] px worth a patch and their corner quality [C]: corners, or LiDAR points on texture."""
    camera = frame.camera
    assert camera is not None
    # Half the resolution shows the same corners at a quarter of the cost.
    corner = cv2.cornerMinEigenVal(cv2.pyrDown(gray), config.patch_px // 2, ksize=3)
    border = config.patch_px // 2 + 2
    if frame.sparse_depth is not None:
        uv = frame.sparse_depth.uv
        inside = (uv >= border).all(axis=1) & (uv < (camera.width - border, camera.height - border)).all(axis=1)
        uv = uv[inside & (frame.sparse_depth.z[: len(inside)] < config.max_depth)]
        col, row = np.floor(uv / 2).astype(np.int64).T
    else:
        peak = corner >= cv2.dilate(corner, np.ones((3, 3), np.uint8))
        edge = border // 2 + 1
        peak[:edge], peak[-edge:], peak[:, :edge], peak[:, -edge:] = False, False, False, False
        row, col = np.nonzero(peak)
        uv = np.stack([2 * col + 0.5, 2 * row + 0.5], axis=-1)
    score = corner[row, col].astype(np.float64)
    good = score > config.min_quality * float(corner.max())
    return uv[good], score[good]


def fit_planes(offset: Float64, w: Float64, weight: Float64, flat: float = 0.0) -> tuple[Float64, Float64, Float64]:
    """Weighted fit ``w = w0 + slope . offset``: w0 [C], slope [C, 2] and the residual's deviation [C].

    Args:
        offset: [C, K, 2] px; w: [C, K] inverse depths; weight: [C, K], 0 where there is none.
        flat: weight of the expectation that the slope is 0.
    """
    A = np.concatenate([np.ones((*w.shape, 1)), offset], axis=-1)
    At = (A * weight[..., None]).transpose(0, 2, 1)
    plane = np.linalg.solve(At @ A + 1e-9 * np.eye(3) + flat * np.diag([0.0, 1.0, 1.0]), At @ w[..., None])[..., 0]
    left = (w - (A @ plane[..., None])[..., 0]) ** 2 * weight
    return plane[:, 0], plane[:, 1:], np.sqrt(left.sum(axis=1) / np.maximum(weight.sum(axis=1) - 3, 1.0))


def _neighbourhood(frame: Frame, uv: Float64) -> tuple[Float64, Float64]:
    """Offsets [C, K, 2] px and inverse depths [C, K] (NaN: none) of the measured depths round each place."""
    sparse = frame.sparse_depth
    if sparse is not None:
        # A scanner's stroke is dense along its way: its next points would lie on a line and leave the plane open.
        cell = np.floor(sparse.uv / _SPACING).astype(np.int64) @ (1, 1 << 32)
        apart = np.unique(cell, return_index=True)[1]
        at, w = sparse.uv[apart], 1.0 / sparse.z[apart]
        near = cKDTree(at).query(uv, k=min(_PLANE_NEIGHBOURS, len(at)))[1].reshape(len(uv), -1)
        return at[near] - uv[:, None], w[near]
    assert frame.depth is not None
    dv, du = (g.ravel() for g in np.mgrid[-_PLANE_HALF : _PLANE_HALF + 1, -_PLANE_HALF : _PLANE_HALF + 1])
    col, row = np.floor(uv).astype(np.int64).T
    height, width = frame.depth.z.shape
    rows, cols = np.clip(row[:, None] + dv, 0, height - 1), np.clip(col[:, None] + du, 0, width - 1)
    z = frame.depth.z[rows, cols].astype(np.float64)
    w = np.where(z > 0, 1.0 / np.where(z > 0, z, 1.0), np.nan)
    return np.stack([cols + 0.5, rows + 0.5], axis=-1) - uv[:, None], w


def measure(frame: Frame, uv: Float64, config: TrackingConfig) -> Measured:
    """What the frame's depth says about the places ``uv`` [M, 2]."""
    count = len(uv)
    no_depth = frame.depth is None and (frame.sparse_depth is None or len(frame.sparse_depth) < _PLANE_NEIGHBOURS)
    if no_depth or count == 0:
        nan = np.full(count, np.nan)
        return Measured(nan, nan, np.zeros((count, 2)), np.zeros(count, dtype=bool))
    offset, w = _neighbourhood(frame, uv)
    known = np.isfinite(w)
    w = np.where(known, w, 0.0)
    w0, slope, rough = fit_planes(offset, w, known.astype(np.float64))
    z = 1.0 / np.maximum(w0, 1e-3)
    # Structured light errs with z^2, that is alike in inverse depth; LiDAR alike in depth.
    dense = frame.sparse_depth is None
    model = np.full(count, config.depth_sigma) if dense else config.lidar_sigma / z**2
    spread = np.where(known, np.abs(w - w0[:, None] - np.einsum("ckj,cj->ck", offset, slope)), 0.0).max(axis=1)
    broken = spread > np.maximum(config.depth_gap * w0, 6 * model)
    if dense:
        broken |= np.abs(slope).max(axis=1) > _GRAZING * w0
    enough = (known.mean(axis=1) >= _KNOWN_SHARE) & (w0 > 1.0 / config.max_depth)
    # A smooth sensor earns trust, but never beyond a part of its model: offsets do not show in the residual.
    # Where the surface is inclined, depth that lies beside its pixel is another's.
    beside = config.registration_px * np.linalg.norm(slope, axis=1)
    sigma = np.sqrt((0.25 * model) ** 2 + rough**2 + beside**2)
    w0 = np.where(enough, w0, np.nan)
    return Measured(w0, np.where(enough, sigma, np.nan), np.where(enough[:, None], slope, 0.0), broken & enough)


def extract(frame: Frame, gray: UInt8, config: TrackingConfig) -> tuple[Float64, Measured]:
    """Places uv [M, 2] px of the patches of a new keyframe, and the inverse depth measured at each.

    Places beside a step in depth are left out, since there the texture and the depth may belong to different
    surfaces. Places without depth only fill up what places with depth leave.
    """
    camera = frame.camera
    assert camera is not None
    uv, score = _candidates(frame, gray, config)
    if len(uv) == 0:
        return uv.reshape(0, 2), measure(frame, uv.reshape(0, 2), config)
    count = config.patches * (1 if frame.measured else _FREE)
    chosen = _spread(score, uv, camera, round(_SPARES * count))
    uv = uv[chosen]
    found = measure(frame, uv, config)
    order = np.argsort(np.isnan(found.w), kind="stable")  # measured ones first, each in the order of choice
    kept = np.sort(order[~found.broken[order]][:count])
    return uv[kept], found.take(kept)
