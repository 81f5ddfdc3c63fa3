"""Errors of depth maps and of the variance predicted with them."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from sf_interfaces.errors import ConfigError, FormatError
from sf_interfaces.types import DepthMap, Float64

ALIGNMENTS = ("none", "median", "lstsq")
INLIER_RATIO = 1.03  # tau of RobustMVD: max(p/g, g/p) below this counts as an inlier
DELTA1_RATIO = 1.25
FARTHEST = 1000.0  # m; an aligned inverse depth that is not positive counts as this far
_STEPS = 20  # of the sparsification curve: 5 % of the pixels each


@dataclass(frozen=True, slots=True)
class DepthError:
    """Depth error over the pixels valid in both maps; calibration where variance is known, else NaN.

    Where the median aligns, the scale is free, and the ratio of two medians carries what a few wrong pixels do to it
    into every pixel. Calibration is therefore measured after the median of ratios.
    """

    absrel: float  # percent
    inlier: float  # percent of pixels within the 1.03 ratio
    mae: float  # m
    rmse: float  # m
    delta1: float  # percent of pixels within the 1.25 ratio
    density: float  # percent of reference pixels that are predicted
    within_1_sigma: float  # percent; a Gaussian has 68.3
    within_2_sigma: float  # percent; a Gaussian has 95.4
    nll: float  # mean negative log likelihood of the truth, nats (m)
    ause: float  # area between sparsification by sigma and by error, 0 = sigma ranks the errors perfectly
    pixels: int

    def as_dict(self) -> dict[str, float]:
        """Plain numbers for JSON."""
        return asdict(self)


def align_depth(p: Float64, g: Float64, alignment: str) -> tuple[Float64, Float64]:
    """Predicted depths [N] brought to the reference [N] m, and the factor [N] on their standard deviation.

    Args:
        alignment: ``none``; ``median``: one factor median(g) / median(p); ``lstsq``: scale and shift of
            inverse depth that minimise ``sum (1/g - a/p - b)^2``.

    Raises:
        ConfigError: unknown alignment.
    """
    if alignment == "none":
        return p, np.ones_like(p)
    if alignment == "median":
        factor = np.median(g) / np.median(p)
        return factor * p, np.full_like(p, factor)
    if alignment != "lstsq":
        raise ConfigError(f"depth alignment '{alignment}' is unknown; choose {', '.join(ALIGNMENTS)}")
    (a, b), *_ = np.linalg.lstsq(np.stack([1 / p, np.ones_like(p)], axis=1), 1 / g, rcond=None)
    aligned = 1 / np.maximum(a / p + b, 1 / FARTHEST)
    return aligned, np.abs(a) * (aligned / p) ** 2


def depth_error(estimate: DepthMap, reference: DepthMap, alignment: str = "none") -> DepthError:
    """Compare one depth map with its reference of the same size, over the pixels valid in both.

    Raises:
        FormatError: sizes differ or no pixel is valid in both.
    """
    if estimate.z.shape != reference.z.shape:
        raise FormatError(f"depth maps differ in size: {estimate.z.shape} and {reference.z.shape}")
    both = estimate.valid & reference.valid
    if not both.any():
        raise FormatError("no pixel has both an estimated and a reference depth")
    g = reference.z[both].astype(np.float64)
    p, stretch = align_depth(estimate.z[both].astype(np.float64), g, alignment)
    error, ratio = np.abs(p - g), np.maximum(p / g, g / p)
    sigma = None if estimate.variance is None else stretch * np.sqrt(estimate.variance[both].astype(np.float64))
    free = float(np.median(g / p)) if alignment == "median" else 1.0
    return DepthError(
        absrel=100 * float((error / g).mean()),
        inlier=100 * float((ratio < INLIER_RATIO).mean()),
        mae=float(error.mean()),
        rmse=float(np.sqrt((error**2).mean())),
        delta1=100 * float((ratio < DELTA1_RATIO).mean()),
        density=100 * float(both.sum() / reference.valid.sum()),
        **calibration(np.abs(free * p - g), None if sigma is None else free * sigma),
        pixels=int(both.sum()),
    )


def calibration(error: Float64, sigma: Float64 | None) -> dict[str, float]:
    """How well standard deviations [N] m describe absolute errors [N] m; NaN without them."""
    if sigma is None:
        return dict.fromkeys(("within_1_sigma", "within_2_sigma", "nll", "ause"), float("nan"))
    floor = np.maximum(sigma, 1e-9)
    return {
        "within_1_sigma": 100 * float((error <= sigma).mean()),
        "within_2_sigma": 100 * float((error <= 2 * sigma).mean()),
        "nll": float((0.5 * np.log(2 * np.pi * floor**2) + 0.5 * (error / floor) ** 2).mean()),
        "ause": ause(error, sigma),
    }


def sparsification(error: Float64, sigma: Float64) -> tuple[Float64, Float64, Float64]:
    """Mean error of what is left after removing the most uncertain pixels, relative to that of all.

    Returns:
        Fraction removed (0, 5, ... 95 %), the curve by ``sigma`` and the oracle's by ``error`` itself, [20] each.
    """
    steps = np.arange(_STEPS)
    left = len(error) - (steps * len(error)) // _STEPS  # pixels that stay, at least 5 %
    by_sigma = np.cumsum(error[np.argsort(sigma, kind="stable")])[left - 1] / left
    by_error = np.cumsum(np.sort(error))[left - 1] / left
    mean = max(float(error.mean()), np.finfo(np.float64).tiny)
    return steps / _STEPS, by_sigma / mean, by_error / mean


def ause(error: Float64, sigma: Float64) -> float:
    """Area under the sparsification error: how much worse ``sigma`` [N] ranks ``error`` [N] than an oracle."""
    _, by_sigma, by_error = sparsification(error, sigma)
    return float((by_sigma - by_error).mean())


def mean_depth_error(errors: list[DepthError]) -> DepthError:
    """Mean over images of each measure; pixel counts add up."""
    rows = np.array([[float(value) for value in asdict(e).values()] for e in errors])
    mean = rows.mean(axis=0)
    return DepthError(*(float(v) for v in mean[:-1]), pixels=int(rows[:, -1].sum()))
