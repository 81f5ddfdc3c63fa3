"""Where the geometry known by now expects every pixel in every source: what matching starts from again."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from sf_depth.core import pinhole
from sf_depth.core.dense_ba import Estimate, Observations
from sf_depth.core.matching import pixel_grid
from sf_depth.core.parallel import each
from sf_depth.core.plane_sweep import sweep_planes
from sf_depth.core.posterior import Adjusted
from sf_interfaces.types import Float32, Float64, UInt8

_AGREE = 0.08  # relative difference up to which triangulated and swept inverse depth show one surface
_MIN_Z = 0.05  # of the reference depth


def expected(
    reference: UInt8, sources: Sequence[UInt8], fit: Adjusted, seen: Observations, grid: tuple[int, int], least: int
) -> list[Float32 | None]:
    """Target pixels [H, W, 2] of every reference pixel in each source; None for a lost one.

    Args:
        fit, seen: the optimum so far and the correspondences behind it, on ``grid`` rows and columns.
        least: correspondences of a source that is not lost.
    """
    height, width = reference.shape[:2]
    at, matched = fit.estimate, seen.weight > 0
    known = matched.sum(axis=1) >= least
    if not known.any():
        return [None] * len(known)
    placed = Estimate(at.theta, at.T[known], at.inverse_depth[matched.any(axis=0)])
    swept = sweep_planes(reference, [sources[j] for j in np.flatnonzero(known)], placed)
    d = _merged(at.inverse_depth.reshape(grid), _confidence(fit, seen).reshape(grid), swept)
    d = cv2.resize(d, (width, height), interpolation=cv2.INTER_LINEAR).reshape(-1)
    x = pinhole.rays(at.theta, pixel_grid((height, width)).reshape(-1, 2).T)

    def one(j: int) -> Float32 | None:
        if not known[j]:
            return None
        T = at.T[j].astype(np.float32)
        X = T[:3, :2] @ x + T[:3, 2:3] + T[:3, 3:] * d
        uv = pinhole.project(at.theta, X[:2] / np.maximum(X[2], np.float32(_MIN_Z)))
        uv = np.clip(uv, -width, 2 * width)
        return np.ascontiguousarray(uv.T.reshape(height, width, 2), dtype=np.float32)

    return each(one, range(len(at.T)))


def _confidence(fit: Adjusted, seen: Observations) -> Float64:
    """How sure a triangulated inverse depth is, 0..1 [N]."""
    square = fit.estimate.inverse_depth**2
    known = (seen.weight > 0).sum(axis=0) * square / (fit.inverse_depth_variance + 1e-6 * square)
    return np.asarray(np.minimum(known, 1e4) / 1e4)


def _merged(d: Float64, confidence: Float64, swept: Float32) -> Float32:
    """Inverse depth of the size of ``swept``: triangulated where both show one surface, else swept.

    The sweep sees what flow has missed; triangulation is finer than the distance of two planes.
    """
    size = swept.shape[::-1]
    coarse = cv2.resize(swept, d.shape[::-1], interpolation=cv2.INTER_AREA)
    alike = (np.abs(np.log(d / coarse)) < _AGREE) & (confidence > 0)
    fine = _filled(np.where(alike, d, coarse), np.where(alike, confidence, 1e-9))
    fine = cv2.resize(fine, size, interpolation=cv2.INTER_LINEAR)
    share = cv2.resize(alike.astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
    return np.where((np.abs(np.log(fine / swept)) < _AGREE) & (share > 0.5), fine, swept)


def _filled(values: Float64, confidence: Float64) -> Float32:
    """An image without gaps: at every scale the finest level that knows something wins."""
    levels = [((values * confidence).astype(np.float32), confidence.astype(np.float32))]
    while min(levels[-1][0].shape) > 2:
        levels.append((cv2.pyrDown(levels[-1][0]), cv2.pyrDown(levels[-1][1])))
    top, bottom = levels.pop()
    out = top / np.maximum(bottom, 1e-9)
    while levels:
        top, bottom = levels.pop()
        coarse = cv2.resize(out, top.shape[::-1], interpolation=cv2.INTER_LINEAR)
        share = np.minimum(bottom, 1.0)
        out = np.where(bottom > 1e-6, top / np.maximum(bottom, 1e-9), 0.0) * share + (1.0 - share) * coarse
    return np.asarray(np.maximum(out, 1e-3 * float(np.median(values))), dtype=np.float32)
