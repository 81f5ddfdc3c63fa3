"""Does depth lie on colour? The turn and the lag between a depth and a colour camera, from edges alone.

Needed are some tens of depth images with the colour image of each, and the colour images before and after it, which
tell the motion. No board, no poses, no tracker: :mod:`depth_edges` says how far each depth image is off, here that is
told apart into what is the same in all frames (a wrong rotation) and what follows the motion (a lag).

A wrong place of the camera moves near edges more than far ones, a wrong rotation moves all alike. The two are alike
where all edges are at one distance, so only a rotation is estimated; how much near edges differ from far ones after it
is measured and told.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from sf_interfaces.geometry import se3
from sf_interfaces.geometry.depth_edges import Gradients, best_shift, scores_of_shifts, seen
from sf_interfaces.geometry.edge_views import EdgeView, EdgeViews
from sf_interfaces.types import Camera, Float64

REACH = 0.05  # of the image width, the largest shift that is found
FEW_EDGES = 150  # a depth image with fewer says nothing
_CLEAR = 1.35  # clarity from which on the shift of one frame counts; without any relation it is 1.1 to 1.3
FEW_FRAMES = 10  # frames that count; with fewer nothing is said
_NOISE_PX = 0.3  # deviation of the shift of a single frame
_LOOSE_PX = 0.7  # shifts that are off the common line by more count less
_LAG_TOLD_S = 0.004  # deviation of the lag from which on the motion was too little
_JUMP_FRAMES = 0.6  # a change of the lag by less is none
_JUMP_GAIN = 8.0  # log-likelihood by which a jump explains the shifts better; chance makes up to 6
_JUMP_SIDE = 4  # frames on either side of a jump
_BORDER_PX = 8  # edges nearer to the border of the image are not looked at
_EDGES_OF_VIEW = 1000  # of each view, in the fit
_UNITS = np.array([0.005, 0.005, 0.01, 0.01])  # rad and s, first steps of the fit


@dataclass(frozen=True, slots=True)
class Jump:
    """Depth that comes later from some frame on, as after a lost depth image.

    Args:
        after_ns, before_ns: stamps of the last frame before it and of the first one behind it.
        seconds: by how much the lag grows (negative: as if a depth image was lost; positive: a colour image).
    """

    after_ns: int
    before_ns: int
    seconds: float


@dataclass(frozen=True, slots=True)
class Alignment:
    """How depth lies on colour.

    Args:
        frames, used: how many there were, and in how many the edges told where they belong.
        offset_px: (right, down), mean of the correction at the edges, in the colour image.
        off_px: mean length of it; more than the length of its mean where depth is rolled.
        rotation: [3] rad, ``T_color_depth = exp(rotation) T_given``.
        halves_px, halves_rad: how much the rotations found in the first and the second half of the frames differ.
        confirmed: what was found in either half makes the edges of the other half fit better.
        lag_s: by how much the depth is older than its stamp says; None where the camera moved too little to tell.
        halves_lag_s: how much the lags found in the halves differ.
        jump: a change of the lag, if there is one.
        score, score_corrected, score_chance: mean gradient at the edges as given, corrected, and anywhere.
        near_far_px: after the correction, offset of the nearer half of the edges less that of the farther half.
        depth_m: median depth of the edges.
        speed_px_s: median speed of the edges in the colour image.
        period_s: median time between colour images.
    """

    frames: int
    used: int
    offset_px: Float64
    off_px: float
    rotation: Float64
    halves_px: float
    halves_rad: float
    confirmed: bool
    lag_s: float | None
    halves_lag_s: float
    jump: Jump | None
    score: float
    score_corrected: float
    score_chance: float
    near_far_px: Float64
    depth_m: float
    speed_px_s: float
    period_s: float

    def corrected(self, T_color_depth: Float64) -> Float64:
        """The pose of the depth camera with the rotation that was found."""
        return np.asarray(se3.exp(np.concatenate([np.zeros(3), self.rotation])) @ T_color_depth)


def align(found: EdgeViews) -> Alignment | None:
    """How the depth of some shots lies on their colour images.

    Returns:
        None where there are too few frames whose edges tell.
    """
    views, shifts = _telling(found.views, found.camera, found.T_color_depth)
    if len(views) < FEW_FRAMES:
        return None
    camera, T = found.camera, found.T_color_depth
    flow = np.array([np.median(view.flow, axis=0) for view in views])  # [N, 2] px/s
    first = _line(shifts, flow)
    start = np.array([-first.offset[1] / camera.fy, first.offset[0] / camera.fx, 0.0, first.lag])
    everything = _Edges(views, camera, T)
    # Where much looks alike, single frames may agree on a wrong shift; all edges together judge better.
    turned = everything.fit(max(start, start * (0, 0, 0, 1), key=everything.score), first.told)
    # A jump shows when what differs over the image, a roll above all, no longer blurs the shifts.
    kept, shifts = _telling(views, camera, _turned(turned) @ T)
    jump = _jump(kept, shifts) if first.told and len(kept) >= FEW_FRAMES else None
    if jump is not None:
        views = [replace(v, ahead=v.ahead + jump.seconds) if v.stamp_ns >= jump.before_ns else v for v in views]
    return _judged(found, views, turned, first.told, jump)


def _judged(found: EdgeViews, views: list[EdgeView], start: Float64, told: bool, jump: Jump | None) -> Alignment:
    """The correction from all views, and from two halves of them how far it is to be trusted."""
    camera, T, grow = found.camera, found.T_color_depth, found.enlarged
    quarters = np.arange(len(views)) * 4 // len(views) % 2  # the halves: quarters 1 and 3, quarters 2 and 4
    halves = [_Edges([v for v, q in zip(views, quarters, strict=True) if q == half], camera, T) for half in (0, 1)]
    everything = _Edges(views, camera, T)
    best = everything.fit(start, told)
    a, b = (half.fit(best, told) for half in halves)
    gains = [half.score(p) - half.score(p * (0, 0, 0, 1)) for half, p in zip(halves, (b, a), strict=True)]
    near = everything.depth < np.median(everything.depth)
    sides = [everything.rest(best, chosen) for chosen in (near, ~near)]
    move = everything.between(best * (0, 0, 0, 1), best)
    apart = everything.between(a * (1, 1, 1, 0), b * (1, 1, 1, 0))
    return Alignment(
        frames=len(found.views),
        used=len(views),
        offset_px=grow * move.mean(axis=0),
        off_px=float(grow * np.linalg.norm(move, axis=1).mean()),
        rotation=best[:3],
        halves_px=float(grow * np.linalg.norm(apart, axis=1).mean()),
        halves_rad=float(np.linalg.norm(a[:3] - b[:3])),
        confirmed=min(gains) > 0,
        lag_s=float(best[3]) if told else None,
        halves_lag_s=float(abs(a[3] - b[3])),
        jump=jump,
        score=everything.score(np.zeros(4)),
        score_corrected=everything.score(best),
        score_chance=everything.chance(),
        near_far_px=grow * (sides[0] - sides[1]),
        depth_m=float(np.median(everything.depth)),
        speed_px_s=grow * everything.speed,
        period_s=float(np.median([view.period for view in views])),
    )


def _turned(p: Float64) -> Float64:
    return se3.exp(np.concatenate([np.zeros(3), p[:3]]))


def _radius(camera: Camera) -> int:
    return min(round(REACH * camera.width), camera.height // 4)


def _telling(views: Sequence[EdgeView], camera: Camera, T_color_depth: Float64) -> tuple[list[EdgeView], Float64]:
    """The views of which it is clear how far they are off, and these shifts, [N, 2] px."""
    kept, shifts = [], []
    for view in views:
        if len(view.edges) < FEW_EDGES:
            continue
        uv, axis = seen(view.edges, camera, T_color_depth)
        shift = best_shift(scores_of_shifts(uv + view.ahead * view.flow, axis, view.gradients, _radius(camera)))
        if shift is not None and shift.clarity > _CLEAR:
            kept.append(view)
            shifts.append(shift.px)
    return kept, np.array(shifts).reshape(-1, 2)


@dataclass(frozen=True, slots=True)
class _Line:
    """Shift of a frame = offset + lag x flow: px, s, and whether there was motion enough for the lag."""

    offset: Float64
    lag: float
    told: bool


def _line(shifts: Float64, flow: Float64) -> _Line:
    """What is the same in the shifts of all frames, and what follows the motion."""
    spread = np.sqrt(((flow - flow.mean(axis=0)) ** 2).sum())  # px/s; a steady motion is like a turn
    if _LAG_TOLD_S * spread > _NOISE_PX:
        x, _, _ = _robust(shifts, flow[..., None])
        return _Line(x[:2], float(x[2]), True)
    return _Line(_robust(shifts, np.zeros((*flow.shape, 0)))[0], 0.0, False)


def _jump(views: Sequence[EdgeView], shifts: Float64) -> Jump | None:
    """The frame from which on the lag is another, if that explains the shifts much better than one lag."""
    flow = np.array([np.median(view.flow, axis=0) for view in views])
    _, without, _ = _robust(shifts, flow[..., None])
    tried = []
    for k in range(_JUMP_SIDE, len(views) - _JUMP_SIDE + 1):
        later = np.where(np.arange(len(views))[:, None] >= k, flow, 0)
        tried.append((*_robust(shifts, np.stack([flow, later], axis=-1)), k))
    x, cost, deviation, k = min(tried, key=lambda t: t[1])
    period = float(np.median([view.period for view in views]))
    if cost > without - _JUMP_GAIN or abs(x[3]) < max(_JUMP_FRAMES * period, 4 * deviation[3]):
        return None
    return Jump(views[k - 1].stamp_ns, views[k].stamp_ns, float(x[3]))


def _robust(shifts: Float64, flows: Float64) -> tuple[Float64, float, Float64]:
    """Cauchy fit of shifts [N, 2] = offset + flows [N, 2, K] lags [K].

    Returns:
        [2 + K] offset and lags, the cost, and the deviation of each number.
    """
    count = flows.shape[-1]
    A = np.concatenate([np.tile(np.eye(2), (len(shifts), 1, 1)), flows], axis=-1).reshape(-1, 2 + count)
    b = shifts.ravel()
    weight = np.ones(len(b))
    for _ in range(20):
        x = np.linalg.lstsq(A * weight[:, None], b * weight, rcond=None)[0]
        off = b - A @ x
        weight = 1 / np.sqrt(1 + (off / _LOOSE_PX) ** 2)
    cost = float(np.log1p((off / _LOOSE_PX) ** 2).sum())
    information = (A * weight[:, None] ** 2).T @ A
    return np.asarray(x, np.float64), cost, np.asarray(_NOISE_PX * np.sqrt(np.diag(np.linalg.pinv(information))))


class _Edges:
    """The edges of several views, and how well they fit the images after a correction (rotation [3] rad, lag s)."""

    def __init__(self, views: Sequence[EdgeView], camera: Camera, T_color_depth: Float64) -> None:
        self._camera = camera
        size = np.array([camera.width, camera.height])
        points, axes, flows, ahead, images = [], [], [], [], []
        for k, view in enumerate(views):
            uv, axis = seen(view.edges, camera, T_color_depth)
            # Always the same edges: else the score would rise by moving those out of the image that fit badly.
            inside = np.flatnonzero(((uv > _BORDER_PX) & (uv < size - _BORDER_PX)).all(axis=1))
            chosen = inside[:: -(-len(inside) // _EDGES_OF_VIEW) or 1]
            points.append(view.edges.points[chosen])
            axes.append(axis[chosen])
            flows.append(view.flow[chosen])
            ahead.append(np.full((len(chosen), 1), view.ahead))
            images.append(np.full(len(chosen), k))
        self._points = se3.transform(T_color_depth, np.concatenate(points))  # [M, 3] m, colour camera as given
        self._axis, self._image = np.concatenate(axes), np.concatenate(images)
        self._flow, self._ahead = np.concatenate(flows), np.concatenate(ahead)
        self._gradients = np.stack([view.gradients.along for view in views])  # [V, 2, H, W]
        self._start = (2 * self._image + self._axis) * (camera.width * camera.height)  # of its image, of all pixels
        self.depth = self._points[:, 2]
        self.speed = float(np.median(np.linalg.norm(self._flow, axis=1)))

    def _uv(self, p: Float64) -> Float64:
        uv, _ = self._camera.project(se3.transform(_turned(p), self._points))
        return np.asarray(uv + (self._ahead + p[3]) * self._flow)

    def score(self, p: Float64) -> float:
        """Mean gradient at the edges, 0 ... 1; 0 for an edge outside of the image."""
        at = self._uv(p) - 0.5  # gradients are at pixel centres
        corner = np.floor(at)
        width, g = self._camera.width, self._gradients.ravel()
        inside = ((corner >= 0) & (corner < (width - 1, self._camera.height - 1))).all(axis=1)
        (u, v), (du, dv) = corner[inside].astype(np.int64).T, (at - corner)[inside].T
        first = self._start[inside] + v * width + u
        upper = g[first] * (1 - du) + g[first + 1] * du
        lower = g[first + width] * (1 - du) + g[first + width + 1] * du
        return float(np.sum(upper * (1 - dv) + lower * dv)) / (255 * len(at))

    def fit(self, start: Float64, with_lag: bool) -> Float64:
        """The rotation, and the lag if asked for, with the highest score; begun at ``start``."""
        free = 4 if with_lag else 3

        def cost(x: Float64) -> float:
            return -self.score(start + _UNITS * np.append(x, np.zeros(4 - free)))

        options = {"xtol": 2e-3, "ftol": 1e-6, "maxiter": 6}
        x = minimize(cost, np.zeros(free), method="Powell", options=options).x
        return np.asarray(start + _UNITS * np.append(x, np.zeros(4 - free)))

    def between(self, p: Float64, q: Float64) -> Float64:
        """How the edges move from one correction to another, [M, 2] px."""
        return self._uv(q) - self._uv(p)

    def rest(self, p: Float64, chosen: NDArray[np.bool_]) -> Float64:
        """By how much some of the edges are still off after a correction, [2] px (NaN: not told)."""
        shift = best_shift(self._shifted(p, chosen, _radius(self._camera) // 4))
        return np.full(2, np.nan) if shift is None else shift.px

    def chance(self) -> float:
        """Mean score over all shifts of the edges as given."""
        everything = np.ones(len(self.depth), bool)
        return float(np.nanmean(self._shifted(np.zeros(4), everything, _radius(self._camera))))

    def _shifted(self, p: Float64, chosen: NDArray[np.bool_], radius: int) -> Float64:
        """The scores of shifts of some of the edges, mean of all views."""
        uv, total = self._uv(p), []
        for k in range(len(self._gradients)):
            mine = chosen & (self._image == k)
            total.append(scores_of_shifts(uv[mine], self._axis[mine], Gradients(self._gradients[k]), radius))
        return np.asarray(np.nanmean(total, axis=0))
