"""DepthCompleter: sparse depth and an image become dense depth with variance (paper Sec. ScaleCov)."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial import cKDTree

from sf_depth.config import DepthConfig
from sf_depth.core import gaussian_process as gp
from sf_depth.core.covariance import CovarianceModel, PixelCovariance, StructureCovariance
from sf_interfaces.errors import FormatError
from sf_interfaces.types import DepthMap, Float32, Float64, Keyframe, UInt8

_MIN_OBSERVATIONS = 4  # a plane and one to spare
_LENGTHS = (1.0, 2.0, 4.0, 8.0)  # candidate correlation lengths, in mean point spacings
_SUBSET = 800  # observations the hyper-parameters are estimated on
_SPACING_CELL = 16  # px; side of the cells that measure which area the observations cover


@dataclass(frozen=True, slots=True)
class Hyperparameters:
    """What one image says about its depth: correlation length px, prior variance, calibration factor."""

    length_px: float
    amplitude: float
    inflation: float


class DepthCompleter:
    """Completes the depth of keyframes; holds no state between them.

    Args:
        config: see :class:`DepthConfig`.
        covariance: replaces the training-free covariance by another, such as a learned one.
    """

    def __init__(self, config: DepthConfig, covariance: CovarianceModel | None = None) -> None:
        self._config = config
        self._covariance = covariance or StructureCovariance(config.color_scale, config.edge_strength)

    def complete(self, keyframe: Keyframe) -> Keyframe:
        """The keyframe with depth at every pixel and its variance, m^2.

        Measured pixels keep their depth and carry the sensor's variance. Pixels far from any measurement
        carry a large variance; with ``max_sigma`` they become NaN.

        Raises:
            FormatError: the keyframe has no depth, of another size, or fewer than four measured pixels.
        """
        depth = keyframe.depth
        if depth is None:
            raise FormatError(
                f"keyframe {keyframe.stamp_ns} has no depth to complete; give sparse depth, as of a LiDAR"
            )
        if depth.z.shape != keyframe.image.shape[:2]:
            raise FormatError(f"depth {depth.z.shape} and image {keyframe.image.shape[:2]} differ in size")
        measured = depth.valid
        if measured.sum() < _MIN_OBSERVATIONS:
            raise FormatError(
                f"keyframe {keyframe.stamp_ns} has {int(measured.sum())} measured pixels, completion needs "
                f"{_MIN_OBSERVATIONS}; check that the LiDAR sees what the camera sees"
            )
        z, variance = self._regress(depth, keyframe.image)
        sensor = np.full_like(z, self._config.depth_sigma**2) if depth.variance is None else depth.variance
        z = np.where(measured, depth.z, z)
        variance = np.where(measured, sensor, variance + self._config.depth_sigma**2)
        if self._config.max_sigma > 0:
            unsure = variance > self._config.max_sigma**2
            z, variance = np.where(unsure, np.nan, z), np.where(unsure, np.nan, variance)
        return replace(keyframe, depth=DepthMap(z, variance, depth.scale))

    def _regress(self, depth: DepthMap, image: UInt8) -> tuple[Float32, Float32]:
        """Depth and variance of all tiles that miss a pixel, [H, W] each."""
        index = np.argwhere(depth.valid)
        observed = gp.Observations(index, depth.z[index[:, 0], index[:, 1]])
        tree = cKDTree(index)
        estimated, pixels = self._estimate(observed, tree, image)
        height, width = depth.z.shape
        size = self._config.tile
        grid_rows, grid_cols = -(-height // size), -(-width // size)
        padded = np.ones((grid_rows * size, grid_cols * size), dtype=bool)
        padded[:height, :width] = depth.valid
        corner = size * np.argwhere(~padded.reshape(grid_rows, size, grid_cols, size).all(axis=(1, 3)))
        inside = np.indices((size, size)).reshape(2, -1).T
        z, variance = (np.full((height, width), np.nan, dtype=np.float32) for _ in range(2))
        for part in gp.chunks(len(corner)):
            query = np.minimum(corner[part, None] + inside, (height - 1, width - 1))
            center = corner[part] + 0.5 * (size - 1)
            tiles = gp.solve(observed, self._nearest(tree, center), center, pixels, self._config.nugget)
            amplitude = gp.amplitudes(tiles, estimated.amplitude) * estimated.inflation
            row, col = query[..., 0], query[..., 1]
            z[row, col], variance[row, col] = gp.predict(tiles, query, center, pixels, amplitude)
        return z, variance

    def _nearest(self, tree: cKDTree, center: Float64) -> np.ndarray:
        """The observations each tile is conditioned on, [B, K], nearest first."""
        count = min(self._config.neighbours, tree.n)
        return tree.query(center, k=count)[1].reshape(len(center), count)

    def _estimate(
        self, observed: gp.Observations, tree: cKDTree, image: UInt8
    ) -> tuple[Hyperparameters, PixelCovariance]:
        """Correlation length of the greatest leave-one-out likelihood, and variances to match its errors."""
        cells = np.unique(observed.index // _SPACING_CELL, axis=0)
        spacing = float(np.sqrt(len(cells) * _SPACING_CELL**2 / len(observed.z)))
        rng = np.random.default_rng(self._config.seed)
        chosen = np.sort(rng.permutation(len(observed.z))[:_SUBSET])
        center = observed.index[chosen].astype(np.float64)
        near = self._nearest(tree, center)
        lengths = (self._config.length_scale,) if self._config.length_scale > 0 else _LENGTHS
        best: tuple[float, Hyperparameters, PixelCovariance] | None = None
        for length in lengths:
            pixels = self._covariance(image, length * spacing)
            tiles = gp.solve(observed, near, center, pixels, self._config.nugget)
            typical = max(float(tiles.amplitude.median()), 1e-10)
            error, unit_variance = gp.leave_one_out(tiles)
            variance = gp.amplitudes(tiles, typical) * unit_variance
            normalised = error**2 / variance
            one, two = torch.quantile(normalised, torch.tensor([0.683, 0.954])).tolist()
            inflation = max(one, two / 4.0, 1e-3)  # 68 % within one sigma and 95 % within two
            cost = float((torch.log(inflation * variance) + torch.log1p(normalised / inflation)).mean())
            if best is None or cost < best[0]:
                best = cost, Hyperparameters(length * spacing, typical, inflation), pixels
        assert best is not None
        return best[1], best[2]
