"""Improved Point Rasterization: the compiled kernel behind the same signature as its numpy definition."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Callable, Collection
from functools import partial

import numpy as np

from sf_interfaces.errors import ConfigError
from sf_interfaces.types import Camera, Float32, Float64
from sf_recon.config import ReconConfig
from sf_recon.core.device import torch_device
from sf_recon.core.ipr_reference import OUTPUTS, Raster, RasterOptions, rasterize_reference
from sf_recon.core.native import native
from sf_recon.core.rasterizer_cuda import CudaRasterizer

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
    points: Float32,
    camera: Camera,
    T_camera_map: Float64,
    options: RasterOptions,
    threads: int = 0,
    *,
    outputs: Collection[str] = ("position",),
    normals: Float32 | None = None,
) -> Raster:
    """Draw points by the compiled kernel.

    Args:
        points: [N, 3] m, map frame; rows that are not finite or lie behind the camera are left out.
        camera: pinhole camera without distortion.
        T_camera_map: maps the points into the camera frame.
        options: lengths in the unit of the points.
        threads: 0 for all. The result does not depend on it.
        outputs: images wanted besides the depth: position, index, weight, normal. Each costs time.
        normals: [N, 3] unit normals of the points, map frame; without them, normals come from the drawn depth.
    """
    images = native().rasterize(
        np.ascontiguousarray(points, dtype=np.float32),
        np.ascontiguousarray(T_camera_map, dtype=np.float32),
        *(camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height),
        *(options.radius, options.near, options.max_half, options.k_ray, options.layer_gap, options.sigma),
        None if normals is None else np.ascontiguousarray(normals, dtype=np.float32),
        *(name in outputs for name in OUTPUTS),
        threads,
    )
    return Raster(*images)


def make_rasterizer(config: ReconConfig) -> Rasterizer:
    """The rasteriser that ``config.rasterizer`` names, on ``config.device``.

    Raises:
        ConfigError: another name, or a device that is not to be had.
    """
    device = torch_device(config.device)
    if config.rasterizer == "reference":
        return rasterize_reference
    if config.rasterizer == "native":
        return (
            CudaRasterizer(device.index).draw if device.type == "cuda" else partial(rasterize, threads=config.threads)
        )
    raise ConfigError(f"recon.rasterizer must be native or reference, got '{config.rasterizer}'")
