"""Places: what is remembered of a view, and which remembered views an image resembles.

A place is some hundred ORB descriptors with their 3-D points; images are not kept. Resemblance is voted for
by an index that needs no training: the words of a descriptor are fixed subsets of its bits, so
similar descriptors share some of their words (locality-sensitive hashing).
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sf_interfaces.types import Camera, DepthMap, Float32, Float64, Frame, Keyframe, SparseDepth, UInt8
from sf_tracking.core.patches import to_gray

_FEATURES = 1000  # corners of an image
_KEPT = 400  # of them with a 3-D point, per place
_FAST = 10  # grey levels by which a corner stands out
_PATCH_PX = 31.0  # what a descriptor looks at, px of its pyramid level
_PYRAMID = 1.2  # between ORB's levels
_LEVELS = (0, 2, 4)  # at which a landmark is described, for it has no size of its own
_SPARSE = 0.5  # share of pixels with depth, below which a corner takes the depth of a point near it
_SPARSE_PX = 2.0  # this near
_TABLES, _BITS = 4, 14  # words per descriptor and bits per word; all words together fit 16 bits


@dataclass(frozen=True, slots=True)
class Features:
    """Corners of an image: uv [N, 2] px and upright ORB descriptors [N, 32]."""

    uv: Float64
    descriptors: UInt8

    def __len__(self) -> int:
        return len(self.uv)


@dataclass(frozen=True, slots=True)
class Place:
    """A view by which the map can be found again: points [N, 3] in its optical frame and their descriptors."""

    stamp_ns: int
    camera: Camera
    points: Float32
    descriptors: UInt8

    def __len__(self) -> int:
        return len(self.points)

    @property
    def depth(self) -> float:
        """Median depth of the points."""
        return float(np.median(self.points[:, 2])) if len(self.points) else 1.0


def features(image: UInt8) -> Features:
    """The corners of an image, described upright."""
    gray, orb = to_gray(image), _orb()
    corners = orb.detect(gray, None)
    for corner in corners:
        corner.angle = 0.0
    return _described(orb, gray, corners)


def place_of_keyframe(keyframe: Keyframe, found: Features) -> Place:
    """What is remembered of a keyframe: corners with measured depth, or its landmarks where none is measured."""
    if keyframe.depth is not None:
        return _measured(keyframe.stamp_ns, keyframe.camera, keyframe.depth, found)
    cloud = keyframe.landmarks
    points = np.zeros((0, 3), np.float32) if cloud is None else cloud.points
    at = keyframe.camera.project(points.astype(np.float64))[0] - 0.5
    corners = [
        cv2.KeyPoint(float(u), float(v), _PATCH_PX * _PYRAMID**level, 0.0, 0.0, level, i)
        for i, (u, v) in enumerate(at)
        for level in _LEVELS
        if np.isfinite((u, v)).all()
    ]
    kept, descriptors = _orb().compute(to_gray(keyframe.image), corners)
    index = [corner.class_id for corner in kept]
    return Place(keyframe.stamp_ns, keyframe.camera, points[index], _rows(descriptors))


def place_of_frame(frame: Frame) -> Place | None:
    """A frame with depth as a place; None without."""
    assert frame.image is not None and frame.camera is not None
    depth = frame.depth
    if frame.sparse_depth is not None:
        depth = frame.sparse_depth.to_map(frame.camera.height, frame.camera.width)
    return None if depth is None else _measured(frame.stamp_ns, frame.camera, depth, features(frame.image))


def _measured(stamp_ns: int, camera: Camera, depth: DepthMap, found: Features) -> Place:
    column, row = np.floor(found.uv).astype(np.int64).T
    z = np.where(depth.valid, depth.z, np.nan)[row, column].astype(np.float64)
    if len(found) and depth.density < _SPARSE and (sparse := SparseDepth.from_map(depth)):
        distance, nearest = cKDTree(sparse.uv).query(found.uv, distance_upper_bound=_SPARSE_PX)
        near = np.isfinite(distance)
        z[near] = sparse.z[nearest[near]]
    known = np.flatnonzero(np.isfinite(z))
    known = known[np.linspace(0, len(known) - 1, min(len(known), _KEPT)).astype(np.int64)]
    points = camera.unproject(found.uv[known], z[known]).astype(np.float32)
    return Place(stamp_ns, camera, points, found.descriptors[known])


def _orb() -> cv2.ORB:
    return cv2.ORB_create(nfeatures=_FEATURES, scaleFactor=_PYRAMID, fastThreshold=_FAST)


def _described(orb: cv2.ORB, gray: UInt8, corners: list[cv2.KeyPoint]) -> Features:
    kept, descriptors = orb.compute(gray, corners)
    uv = np.array([corner.pt for corner in kept], dtype=np.float64).reshape(-1, 2) + 0.5
    return Features(uv, _rows(descriptors))


def _rows(descriptors: UInt8 | None) -> UInt8:
    return np.zeros((0, 32), np.uint8) if descriptors is None else descriptors


class Index:
    """Which of the places added so far share rare words with a set of descriptors."""

    def __init__(self) -> None:
        # Fixed for ever: a map that is read back has to mean the same.
        chosen = np.random.default_rng(0).permutation(256)[: _TABLES * _BITS].reshape(_TABLES, _BITS)
        self._byte, self._bit = chosen // 8, (7 - chosen % 8).astype(np.uint8)
        self._holders = np.zeros(_TABLES << _BITS, np.int64)  # of each word: how many places have it
        self._words = np.zeros(1 << 16, np.uint16)  # of all places, one after the other
        self._ends: list[int] = []

    def __len__(self) -> int:
        return len(self._ends)

    def add(self, descriptors: UInt8) -> None:
        """One more place; its number is the count of those before."""
        words = self._words_of(descriptors)
        begin = self._ends[-1] if self._ends else 0
        while begin + len(words) > len(self._words):
            self._words = np.concatenate([self._words, np.zeros_like(self._words)])
        self._words[begin : begin + len(words)] = words
        self._holders[words] += 1
        self._ends.append(begin + len(words))

    def drop(self) -> None:
        """Forget the place added last."""
        end = self._ends.pop()
        begin = self._ends[-1] if self._ends else 0
        self._holders[self._words[begin:end]] -= 1

    def scores(self, descriptors: UInt8) -> Float64:
        """How much each place shares with the descriptors, [len(self)]; rare words count more."""
        if not self._ends:
            return np.zeros(0)
        words = self._words_of(descriptors)
        weight = np.zeros(len(self._holders), np.float32)
        weight[words] = np.log1p(len(self) / np.maximum(self._holders[words], 1)) ** 2
        shared = np.take(weight, self._words[: self._ends[-1]])
        ends = np.array(self._ends)
        begins = np.r_[0, ends[:-1]]
        return np.add.reduceat(np.r_[shared, np.float32(0)], begins).astype(np.float64) * (ends > begins)

    def _words_of(self, descriptors: UInt8) -> NDArray[np.int64]:
        """The distinct words of at most ``_KEPT`` descriptors [N, 32], over all tables."""
        some = descriptors[np.linspace(0, len(descriptors) - 1, min(len(descriptors), _KEPT)).astype(np.int64)]
        bits = (some[:, self._byte] >> self._bit & 1).astype(np.int64)  # [N, tables, bits]
        return np.unique(bits @ (1 << np.arange(_BITS)) + (np.arange(_TABLES) << _BITS))
