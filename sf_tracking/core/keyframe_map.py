"""The map of final keyframes: where they lie, what ties them together, and by what they are found again.

A keyframe is looked for among the older ones when it has become final. The search is done in parts, one per
frame, so that tracking never waits for it; a loop it finds takes effect with the next keyframe.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Future
from dataclasses import dataclass, replace

import numpy as np

from sf_interfaces.geometry import se3
from sf_interfaces.types import Camera, Float64, Keyframe, Scale
from sf_tracking.config import TrackingConfig
from sf_tracking.core import sim3
from sf_tracking.core.beside import beside
from sf_tracking.core.places import Features, Index, Place, features, place_of_keyframe
from sf_tracking.core.pose_graph import Edges, optimise
from sf_tracking.core.recognise import Sighting, sight

_NEIGHBOURS = 15  # latest keyframes that are no loop
_JUST_MADE = 2  # latest keyframes that a new one is allowed to resemble
_CANDIDATES = 3  # places that are verified
_APART = 5  # keyframes between two of them
_ALIKE = 1.4  # score of a candidate relative to the median
_ODOMETRY_PX = 0.5  # what a relative pose between neighbours errs by, as displacement of its landmarks
_ODOMETRY_STRETCH, _LOOP_STRETCH = 0.005, 0.02  # and its unit, and that of a loop
_NEWS = 3.0  # deviations from which on a loop tells anything that the map does not know
_SAME_PLACE = (0.04, 0.04, 0.15)  # two sightings agree: share of the depth, rad, log of scale
_SIGHTINGS, _WITHIN = 3, 3  # so many keyframes have to agree on a loop, each so soon after the one before
_PLAUSIBLE = {Scale.METRIC: 0.02, Scale.ARBITRARY: 0.25}  # drift per path that a loop may ask for
_LOOP_INLIERS = 50  # corners that agree: a bay that merely looks alike has fewer, a known one some hundred
_TURN, _STRETCH = 0.35, 0.7  # rad and log of scale that it may ask for


@dataclass(frozen=True, slots=True)
class Recognised:
    """A view found again: near keyframe number ``index``, at S in the map (scale: its unit in the map's).

    Args:
        sigma: [7] deviations of S in its own frame (m, rad, log of scale).
        inliers: corners of the view that agree.
    """

    index: int
    S: Float64
    sigma: Float64
    inliers: int


class KeyframeMap:
    """Final keyframes with poses that loops correct.

    Attributes:
        scale: METRIC: relative poses are rigid; ARBITRARY: the unit may drift along the way, and loops find it.
        stamps: of the keyframes, ns.
        measured: whether they have depth.
        S: [N, 4, 4] similarities: from a keyframe's optical frame, in the unit it was published in, to the map.
    """

    def __init__(self, *, loops: bool = True) -> None:
        self.scale = Scale.METRIC
        self.stamps: list[int] = []
        self.S: Float64 = np.zeros((0, 4, 4))
        self.measured: list[bool] = []
        self.places: list[Place] = []
        self.edges: list[tuple[int, int, Float64, Float64, bool]] = []  # i, j, Z, sigma, closes a loop
        self._loops = loops
        self._index = Index()
        self._walked: list[float] = []  # length of the path up to each keyframe
        self._gap = np.zeros(7)  # variances of the way to keyframes that were dropped since the last one
        self._came: tuple[Float64, float] | None = None  # where the last one was, dropped or not, and the way to it
        self._parts: Iterator[None] = iter(())
        self._hints: list[tuple[Recognised, int]] = []  # sightings that agree so far, and the keyframes that had them
        self._news = False

    def __len__(self) -> int:
        return len(self.stamps)

    def add(self, keyframe: Keyframe, found: Recognised | None = None) -> None:
        """One more final keyframe.

        Args:
            found: what ties it to the map where it does not follow the last keyframe.
        """
        self.complete()
        n, T = len(self), keyframe.T_map_camera
        self.stamps.append(keyframe.stamp_ns)
        self.S = np.concatenate([self.S, T[None]])
        before, way = self._came or (T[:3, 3], 0.0)
        self._came = T[:3, 3], way + float(np.linalg.norm(T[:3, 3] - before))
        self._walked.append(self._came[1])
        self.measured.append(keyframe.depth is not None)
        if found is not None:
            self._tie(found.index, n, T, found.sigma, loop=True)
        elif n:
            self._tie(n - 1, n, T, np.sqrt(_odometry_sigma(keyframe) ** 2 + self._gap), loop=False)
        self._gap = np.zeros(7)
        self._parts = self._search(keyframe, beside(_describe, keyframe), n)

    def knows(self, keyframe: Keyframe, config: TrackingConfig) -> bool:
        """Whether an older keyframe already sees what this one does: too little flow and enough overlap.

        Of the last ones the tracker has thought already. What was seen ``renew_s`` ago, and
        half as long ago as the first time, counts as forgotten: things move, and keyframes get lost on their way.
        """
        older = max(0, len(self) - _JUST_MADE)
        seen = [i for i, T in self._near(keyframe, config) if _same_view(keyframe, T, config)]
        if not seen or seen[0] >= older:
            return False
        first, last = self.stamps[seen[0]], self.stamps[seen[-1]]
        return keyframe.stamp_ns - last <= max(config.renew_s * 1e9, last - first)

    def _near(self, keyframe: Keyframe, config: TrackingConfig) -> list[tuple[int, Float64]]:
        """Keyframes, with depth if this one has it, that may see the same, oldest first, and T_other_own."""
        cloud, camera = keyframe.landmarks, keyframe.camera
        if cloud is None or not len(cloud) or not len(self):
            return []
        moved = se3.inverse(sim3.rigid(self.S)) @ keyframe.T_map_camera
        turn = 2 * config.keyframe_flow * camera.width / camera.fx
        near = np.linalg.norm(moved[:, :3, 3], axis=1) < turn * float(np.median(cloud.points[:, 2]))
        near &= moved[:, 2, 2] > np.cos(min(turn, np.pi))
        near &= np.array(self.measured) | (keyframe.depth is None)
        return [(int(i), moved[i]) for i in np.flatnonzero(near)]

    @property
    def news(self) -> bool:
        """Whether loops wait to take effect."""
        self.complete()
        return self._news

    @property
    def told(self) -> bool:
        """Whether what was found out from the last keyframe speaks against the map as it is."""
        return self.news or (bool(self._hints) and self._hints[-1][1] == len(self) - 1)

    def drop(self) -> None:
        """Forget the last keyframe, which told nothing; the next one is tied to the one before it."""
        self.complete()
        _, _, _, sigma, _ = self.edges.pop()
        self._gap = np.asarray(sigma**2)
        for values in (self.stamps, self.places, self._walked, self.measured):
            values.pop()
        self.S = self.S[:-1]
        self._index.drop()

    def work(self) -> bool:
        """Do the next part of the search for a loop; True when nothing is left."""
        return next(self._parts, self) is self

    def complete(self) -> None:
        """Do all that is left."""
        while not self.work():
            pass

    def correct(self) -> Float64 | None:
        """Let the loops found so far take effect.

        Returns:
            Motion of each keyframe within the map, [N, 4, 4] similarities; None where nothing changes.
        """
        if not self._news:
            return None
        self.complete()
        self._news, self._hints = False, []
        before = self.S
        self.S, _ = optimise(before, self._graph(), with_scale=self.scale is Scale.ARBITRARY)
        motion = self.S @ sim3.inverse(before)
        self._renew(len(self) - 1)
        return motion

    def _renew(self, n: int) -> None:
        """Keyframe ``n`` is published after the correction: in the unit that the map has there now."""
        unit = float(sim3.scale_of(self.S[n]))
        old = sim3.similarity(np.eye(4), 1.0 / unit)  # of the new unit in the old one
        self.S[n] = sim3.rigid(self.S[n])
        self.places[n] = replace(self.places[n], points=self.places[n].points * np.float32(unit))
        for k, (i, j, Z, sigma, loop) in enumerate(self.edges):
            if n in (i, j):
                self.edges[k] = (i, j, sim3.inverse(old) @ Z if i == n else Z @ old, sigma, loop)

    def recognise(self, found: Features, camera: Camera, own: Place | None = None) -> Recognised | None:
        """Where in the whole map an image is, or None.

        Args:
            own: the image's own landmarks, from which its unit is told; None: it has the map's unit.
        """
        self.complete()
        out: list[Recognised] = []
        for index in self._candidates(self._index.scores(found.descriptors)):
            out += self._verified(index, found, camera, own)
        return self._unambiguous(out)

    def agree(self, a: Float64, b: Float64, depth: float) -> bool:
        """Whether two similarities put a camera that looks ``depth`` far to the same place."""
        r, _ = sim3.coordinates(sim3.inverse(a) @ b)
        share, turn, stretch = _SAME_PLACE
        return bool(np.linalg.norm(r[:3]) < share * depth and np.linalg.norm(r[3:6]) < turn and np.abs(r[6]) < stretch)

    # ---- the search for a loop

    def _search(self, keyframe: Keyframe, described: Future[tuple[Features, Place]], n: int) -> Iterator[None]:
        found, place = described.result()
        scores = self._index.scores(place.descriptors)
        self._index.add(place.descriptors)
        self.places.append(place)
        if not self._loops or n <= _NEIGHBOURS:
            return
        yield
        own = place if self.scale is Scale.ARBITRARY else None
        out: list[Recognised] = []
        for index in self._candidates(scores[: n - _NEIGHBOURS]):
            out += self._verified(index, found, keyframe.camera, own)
            yield
        loop = self._unambiguous(out)
        if loop is not None and self._plausible(loop, n):
            self._consider(loop, n)

    def _candidates(self, scores: Float64) -> list[int]:
        """Numbers of the places that resemble the view, the best first."""
        if not len(scores):
            return []
        least, left, out = _ALIKE * np.median(scores), scores.copy(), []
        for _ in range(_CANDIDATES):
            best = int(np.argmax(left))
            if left[best] <= (least if len(scores) > 2 * _NEIGHBOURS else 0.0):
                break
            out.append(best)
            left[max(0, best - _APART) : best + _APART + 1] = 0.0
        return out

    def _verified(self, index: int, found: Features, camera: Camera, own: Place | None) -> list[Recognised]:
        """The view as the keyframes round ``index`` see it: one result or none."""
        around = self._around(index)
        seen: Sighting | None = sight([self.places[i] for i in around], self.S[around], found, camera)
        unit = 1.0 if own is None or seen is None else seen.unit(own)
        if seen is None or unit is None:
            return []
        sigma = np.r_[seen.sigma, _LOOP_STRETCH]
        return [Recognised(index, sim3.similarity(seen.T, unit), sigma, seen.inliers)]

    def _around(self, index: int) -> list[int]:
        return [i for i in (index - 1, index, index + 1) if 0 <= i < len(self.places)]

    def points_near(self, index: int) -> list[Float64]:
        """Points [K, 3] in the map of keyframe number ``index`` and its neighbours."""
        return [se3.transform(self.S[i], self.places[i].points.astype(np.float64)) for i in self._around(index)]

    def _unambiguous(self, found: list[Recognised]) -> Recognised | None:
        """The best of some results, unless another contradicts it: then two places look alike."""
        if not found:
            return None
        best = max(found, key=lambda r: r.inliers)
        depth = self.places[best.index].depth
        return best if all(self.agree(best.S, other.S, depth) for other in found) else None

    def _plausible(self, loop: Recognised, n: int) -> bool:
        """A loop needs many corners, and may only ask for as much drift as the way since then explains."""
        if loop.inliers < _LOOP_INLIERS:
            return False
        r, _ = sim3.coordinates(sim3.inverse(self.S[n]) @ loop.S)
        way = self._walked[n] - self._walked[loop.index]
        most = _PLAUSIBLE[self.scale] * way + 0.1 * self.places[n].depth
        return bool(np.linalg.norm(r[:3]) < most and np.linalg.norm(r[3:6]) < _TURN and np.abs(r[6]) < _STRETCH)

    def _consider(self, loop: Recognised, n: int) -> None:
        """Take a loop that tells something new, once enough keyframes in a row agree on it."""
        r, _ = sim3.coordinates(sim3.inverse(loop.S) @ self.S[n])
        if np.abs(r / loop.sigma).max() < _NEWS:
            self._hints = []
            return
        if self._hints:
            last, at = self._hints[-1]
            expected = last.S @ sim3.inverse(self.S[at]) @ self.S[n]
            depth = self.places[n].depth * float(sim3.scale_of(loop.S))
            if n - at > _WITHIN or not self.agree(expected, loop.S, depth):
                self._hints = []
        self._hints.append((loop, n))
        if len(self._hints) >= _SIGHTINGS:
            for seen, at in self._hints:
                self._tie(seen.index, at, seen.S, seen.sigma, loop=True)
            self._news, self._hints = True, []

    # ---- the graph

    def _tie(self, i: int, j: int, S_j: Float64, sigma: Float64, *, loop: bool) -> None:
        self.edges.append((i, j, sim3.inverse(self.S[i]) @ S_j, sigma, loop))

    def _graph(self) -> Edges:
        i, j, Z, sigma, loop = (list(part) for part in zip(*self.edges, strict=True))
        return Edges(np.array(i), np.array(j), np.array(Z), np.array(sigma), np.array(loop, dtype=bool))

    def restore(
        self,
        stamps: list[int],
        S: Float64,
        measured: list[bool],
        places: list[Place],
        edges: list[tuple[int, int, Float64, Float64, bool]],
    ) -> None:
        """Take over the content of a map that was saved."""
        self.stamps, self.S, self.measured, self.places, self.edges = stamps, S, measured, places, edges
        steps = np.linalg.norm(np.diff(S[:, :3, 3], axis=0), axis=1)
        self._walked = np.r_[0.0, np.cumsum(steps)].tolist() if len(stamps) else []
        self._came = (S[-1, :3, 3], self._walked[-1]) if len(stamps) else None
        for place in places:
            self._index.add(place.descriptors)

    def poses(self) -> dict[int, Float64]:
        """T_map_camera of every keyframe, by stamp."""
        return dict(zip(self.stamps, sim3.rigid(self.S), strict=True)) if self.stamps else {}


def _describe(keyframe: Keyframe) -> tuple[Features, Place]:
    found = features(keyframe.image)
    return found, place_of_keyframe(keyframe, found)


def _odometry_sigma(keyframe: Keyframe) -> Float64:
    """Deviations [7] of the pose of a keyframe relative to the one before: a displacement of its landmarks in px."""
    cloud, turn = keyframe.landmarks, _ODOMETRY_PX / keyframe.camera.fx
    depth = 1.0 if cloud is None or not len(cloud) else float(np.median(cloud.points[:, 2]))
    return np.array([*[turn * depth] * 3, *[turn] * 3, _ODOMETRY_STRETCH])


def _same_view(keyframe: Keyframe, T_other_own: Float64, config: TrackingConfig) -> bool:
    """Whether the landmarks of a keyframe lie in view of another one, and hardly elsewhere in its image."""
    cloud, camera = keyframe.landmarks, keyframe.camera
    assert cloud is not None
    X = cloud.points.astype(np.float64)
    uv, z = camera.project(se3.transform(T_other_own, X))
    seen = camera.sees(uv, z)
    flow = np.linalg.norm(uv - camera.project(X)[0], axis=1)[seen]
    return bool(seen.mean() >= config.keyframe_overlap and flow.mean() <= config.keyframe_flow * camera.width)
