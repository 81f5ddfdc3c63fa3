"""The window of keyframes: the patch graph, its bundle adjustment, and keyframes that become final."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sf_interfaces.geometry import se3
from sf_interfaces.types import Camera, Float64, Frame
from sf_tracking.config import TrackingConfig
from sf_tracking.core.beside import beside
from sf_tracking.core.bundle import Problem, adjusting, information_root
from sf_tracking.core.keyframes import TrackedKeyframe, reproject
from sf_tracking.core.locate import Location, align_sights
from sf_tracking.core.patches import Measured, Patches, extract
from sf_tracking.core.relief import known_points, surface_at
from sf_tracking.core.shape import ShapeFit, fit
from sf_tracking.core.update import UpdateOperator, View, search

_GUESS = 0.5  # relative deviation of an inverse depth that is only expected from its neighbours
_AT_ONCE = 2  # keyframes in which a new one's patches are looked for per part of the work
_CONTRADICTION = 10.0  # standard deviations between patches and surfaces, beyond which the surfaces do not count
_DONE = object()
_RANGE = (1e-3, 50.0)  # of the median inverse depth, within which refined ones are kept


class Window:
    """Keyframes under optimisation, oldest first, and who of them sees the patches of whom."""

    def __init__(self, config: TrackingConfig, operator: UpdateOperator) -> None:
        self._config = config
        self._operator = operator
        self.keyframes: list[TrackedKeyframe] = []
        self._parts: Iterator[None] = iter(())
        self._idle = True
        self._calls = 0  # of work() since the newest keyframe
        self._pace = 1  # parts per call

    def __len__(self) -> int:
        return len(self.keyframes)

    @property
    def full(self) -> bool:
        """One more keyframe than is optimised: the oldest is final."""
        return len(self.keyframes) > self._config.window

    @property
    def settled(self) -> TrackedKeyframe:
        """The newest keyframe whose work is done: its pose hardly moves any more."""
        return self.keyframes[-1 if self._idle or len(self.keyframes) < 2 else -2]

    def make(self, frame: Frame, view: View, T_cw: Float64) -> TrackedKeyframe | None:
        """A keyframe of ``frame`` with new patches, or None where too few places are worth one."""
        uv, found = extract(frame, view.gray, self._config)
        if len(uv) < self._config.min_inliers:
            return None
        camera = frame.camera
        assert camera is not None
        patches = self._patches(camera, T_cw, uv, found)
        return TrackedKeyframe(frame, view, patches, self._operator.describe(view, uv), T_cw)

    def _patches(self, camera: Camera, T_cw: Float64, uv: Float64, found: Measured) -> Patches:
        """Patches that start at their measured depth, or at what those around them let expect."""
        measured = np.isfinite(found.w)
        w, sigma, slope = found.w.copy(), found.sigma.copy(), found.slope.copy()
        if not measured.all():
            expected, tilt = surface_at(uv[~measured], *known_points(self.keyframes, T_cw))
            w[~measured], sigma[~measured], slope[~measured] = expected, _GUESS * expected, tilt
        return Patches(uv, slope, w, sigma, w.copy(), sigma.copy(), measured)

    def _tilt(self) -> None:
        """Slopes of patches in keyframes without measured depth, from what is known around them by now."""
        for keyframe in self.keyframes:
            patches = keyframe.patches
            if not patches.measured.any():
                patches.slope = surface_at(patches.uv, *known_points(self.keyframes, keyframe.T_cw))[1]

    def add(self, keyframe: TrackedKeyframe, found: Location, fixed: int = 2, iterations: int | None = None) -> None:
        """Append a keyframe in which the window's patches were seen; the rest of its work is done in parts.

        Args:
            fixed: how many of the oldest keyframes hold the gauge in the bundle adjustment to come.
            iterations: of that adjustment; None: as configured.
        """
        self.complete()
        stamp, sights = keyframe.frame.stamp_ns, found.sights
        for index, source in enumerate(self.keyframes):
            mine = sights.keyframe == index
            _remember(source, stamp, sights.patch[mine], sights.uv[mine], sights.information[mine])
        self.keyframes.append(keyframe)
        steps = iterations or self._config.bundle_iterations
        parts = -(-(len(self.keyframes) - 1) // _AT_ONCE) + steps
        # As many frames as lay between the last two keyframes lie before the next, which has work enough of its own.
        self._pace, self._calls = -(-parts // max(1, self._calls - 1)), 0
        self._idle = False
        self._parts = self._integrate(keyframe, found, fixed, steps)
        next(self._parts)  # surfaces are aligned beside all that follows

    def work(self) -> bool:
        """Do the next parts of a new keyframe's work; True when nothing is left.

        The parts go evenly to the frames that follow a keyframe, so that none takes much longer than another.
        """
        self._calls += 1
        for _ in range(self._pace):
            self._idle = next(self._parts, _DONE) is _DONE
        return self._idle

    def complete(self) -> None:
        """Do all that is left."""
        for _ in self._parts:
            pass
        self._idle = True

    def _integrate(self, keyframe: TrackedKeyframe, found: Location, fixed: int, iterations: int) -> Iterator[None]:
        """Look for the patches of a new keyframe in the window, align its surface, adjust the bundle."""
        others = self.keyframes[:-1]
        near = (
            others[-self._config.shape_keyframes :] if self._config.shape_keyframes and self._config.shape_trust else []
        )
        aligned = [beside(_surface_motion, keyframe, other, other.T_cw, keyframe.T_cw, self._config) for other in near]
        yield
        for count, target in enumerate(reversed(others), start=1):
            self._observe(keyframe, target, found.excess)
            if count % _AT_ONCE == 0:
                yield
        for target, moved in zip(near, aligned, strict=True):
            _believe(keyframe, target, found, moved.result())
        yield from self._optimise(fixed, iterations)
        self._tilt()

    def _observe(self, source: TrackedKeyframe, target: TrackedKeyframe, excess: float) -> None:
        """Look for the patches of ``source`` in ``target``; over levels where their depth is only guessed."""
        at = reproject(source, target.T_cw)
        take = np.flatnonzero(at.visible)
        guessed = take[~source.patches.measured[take]]
        if len(guessed):
            uv, ok = search(
                self._config, source.view, source.patches.uv[guessed], target.view, at.uv[guessed], wide=False
            )
            at.uv[guessed] = uv
            take = np.sort(np.r_[take[source.patches.measured[take]], guessed[ok]])
        sights = align_sights(self._operator, target.view, 0, source, at, take)
        _remember(source, target.frame.stamp_ns, sights.patch, sights.uv, sights.information / excess)

    def _optimise(self, fixed: int, iterations: int) -> Iterator[None]:
        """Bundle adjustment of the window, step by step; the ``fixed`` oldest keyframes hold the gauge."""
        keyframes = self.keyframes
        free = np.arange(len(keyframes)) >= min(fixed, len(keyframes) - 1)
        steps = adjusting(keyframes[0].camera, self._problem(), free, self._config.robust_sigmas, iterations)
        for solved, information in steps:
            self._store(solved, information)
            yield

    def _store(self, solved: Problem, information: Float64) -> None:
        """Poses and inverse depths of an adjusted problem."""
        keyframes = self.keyframes
        known = np.concatenate([k.patches.w for k in keyframes])
        low, high = np.median(known) * _RANGE[0], np.median(known) * _RANGE[1]
        for i, keyframe in enumerate(keyframes):
            keyframe.T_cw = solved.T_cw[i]
            m = len(keyframe.patches)
            keyframe.patches.w = np.clip(solved.w[i, :m], low, high)
            keyframe.patches.sigma = 1.0 / np.sqrt(np.maximum(information[i, :m], 1e-12))

    def _problem(self) -> Problem:
        """The window as dense arrays; missing patches and sights have no information."""
        keyframes = self.keyframes
        n, m = len(keyframes), max(len(k.patches) for k in keyframes)
        index = {k.frame.stamp_ns: i for i, k in enumerate(keyframes)}
        rays, w, prior, weight = np.zeros((n, m, 2)), np.ones((n, m)), np.ones((n, m)), np.zeros((n, m))
        uv, information = np.zeros((n, n, m, 2)), np.zeros((n, n, m, 2, 2))
        for i, keyframe in enumerate(keyframes):
            patches, k = keyframe.patches, len(keyframe.patches)
            rays[i, :k], w[i, :k], prior[i, :k] = patches.rays(keyframe.camera), patches.w, patches.prior
            weight[i, :k] = patches.prior_sigma**-2.0
            for stamp, (where, how_sure) in keyframe.seen.items():
                if stamp in index:
                    uv[i, index[stamp], :k], information[i, index[stamp], :k] = where, how_sure
        motion, sure = np.broadcast_to(np.eye(4), (n, n, 4, 4)).copy(), np.zeros((n, n, 6, 6))
        for i, keyframe in enumerate(keyframes):
            for stamp, shape_fit in keyframe.moved.items():
                if stamp in index:
                    motion[i, index[stamp]], sure[i, index[stamp]] = shape_fit.T, shape_fit.information
        poses, root = np.stack([k.T_cw for k in keyframes]), information_root(information)
        return Problem(poses, rays, w, prior, weight, uv, root, motion, sure)

    def rescale(self, unit: float) -> None:
        """Multiply all lengths by ``unit``, 1/m."""
        for keyframe in self.keyframes:
            keyframe.T_cw = keyframe.T_cw.copy()
            keyframe.T_cw[:3, 3] *= unit
            patches = keyframe.patches
            for name in ("w", "sigma", "prior", "prior_sigma", "slope"):
                setattr(patches, name, getattr(patches, name) / unit)

    def retire(self) -> TrackedKeyframe:
        """The oldest keyframe leaves: its pose is final."""
        self.complete()
        oldest = self.keyframes.pop(0)
        for keyframe in self.keyframes:
            keyframe.seen.pop(oldest.frame.stamp_ns, None)
        return oldest


def _remember(source: TrackedKeyframe, stamp: int, patch: Float64, uv: Float64, information: Float64) -> None:
    """Store where patches of ``source`` were seen in the keyframe ``stamp``."""
    m = len(source.patches)
    where, how_sure = np.zeros((m, 2)), np.zeros((m, 2, 2))
    where[patch], how_sure[patch] = uv, information
    source.seen[stamp] = (where, how_sure)


def _surface_motion(
    source: TrackedKeyframe, target: TrackedKeyframe, T_target: Float64, T_source: Float64, config: TrackingConfig
) -> ShapeFit | None:
    """The relative motion of two keyframes, at T_cw now, from their measured surfaces; None where they tell none."""
    shapes = source.measured_shape(config), target.measured_shape(config)
    if shapes[0] is None or shapes[1] is None:
        return None
    return fit(source.camera, *shapes, T_target @ se3.inverse(T_source), np.eye(6), config.shape_trust)


def _believe(keyframe: TrackedKeyframe, target: TrackedKeyframe, found: Location, moved: ShapeFit | None) -> None:
    """Take the motion that surfaces tell.

    Surfaces that contradict patches which agree with each other are those of something that moves.
    """
    T = target.T_cw @ se3.inverse(keyframe.T_cw)
    if moved is not None and (found.doubtful or found.distance(T, moved.T) < _CONTRADICTION):
        keyframe.moved[target.frame.stamp_ns] = moved
