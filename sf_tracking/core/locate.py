"""The pose of one image against the patches of the window: search, alignment, robust pose."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sf_interfaces.geometry import se3
from sf_interfaces.types import Camera, Float64
from sf_tracking.config import TrackingConfig
from sf_tracking.core.keyframes import Reprojection, TrackedKeyframe, reproject
from sf_tracking.core.patches import Patches
from sf_tracking.core.pose import Solution, solve_pose
from sf_tracking.core.search import consensus
from sf_tracking.core.update import UpdateOperator, View, search

_SEARCH_SIGMA = 0.5  # px, of a position found by the search over levels
_SEARCHED = 200  # patches searched over levels to find the motion
_WIDE_SCALES = (20.0, 5.0)  # robust scales of a first guess: right edges must not be rejected far from the truth
_AGREEING = 0.4  # share of searched patches that must agree before the search counts as done
_MOST = 0.5  # share of them that must agree on a pose far from the predicted one
_CERTAIN = (0.6, 0.8)  # shares of patches found, and of those agreeing, that make a second alignment needless
_LIKELY = (0.5, 0.6)  # the same that make a search needless
_MOTION = np.diag([0.03**-2] * 3 + [0.02**-2] * 3)  # information of a predicted pose, m and rad
_HONEST, _PLENTY = 1.5, 80  # excess of errors and number of patches, from which patches alone are trusted
_FAR = 1e-6  # inverse depth, 1/m, below which a point counts as that far


class Placed(Protocol):
    """Patches at a known place: a keyframe, or what remains of one."""

    @property
    def camera(self) -> Camera: ...
    @property
    def patches(self) -> Patches: ...
    @property
    def T_cw(self) -> Float64: ...


@dataclass(frozen=True, slots=True)
class Sights:
    """Patches of the window seen in one image."""

    keyframe: NDArray[np.int64]  # [E] index of the keyframe in the window
    patch: NDArray[np.int64]  # [E] index of the patch in the keyframe
    uv: Float64  # [E, 2] px
    information: Float64  # [E, 2, 2] 1/px^2, of the alignment alone
    J_w: Float64  # [E, 2] d(uv)/d(inverse depth)

    def __len__(self) -> int:
        return len(self.keyframe)


@dataclass(frozen=True, slots=True)
class Location:
    """The pose of an image and the sights that it rests on."""

    T_cw: Float64
    information: Float64  # [6, 6] of exp(xi) T_cw
    excess: float  # of squared errors over what alignment claims
    sights: Sights
    inliers: int
    support: float  # patches that agree within what alignment claims
    found: float  # share of the patches looked for that were found
    overlap: float  # share of the newest keyframe's patches that are in view and were found

    @property
    def doubtful(self) -> bool:
        """Patches err more than they claim, or are few: measured depth has something to add."""
        return self.excess > _HONEST or self.inliers < _PLENTY

    def seen_from(self, T: Float64) -> Float64:
        """The information [6, 6] of the pose as one of exp(xi) T, with T = T_other_this."""
        back = np.linalg.inv(se3.adjoint(T))
        return np.asarray(back.T @ self.information @ back)

    def distance(self, T: Float64, moved: Float64) -> float:
        """Standard deviations between this pose, as T = T_other_this, and another opinion of it."""
        xi = se3.log(moved @ se3.inverse(T))
        return float(np.sqrt(xi @ self.seen_from(T) @ xi / len(xi)))

    def passes(self, shares: tuple[float, float]) -> bool:
        """Whether more than these shares of the patches were found, and of those agree."""
        return self.found > shares[0] and self.inliers > shares[1] * len(self.sights)


def blind_location(T_cw: Float64) -> Location:
    """A pose that only the motion model vouches for, within centimetres and a degree."""
    return Location(T_cw, _MOTION, 1.0, join([]), 0, 0.0, 0.0, 0.0)


def align_sights(
    operator: UpdateOperator,
    target: View,
    index: int,
    keyframe: TrackedKeyframe,
    at: Reprojection,
    take: NDArray[np.int64],
) -> Sights:
    """Sights of the patches ``take`` of one keyframe, corrected from their reprojections."""
    update = operator(keyframe.described.take(take), target, at.uv[take], at.warp[take])
    ok = update.valid
    found = take[ok]
    return Sights(np.full(len(found), index), found, update.target[ok], update.information[ok], at.J_w[found])


def join(parts: Sequence[Sights]) -> Sights:
    """All sights of several keyframes."""
    none = Sights(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros((0, 2)))
    parts = parts or [none]
    return Sights(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(Sights)))


class Locator:
    """Finds the pose of an image against the keyframes of the window."""

    def __init__(self, config: TrackingConfig, operator: UpdateOperator) -> None:
        self._config = config
        self._operator = operator

    def __call__(
        self, window: Sequence[TrackedKeyframe], view: View, predicted: Float64, *, wide: bool
    ) -> Location | None:
        """Pose near ``predicted`` T_cw, or None when too few patches agree on one.

        A smooth motion is predicted well enough to align at once; else the search over levels comes first.
        """
        near = None if wide else self.align(window, view, predicted)
        if near is not None and not near.passes(_CERTAIN):
            # Nearer to the truth more patches lie within the reach of alignment.
            again = self.align(window, view, near.T_cw)
            near = again if again is not None and again.support > near.support else near
        if near is not None and near.passes(_LIKELY):
            return near
        T_cw = self._search(window, view, predicted, wide)
        searched = None if T_cw is None else self.align(window, view, T_cw)
        # Where much of the image moves on its own, the search may follow it; most patches decide.
        return max((f for f in (near, searched) if f is not None), key=lambda f: f.support, default=None)

    def _search(self, window: Sequence[TrackedKeyframe], view: View, predicted: Float64, wide: bool) -> Float64 | None:
        """A first pose from the newest keyframes' patches, found over the levels of the pyramid."""
        parts, tried = [], 0
        for index in range(len(window) - 1, max(-1, len(window) - (4 if wide else 2)), -1):
            keyframe = window[index]
            at = reproject(keyframe, predicted)
            take = _thin(np.flatnonzero(at.visible | wide), _SEARCHED)
            start = np.where(np.isfinite(at.uv[take]), at.uv[take], keyframe.patches.uv[take])
            uv, ok = search(self._config, keyframe.view, keyframe.patches.uv[take], view, start, wide=wide)
            tried += len(take)
            sigma = np.broadcast_to(np.eye(2) / _SEARCH_SIGMA**2, (int(ok.sum()), 2, 2))
            parts.append(Sights(np.full(int(ok.sum()), index), take[ok], uv[ok], sigma, at.J_w[take[ok]]))
            if len(parts[-1]) > 0.5 * _SEARCHED:
                break
        sights = join(parts)
        solved = self._pose(window, sights, predicted, (*_WIDE_SCALES, self._config.robust_sigmas))
        if self._agreeing(solved) < _CERTAIN[1] * len(sights):
            solved = self._outvoted(window, sights, solved)
        agreeing = self._agreeing(solved)
        enough = agreeing >= self._config.min_inliers and agreeing > _AGREEING * len(sights)
        return solved.T_cw if enough else None

    def _outvoted(self, window: Sequence[TrackedKeyframe], sights: Sights, solved: Solution) -> Solution:
        """The pose that most sights vote for, where another than the one near the prediction has that many.

        Bars and tiles are found one period off, and sights that err alike draw the pose away from the prediction.
        """
        X, w = _placed(window, sights)
        T_cw = consensus(X / np.maximum(w, _FAR)[:, None], sights.uv, window[-1].camera, self._config)
        if T_cw is None:
            return solved
        voted = self._pose(window, sights, T_cw, (self._config.robust_sigmas,))
        most = self._agreeing(voted) > max(_MOST * len(sights), self._agreeing(solved))
        return voted if most else solved

    def _agreeing(self, solved: Solution) -> int:
        return int((solved.error < 2 * self._config.inlier_px).sum())

    def align(
        self, window: Sequence[TrackedKeyframe], view: View, T_cw: Float64, *, thorough: bool = False
    ) -> Location | None:
        """Pose from aligned patches of all keyframes, from a start T_cw within about a pixel.

        ``thorough`` aligns twice as many patches as ``config.edges``, for an image that becomes a keyframe.
        """
        ats = [reproject(keyframe, T_cw) for keyframe in window]
        owner = np.concatenate([np.full(int(at.visible.sum()), i) for i, at in enumerate(ats)])
        patch = np.concatenate([np.flatnonzero(at.visible) for at in ats])
        chosen = _thin(np.arange(len(owner)), self._config.edges * (2 if thorough else 1))
        owner, patch = owner[chosen], patch[chosen]
        parts = []
        for index, (keyframe, at) in enumerate(zip(window, ats, strict=True)):
            take = patch[owner == index]
            parts.append(align_sights(self._operator, view, index, keyframe, at, take))
        sights = join(parts)
        scale = self._config.robust_sigmas
        solved = self._pose(window, sights, T_cw, (3 * scale, scale, scale))
        inliers = int((solved.error < self._config.inlier_px).sum())
        if inliers < self._config.min_inliers or inliers < 0.3 * len(sights):
            return None
        newest = len(window) - 1
        share = float((sights.keyframe == newest).sum()) / max(1, int((owner == newest).sum()))
        overlap = share * float(ats[-1].visible.mean())
        sights = replace(sights, information=sights.information / solved.excess)
        return Location(
            solved.T_cw,
            solved.information,
            solved.excess,
            sights,
            inliers,
            solved.support,
            len(sights) / max(1, len(owner)),
            overlap,
        )

    def again(self, keyframes: Sequence[Placed], sights: Sights, T_cw: Float64) -> Float64 | None:
        """Pose T_cw near a known one from sights of keyframes that have moved since; None where too few agree."""
        solved = self._pose(keyframes, sights, T_cw, (3 * self._config.robust_sigmas, self._config.robust_sigmas))
        enough = int((solved.error < self._config.inlier_px).sum()) >= self._config.min_inliers
        return solved.T_cw if enough else None

    def _pose(self, window: Sequence[Placed], sights: Sights, T_cw: Float64, scales: Sequence[float]) -> Solution:
        """Pose from sights whose information counts the uncertain depth of their patches."""
        X, w = _placed(window, sights)
        sigma = np.zeros(len(sights))
        for index, keyframe in enumerate(window):
            mine = sights.keyframe == index
            sigma[mine] = keyframe.patches.sigma[sights.patch[mine]]
        information = _less_sure(sights.information, sights.J_w * sigma[:, None])
        return solve_pose(window[-1].camera, T_cw, X, w, sights.uv, information, scales)


def _less_sure(information: Float64, along: Float64) -> Float64:
    """Information [E, 2, 2] of positions that err by ``along`` [E, 2] px in addition: (I^-1 + a a^T)^-1."""
    Ia = (information @ along[:, :, None])[:, :, 0]
    return np.asarray(information - Ia[:, :, None] * Ia[:, None] / (1.0 + (along * Ia).sum(axis=1))[:, None, None])


def _placed(window: Sequence[Placed], sights: Sights) -> tuple[Float64, Float64]:
    """Scaled points [E, 3] of sights, world position times inverse depth, and those inverse depths [E]."""
    X, w = np.zeros((len(sights), 3)), np.zeros(len(sights))
    for index, keyframe in enumerate(window):
        mine = np.flatnonzero(sights.keyframe == index)
        take = sights.patch[mine]
        T_wc = se3.inverse(keyframe.T_cw)
        rays = keyframe.patches.rays(keyframe.camera)[take]
        w[mine] = keyframe.patches.w[take]
        X[mine] = rays @ T_wc[:3, :2].T + T_wc[:3, 2] + w[mine, None] * T_wc[:3, 3]
    return X, w


def _thin(index: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """At most ``count`` of ``index``, evenly."""
    if len(index) <= count:
        return index
    return index[np.linspace(0, len(index) - 1, count).astype(np.int64)]
