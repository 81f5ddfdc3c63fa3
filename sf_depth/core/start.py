"""Where dense bundle adjustment starts: essential matrices, over a sweep of focal lengths where it is unknown.

The sweep makes the start independent of any guess: every candidate gets relative poses, triangulated depths
and a few iterations of bundle adjustment on a subset, and the one that explains the correspondences best wins.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from sf_depth.core import dense_ba, focal, pinhole
from sf_depth.core.dense_ba import Estimate, Observations
from sf_depth.core.parallel import each
from sf_interfaces.errors import InsufficientParallax
from sf_interfaces.types import Float64

_SWEEP = np.geomspace(0.4, 3.2, 13)  # focal lengths tried, in image widths (102 to 18 degrees of view)
_TRIAL = 5  # iterations that tell the focal lengths apart; the best three go on
_SUBSET = 500  # correspondences of each source the start is made from
_LEAST = 24  # correspondences a source needs
_GATE = 1.5  # px at a width of 640; epipolar distance of an inlier
_RIGID_GATE = 0.8  # px at a width of 640; below it a rotation alone explains the motion
_DEPTH_RANGE = (0.02, 50.0)  # inverse depths kept, relative to the median


@dataclass(frozen=True, slots=True)
class Size:
    """Image size, px."""

    width: int
    height: int

    @property
    def unit(self) -> float:
        """One px of an image 640 wide."""
        return self.width / 640.0


def subset(seen: Observations, count: int = _SUBSET) -> Observations:
    """Evenly spread pixels, those that most sources see; deterministic."""
    views = (seen.weight > 0).sum(axis=0)
    order = np.argsort(-np.minimum(views, 3), kind="stable")
    usable = order[: max(count, int((views >= min(2, len(seen.weight))).sum()))]
    pick = np.sort(usable[np.linspace(0, len(usable) - 1, min(count, len(usable))).astype(int)])
    return Observations(seen.uv[:, pick], seen.target[:, :, pick], seen.weight[:, pick])


def start(seen: Observations, size: Size, theta: Float64 | None) -> Estimate:
    """Poses, inverse depths of all pixels of ``seen``, and a focal length where ``theta`` is None.

    Raises:
        InsufficientParallax: the views differ by rotation only, or not at all; or too little matches.
    """
    few = subset(seen)
    if not ((few.weight > 0).sum(axis=1) >= _LEAST).any():
        raise InsufficientParallax(
            "the images have too little in common to be matched; give sharp, textured images that overlap by half"
        )
    _require_parallax(few, size, theta)
    if theta is not None:
        best = _refined(few, _from_essentials(few, size, theta), "none")
    else:
        tried = each(lambda f: _refined(few, _from_essentials(few, size, _centred(size, f)), "none"), _SWEEP)
        tried.sort(key=lambda found: _implausibility(found, size))
        best = min(
            each(lambda one: _refined(few, one.estimate, "f"), tried[:3]), key=lambda f: _implausibility(f, size)
        )
    at = _canonical(best.estimate)
    return replace(at, inverse_depth=triangulate(seen, at))


def _implausibility(found: dense_ba.Optimum, size: Size) -> float:
    return focal.implausibility(found.cost, found.estimate.theta[0], max(size.width, size.height))


def _centred(size: Size, widths: float) -> Float64:
    f = widths * size.width
    return np.array([f, f, size.width / 2, size.height / 2, 0.0])


def _refined(seen: Observations, at: Estimate, intrinsics: str) -> dense_ba.Optimum:
    return dense_ba.optimum(seen, at, intrinsics=intrinsics, iterations=_TRIAL if intrinsics == "none" else 15)


def _canonical(at: Estimate) -> Estimate:
    """The unit of length in which the median depth is one."""
    return dense_ba.in_unit(at, float(np.median(at.inverse_depth)))


def _require_parallax(seen: Observations, size: Size, theta: Float64 | None) -> None:
    """Refuse views that a rotation alone explains, with the known focal length or with any.

    Raises:
        InsufficientParallax: says so.
    """
    candidates = [theta] if theta is not None else [_centred(size, f) for f in _SWEEP]
    left = min(max(_rotation_residual(seen, j, known) for j in range(len(seen.weight))) for known in candidates)
    if left < _RIGID_GATE * size.unit:
        raise InsufficientParallax(
            f"the images show no parallax: a rotation of the camera explains them within {left:.2f} px; "
            "move the camera sideways by about a tenth of the distance to the scene"
        )


def _rotation_residual(seen: Observations, j: int, theta: Float64) -> float:
    """Upper quartile of what the best rotation leaves of the motion to source j, px; 0 if it has few matches."""
    use = seen.weight[j] > 0
    if use.sum() < _LEAST:
        return 0.0
    a, b = (_unit(pinhole.rays(theta, uv)) for uv in (seen.uv[:, use], seen.target[j][:, use]))
    weight = np.ones(a.shape[1])
    for _ in range(5):
        U, _, Vt = np.linalg.svd((b * weight) @ a.T)
        R = U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt
        off = theta[0] * np.linalg.norm(b - R @ a, axis=0)
        weight = 1.0 / (1.0 + (off / size_of_kernel(off)) ** 2)
    return float(np.quantile(off, 0.75))


def size_of_kernel(off: Float64) -> float:
    """Where a robust kernel sets in for residuals of unknown spread."""
    return max(2.0 * float(np.median(off)), 1e-6)


def _unit(x: Float64) -> Float64:
    """Unit vectors [3, N] of normalised coordinates [2, N]."""
    X = np.vstack([x, np.ones(x.shape[1])])
    return X / np.linalg.norm(X, axis=0)


def _from_essentials(seen: Observations, size: Size, theta: Float64) -> Estimate:
    """Relative poses from one essential matrix a source, brought to one scale by the depths they share."""
    x = pinhole.rays(theta, seen.uv)
    count, N = seen.weight.shape
    T = np.tile(np.eye(4), (count, 1, 1))
    depth, information = np.full((count, N), np.nan), np.zeros((count, N))
    for j in range(count):
        use = seen.weight[j] > 0
        if use.sum() >= _LEAST:
            y = pinhole.rays(theta, seen.target[j])
            T[j], inlier = _relative(x[:, use], y[:, use], _GATE * size.unit / theta[0])
            d, c = linear_inverse_depth(T[j], x, y)
            good = use & (d > 0)
            good[use] &= inlier
            depth[j, good], information[j, good] = d[good], c[good]
    return Estimate(theta, *_one_scale(T, depth, information))


def _relative(x: Float64, y: Float64, gate: float) -> tuple[Float64, np.ndarray]:
    """T_source_reference with unit translation, and which of the N correspondences support it."""
    a, b = np.ascontiguousarray(x.T), np.ascontiguousarray(y.T)
    cv2.setRNGSeed(0)
    E, mask = cv2.findEssentialMat(a, b, np.eye(3), cv2.USAC_FAST, 0.999, gate, 500)
    T = np.eye(4)
    if E is None or E.shape != (3, 3):
        return T, np.zeros(len(a), bool)
    _, T[:3, :3], t, mask = cv2.recoverPose(E, a, b, np.eye(3), mask=mask)
    T[:3, 3] = t[:, 0]
    return T, mask.ravel() > 0


def _one_scale(T: Float64, depth: Float64, information: Float64) -> tuple[Float64, Float64]:
    """Translations in the unit of the best source, and the mean inverse depth of all [N]."""
    strength = np.nansum(np.where(np.isfinite(depth), np.sqrt(information), 0.0), axis=1)
    order = np.argsort(-strength)
    combined, total = np.zeros(depth.shape[1]), np.zeros(depth.shape[1])
    T = T.copy()
    for j in order:
        both = np.isfinite(depth[j]) & (total > 0)
        if total.any():
            ratio = np.median(depth[j][both] * total[both] / combined[both]) if both.sum() >= 8 else 1.0
            T[j, :3, 3] *= ratio
        else:
            ratio = 1.0
        new = np.isfinite(depth[j])
        weight = information[j] * ratio**2
        combined[new] += (weight * depth[j] / ratio)[new]
        total[new] += weight[new]
    d = combined / np.where(total > 0, total, np.nan)
    middle = np.nanmedian(d) if np.isfinite(d).any() else 1.0
    return T, np.clip(np.nan_to_num(d, nan=middle), _DEPTH_RANGE[0] * middle, _DEPTH_RANGE[1] * middle)


def linear_inverse_depth(T: Float64, x: Float64, y: Float64) -> tuple[Float64, Float64]:
    """Inverse depth [N] at which ray x [2, N] meets its match y [2, N], and its information (parallax^2) [N]."""
    m = T[:3, :2] @ x + T[:3, 2:3]
    t = T[:3, 3]
    a = np.stack([t[0] - y[0] * t[2], t[1] - y[1] * t[2]])  # a d = b
    b = np.stack([y[0] * m[2] - m[0], y[1] * m[2] - m[1]])
    information = (a * a).sum(axis=0)
    return (a * b).sum(axis=0) / np.maximum(information, 1e-12), information


def triangulate(seen: Observations, at: Estimate) -> Float64:
    """Inverse depths [N] of all observations for known poses and intrinsics, within the range that is kept."""
    x = pinhole.rays(at.theta, seen.uv)
    top, bottom = np.zeros(x.shape[1]), np.zeros(x.shape[1])
    for j, T in enumerate(at.T):
        y = pinhole.rays(at.theta, np.where(seen.weight[j] > 0, seen.target[j], 0.0))
        d, information = linear_inverse_depth(T, x, y)
        w = np.where((seen.weight[j] > 0) & (d > 0), information, 0.0)
        top += w * d
        bottom += w
    d = top / np.where(bottom > 0, bottom, np.nan)
    middle = float(np.nanmedian(d)) if np.isfinite(d).any() else 1.0
    return np.clip(np.nan_to_num(d, nan=middle), _DEPTH_RANGE[0] * middle, _DEPTH_RANGE[1] * middle)
