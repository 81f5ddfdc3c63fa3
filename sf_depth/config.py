"""Configuration of the depth block."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass

from sf_interfaces.config import option


@dataclass(frozen=True, slots=True)
class DepthConfig:
    """How sparse depth becomes dense depth with variance (paper Sec. ScaleCov)."""

    mode: str = option("complete", "what the node does: complete, slam, posed or mvd (calls only)")
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
    registration_sigma: float = option(
        0.0, "how far measured depth may lie from where the image shows it, px (1 sigma)", low=0.0, high=16.0
    )
    max_sigma: float = option(0.0, "pixels less certain than this, m, become NaN; 0 = keep all", low=0.0)
    seed: int = option(0, "seed of the observations that calibrate the variance", low=0)
    # multi-view depth (paper Sec. Depth Recovery with Dense Correlation, Depth Frame Selection)
    matcher: str = option("flow", "dense matcher: flow, or one of an installed package")
    intrinsics: str = option("f", "what is estimated of an unknown camera: f, pinhole or radial")
    lens: bool = option(True, "an image set without poses that shows a lens is rectified")
    stride: int = option(4, "dense bundle adjustment uses every n-th pixel of both axes", low=1, high=32)
    rematches: int = option(1, "rounds of matching again from the geometry found so far", low=0, high=4)
    max_sources: int = option(4, "views a reference is triangulated with at most", low=1, high=16)
    max_side: int = option(1024, "larger images are reduced to this side for multi-view depth, px", low=160)
    max_angle: float = option(30.0, "facing angle of a good neighbour, deg", low=1.0, high=90.0)
    min_baseline: float = option(0.03, "baseline of a good neighbour over scene depth, at least", low=0.0)
    max_baseline: float = option(0.4, "baseline of a good neighbour over scene depth, at most", low=0.0)
    monodepth: str = option("none", "base of completion: none, structure, metric3d, depth_anything or installed")
    monodepth_path: str = option("", "folder of its weights; empty: the user's cache (nothing is downloaded)")
    keyframe_baseline: float = option(0.06, "posed: motion over scene depth between two depth maps", low=0.0)
