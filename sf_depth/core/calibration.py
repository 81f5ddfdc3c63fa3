"""Variances that hold: the regression is tried on observations it may not see, and its variance made to match."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from sf_depth.core.conditioning import Observations
from sf_interfaces.types import Float32, Float64

_TRIALS = 1500  # held-out observations
_BINS = 10  # of equally many trials each
_ONE_SIGMA = 0.683
_FARTHEST = 64.0  # px; beyond it nothing is left to compare with


@dataclass(frozen=True, slots=True)
class Calibration:
    """Maps a variance of the regression to one whose sigma holds 68 % of the errors."""

    log_raw: Float64  # [B] increasing
    log_true: Float64  # [B] increasing

    def __call__(self, variance: Float32) -> Float32:
        """Calibrated variance, same shape; beyond the trials it keeps its proportion."""
        raw = np.log(np.maximum(variance, 1e-20))
        low, high = self.log_raw[0], self.log_raw[-1]
        true = np.interp(raw, self.log_raw, self.log_true)
        true += np.maximum(raw - high, 0.0) + np.minimum(raw - low, 0.0)
        return np.exp(true).astype(np.float32)


def held_out(observed: Observations, measured: np.ndarray, seed: int) -> tuple[Float64, Float64, Float64]:
    """Observations to predict: (row, col) [T, 2], log(z / base) [T] and the radius px [T] hidden around each.

    The radii are those at which missing pixels lie from their nearest observation.
    """
    gap = cv2.distanceTransform((~measured).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    distances = np.minimum(gap[~measured], _FARTHEST)
    rng = np.random.default_rng(seed)
    chosen = np.sort(rng.permutation(observed.densest)[:_TRIALS])
    radius = np.quantile(distances, rng.permutation((np.arange(len(chosen)) + 0.5) / len(chosen))) - 1.0
    truth = -np.log(observed.ratio.numpy()[chosen].astype(np.float64))
    return observed.index[chosen].astype(np.float64), truth, np.maximum(radius, 0.0)


def calibrate(error: Float64, variance: Float32) -> Calibration:
    """Calibration by trials: absolute errors of log z [T] and the variances [T] claimed for them."""
    order = np.argsort(variance, kind="stable")
    bins = min(_BINS, max(1, len(order) // 20))
    raw, true = [], []
    for part in np.array_split(order, bins):
        raw.append(float(np.log(np.maximum(np.median(variance[part]), 1e-20))))
        true.append(2.0 * float(np.log(np.maximum(np.quantile(error[part], _ONE_SIGMA), 1e-7))))
    return Calibration(np.maximum.accumulate(raw) + 1e-9 * np.arange(bins), np.maximum.accumulate(true))
