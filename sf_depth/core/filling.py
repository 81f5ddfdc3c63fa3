"""From triangulated to complete depth: a monocular base where there is a model, ScaleCov for its scale."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from sf_depth.config import DepthConfig
from sf_depth.core.estimator import DepthCompleter
from sf_depth.core.monodepth import MonoDepth, load_monodepth
from sf_interfaces.types import DepthMap, Float32, Float64, Keyframe

# Relative deviation for every image width of distance from triangulated depth: another surface may be there,
# which no interpolation of what was seen can know. What poses and calibration get wrong around a gap they get wrong
# in it, too: the relative variance of the nearest triangulated pixel is added.
_UNSEEN = 1.0
_LEAST_WINDOW = 4.0  # px, half the side of the smallest window that surfaces are compared in


class Filler:
    """Completes keyframes whose depth has gaps.

    Args:
        config: see :class:`DepthConfig`; ``monodepth`` names the base.

    Raises:
        ConfigError: that model is not installed.
    """

    def __init__(self, config: DepthConfig) -> None:
        self._completer = DepthCompleter(config)
        self._model: MonoDepth | None = None
        if config.monodepth != "none":
            self._model = load_monodepth(config.monodepth, config.monodepth_path)

    def fill(self, keyframe: Keyframe) -> Keyframe:
        """The keyframe with depth and variance at every pixel.

        Raises:
            FormatError: it has too little depth to start from.
        """
        seen = keyframe.depth
        base = None
        if self._model is not None:
            guessed = self._model(keyframe.image, keyframe.camera, seen).z
            base = np.nan_to_num(guessed, nan=float(np.nanmedian(guessed)))
        full = self._completer.complete(keyframe, base)
        assert full.depth is not None and full.depth.variance is not None
        assert seen is not None and seen.variance is not None
        away, owner = _nearest(seen.valid)
        unseen = (_UNSEEN * away / keyframe.camera.width) ** 2
        unseen += np.where(seen.valid, 0.0, (seen.variance / seen.z**2)[owner] + _disagreement(seen.z, away))
        variance = full.depth.variance + unseen * full.depth.z**2
        return replace(full, depth=DepthMap(full.depth.z, variance, full.depth.scale))


def _nearest(valid: np.ndarray) -> tuple[Float32, tuple[np.ndarray, np.ndarray]]:
    """Distance [H, W] px of every pixel to the nearest valid one, and the row and column of that one."""
    gaps = (~valid).astype(np.uint8)
    away, label = cv2.distanceTransformWithLabels(gaps, cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL)
    place = np.zeros(int(label.max()) + 1, np.int64)
    place[label[valid]] = np.flatnonzero(valid)
    return np.asarray(away), np.unravel_index(place[label], valid.shape)


def _disagreement(z: Float32, away: Float32) -> Float32:
    """Variance [H, W] of the log depth seen around each gap's pixel, up to twice its distance [H, W] px from it.

    What a gap hides belongs to one of the surfaces around it, and which one is a guess. 0 where depth is seen.
    """
    seen = np.isfinite(z)
    log = np.log(np.where(seen, z, 1.0)).astype(np.float64)
    row, col = np.nonzero(~seen)
    half = np.maximum(2.0 * away[row, col], _LEAST_WINDOW).astype(np.int64)
    top, left = np.maximum(row - half, 0), np.maximum(col - half, 0)
    bottom, right = np.minimum(row + half + 1, z.shape[0]), np.minimum(col + half + 1, z.shape[1])

    def around(values: np.ndarray) -> Float64:
        """Sum over the window of every pixel, [G]."""
        total = cv2.integral(values, sdepth=cv2.CV_64F)
        return np.asarray(total[bottom, right] - total[top, right] - total[bottom, left] + total[top, left])

    count = np.maximum(around(seen.astype(np.float64)), 1.0)
    mean = around(log) / count
    out = np.zeros(z.shape, np.float32)
    out[row, col] = np.maximum(around(log * log) / count - mean * mean, 0.0)
    return out
