"""From triangulated to complete depth: gaps are filled from what bounds them, or by a monocular model and ScaleCov.

What several views see is dense and has gaps where nothing could be matched. Depth and its planes diffuse into them
(:mod:`diffusion`), through what looks alike. How sure that is tells the diffusion, too.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from sf_depth.config import DepthConfig
from sf_depth.core.conditioning import coarse_slopes
from sf_depth.core.diffusion import CHANNELS, Diffusion, spread
from sf_depth.core.estimator import DepthCompleter
from sf_depth.core.monodepth import MonoDepth, load_monodepth
from sf_depth.core.parallel import one_torch_thread
from sf_depth.core.scalecov import MIN_OBSERVATIONS
from sf_depth.core.supports import supports
from sf_interfaces.errors import FormatError
from sf_interfaces.types import DepthMap, Float32, Keyframe

_REACH = 0.3  # image widths over which a plane that bounds a gap is lost
_CELL = 4  # px; planes are fitted to one pixel a cell
_SURE, _LEAST = 0.1, 0.25  # relative deviation of what gaps are filled from, where that is this share of what is seen
_FARTHEST = 1.2  # inverse depth beyond nearly all that is seen, as a factor
# Variance of the log depth in a gap, in units of what it grows with: fitted to exact and sensor depth.
_BOUNDS = 0.63  # variance of what bounds it: a walk may have crossed an edge where there is none in depth, or not
_PLANES = 0.7  # square of the difference that the planes make
_SEEN = 0.8  # relative variance of what bounds it
_AWAY = 1.8  # relative deviation for every image width of distance from what is seen


class Filler:
    """Completes keyframes whose depth has gaps.

    Args:
        config: see :class:`DepthConfig`; ``monodepth`` names the base, ``none``: gaps are filled by diffusion.

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
        assert seen is not None and seen.variance is not None
        if int(seen.valid.sum()) < MIN_OBSERVATIONS:
            raise FormatError(f"keyframe {keyframe.stamp_ns}: fewer than {MIN_OBSERVATIONS} pixels have depth")
        z, variance = _filled(keyframe.image, seen)
        if self._model is not None:
            guessed = self._model(keyframe.image, keyframe.camera, seen).z
            base = np.nan_to_num(guessed, nan=float(np.nanmedian(guessed)))
            full = self._completer.complete(keyframe, base).depth
            assert full is not None
            variance = np.where(seen.valid, variance, full.variance + variance * (full.z / z) ** 2)
            z = full.z
        return replace(keyframe, depth=DepthMap(z, variance, seen.scale))


def _filled(image: np.ndarray, seen: DepthMap) -> tuple[Float32, Float32]:
    """Depth and variance without gaps, [H, W] each."""
    assert seen.variance is not None
    width = image.shape[1]
    d = np.where(seen.valid, 1.0 / np.where(seen.valid, seen.z, 1.0), 0.0).astype(np.float32)
    sure = seen.valid & (seen.variance * d * d < _SURE**2)
    support = supports(image, d, sure if sure.sum() > _LEAST * seen.valid.sum() else seen.valid)
    d = np.where(support, d, np.float32(0))
    relative = np.where(support, seen.variance * d * d, 0.0).astype(np.float32)
    slope = spread(image, _slopes(d, support), support, _REACH * width)[..., :2]
    along, level, square, known = np.moveaxis(
        Diffusion(image, support).fill(np.stack([d, d, d * d, relative], axis=2), slope=slope), 2, 0
    )
    low, high = np.quantile(d[support], [0.01, 0.99])
    along, level = (np.clip(part, low / _FARTHEST, high * _FARTHEST) for part in (along, level))
    known = np.clip(known, relative[support].min(), relative[support].max())  # a mean, which few steps may miss
    away = cv2.distanceTransform((~support).astype(np.uint8), cv2.DIST_L2, 3) / width
    unsure = _BOUNDS * np.maximum(square / level**2 - 1.0, 0.0) + _PLANES * np.log(along / level) ** 2
    unsure += _SEEN * known + (_AWAY * away) ** 2
    z = np.where(seen.valid, seen.z, 1.0 / along)
    return z, np.where(seen.valid, seen.variance, unsure * z * z)


def _slopes(d: Float32, support: np.ndarray) -> Float32:
    """Slopes of the planes [H, W, 4] that the supporting pixels lie on, (right, down, 0, 0) per px: of the nearest."""
    out = np.zeros((*d.shape, CHANNELS), np.float32)
    with one_torch_thread():
        index, slope = coarse_slopes(d, support, _CELL)
    missing = np.ones(d.shape, np.uint8)
    missing[tuple(index.T)] = 0
    _, label = cv2.distanceTransformWithLabels(missing, cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL)
    owner = np.zeros(int(label.max()) + 1, np.int64)
    owner[label[tuple(index.T)]] = np.arange(len(index))
    out[..., :2] = slope[owner[label]]
    return out
