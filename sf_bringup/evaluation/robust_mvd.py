"""The multi-view depth benchmark RobustMVD: its error of one view, and its two ways of using source views."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from sf_bringup.evaluation.depth import INLIER_RATIO
from sf_interfaces.errors import ConfigError, FormatError
from sf_interfaces.types import Float64

CLIP = (0.1, 100.0)  # m, applied to every prediction after its alignment
Predict = Callable[[Sequence[int]], Float64]  # source views -> depth [H, W] m of the key view, 0 or NaN = none


@dataclass(frozen=True, slots=True)
class MvdError:
    """Of one key view; ``views`` are the source views it was made from."""

    absrel: float  # percent
    inlier: float  # percent, tau at 1.03
    density: float  # percent of reference pixels that are predicted
    views: tuple[int, ...] = ()


def mvd_error(prediction: Float64, truth: Float64, alignment: str = "none", sparse: bool = False) -> MvdError:
    """RobustMVD's absrel and inlier ratio over all pixels with truth.

    Args:
        prediction: [h, w] m, 0 or NaN = none; brought to the size of the truth by nearest neighbour.
        truth: [H, W] m, 0 or NaN = none.
        alignment: ``none`` or ``median`` (over pixels valid in both).
        sparse: leave pixels without a prediction out; otherwise they count, clipped to the nearest depth.

    Raises:
        FormatError: the truth is empty, or nothing is predicted where it is not.
    """
    if alignment not in ("none", "median"):
        raise ConfigError(f"RobustMVD knows the alignments none and median, not '{alignment}'")
    p = _resize_nearest(np.nan_to_num(prediction, posinf=0.0), truth.shape)
    g = np.nan_to_num(truth, posinf=0.0)
    known = g > 0
    predicted = known & (p > 0)
    if not predicted.any():
        raise FormatError("no pixel has both an estimated and a reference depth")
    if alignment == "median":
        p = p * (np.median(g[predicted]) / np.median(p[predicted]))
    scored = predicted if sparse else known
    clipped, truth_scored = np.clip(p[scored], *CLIP), g[scored]
    ratio = np.maximum(clipped / truth_scored, truth_scored / clipped)
    return MvdError(
        absrel=100 * float((np.abs(clipped - truth_scored) / truth_scored).mean()),
        inlier=100 * float(((ratio < INLIER_RATIO) & predicted[scored]).mean()),
        density=100 * float(predicted.sum() / known.sum()),
    )


def all_views(predict: Predict, sources: Sequence[int], truth: Float64, alignment: str = "none") -> MvdError:
    """The error with every source view: what a user without ground truth gets."""
    return _score(predict, tuple(sources), truth, alignment)


def oracle_view_choice(predict: Predict, sources: Sequence[int], truth: Float64, alignment: str = "none") -> MvdError:
    """RobustMVD's "quasi-optimal" choice: rank source views by their own absrel, add one by one, keep the best.

    It looks at the ground truth to choose, so it bounds what a choice of views could reach.
    """
    alone = [_score(predict, (s,), truth, alignment) for s in sources]
    ranked = [sources[k] for k in np.argsort([e.absrel for e in alone], kind="stable")]
    grown = [_score(predict, tuple(ranked[:n]), truth, alignment) for n in range(2, len(ranked) + 1)]
    return min([*alone, *grown], key=lambda e: e.absrel)


def _score(predict: Predict, views: tuple[int, ...], truth: Float64, alignment: str) -> MvdError:
    error = mvd_error(predict(views), truth, alignment)
    return MvdError(error.absrel, error.inlier, error.density, views)


def _resize_nearest(values: Float64, shape: tuple[int, ...]) -> Float64:
    rows, cols = (((np.arange(n) + 0.5) * m / n).astype(int) for n, m in zip(shape, values.shape, strict=True))
    return values[rows][:, cols]
