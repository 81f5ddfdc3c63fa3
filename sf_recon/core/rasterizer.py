"""Improved Point Rasterization: the compiled kernel behind the same signature as its numpy definition."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from sf_interfaces.errors import ConfigError
from sf_interfaces.types import Camera, Float32, Float64
from sf_recon.config import ReconConfig
from sf_recon.core.ipr_reference import Raster, RasterOptions, rasterize_reference
from sf_recon.core.native import native

NEAR = 10.0  # near plane, in resolutions: closer, a point would cover a visible part of the image

Rasterizer = Callable[[Float32, Camera, Float64, RasterOptions], Raster]


def raster_options(config: ReconConfig, resolution: float) -> RasterOptions:
    """The configuration in metres, for points of one resolution."""
    return RasterOptions(
        radius=0.5 * config.coverage * resolution,
        near=NEAR * resolution,
        layer_gap=config.layer_gap * resolution,
        max_half=float(config.max_window),
        k_ray=config.k_ray,
        sigma=config.ray_sigma,
    )


def rasterize(
    points: Float32, camera: Camera, T_camera_map: Float64, options: RasterOptions, threads: int = 0
) -> Raster:
    """Draw points [N, 3] (map frame) by the compiled kernel. The result does not depend on ``threads``."""
    depth, position = native().rasterize(
        np.ascontiguousarray(points, dtype=np.float32),
        np.ascontiguousarray(T_camera_map, dtype=np.float32),
        camera.fx,
        camera.fy,
        camera.cx,
        camera.cy,
        camera.width,
        camera.height,
        options.radius,
        options.near,
        options.max_half,
        options.k_ray,
        options.layer_gap,
        options.sigma,
        threads,
    )
    return Raster(depth, position)


def make_rasterizer(config: ReconConfig) -> Rasterizer:
    """The rasteriser that ``config.rasterizer`` names.

    Raises:
        ConfigError: the name is neither native nor reference.
    """
    if config.rasterizer == "reference":
        return rasterize_reference
    if config.rasterizer == "native":
        return partial(rasterize, threads=config.threads)
    raise ConfigError(f"recon.rasterizer must be native or reference, got '{config.rasterizer}'")
