"""Dense bundle adjustment (paper Eq. DBA): poses, inverse depths and intrinsics from dense correspondences.

    L(G, d, theta) = sum_j | x*_j - Pi(G_j Pi^-1(x, d, theta), theta) |^2

Levenberg-Marquardt with a Cauchy kernel. The inverse depths are eliminated by the Schur complement: with
``C dd + E^T dx = w`` the depth step is ``dd = C^-1 (w - E^T dx)``, where x holds poses and intrinsics alike.
The sums over all correspondences are compiled; ``dense_ba_reference`` says what they are.

A camera that moves while the rows of its image are read one after the other (rolling shutter) sees every row from a
pose of its own, and free poses would explain that by another motion. Each source may therefore turn while it is read: a
row at tangent y is seen after a further rotation ``exp(y omega)``; a hand turns little in so short a time.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sf_depth.core import pinhole
from sf_interfaces.geometry import se3
from sf_interfaces.native import kernels
from sf_interfaces.types import Float32, Float64

MIN_Z = 0.05  # of the reference depth; nearer to a source, or behind it, a point says nothing
KERNEL = 2.5  # deviations at which the Cauchy kernel sets in
_LEAST_SIGMA = 0.02  # px; correspondences are never better than this
_FALL = 1e-4  # relative fall of the cost below which the iteration has converged
_BEND = 0.04  # prior deviation of a radial term beside known intrinsics: of lenses that pass for none
_ALIKE = 30  # correspondences of a source that err on their own, for these priors: neighbours err alike
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
        turn: rotation vector of every source while its rows are read, rad per unit of the row's tangent [S, 3];
            None: none turns.
        turn_deviation, bend_deviation: of the priors of each turn, in the same unit, and of the radial term.
    """

    theta: Float64
    T: Float64
    inverse_depth: Float64
    turn: Float64 | None = None
    turn_deviation: float = np.inf
    bend_deviation: float = np.inf

    @property
    def turned(self) -> Float64:
        """The turns of all sources [S, 3]."""
        return np.zeros((len(self.T), 3)) if self.turn is None else self.turn


@dataclass(frozen=True, slots=True)
class Optimum:
    """Where Levenberg-Marquardt has ended.

    Args:
        estimate: the optimum.
        iterations: accepted and refused steps.
        sigma: deviation of one coordinate of a correspondence, px.
        cost: mean robust cost of an observation, px^2.
    """

    estimate: Estimate
    iterations: int
    sigma: float
    cost: float


@dataclass(frozen=True, slots=True)
class System:
    """Normal equations: H [P, P] and g [P] of poses, turns, intrinsics; C [N] and w [N] of depths; E [P, N] both.

    ``scores`` is what each pixel contributes to g, [P, N], where it was asked for.
    """

    H: Float64
    g: Float64
    E: Float32
    C: Float32
    w: Float32
    scores: Float32


def optimum(
    seen: Observations,
    start: Estimate,
    *,
    poses: bool = True,
    intrinsics: str = "none",
    turn: float = 0.0,
    iterations: int = 25,
) -> Optimum:
    """Minimise the reprojection error over the inverse depths and whatever is free.

    Args:
        poses: whether the poses of the sources are free; fixed ones also fix the scale.
        intrinsics: which are free: none, f, pinhole (fx fy cx cy), radial (f and one radial term), or lens (that term
            alone, which is kept small).
        turn: prior deviation of what sources turn by while they are read, rad per unit of the row's tangent; 0: they
            do not turn. Only with free poses.
        iterations: at most.
    """
    turns = start.turned if turn and poses else None
    bend = _BEND if intrinsics == "lens" else np.inf
    here = replace(start, turn=turns, turn_deviation=turn or np.inf, bend_deviation=bend)
    damping, done = 1e-3, 0
    squares = squared_residuals(seen, here)
    while done < iterations:
        sigma = deviation(squares)
        cost = _cost(squares, seen, here, sigma)
        columns = pinhole.free_columns(here.theta, intrinsics)
        system = linearise(seen, here, sigma, poses, columns)
        better = None
        while better is None and done < iterations:
            done += 1
            there = moved(here, step(system, damping), poses, columns)
            squares_there = squared_residuals(seen, there)
            new = _cost(squares_there, seen, there, sigma)
            if new < cost:
                better, fall = there, (cost - new) / cost
                damping = max(damping / 10, 1e-9)
            elif damping > 1e6:
                break
            else:
                damping *= 10
        if better is None:
            break
        here, squares = better, squares_there
        if fall < _FALL:
            break
    sigma = deviation(squares)
    return Optimum(here, done, sigma, _cost(squares, seen, here, sigma))


def _arrays(seen: Observations, at: Estimate) -> tuple[Float64, ...]:
    """What the kernels take: theta, T, rays, inverse depth, target, weight, turn."""
    arrays = (at.theta, at.T, pinhole.rays(at.theta, seen.uv), at.inverse_depth, seen.target, seen.weight, at.turned)
    return tuple(np.ascontiguousarray(array, np.float64) for array in arrays)


def squared_residuals(seen: Observations, at: Estimate) -> Float32:
    """|x* - Pi(G Pi^-1(x, d))|^2, [S, N] px^2; NaN where a source cannot see the point or the weight is 0."""
    return np.asarray(kernels("sf_depth").squared_residuals(*_arrays(seen, at)))


def deviation(squares: Float32) -> float:
    """Robust standard deviation of one coordinate, px: the median of a Rayleigh distribution is 1.177 sigma."""
    known = squares[~np.isnan(squares)]
    return max(float(np.median(np.sqrt(known))) / 1.177 if len(known) else 1.0, _LEAST_SIGMA)


def robust_cost(squares: Float32, weight: Float64, sigma: float) -> float:
    """Mean Cauchy cost, px^2; a point behind a camera costs as much as one 100 deviations off."""
    total, weights = kernels("sf_depth").robust_cost(squares, weight, (KERNEL * sigma) ** 2, (100 * sigma) ** 2)
    return float(total / max(weights, 1e-12))


def turn_information(seen: Observations, at: Estimate, sigma: float) -> Float64:
    """Of the prior of each source's turn, [S] px^2: as many of its correspondences as err on their own outweigh it."""
    return np.asarray((sigma / at.turn_deviation) ** 2 / _ALIKE * seen.weight.sum(axis=1))


def bend_information(seen: Observations, at: Estimate, sigma: float) -> float:
    """The same of the radial term, px^2."""
    return float((sigma / at.bend_deviation) ** 2 / _ALIKE * seen.weight.sum())


def _cost(squares: Float32, seen: Observations, at: Estimate, sigma: float) -> float:
    """:func:`robust_cost` with that of the priors."""
    prior = bend_information(seen, at, sigma) * at.theta[4] ** 2
    if at.turn is not None:
        prior += turn_information(seen, at, sigma) @ (at.turn**2).sum(axis=1)
    return float(robust_cost(squares, seen.weight, sigma) + prior / max(seen.weight.sum(), 1e-12))


def linearise(
    seen: Observations, at: Estimate, sigma: float, poses: bool, columns: Float64, scores: bool = False
) -> System:
    """Normal equations at an estimate with the Cauchy weights of a deviation ``sigma`` px.

    The turns of the sources are free where the estimate has some.
    """
    x = pinhole.rays(at.theta, seen.uv).astype(np.float32)
    dx = pinhole.rays_jacobian(at.theta, x, columns) if columns.shape[1] else np.zeros((2, 0, 0), np.float32)
    arrays = (*_arrays(seen, at), np.ascontiguousarray(dx), np.ascontiguousarray(columns))
    turns = at.turn is not None
    system = System(*kernels("sf_depth").linearise(*arrays, poses, turns, (KERNEL * sigma) ** 2, scores))
    if at.turn is not None:
        where = turn_rows(len(at.T), poses)
        information = np.repeat(turn_information(seen, at, sigma), 3)
        system.H[where, where] += information
        system.g[where] -= information * at.turn.ravel()
    bent = len(system.g) - columns.shape[1] + np.flatnonzero(columns[4])
    known = bend_information(seen, at, sigma)
    system.H[bent, bent] += known
    system.g[bent] -= known * at.theta[4]
    return system


def turn_rows(count: int, poses: bool) -> np.ndarray:
    """Rows of the turns of so many sources among all: behind their poses."""
    return (6 * count if poses else 0) + np.arange(3 * count)


def steadied(at: Estimate, target: np.ndarray) -> np.ndarray:
    """Source pixels [S, 2, N] as sources that do not turn would have seen them, in their precision."""
    if at.turn is None:
        return target
    out = np.empty_like(target)
    for j, omega in enumerate(at.turn.astype(target.dtype)):
        y = pinhole.rays(at.theta, target[j])
        row = (target[j, 1] - target.dtype.type(at.theta[3])) / target.dtype.type(at.theta[1])
        X = np.stack([y[0], y[1], np.ones_like(row)])
        X -= row * np.cross(omega, X, axisb=0).T
        out[j] = pinhole.project(at.theta, X[:2] / X[2])
    return out


def step(system: System, damping: float) -> tuple[Float64, Float64]:
    """Damped step (dx [P], dd [N]); damping is relative to each diagonal, so it scales with the residuals."""
    C = system.C * np.float32(1.0 + damping) + least_information(system.C)
    S, b = kernels("sf_depth").eliminate(system.E, C, system.w, system.H, system.g)
    S[np.diag_indices_from(S)] += damping * np.diag(system.H) + 1e-12 * np.trace(system.H) + 1e-300
    dx = np.linalg.solve(S, b) if len(S) else np.zeros(0)
    return dx, kernels("sf_depth").substitute(system.E, C, system.w, dx)


def least_information(C: Float32) -> np.float32:
    """Keeps depths that nothing constrains where they are."""
    return np.float32(1e-6 * float(np.median(C)) + 1e-30)


def moved(at: Estimate, step: tuple[Float64, Float64], poses: bool, columns: Float64) -> Estimate:
    """The estimate after a step; inverse depths stay positive."""
    dx, dd = step
    count = len(at.T)
    T = se3.exp(dx[: 6 * count].reshape(count, 6)) @ at.T if poses else at.T
    turn = None if at.turn is None else at.turn + dx[turn_rows(count, poses)].reshape(count, 3)
    theta = pinhole.moved(at.theta, columns, dx[len(dx) - columns.shape[1] :]) if columns.shape[1] else at.theta
    d = np.clip(at.inverse_depth + dd, at.inverse_depth / _LARGEST_STEP, at.inverse_depth * _LARGEST_STEP)
    return replace(at, theta=theta, T=T, inverse_depth=d, turn=turn)


def in_unit(at: Estimate, factor: float) -> Estimate:
    """The same geometry in another unit: translations and depths times ``factor``."""
    T = at.T.copy()
    T[:, :3, 3] *= factor
    return replace(at, T=T, inverse_depth=at.inverse_depth / factor)
