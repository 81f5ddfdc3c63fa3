"""Dense bundle adjustment (paper Eq. DBA): poses, inverse depths and intrinsics from dense correspondences.

    L(G, d, theta) = sum_j | x*_j - Pi(G_j Pi^-1(x, d, theta), theta) |^2

Levenberg-Marquardt with a Cauchy kernel. The inverse depths are eliminated by the Schur complement: with
``C dd + E^T dx = w`` the depth step is ``dd = C^-1 (w - E^T dx)``, where x holds poses and intrinsics alike.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sf_depth.core import pinhole
from sf_interfaces.geometry import se3
from sf_interfaces.types import Float32, Float64

_MIN_Z = 0.05  # of the reference depth; nearer to a source, or behind it, a point says nothing
_SINGLE = np.float32  # of the normal equations; residuals and the estimate are in double precision
_KERNEL = 2.5  # deviations at which the Cauchy kernel sets in
_LEAST_SIGMA = 0.02  # px; correspondences are never better than this
_FALL = 1e-4  # relative fall of the cost below which the iteration has converged
_TILES = (9, 12)  # rows and columns of the tiles that count as independent in the covariance
_LARGEST_STEP = 4.0  # factor by which one step may change an inverse depth


@dataclass(frozen=True, slots=True)
class Observations:
    """Reference pixels and where the sources see them.

    Args:
        uv: continuous reference pixels [2, N].
        target: continuous source pixels [S, 2, N]; anything where the weight is 0.
        weight: confidence of each correspondence [S, N], 0 = not seen.
    """

    uv: Float64
    target: Float64
    weight: Float64


@dataclass(frozen=True, slots=True)
class Estimate:
    """What the correspondences are explained by.

    Args:
        theta: intrinsics [5], see :mod:`sf_depth.core.pinhole`.
        T: T_source_reference [S, 4, 4].
        inverse_depth: [N], 1 / unit of the translations, positive.
    """

    theta: Float64
    T: Float64
    inverse_depth: Float64


@dataclass(frozen=True, slots=True)
class Adjusted:
    """The optimum with its uncertainty.

    Args:
        estimate: the optimum.
        iterations: accepted and refused steps.
        sigma: deviation of one coordinate of a correspondence, px.
        covariance: of poses (translation, rotation; 6 per source, if free) and of f and k1 (or fx fy cx cy), [P, P],
            free or not: what the camera model leaves out is unsure in given intrinsics, too.
        inverse_depth_variance: [N], with what poses and intrinsics contribute; inf where nothing was seen.
        common_variance: the part of it that comes from poses and intrinsics, [N].
        cost: mean robust cost of an observation, px^2.
    """

    estimate: Estimate
    iterations: int
    sigma: float
    covariance: Float64
    inverse_depth_variance: Float64
    common_variance: Float64
    cost: float


@dataclass(frozen=True, slots=True)
class System:
    """Normal equations: H [P, P] and g [P] of poses and intrinsics, C [N] and w [N] of depths, E [P, N] between.

    ``scores`` is what each pixel contributes to g, [P, N].
    """

    H: Float64
    scores: Float32
    E: Float32
    C: Float32
    w: Float32

    @property
    def g(self) -> Float64:
        """Right side of the poses and intrinsics, [P]."""
        return np.asarray(self.scores.sum(axis=1, dtype=np.float64))


def adjust(
    seen: Observations, start: Estimate, *, poses: bool = True, intrinsics: str = "none", iterations: int = 25
) -> Adjusted:
    """Minimise the reprojection error over the inverse depths and whatever is free.

    Args:
        poses: whether the poses of the sources are free; fixed ones also fix the scale.
        intrinsics: which are free: none, f, pinhole (fx fy cx cy), radial (f and one radial term).
        iterations: at most.
    """
    here, damping, done = start, 1e-3, 0
    r = residuals(seen, here)
    while done < iterations:
        sigma = _deviation(r, seen.weight)
        cost = _cost(r, seen.weight, sigma)
        columns = pinhole.free_columns(here.theta, intrinsics)
        system = linearise(seen, here, _robust(r, seen.weight, sigma), r, poses, columns)
        better = None
        while better is None and done < iterations:
            done += 1
            there = moved(here, step(system, damping), poses, columns)
            r_there = residuals(seen, there)
            new = _cost(r_there, seen.weight, sigma)
            if new < cost:
                better, fall = there, (cost - new) / cost
                damping = max(damping / 10, 1e-9)
            elif damping > 1e6:
                break
            else:
                damping *= 10
        if better is None:
            break
        here, r = better, r_there
        if fall < _FALL:
            break
    return _with_covariance(seen, here, r, done, poses, intrinsics)


def residuals(seen: Observations, at: Estimate) -> Float64:
    """x* - Pi(G Pi^-1(x, d)), [S, 2, N] px; NaN where a source cannot see the point."""
    x = pinhole.rays(at.theta, seen.uv)
    out = np.empty_like(seen.target)
    for j, T in enumerate(at.T):
        X = _transformed(T, x, at.inverse_depth)
        X[2][X[2] < _MIN_Z] = np.nan
        out[j] = seen.target[j] - pinhole.project(at.theta, X[:2] / X[2])
    return out


def _transformed(T: Float64, x: Float64, d: Float64) -> Float64:
    """Points of rays x [2, N] at inverse depth d [N] in a source, in units of the reference depth, [3, N]."""
    return T[:3, :2] @ x + T[:3, 2:3] + T[:3, 3:] * d


def _squared(r: Float64) -> Float64:
    return r[:, 0] ** 2 + r[:, 1] ** 2


def _deviation(r: Float64, weight: Float64) -> float:
    """Robust standard deviation of one coordinate, px: the median of a Rayleigh distribution is 1.177 sigma."""
    lengths = np.sqrt(_squared(r))[weight > 0]
    lengths = lengths[np.isfinite(lengths)]
    return max(float(np.median(lengths)) / 1.177 if len(lengths) else 1.0, _LEAST_SIGMA)


def _robust(r: Float64, weight: Float64, sigma: float) -> Float64:
    """Weights [S, N] of the Cauchy kernel times the confidence; 0 behind a camera."""
    with np.errstate(invalid="ignore"):
        w = weight / (1.0 + _squared(r) / (_KERNEL * sigma) ** 2)
    return np.where(np.isfinite(w), w, 0.0)


def _cost(r: Float64, weight: Float64, sigma: float) -> float:
    """Mean robust cost, px^2; a point behind a camera costs as much as one 100 deviations off."""
    c2 = (_KERNEL * sigma) ** 2
    squares = _squared(r)
    squares[~np.isfinite(squares)] = (100 * sigma) ** 2
    return float((weight * c2 * np.log1p(squares / c2)).sum() / max(weight.sum(), 1e-12))


def linearise(seen: Observations, at: Estimate, weight: Float64, r: Float64, poses: bool, columns: Float64) -> System:
    """Normal equations at an estimate, weights [S, N] and residuals [S, 2, N] given; in single precision."""
    count, K = len(at.T), columns.shape[1]
    own = 6 * count if poses else 0
    P, N = own + K, seen.uv.shape[1]
    H, scores, E = np.zeros((P, P)), np.zeros((P, N), _SINGLE), np.zeros((P, N), _SINGLE)
    C, w = np.zeros(N, _SINGLE), np.zeros(N, _SINGLE)
    x, d = pinhole.rays(at.theta, seen.uv).astype(_SINGLE), at.inverse_depth.astype(_SINGLE)
    dx = pinhole.rays_jacobian(at.theta, x, columns) if K else np.zeros((2, 0, N), _SINGLE)
    for j, T in enumerate(at.T):
        A, a = jacobians(at.theta, T, x, dx, d, poses, columns)
        root = np.sqrt(weight[j]).astype(_SINGLE)
        A *= root  # 0 where the source is blind, and what was clipped there is finite
        a *= root
        b = np.where(root > 0, r[j], 0.0).astype(_SINGLE) * root
        flat = A.reshape(len(A), 2 * N)
        rows = np.r_[6 * j : 6 * j + 6, own:P] if poses else np.arange(own, P)
        H[np.ix_(rows, rows)] += flat @ flat.T
        pose, count = slice(6 * j, 6 * j + 6), len(A) - K
        for total, (first, second) in ((scores, b), (E, a)):
            part = A[:, 0] * first + A[:, 1] * second
            total[pose][:count] = part[:count]  # of this source alone
            total[own:] += part[count:]
        C += a[0] ** 2 + a[1] ** 2
        w += a[0] * b[0] + a[1] * b[1]
    return System(H, scores, E, C, w)


def jacobians(
    theta: Float64, T: Float64, x: Float64, dx: Float64, d: Float64, poses: bool, columns: Float64
) -> tuple[Float64, Float64]:
    """d Pi / d (pose, phi) [6 + K, 2, N] and d Pi / d d [2, N] of one source, in the precision of ``x``."""
    theta, T, columns = (array.astype(x.dtype, copy=False) for array in (theta, T, columns))
    X = _transformed(T, x, d)
    inverse_z = 1.0 / np.maximum(X[2], _MIN_Z)
    y = X[:2] * inverse_z
    uu, uv, vv = pinhole.project_jacobian(theta, y)
    J = np.empty((3, 2, len(d)), x.dtype)  # d uv / d (point in the source)
    J[0] = theta[0] * inverse_z * uu, theta[1] * inverse_z * uv
    J[1] = theta[0] * inverse_z * uv, theta[1] * inverse_z * vv
    J[2] = -(y[0] * J[0] + y[1] * J[1])
    A = np.empty(((6 if poses else 0) + columns.shape[1], 2, len(d)), x.dtype)
    if poses:
        A[:3] = J * d  # translations act on the point of unit ray in proportion to its inverse depth
        A[3] = X[1] * J[2] - X[2] * J[1]
        A[4] = X[2] * J[0] - X[0] * J[2]
        A[5] = X[0] * J[1] - X[1] * J[0]
    if columns.shape[1]:
        own = pinhole.project_parameters(theta, y, columns)
        for k in range(columns.shape[1]):
            v = T[:3, :2] @ dx[:, k]
            A[k - columns.shape[1]] = v[0] * J[0] + v[1] * J[1] + v[2] * J[2] + own[:, k]
    t = T[:3, 3]
    return A, t[0] * J[0] + t[1] * J[1] + t[2] * J[2]


def step(system: System, damping: float) -> tuple[Float64, Float64]:
    """Damped step (dx [P], dd [N]); damping is relative to each diagonal, so it scales with the residuals."""
    C = system.C * _SINGLE(1.0 + damping) + _least_information(system.C)
    scaled = system.E / C
    S = system.H - scaled @ system.E.T
    S[np.diag_indices_from(S)] += damping * np.diag(system.H) + 1e-12 * np.trace(system.H)
    dx = np.linalg.solve(S, system.g - scaled @ system.w) if len(S) else np.zeros(0)
    return dx, (system.w - system.E.T @ dx.astype(_SINGLE)) / C


def _least_information(C: Float32) -> np.float32:
    """Keeps depths that nothing constrains where they are."""
    return _SINGLE(1e-6 * float(np.median(C)) + 1e-30)


def moved(at: Estimate, step: tuple[Float64, Float64], poses: bool, columns: Float64) -> Estimate:
    """The estimate after a step; inverse depths stay positive."""
    dx, dd = step
    count = len(at.T)
    T = se3.exp(dx[: 6 * count].reshape(count, 6)) @ at.T if poses else at.T
    theta = pinhole.moved(at.theta, columns, dx[len(dx) - columns.shape[1] :]) if columns.shape[1] else at.theta
    d = np.clip(at.inverse_depth + dd, at.inverse_depth / _LARGEST_STEP, at.inverse_depth * _LARGEST_STEP)
    return Estimate(theta, T, d)


def _with_covariance(
    seen: Observations, at: Estimate, r: Float64, iterations: int, poses: bool, intrinsics: str
) -> Adjusted:
    """Posterior covariance at the optimum. The scale, which nothing observes, counts as known."""
    sigma = _deviation(r, seen.weight)
    columns = pinhole.free_columns(at.theta, "pinhole" if intrinsics == "pinhole" else "radial")
    system = linearise(seen, at, _robust(r, seen.weight, sigma), r, poses, columns)
    C = system.C + _least_information(system.C)
    scaled = system.E / C
    S = system.H - scaled @ system.E.T
    if poses and len(S):
        gauge = np.zeros(len(S))
        for j, T in enumerate(at.T):
            gauge[6 * j : 6 * j + 3] = T[:3, 3]
        S += np.trace(S) * np.outer(gauge, gauge) / max(gauge @ gauge, 1e-300)
    scores = system.scores - scaled * system.w  # of poses and intrinsics alone, [P, N]
    inverse = np.linalg.pinv(S, hermitian=True) if len(S) else S
    covariance = inverse @ _spread(seen.uv, scores, sigma**2 * S) @ inverse
    common = (scaled * (covariance.astype(_SINGLE) @ scaled)).sum(axis=0)
    with np.errstate(divide="ignore"):
        variance = sigma**2 / system.C + common
    return Adjusted(at, iterations, sigma, covariance, variance, common, _cost(r, seen.weight, sigma))


def _spread(uv: Float64, scores: Float64, independent: Float64) -> Float64:
    """Covariance [P, P] of the sum of the scores [P, N] of pixels [2, N], never less than the ``independent`` one.

    The errors of neighbouring correspondences are alike, and what the camera model leaves out (a rolling shutter,
    a lens) is so all over the image; as independent ones they would seem to average out. Tiles of the image take
    the place of observations instead, as in the cluster-robust estimate of Liang and Zeger.
    """
    P = len(scores)
    low, high = uv.min(axis=1, keepdims=True), uv.max(axis=1, keepdims=True)
    rows, cols = _TILES
    col, row = np.minimum(
        ((uv - low) / np.maximum(high - low, 1e-12) * [[cols], [rows]]).astype(int), [[cols - 1], [rows - 1]]
    )
    tile = row * cols + col
    sums = np.stack([np.bincount(tile, score, rows * cols) for score in scores]) if P else np.zeros((0, 1))
    count = int((np.bincount(tile) > 0).sum())
    clustered = sums @ sums.T * (count / max(count - P, 1))
    total = scores.sum(axis=1)
    return np.asarray(clustered + independent + np.outer(total, total))


def rescaled(adjusted: Adjusted, factor: float) -> Adjusted:
    """The same optimum in another unit: translations and depths times ``factor``."""
    per_parameter = np.ones(len(adjusted.covariance))
    for j in range(len(adjusted.estimate.T)):
        per_parameter[6 * j : 6 * j + 3] = factor  # poses are free: without them there is no unit to choose
    return replace(
        adjusted,
        estimate=in_unit(adjusted.estimate, factor),
        covariance=adjusted.covariance * np.outer(per_parameter, per_parameter),
        inverse_depth_variance=adjusted.inverse_depth_variance / factor**2,
        common_variance=adjusted.common_variance / factor**2,
    )


def in_unit(at: Estimate, factor: float) -> Estimate:
    """The same geometry in another unit: translations and depths times ``factor``."""
    T = at.T.copy()
    T[:, :3, 3] *= factor
    return replace(at, T=T, inverse_depth=at.inverse_depth / factor)
