"""Depth of the keyframes of SLAM (mode ``slam``): a sweep at their poses, and what other keyframes confirm of it.

The tracker has aligned its keyframes to a fraction of a pixel, so a match need only be looked for along one line, in
all sources at once (:mod:`plane_sweep`). Each keyframe then waits until some after it have been swept too.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from sf_depth.core import pinhole
from sf_depth.core.agreement import Swept, confirmed
from sf_depth.core.dense_ba import Estimate
from sf_depth.core.matching import grey, pixel_grid, sample
from sf_depth.core.plane_sweep import compare, planes_of, sweep
from sf_depth.core.refined import refined
from sf_interfaces.errors import InsufficientParallax
from sf_interfaces.geometry import se3
from sf_interfaces.types import Float32, Float64, Keyframe, UInt8

_WIDTH = 320  # px that are swept at least, where the image has as many
_BEFORE, _AFTER = 6, 3  # swept keyframes that are asked about the depth of one
_PATCH = 7  # px, side of the squares around landmarks that have to look alike in a source
_ALIKE = 0.3  # correlation of half the landmarks; where a pose is wrong it is about 0
_LEAST_LANDMARKS = 8
# What has no texture is as unlike on every plane of a sweep, and whole fronts come to lie on near ones, where sources
# lose sight of them. So in front of all landmarks depth counts only where the images are alike.
_IN_FRONT = 1.5  # times the inverse depth of the nearest landmarks
_UNLIKE = 0.4  # dissimilarity


def relative(frame: Keyframe, sources: list[Keyframe]) -> Float64:
    """T_source_reference [S, 4, 4] by the poses of the keyframes."""
    return np.stack([se3.inverse(source.T_map_camera) @ frame.T_map_camera for source in sources])


def swept(frame: Keyframe, sources: list[Keyframe]) -> Swept:
    """Inverse depth of a keyframe by a sweep through the sources that its landmarks are found in.

    Raises:
        InsufficientParallax: too few landmarks, or none of the sources shows them where its pose says.
    """
    points = np.zeros((0, 3)) if frame.landmarks is None else frame.landmarks.points.astype(np.float64)
    points = points[points[:, 2] > 0]
    if len(points) < _LEAST_LANDMARKS:
        raise InsufficientParallax(f"only {len(points)} landmarks, a sweep needs {_LEAST_LANDMARKS}")
    T = relative(frame, sources)
    own = grey(frame.image)
    good = [j for j, source in enumerate(sources) if _alike(own, grey(source.image), frame, points, T[j]) > _ALIKE]
    if not good:
        raise InsufficientParallax("no neighbour shows the landmarks where its pose says: the poses contradict them")
    at = Estimate(pinhole.theta_of(frame.camera), T[good], 1.0 / points[:, 2])
    reduction = max(1, round(frame.camera.width / _WIDTH))
    part, planes = compare(frame.image, [sources[j].image for j in good], at, reduction), planes_of(at, reduction)
    d, unlike = refined(part, sweep(part, planes), float(planes[1] - planes[0]))
    known = (d < _IN_FRONT * np.quantile(at.inverse_depth, 0.99)) | (unlike < _UNLIKE)
    return Swept(frame, d, known, float(np.linalg.norm(T[good, :3, 3], axis=1).max()))


def _alike(first: UInt8, second: UInt8, frame: Keyframe, points: Float64, T: Float64) -> float:
    """Median correlation of the squares around landmarks [N, 3] with where a pose places them; 0 where few are."""
    uv, _ = frame.camera.project(points)
    there, z = frame.camera.project(se3.transform(T, points))
    size = np.array([frame.camera.width, frame.camera.height])
    inside = (z > 0) & (there > _PATCH).all(axis=1) & (there < size - _PATCH).all(axis=1)
    if inside.sum() < _LEAST_LANDMARKS:
        return 0.0
    square = (pixel_grid((_PATCH, _PATCH)) - 0.5 * _PATCH).reshape(-1, 2)
    zoom = (points[inside, 2] / z[inside])[:, None, None]
    a = _normalised(sample(first, (uv[inside][:, None] + square).astype(np.float32)))
    b = _normalised(sample(second, (there[inside][:, None] + zoom * square).astype(np.float32)))
    return float(np.median((a * b).sum(axis=1)))


def _normalised(patches: np.ndarray) -> Float32:
    """Grey levels [N, P] without their mean, of unit length."""
    centred = patches.astype(np.float32) - patches.mean(axis=1, keepdims=True)
    return np.asarray(centred / np.sqrt((centred * centred).sum(axis=1, keepdims=True) + 1.0))


@dataclass(slots=True)
class Consensus:
    """Keyframes that were swept, and wait for others to confirm them."""

    swept: list[Swept] = field(default_factory=list)
    next: int = 0  # index of the first that has not been asked about

    def add(self, one: Swept) -> list[Keyframe]:
        """Take the next; returns those whose depth is confirmed now, NaN where it is not."""
        self.swept.append(one)
        done = []
        while len(self.swept) - self.next > _AFTER:
            done.append(self._ask())
        if self.next > _BEFORE:
            del self.swept[0]
            self.next -= 1
        return done

    def finish(self) -> list[Keyframe]:
        """The end of the sequence: the last have fewer after them."""
        done = [self._ask() for _ in range(len(self.swept) - self.next)]
        self.swept, self.next = [], 0
        return done

    def _ask(self) -> Keyframe:
        i = self.next
        self.next += 1
        others = self.swept[max(i - _BEFORE, 0) : i] + self.swept[i + 1 : i + 1 + _AFTER]
        own = self.swept[i]
        return replace(own.keyframe, depth=confirmed(own, others))
