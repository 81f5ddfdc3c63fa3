"""Configuration of the depth block."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass

from sf_interfaces.config import option


@dataclass(frozen=True, slots=True)
class DepthConfig:
    """How sparse depth becomes dense depth with variance (paper Sec. ScaleCov)."""

    # completion (ScaleCov)
    neighbours: int = option(16, "observations each tile of pixels is conditioned on", low=4, high=64)
    tile: int = option(4, "side in px of the tiles that share their observations", low=1, high=32)
    length_scale: float = option(2.0, "correlation length in point spacings", low=0.1, high=64.0)
    color_scale: float = option(
        0.1, "colour difference (0..1) at which an observation counts half", low=0.01, high=10.0
    )
    covariance: str = option("structure", "covariance of depth: structure (of the image) or depthcov (a network)")
    covariance_weights: str = option("", "path of the network's checkpoint")
    covariance_color_scale: float = option(
        0.08, "colour difference (0..1) over which correlation falls to 0.6", low=0.01, high=10.0
    )
    edge_strength: float = option(
        1.0, "how much correlation shortens across image edges; 0 = not at all", low=0.0, high=100.0
    )
    nugget: float = option(0.1, "noise variance of an observation relative to the prior", low=1e-5, high=10.0)
    depth_sigma: float = option(0.03, "noise of a measured depth, m (1 sigma)", low=1e-5, high=10.0)
    max_sigma: float = option(0.0, "pixels less certain than this, m, become NaN; 0 = keep all", low=0.0)
    seed: int = option(0, "seed of the observations that calibrate the variance", low=0)
