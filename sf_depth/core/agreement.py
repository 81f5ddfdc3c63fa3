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
from numpy.typing import NDArray

from sf_depth.core import pinhole
from sf_depth.core.matching import pixel_grid
from sf_interfaces.geometry import se3
from sf_interfaces.types import DepthMap, Float32, Float64, Keyframe

_ALIKE, _MOST_ALIKE = 0.015, 0.05  # relative difference of inverse depths that show one surface, at least and at most
_ALIKE_NOISE = 3.5  # in between so many times what keyframes typically disagree by
_SAME = 0.1  # relative difference of inverse depths of what may be one surface at all
_MIN_Z = 0.05  # of the own depth; nearer to another camera nothing is compared
# Measured against exact and sensor depth, in units of what keyframes typically disagree by: a point that one other
# keyframe confirms errs by so much (1 sigma), one that n confirm by an n-th of it, as far as poses are right; each that
# sees through it makes it less sure, and a little each that sees something in front of it. What poses get wrong all
# keyframes may share.
_SIGMA, _DENIED, _HIDDEN, _SHARED = 5.0, 0.7, 0.3, 0.8
_CONTINUOUS = 0.02  # relative difference within one surface: there depth is interpolated


@dataclass(frozen=True, slots=True)
class Swept:
    """A keyframe with the inverse depth a sweep found.

    Args:
        d: [h, w], in the unit of its pose; a fraction of the size of its image.
        known: [h, w] bool, where that means something.
        baseline: distance of the source farthest from it.
    """

    keyframe: Keyframe
    d: Float32
    known: NDArray[np.bool_]
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
class _Said:
    """What one keyframe says about another's points, [N].

    Args:
        d: inverse depth of what it sees in their place, on their rays.
        apart: relative difference of what it sees from what it should see there; NaN where it does not look.
    """

    d: Float32
    apart: Float32


def confirmed(own: Swept, others: Sequence[Swept]) -> DepthMap:
    """Depth with variance of the full image, NaN where no other keyframe confirms it."""
    shape, size = own.d.shape, (own.keyframe.camera.width, own.keyframe.camera.height)
    x = pinhole.rays(own.theta, np.ascontiguousarray(pixel_grid(shape).reshape(-1, 2).T)).astype(np.float32)
    said = [_asked(own, other, x) for other in others]
    own_d, disparity = own.d.reshape(-1), own.disparity.reshape(-1)
    noise, noise_px = _disagreement(said, disparity)
    alike = np.clip(_ALIKE_NOISE * noise_px / disparity, _ALIKE, _MOST_ALIKE)
    total, (count, denied, hidden) = own_d.copy(), np.zeros((3, *own_d.shape), own_d.dtype)
    for one in said:
        confirms = np.abs(one.apart) < alike
        total += np.where(confirms, one.d, np.float32(0))
        count += confirms
        denied += one.apart < -alike
        hidden += one.apart > alike
    d = np.where((count > denied) & own.known.reshape(-1), total / (count + 1), np.float32(np.nan))
    doubt = 1 + _DENIED * denied + _HIDDEN * hidden
    sigma = _SIGMA * noise_px * doubt / np.maximum(count, 1) / disparity
    relative = np.hypot(sigma, _SHARED * noise).astype(np.float32)
    z = 1.0 / _enlarged(d.reshape(shape), size)
    variance = (z * cv2.resize(relative.reshape(shape), size, interpolation=cv2.INTER_NEAREST)) ** 2
    return DepthMap(z, variance, own.keyframe.scale)


def _disagreement(said: Sequence[_Said], disparity: Float32) -> tuple[float, float]:
    """What keyframes typically disagree by about one surface: relative, and in px of disparity [N]."""
    apart = [np.abs(one.apart) for one in said]
    same = [a < _SAME for a in apart]
    if not any(s.any() for s in same):
        return _SAME, float(np.median(_SAME * disparity))
    relative = np.concatenate([a[s] for a, s in zip(apart, same, strict=True)])
    px = np.concatenate([(a * disparity)[s] for a, s in zip(apart, same, strict=True)])
    return float(np.median(relative)), float(np.median(px))


def _asked(own: Swept, other: Swept, x: Float32) -> _Said:
    """What ``other`` says about the points on the rays x [2, N] of ``own``."""
    d = own.d.reshape(-1)
    T = (se3.inverse(other.keyframe.T_map_camera) @ own.keyframe.T_map_camera).astype(np.float32)
    X = T[:3, :2] @ x + T[:3, 2:3] + T[:3, 3:] * d
    ahead = np.maximum(X[2], np.float32(_MIN_Z))
    y = X[:2] / ahead
    col, row = np.floor(pinhole.project(other.theta, y)).astype(np.int64)
    height, width = other.d.shape
    inside = (X[2] > _MIN_Z) & (col >= 0) & (col < width) & (row >= 0) & (row < height)
    place = row.clip(0, height - 1), col.clip(0, width - 1)
    inside &= other.known[place] & own.known.reshape(-1)
    theirs = np.where(inside, other.d[place], np.float32(1))
    # The depth of their point in our camera, in units of theirs.
    back = T[:2, 2] @ y + T[2, 2] - (T[:3, 2] @ T[:3, 3]) * theirs
    inside &= back > _MIN_Z
    apart = np.where(inside, np.log(theirs * ahead / d), np.float32(np.nan))
    return _Said(theirs / np.maximum(back, np.float32(_MIN_Z)), apart)


def _enlarged(d: Float32, size: tuple[int, int]) -> Float32:
    """An inverse depth image of full size: interpolated within surfaces, not across their borders."""
    near = cv2.resize(d, size, interpolation=cv2.INTER_NEAREST)
    between = cv2.resize(d, size, interpolation=cv2.INTER_LINEAR)
    with np.errstate(invalid="ignore"):
        one = np.abs(between - near) < _CONTINUOUS * near
    return np.where(one, between, near)
