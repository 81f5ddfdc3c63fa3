"""Correspondences of a reference with all its sources: every pixel for its depth, every n-th for dense BA."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sf_depth.core.dense_ba import Estimate, Observations
from sf_depth.core.matching import pixel_grid
from sf_depth.core.start import Size
from sf_interfaces.types import Float32


@dataclass(frozen=True, slots=True)
class Matched:
    """Cross-checked correspondences: target [S, H, W, 2] px and weight [S, H, W]; ``seen`` is every n-th of them.

    A coarse match has half the rows and columns; its pixels are those of the full images.
    """

    target: Float32
    weight: Float32
    seen: Observations
    grid: tuple[int, int]  # rows and columns of ``seen``


def matched(target: Float32, weight: Float32, stride: int, size: Size) -> Matched:
    """Correspondences with every n-th pixel of both axes as observations."""
    every = (slice(stride // 2, None, stride),) * 2
    count, height, width = weight.shape
    uv = pixel_grid((height, width))[every] * np.array([size.width / width, size.height / height], np.float32)
    columns = target[:, every[0], every[1]].reshape(count, -1, 2).transpose(0, 2, 1).astype(np.float64)
    seen = Observations(
        np.ascontiguousarray(uv.reshape(-1, 2).T, dtype=np.float64),
        np.ascontiguousarray(columns),
        weight[:, every[0], every[1]].reshape(count, -1).astype(np.float64),
    )
    return Matched(target, weight, seen, uv.shape[:2])


def thinned(seen: Observations, at: Estimate, n: int) -> tuple[Observations, Estimate]:
    """Every n-th pixel that a source sees, and the estimate of these."""
    every = np.flatnonzero(seen.weight.any(axis=0))[::n]
    few = Observations(seen.uv[:, every], seen.target[:, :, every], seen.weight[:, every])
    return few, replace(at, inverse_depth=at.inverse_depth[every])
