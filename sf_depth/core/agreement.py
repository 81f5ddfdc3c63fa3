"""Depth of a keyframe that the depth of other keyframes confirms.

A sweep finds a depth for every pixel, right or wrong. What is wrong differs from keyframe to keyframe, what is right
does not: a point counts if other keyframes, looking from elsewhere, have a surface there, and the mean of what they
say is better than what each one says. How many they are tells how sure it is.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from sf_depth.core import pinhole
from sf_depth.core.matching import pixel_grid
from sf_interfaces.geometry import se3
from sf_interfaces.types import DepthMap, Float32, Float64, Keyframe

_ALIKE = 0.015  # relative difference of inverse depths that show one surface, at least
_ALIKE_PX = 0.5  # or so much of the sweep's disparity
_MOST_ALIKE = 0.05  # but no more than this
_MIN_Z = 0.05  # of the own depth; nearer to another camera nothing is compared
# Measured against exact depth: a point that one other keyframe confirms errs by so many px of disparity (1 sigma), one
# that n confirm by an n-th of it; each that sees through it makes it less sure. Poses err too.
_SIGMA_PX, _DENIED = 0.8, 0.7
_POSES = 0.003  # relative
_CONTINUOUS = 0.02  # relative difference within one surface: there depth is interpolated


@dataclass(frozen=True, slots=True)
class Swept:
    """A keyframe with the inverse depth a sweep found.

    Args:
        d: [h, w], in the unit of its pose; a fraction of the size of its image.
        baseline: distance of the source farthest from it.
    """

    keyframe: Keyframe
    d: Float32
    baseline: float

    @property
    def theta(self) -> Float64:
        """The camera of the reduced image."""
        camera = self.keyframe.camera
        zoom = np.array([self.d.shape[1] / camera.width, self.d.shape[0] / camera.height])
        return pinhole.theta_of(camera) * np.array([*zoom, *zoom, 0.0])

    @property
    def disparity(self) -> Float32:
        """What the sweep measured: px that a point moves in the farthest source, [h, w]."""
        return np.asarray(np.float32(self.theta[0] * self.baseline) * self.d)


@dataclass(frozen=True, slots=True)
class _Witness:
    """What one keyframe says about another's points, [N]: their inverse depth, as far as it confirms or denies them."""

    d: Float32
    confirms: np.ndarray
    denies: np.ndarray


def confirmed(own: Swept, others: Sequence[Swept]) -> DepthMap:
    """Depth with variance of the full image, NaN where no other keyframe confirms it."""
    shape = own.d.shape
    d = own.d.reshape(-1)
    x = pinhole.rays(own.theta, np.ascontiguousarray(pixel_grid(shape).reshape(-1, 2).T)).astype(np.float32)
    alike = np.clip(_ALIKE_PX / own.disparity.reshape(-1), _ALIKE, _MOST_ALIKE)
    total, count, denied = d.copy(), np.zeros_like(d), np.zeros_like(d)
    for other in others:
        said = _witness(own, other, x, alike)
        total += np.where(said.confirms, said.d, np.float32(0))
        count += said.confirms
        denied += said.denies
    d = np.where(count > denied, total / (count + 1), np.float32(np.nan)).reshape(shape)
    sigma = _SIGMA_PX * (1 + _DENIED * denied) / np.maximum(count, 1)  # px of disparity
    relative = np.hypot(sigma.reshape(shape) / own.disparity, np.float32(_POSES))
    size = own.keyframe.camera.width, own.keyframe.camera.height
    z = 1.0 / _enlarged(d, size)
    variance = (z * cv2.resize(relative, size, interpolation=cv2.INTER_NEAREST)) ** 2
    return DepthMap(z, np.where(np.isfinite(z), variance, np.float32(np.nan)), own.keyframe.scale)


def _witness(own: Swept, other: Swept, x: Float32, alike: Float32) -> _Witness:
    """What ``other`` says about the points on the rays x [2, N] of ``own``."""
    d = own.d.reshape(-1)
    T = (se3.inverse(other.keyframe.T_map_camera) @ own.keyframe.T_map_camera).astype(np.float32)
    X = T[:3, :2] @ x + T[:3, 2:3] + T[:3, 3:] * d
    ahead = np.maximum(X[2], np.float32(_MIN_Z))
    y = X[:2] / ahead
    col, row = np.floor(pinhole.project(other.theta, y)).astype(np.int64)
    height, width = other.d.shape
    inside = (X[2] > _MIN_Z) & (col >= 0) & (col < width) & (row >= 0) & (row < height)
    theirs = np.where(inside, other.d[row.clip(0, height - 1), col.clip(0, width - 1)], np.float32(1))
    apart = np.log(theirs * ahead / d)
    # Their point on our ray: its depth here is Z / theirs.
    Z = T[:3, 2] @ np.concatenate([y, np.ones_like(y[:1])]) + _backward(T) * theirs
    confirms = inside & (np.abs(apart) < alike) & (Z > _MIN_Z)
    return _Witness(theirs / np.maximum(Z, np.float32(_MIN_Z)), confirms, inside & (apart < -alike))


def _backward(T: Float32) -> np.float32:
    """The depth coordinate of the translation of the inverse of T."""
    return np.float32(-(T[:3, 2] @ T[:3, 3]))


def _enlarged(d: Float32, size: tuple[int, int]) -> Float32:
    """An inverse depth image of full size: interpolated within surfaces, not across their borders."""
    near = cv2.resize(d, size, interpolation=cv2.INTER_NEAREST)
    between = cv2.resize(d, size, interpolation=cv2.INTER_LINEAR)
    with np.errstate(invalid="ignore"):
        one = np.abs(between - near) < _CONTINUOUS * near
    return np.where(one, between, near)
