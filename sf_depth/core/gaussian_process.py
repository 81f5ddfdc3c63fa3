"""Gaussian-process regression of a scale image, tile by tile (paper Sec. ScaleCov, both GP equations).

Every tile of pixels is conditioned on its nearest observations. The regressed scale is ``base / z``: inverse
depth is linear on a plane, so a linear prior makes planes exact at any slant.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from sf_depth.core.covariance import PixelCovariance, kernel
from sf_interfaces.types import Float32, Float64

_CHUNK = 256  # tiles solved at once; few enough to stay in the processor's cache
_PRIOR_COUNT = 8.0  # how many observations the image-wide amplitude weighs in a tile's own


@dataclass(frozen=True, slots=True)
class Observations:
    """Measured pixels: integer (row, col) [N, 2] and depth [N] m."""

    index: np.ndarray
    z: Float32


@dataclass(frozen=True, slots=True)
class Solved:
    """Tiles conditioned on their observations."""

    x: torch.Tensor  # [B, K, 2] px, relative to the tile's centre
    E: torch.Tensor  # [B, K, 3] px^2
    feature: torch.Tensor  # [B, K, C]
    radius: torch.Tensor  # [B, 1, 1] px, distance of the farthest observation
    base: torch.Tensor  # [B] m, harmonic mean depth
    scale: torch.Tensor  # [B, K] base / z
    inverse: torch.Tensor  # [B, K, K] (K_nn + nugget I)^-1
    alpha: torch.Tensor  # [B, K] inverse @ (scale - 1)

    @property
    def amplitude(self) -> torch.Tensor:
        """Prior variance that maximises each tile's marginal likelihood (closed form), [B]."""
        return ((self.scale - 1.0) * self.alpha).mean(dim=1)


def _trend(x1: torch.Tensor, x2: torch.Tensor, radius: torch.Tensor) -> torch.Tensor:
    """Covariance of an unknown plane in inverse depth, [B, N, M]."""
    return 1.0 + (x1 @ x2.transpose(1, 2)) / radius**2


def _gather(pixels: PixelCovariance, index: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
    row, col = index[..., 0], index[..., 1]
    return torch.from_numpy(pixels.shape[row, col]), torch.from_numpy(pixels.feature[row, col])


def solve(observed: Observations, near: np.ndarray, center: Float64, pixels: PixelCovariance, nugget: float) -> Solved:
    """Condition tiles with centres [B, 2] (row, col) on the observations ``near`` [B, K]."""
    index = observed.index[near]
    x = torch.from_numpy((index - center[:, None]).astype(np.float32))[..., [1, 0]]
    E, feature = _gather(pixels, index)
    inverse_depth = torch.from_numpy(1.0 / observed.z[near])
    mean = inverse_depth.mean(dim=1, keepdim=True)
    scale = inverse_depth / mean
    radius = x.norm(dim=2).amax(dim=1).clamp_min(1.0)[:, None, None]
    K = kernel(x, E, feature, x, E, feature) + _trend(x, x, radius)
    K.diagonal(dim1=1, dim2=2).add_(nugget)
    inverse = torch.cholesky_inverse(torch.linalg.cholesky(K))
    alpha = (inverse @ (scale - 1.0)[..., None])[..., 0]
    return Solved(x, E, feature, radius, 1.0 / mean[:, 0], scale, inverse, alpha)


def predict(
    tiles: Solved, query: np.ndarray, center: Float64, pixels: PixelCovariance, amplitude: torch.Tensor
) -> tuple[Float32, Float32]:
    """Depth [B, M] m and variance [B, M] m^2 of the pixels ``query`` [B, M, 2] (row, col) of each tile."""
    x = torch.from_numpy((query - center[:, None]).astype(np.float32))[..., [1, 0]]
    E, feature = _gather(pixels, query)
    K = kernel(x, E, feature, tiles.x, tiles.E, tiles.feature) + _trend(x, tiles.x, tiles.radius)
    scale = 1.0 + (K @ tiles.alpha[..., None])[..., 0]
    prior = 2.0 + (x * x).sum(dim=2) / tiles.radius[..., 0] ** 2
    left = prior - ((K @ tiles.inverse) * K).sum(dim=2)
    variance = left.clamp_min(0.0) * amplitude[:, None]
    low, high = tiles.scale.amin(dim=1, keepdim=True), tiles.scale.amax(dim=1, keepdim=True)
    scale = torch.minimum(torch.maximum(scale, 0.8 * low), 1.25 * high)  # a plane may not leave the scene
    z = tiles.base[:, None] / scale
    return z.numpy(), (z**2 * variance / scale**2).numpy()


def leave_one_out(tiles: Solved) -> tuple[torch.Tensor, torch.Tensor]:
    """Error and unit-amplitude variance of each tile's nearest observation, given its others, [B]."""
    own = tiles.inverse[:, 0, 0]
    return tiles.alpha[:, 0] / own, 1.0 / own


def amplitudes(tiles: Solved, typical: float) -> torch.Tensor:
    """Each tile's own amplitude drawn towards the image's typical one, [B]."""
    count = tiles.scale.shape[1]
    return (count * tiles.amplitude + _PRIOR_COUNT * typical) / (count + _PRIOR_COUNT)


def chunks(count: int) -> list[slice]:
    """Slices over ``count`` tiles that fit in memory."""
    return [slice(start, start + _CHUNK) for start in range(0, count, _CHUNK)]
