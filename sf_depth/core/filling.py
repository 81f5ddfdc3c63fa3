"""From triangulated to complete depth: a monocular base where there is a model, ScaleCov for its scale."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from sf_depth.config import DepthConfig
from sf_depth.core.estimator import DepthCompleter
from sf_depth.core.monodepth import MonoDepth, load_monodepth
from sf_interfaces.types import DepthMap, Float32, Keyframe

# Relative deviation for every image width of distance from triangulated depth: another surface may be there,
# which no interpolation of what was seen can know. What poses and calibration get wrong around a gap they get wrong
# in it, too: the relative variance of the nearest triangulated pixel is added.
_UNSEEN = 1.0
_FIRST_WINDOW, _WINDOWS = 4.0, 6  # px, half the side of the smallest window; each of the others is twice as wide


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
    """Variance [H, W] of the log depth seen around every pixel, in a window of twice its distance [H, W] px to it.

    What a gap hides belongs to one of the surfaces around it, and which one is a guess.
    """
    seen = np.isfinite(z).astype(np.float32)
    log = np.log(np.where(seen > 0, z, 1.0)).astype(np.float32)
    level = np.clip(np.log2(2.0 * np.maximum(away, 1.0) / _FIRST_WINDOW), 0, _WINDOWS - 1)
    out = np.zeros_like(log)
    for k in range(_WINDOWS):
        side = int(2 * _FIRST_WINDOW * 2**k) + 1
        count, first, second = (cv2.blur(part, (side, side)) for part in (seen, seen * log, seen * log * log))
        mean = first / np.maximum(count, 1e-6)
        own = np.maximum(second / np.maximum(count, 1e-6) - mean * mean, 0.0)
        out += np.maximum(1.0 - np.abs(level - k), 0.0).astype(np.float32) * own
    return out
