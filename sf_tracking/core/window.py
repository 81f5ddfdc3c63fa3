"""The window of keyframes: the patch graph, its bundle adjustment, and keyframes that become final."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from sf_interfaces.geometry import se3
from sf_interfaces.types import Camera, Float64, Frame
from sf_tracking.config import TrackingConfig
from sf_tracking.core.bundle import Problem, adjust, information_root
from sf_tracking.core.keyframes import TrackedKeyframe, reproject
from sf_tracking.core.locate import Location, align_sights
from sf_tracking.core.patches import Measured, Patches, extract
from sf_tracking.core.shape import fit, shape_of
from sf_tracking.core.update import UpdateOperator, View, search

_GUESS = 0.5  # relative deviation of an inverse depth that is only expected from its neighbours
_NEIGHBOURS = 5  # known patches whose median a new patch without depth starts from
_KNOWN = 0.3  # relative deviation up to which a patch counts as known
_RANGE = (1e-3, 50.0)  # of the median inverse depth, within which refined ones are kept


class Window:
    """Keyframes under optimisation, oldest first, and who of them sees the patches of whom."""

    def __init__(self, config: TrackingConfig, operator: UpdateOperator) -> None:
        self._config = config
        self._operator = operator
        self.keyframes: list[TrackedKeyframe] = []

    def __len__(self) -> int:
        return len(self.keyframes)

    @property
    def full(self) -> bool:
        """One more keyframe than is optimised: the oldest is final."""
        return len(self.keyframes) > self._config.window

    def make(self, frame: Frame, view: View, T_cw: Float64) -> TrackedKeyframe | None:
        """A keyframe of ``frame`` with new patches, or None where too few places are worth one."""
        uv, found = extract(frame, view.gray, self._config)
        if len(uv) < self._config.min_inliers:
            return None
        camera = frame.camera
        assert camera is not None
        patches = self._patches(camera, T_cw, uv, found)
        shape = shape_of(frame, self._config) if self._config.shape_trust else None
        return TrackedKeyframe(frame, view, patches, self._operator.describe(view, uv), T_cw, shape=shape)

    def _patches(self, camera: Camera, T_cw: Float64, uv: Float64, found: Measured) -> Patches:
        """Patches that start at their measured depth, or at what their neighbours let expect."""
        measured = np.isfinite(found.w)
        expected = self._expected(T_cw, uv) if not measured.all() else np.ones(len(uv))
        w = np.where(measured, found.w, expected)
        sigma = np.where(measured, found.sigma, _GUESS * expected)
        return Patches(uv, found.slope, w, sigma, w.copy(), sigma.copy(), measured)

    def _expected(self, T_cw: Float64, uv: Float64) -> Float64:
        """Median inverse depth of the known patches nearest to each place; 1 where nothing is known."""
        spots, depths = [], []
        for keyframe in self.keyframes:
            at = reproject(keyframe, T_cw)
            known = at.visible & (keyframe.patches.sigma < _KNOWN * keyframe.patches.w)
            spots.append(at.uv[known])
            depths.append(at.w[known])
        place = np.concatenate(spots) if spots else np.zeros((0, 2))
        if len(place) < _NEIGHBOURS:
            return np.ones(len(uv))
        near = cKDTree(place).query(uv, k=_NEIGHBOURS)[1]
        return np.asarray(np.median(np.concatenate(depths)[near], axis=1))

    def add(self, keyframe: TrackedKeyframe, found: Location) -> None:
        """Append a keyframe in which the window's patches were seen, and look for its patches in the window."""
        stamp, sights = keyframe.frame.stamp_ns, found.sights
        for index, source in enumerate(self.keyframes):
            mine = sights.keyframe == index
            _remember(source, stamp, sights.patch[mine], sights.uv[mine], sights.information[mine])
        for target in self.keyframes:
            self._observe(keyframe, target, found.excess)
        for target in self.keyframes[-self._config.shape_keyframes :]:
            if keyframe.shape is not None and target.shape is not None:
                T = target.T_cw @ se3.inverse(keyframe.T_cw)
                c = self._config
                found = fit(keyframe.camera, keyframe.shape, target.shape, T, np.eye(6), c.shape_trust)
                if found is not None:
                    keyframe.moved[target.frame.stamp_ns] = found
        self.keyframes.append(keyframe)

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

    def optimise(self, fixed: int = 2, iterations: int | None = None) -> None:
        """Bundle adjustment of the window; the ``fixed`` oldest keyframes hold the gauge."""
        keyframes = self.keyframes
        problem = self._problem()
        free = np.arange(len(keyframes)) >= min(fixed, len(keyframes) - 1)
        c = self._config
        solved, information = adjust(
            keyframes[0].camera, problem, free, c.robust_sigmas, iterations or c.bundle_iterations
        )
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
