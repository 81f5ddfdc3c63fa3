"""Gaussian-process regression of a scale image, tile by tile (paper Sec. ScaleCov, both GP equations).

``s_* = K_fn (K_nn + sigma_n^2 I)^-1 s_n`` and ``Sigma_* = K_ff - K_fn (K_nn + sigma_n^2 I)^-1 K_nf``, where n are
the observations a tile is conditioned on and f its pixels; s is what the mean leaves of log(z / base).
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass

import torch

from sf_depth.core.covariance import kernel

_PRIOR_COUNT = 8.0  # how many observations the image-wide amplitude weighs in a tile's own


@dataclass(frozen=True, slots=True)
class Points:
    """Pixels as the kernel sees them: x [B, N, 2] px, shape E [B, N, 3] px^2, feature [B, N, C]."""

    x: torch.Tensor
    E: torch.Tensor
    feature: torch.Tensor


def kernel_of(a: Points, b: Points) -> torch.Tensor:
    """Correlation [B, N, M] of two sets of pixels."""
    return kernel(a.x, a.E, a.feature, b.x, b.E, b.feature)


@dataclass(frozen=True, slots=True)
class Conditioned:
    """Tiles conditioned on ``K`` observations each."""

    n: Points
    s: torch.Tensor  # [B, K]
    inverse: torch.Tensor  # [B, K, K] (K_nn + sigma_n^2 I)^-1
    alpha: torch.Tensor  # [B, K] inverse @ s

    def amplitude(self, typical: float) -> torch.Tensor:
        """Prior variance of the greatest marginal likelihood, drawn to the image's ``typical`` one, [B]."""
        count = self.s.shape[1]
        return ((self.s * self.alpha).sum(dim=1) + _PRIOR_COUNT * typical) / (count + _PRIOR_COUNT)


def condition(n: Points, s: torch.Tensor, noise: torch.Tensor) -> Conditioned:
    """Solve for observations ``s`` [B, K] of noise variance ``noise`` [B, K], relative to the prior's."""
    K_nn = kernel_of(n, n)
    K_nn.diagonal(dim1=1, dim2=2).add_(noise)
    inverse = torch.cholesky_inverse(torch.linalg.cholesky(K_nn))
    return Conditioned(n, s, inverse, (inverse @ s[..., None])[..., 0])


def predict(tiles: Conditioned, f: Points) -> tuple[torch.Tensor, torch.Tensor]:
    """s_* and the diagonal of Sigma_* at unit amplitude, [B, M] each."""
    K_nf = kernel_of(tiles.n, f)  # [B, K, M]
    mean = (tiles.alpha[..., None] * K_nf).sum(dim=1)
    return mean, (1.0 - (K_nf * (tiles.inverse @ K_nf)).sum(dim=1)).clamp_min(0.0)
