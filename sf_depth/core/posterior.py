"""How sure dense bundle adjustment is: posterior covariance of poses, intrinsics and inverse depths at its optimum."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sf_depth.core import pinhole
from sf_depth.core.dense_ba import (
    Observations,
    Optimum,
    in_unit,
    least_information,
    linearise,
    turn_information,
    turn_rows,
)
from sf_interfaces.native import kernels
from sf_interfaces.types import Float64

_TILES = (9, 12)  # rows and columns of the tiles that count as independent in the covariance
_LEAST_OWN = 0.1  # share that correspondences have in what is known of a turn, at least
_LEAST_TOLD = 1e-9  # of the surest combination of parameters; sums in single precision tell no less


@dataclass(frozen=True, slots=True)
class Adjusted(Optimum):
    """The optimum with its uncertainty.

    Args:
        covariance: of poses (translation, rotation; 6 per source, if free) and of f and k1 (or fx fy cx cy), [P, P],
            free or not: what the camera model leaves out is unsure in given intrinsics, too.
        inverse_depth_variance: [N], with what poses and intrinsics contribute; inf where nothing was seen.
        common_variance: the part of it that comes from poses and intrinsics, [N].
    """

    covariance: Float64
    inverse_depth_variance: Float64
    common_variance: Float64


def with_covariance(seen: Observations, found: Optimum, poses: bool, intrinsics: str) -> Adjusted:
    """Posterior covariance at the optimum. The scale, which nothing observes, counts as known."""
    at, sigma = replace(found.estimate, bend_deviation=np.inf), found.sigma  # what the images say of a lens
    columns = pinhole.free_columns(at.theta, "pinhole" if intrinsics == "pinhole" else "radial")
    system = linearise(seen, at, sigma, poses, columns, scores=True)
    C = system.C + least_information(system.C)
    scaled = system.E / C
    S, left = kernels("sf_depth").eliminate(system.E, C, system.w, system.H, system.g)
    if poses and len(S):
        gauge = np.zeros(len(S))
        for j, T in enumerate(at.T):
            gauge[6 * j : 6 * j + 3] = T[:3, 3]
        S += np.trace(S) * np.outer(gauge, gauge) / max(gauge @ gauge, 1e-300)
    scores = system.scores - scaled * system.w  # of poses, turns and intrinsics alone, [P, N]
    inverse = _inverse(S)
    covariance = inverse @ _spread(seen.uv, scores, left) @ inverse + sigma**2 * inverse
    turns = turn_rows(len(at.T), poses) if at.turn is not None else np.zeros(0, int)
    if at.turn is not None:
        told = np.diag(S)[turns]
        pulled = np.repeat(turn_information(seen, at, sigma), 3)  # what the prior has kept small counts whole
        shift = _without(S, turns, at.turn.ravel() * told / np.maximum(told - pulled, _LEAST_OWN * told + 1e-300))
        covariance += np.outer(shift, shift)
    common = (scaled * (covariance.astype(np.float32) @ scaled)).sum(axis=0)
    kept = np.delete(np.arange(len(S)), turns)
    covariance = covariance[np.ix_(kept, kept)]
    with np.errstate(divide="ignore"):
        variance = sigma**2 / system.C + common
    return Adjusted(found.estimate, found.iterations, sigma, found.cost, covariance, variance, common)


def _without(S: Float64, where: np.ndarray, values: Float64) -> Float64:
    """What all others [P] would move by if those at ``where`` did not have their values: how far errors that are alike
    all over an image draw them, of which a turn is one sort only."""
    others = np.delete(np.arange(len(S)), where)
    shift = np.zeros(len(S))
    shift[others] = _inverse(S[np.ix_(others, others)]) @ (S[np.ix_(others, where)] @ values)
    return shift


def _inverse(S: Float64) -> Float64:
    """Inverse of an information [P, P]; what nothing tells, as the pose of a lost source, is unsure without end."""
    values, vectors = np.linalg.eigh(S)
    return np.asarray((vectors / np.maximum(values, _LEAST_TOLD * values.max(initial=1e-300))) @ vectors.T)


def _spread(uv: Float64, scores: Float64, left: Float64) -> Float64:
    """Covariance [P, P] of the sum of the scores [P, N] of pixels [2, N], beyond that of independent ones.

    The errors of neighbouring correspondences are alike, and what the camera model leaves out (a rolling shutter,
    a lens) is so all over the image; as independent ones they would seem to average out. Tiles of the image take
    the place of observations instead, as in the cluster-robust estimate of Liang and Zeger. ``left`` [P] is what the
    gradient leaves: not 0 for what is not free, which counts as unsure as far as it goes.
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
    return np.asarray(clustered + np.outer(left, left))


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
