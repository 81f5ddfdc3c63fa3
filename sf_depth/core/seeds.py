"""Sparse matches that survive an epipolar check, and the smooth dense flow between them.

They make dense flow work at wide baselines: the source is first warped by the seed flow, so that only a small
residual motion, without rotation and change of scale, is left.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import cKDTree

from sf_interfaces.types import Float32, Float64, UInt8

_LONG_SIDE = 480  # px; features are found on an image reduced to it
_COUNT = 1500  # features an image gives at most
_RATIO = 0.85  # of the distance to the best and to the second best descriptor
_GATE = 1.5  # px of the reduced image; epipolar distance of an inlier
_MIN_MATCHES = 16
_CELL = 16  # px; pitch of the grid the seed flow is fitted on
_NEAREST = 12  # matches each grid point is fitted to


@dataclass(frozen=True, slots=True)
class Features:
    """Key points [N, 2] px of the full image, descriptors [N, D] of unit length, and the scale they were found at."""

    uv: Float32
    descriptor: Float32
    scale: float


@dataclass(frozen=True, slots=True)
class Matches:
    """Corresponding pixels of two images, [N, 2] each."""

    first: Float64
    second: Float64

    def __len__(self) -> int:
        return len(self.first)


def detect(grey: UInt8) -> Features:
    """SIFT features with square-rooted descriptors, on the image reduced to a fixed size."""
    scale = min(1.0, _LONG_SIDE / max(grey.shape))
    small = grey if scale == 1.0 else cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    points, descriptor = cv2.SIFT_create(_COUNT, contrastThreshold=0.02).detectAndCompute(small, None)
    if descriptor is None:
        return Features(np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32), scale)
    uv = (np.array([p.pt for p in points], dtype=np.float32) + 0.5) / np.float32(scale)
    root = np.sqrt(descriptor / np.abs(descriptor).sum(axis=1, keepdims=True).clip(1e-6))
    return Features(uv, root.astype(np.float32), scale)


def match_features(first: Features, second: Features) -> Matches:
    """Mutual nearest neighbours that pass the ratio test and agree with one epipolar geometry or homography."""
    none = Matches(np.zeros((0, 2)), np.zeros((0, 2)))
    if min(len(first.uv), len(second.uv)) < _MIN_MATCHES:
        return none
    likeness = first.descriptor @ second.descriptor.T
    best = likeness.argmax(axis=1)
    rows = np.arange(len(best))
    top = likeness[rows, best]
    rest = likeness.copy()
    rest[rows, best] = -1.0
    distinct = 1.0 - top < _RATIO**2 * (1.0 - rest.max(axis=1))
    mutual = likeness.argmax(axis=0)[best] == rows
    keep = np.nonzero(distinct & mutual)[0]
    found = Matches(first.uv[keep].astype(np.float64), second.uv[best[keep]].astype(np.float64))
    return _verified(found, _GATE / first.scale)


def _verified(matches: Matches, gate: float) -> Matches:
    """The matches that one epipolar geometry explains and whose neighbours move alike."""
    if len(matches) < _MIN_MATCHES:
        return Matches(np.zeros((0, 2)), np.zeros((0, 2)))
    cv2.setRNGSeed(0)
    _, inlier = cv2.findFundamentalMat(matches.first, matches.second, cv2.USAC_MAGSAC, gate, 0.999, 2000)
    keep = np.zeros(len(matches), bool) if inlier is None else inlier.ravel() > 0
    matches = Matches(matches.first[keep], matches.second[keep])
    if len(matches) < _MIN_MATCHES:
        return Matches(np.zeros((0, 2)), np.zeros((0, 2)))
    move = matches.second - matches.first
    _, near = cKDTree(matches.first).query(matches.first, k=min(9, len(matches)))
    around = move[near[:, 1:]]  # [N, 8, 2]
    middle = np.median(around, axis=1)
    off = np.linalg.norm(move - middle, axis=1)
    spread = np.median(np.linalg.norm(around - middle[:, None], axis=2), axis=1)
    alike = off < 5.0 * gate + 4.0 * spread
    return Matches(matches.first[alike], matches.second[alike])


def seed_flow(shape: tuple[int, int], matches: Matches) -> Float32 | None:
    """Target pixels [H, W, 2] that vary smoothly and follow the matches; None where there are too few of them.

    Every point of a coarse grid gets the affine motion of its nearest matches, fitted robustly.
    """
    if len(matches) < _MIN_MATCHES:
        return None
    height, width = shape
    rows, cols = -(-height // _CELL) + 1, -(-width // _CELL) + 1
    v, u = np.meshgrid(np.arange(rows) * _CELL, np.arange(cols) * _CELL, indexing="ij")
    at = np.stack([u, v], axis=-1).reshape(-1, 2).astype(np.float64)
    distance, near = cKDTree(matches.first).query(at, k=min(_NEAREST, len(matches)))
    target = _affine(at, matches, distance, near).reshape(rows, cols, 2).astype(np.float32)
    y, x = np.meshgrid(np.arange(height) + 0.5, np.arange(width) + 0.5, indexing="ij")
    return np.asarray(
        cv2.remap(target, (x / _CELL).astype(np.float32), (y / _CELL).astype(np.float32), cv2.INTER_LINEAR)
    )


def _affine(at: Float64, matches: Matches, distance: Float64, near: np.ndarray) -> Float64:
    """Value at the points [G, 2] of affine motions fitted to their neighbours [G, K], drawn to the global one."""
    ones = np.ones((len(matches), 1))
    whole, *_ = np.linalg.lstsq(np.hstack([matches.first, ones]), matches.second, rcond=None)  # [3, 2]
    rest = matches.second - np.hstack([matches.first, ones]) @ whole
    reach = distance[:, -1:].clip(_CELL)
    x = np.concatenate([(matches.first[near] - at[:, None]) / reach[..., None], np.ones((*near.shape, 1))], axis=2)
    y = rest[near]
    weight = np.exp(-2.0 * (distance / reach) ** 2)
    prior = np.diag([0.3, 0.3, 0.01])
    for _ in range(3):
        normal = np.einsum("gk,gki,gkj->gij", weight, x, x) + prior
        fit = np.linalg.solve(normal, np.einsum("gk,gki,gkj->gij", weight, x, y))
        error = np.linalg.norm(x @ fit - y, axis=2)
        weight = np.exp(-2.0 * (distance / reach) ** 2) / (1.0 + (error / 3.0) ** 2)
    return np.hstack([at, np.ones((len(at), 1))]) @ whole + fit[:, 2]
