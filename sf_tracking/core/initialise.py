"""Begins the map: at the first frame with depth, or without depth once two frames show enough parallax."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from sf_interfaces.geometry import se3
from sf_interfaces.types import Camera, Float64, Frame, Scale
from sf_tracking.config import TrackingConfig
from sf_tracking.core.bundle import project
from sf_tracking.core.keyframes import TrackedKeyframe, reproject
from sf_tracking.core.locate import Locator, Sights
from sf_tracking.core.update import UpdateOperator, View, search
from sf_tracking.core.window import Window

_RANSAC_PX = 0.5
_GOOD_PX = 1.0  # reprojection error of a patch that two views explain
_TRACK_SHARE = 0.4  # of the reference's patches that must still be followed, or another reference is taken
_SUPPORT = 0.75  # share of followed patches that two views must explain
_RIVAL = 0.95  # support of another motion relative to the best, from which the choice is open
_SAME = 0.2  # difference of two motions that count as one, rad and parts of the translation
_ITERATIONS = 30  # of the first bundle adjustment, far from its solution
_REMEMBERED = 300  # frames before the map that get a pose when it begins
_VIEWS = 40  # of the latest of them whose image is kept until then


@dataclass(slots=True)
class _Seen:
    """A frame between the reference and the map to be."""

    stamp_ns: int
    sights: Sights  # of the reference's patches
    view: View | None  # of the latest frames


@dataclass(slots=True)
class _Reference:
    """The first view of a map to be, and where its patches went since."""

    keyframe: TrackedKeyframe
    uv: Float64  # [M, 2] px, where each patch was last seen
    alive: NDArray[np.bool_]  # [M]
    frames: list[_Seen] = field(default_factory=list)  # since

    def remember(self, seen: _Seen) -> None:
        """Take a frame; of older ones the image is forgotten, the oldest ones are."""
        self.frames = [*self.frames, seen][-_REMEMBERED:]
        for old in self.frames[:-_VIEWS]:
            old.view = None


@dataclass(frozen=True, slots=True)
class TwoViews:
    """A motion between two views and what it says about the patches of the first."""

    T: Float64  # [4, 4] T_second_first, translation of length 1
    w: Float64  # [M] inverse depths in the first view, per length of the translation
    good: NDArray[np.bool_]  # [M] in front of both cameras and reprojected within two pixels


class Initialiser:
    """Fills the empty window with the keyframes that begin the map."""

    def __init__(self, config: TrackingConfig, operator: UpdateOperator, window: Window, locate: Locator) -> None:
        self._config = config
        self._operator = operator
        self._window = window
        self._locate = locate
        self._reference: _Reference | None = None
        self.scale = Scale.METRIC

    def __call__(self, frame: Frame, view: View) -> list[tuple[int, Float64, Sights]]:
        """Take one frame; when the map begins, the window is filled.

        Returns:
            Then, of the frames since the first keyframe, stamps, poses T_cw and what they saw of it.
        """
        if frame.measured:
            keyframe = self._window.make(frame, view, np.eye(4))
            if keyframe is not None and int(keyframe.patches.measured.sum()) >= self._config.min_inliers:
                self.scale = Scale.METRIC
                self._reference = None
                self._window.keyframes.append(keyframe)
                return []
        self.scale = Scale.ARBITRARY
        reference = self._reference
        sights = None if reference is None else self._follow(reference, view)
        if reference is None or sights is None:
            fresh = self._window.make(frame, view, np.eye(4))
            self._reference = None
            if fresh is not None:
                self._reference = _Reference(fresh, fresh.patches.uv, np.ones(len(fresh.patches), dtype=bool))
            return []
        camera = reference.keyframe.camera
        uv, alive = reference.keyframe.patches.uv, reference.alive
        pair = two_views(camera, uv, reference.uv, alive, self._config)
        begun = [] if pair is None else self._begin(reference, frame, view, pair)
        if not len(self._window):
            reference.remember(_Seen(frame.stamp_ns, sights, view))
        return begun

    def _follow(self, reference: _Reference, view: View) -> Sights | None:
        """Follow the reference's patches into the next view: where they are; None when too few are left."""
        first = reference.keyframe
        uv, ok = search(self._config, first.view, first.patches.uv, view, reference.uv, wide=False)
        reference.alive = reference.alive & ok
        reference.uv = np.where(reference.alive[:, None], uv, reference.uv)
        take = np.flatnonzero(reference.alive)
        if len(take) <= _TRACK_SHARE * len(first.patches):
            return None
        warp = np.broadcast_to(np.eye(2), (len(take), 2, 2))
        update = self._operator(first.described.take(take), view, reference.uv[take], warp)
        ok = update.valid & (np.linalg.norm(update.target - reference.uv[take], axis=1) < _RANSAC_PX)
        take, target = take[ok], update.target[ok]
        reference.uv[take] = target
        return Sights(np.zeros(len(take), np.int64), take, target, update.information[ok], np.zeros((len(take), 2)))

    def _begin(
        self, reference: _Reference, frame: Frame, view: View, pair: TwoViews
    ) -> list[tuple[int, Float64, Sights]]:
        """Two keyframes with refined motion and depth, scaled to a median depth of 1."""
        window, first = self._window, reference.keyframe
        unit = float(np.median(pair.w[pair.good]))
        T = pair.T.copy()
        T[:3, 3] *= unit
        _set_depth(first, np.where(pair.good, pair.w / unit, 1.0))
        window.keyframes.append(first)
        found = self._locate.align(window.keyframes, view, T, thorough=True)
        second = None if found is None else window.make(frame, view, found.T_cw)
        if found is None or second is None:
            window.keyframes.clear()
            return []
        window.add(second, found, fixed=1, iterations=_ITERATIONS)
        window.complete()
        window.rescale(float(np.median(first.patches.w)))
        self._reference = None
        step = se3.log(second.T_cw) / (len(reference.frames) + 1)
        poses = (self._pose(seen, se3.exp(i * step)) for i, seen in enumerate(reference.frames, start=1))
        return [pose for pose in poses if pose is not None]

    def _pose(self, seen: _Seen, T_cw: Float64) -> tuple[int, Float64, Sights] | None:
        """A frame from before the map began, from where it saw the first keyframe's patches; ``T_cw`` is a guess."""
        keyframes = self._window.keyframes
        sights = replace(seen.sights, J_w=reproject(keyframes[0], T_cw).J_w[seen.sights.patch])
        rough = self._locate.again(keyframes[:1], sights, T_cw)
        found = (
            None if seen.view is None else self._locate.align(keyframes, seen.view, T_cw if rough is None else rough)
        )
        if found is not None:
            return seen.stamp_ns, found.T_cw, found.sights
        return None if rough is None else (seen.stamp_ns, rough, sights)


def _set_depth(keyframe: TrackedKeyframe, w: Float64) -> None:
    patches = keyframe.patches
    patches.w, patches.prior = w.copy(), w.copy()
    patches.sigma = patches.prior_sigma = 0.5 * w


def two_views(
    camera: Camera, uv0: Float64, uv1: Float64, alive: NDArray[np.bool_], config: TrackingConfig
) -> TwoViews | None:
    """Motion between two views [M, 2] px from essential matrix and homography; None while it is ambiguous.

    A general scene determines the essential matrix, a plane the homography; the motion that explains more
    patches in front of both cameras wins. Without parallax, under pure rotation, neither is asked.
    """
    x0, x1 = (_normalised(camera, uv) for uv in (uv0, uv1))
    if alive.sum() < config.min_inliers or _parallax(camera, x0[alive], x1[alive]) < config.parallax * camera.width:
        return None
    cv2.setRNGSeed(config.seed)
    motions = []
    E, _ = cv2.findEssentialMat(uv0[alive], uv1[alive], camera.K, cv2.RANSAC, 0.999, _RANSAC_PX)
    if E is not None and E.shape == (3, 3):
        R1, R2, t = cv2.decomposeEssentialMat(E)
        motions += [(R, s * t.ravel()) for R in (R1, R2) for s in (1.0, -1.0)]
    H, _ = cv2.findHomography(uv0[alive], uv1[alive], cv2.RANSAC, 2 * _RANSAC_PX)
    if H is not None:
        _, Rs, ts, _ = cv2.decomposeHomographyMat(H, camera.K)
        motions += [(R, t.ravel() / n) for R, t in zip(Rs, ts) if (n := float(np.linalg.norm(t))) > 1e-6]
    views = [_support(camera, R, t, x0, x1, uv1, alive) for R, t in motions]
    ranked = sorted(views, key=lambda v: -int(v.good.sum()))
    if not ranked or ranked[0].good.sum() < max(config.min_inliers, _SUPPORT * alive.sum()):
        return None
    best = ranked[0]
    rivals = [v for v in ranked[1:] if v.good.sum() > _RIVAL * best.good.sum()]
    if any(np.abs(se3.log(se3.inverse(best.T) @ v.T)).max() > _SAME for v in rivals):
        return None
    return best


def _normalised(camera: Camera, uv: Float64) -> Float64:
    """Rays (x, y, 1) [M, 3]."""
    return camera.unproject(uv, np.ones(len(uv)))


def _parallax(camera: Camera, x0: Float64, x1: Float64) -> float:
    """Median flow, px, that the best rotation leaves."""
    a, b = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in (x0, x1))
    U, _, Vt = np.linalg.svd(b.T @ a)
    R = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    turned = x0 @ R.T
    return float(np.median(np.linalg.norm(turned[:, :2] / turned[:, 2:] - x1[:, :2], axis=1))) * camera.fx


def _support(
    camera: Camera, R: Float64, t: Float64, x0: Float64, x1: Float64, uv1: Float64, alive: NDArray[np.bool_]
) -> TwoViews:
    """Inverse depths by linear triangulation, and which patches the motion (R, t) explains."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    a, b = np.cross(x0 @ R.T, x1), np.cross(t, x1)
    w = -(a * b).sum(axis=1) / np.maximum((b * b).sum(axis=1), 1e-12)
    uv, _ = project(camera, T, x0[:, :2], w)
    with np.errstate(invalid="ignore"):
        good = alive & (w > 0) & (np.linalg.norm(uv - uv1, axis=1) < _GOOD_PX)
    return TwoViews(T, w, good)
