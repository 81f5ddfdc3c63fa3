"""What a keyframe says about the surface: coloured points with a confidence."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from sf_interfaces.errors import FormatError
from sf_interfaces.types import Camera, DepthMap, Float32, Float64, Keyframe, Scale, UInt8
from sf_recon.config import ReconConfig

_SIGMA_FLOOR = 0.1  # of the largest accepted sigma: weights stay within a factor of 100
_AGREEING = 0.05  # relative difference of depth, up to which neighbouring pixels agree
_NEIGHBOURS = 2  # that must agree with a measured pixel
_DENSE = 0.2  # share of measured pixels, above which each has neighbours


@dataclass(frozen=True, slots=True)
class Observation:
    """The usable pixels of one keyframe, in row-major order."""

    pixels: NDArray[np.intp]  # [M] flat pixel index
    points: Float32  # [M, 3] m, map frame
    colors: Float32  # [M, 3] in 0..1
    weights: Float32  # [M] inverse variance relative to the mean, mean 1
    sigmas: Float32  # [M] m, standard deviation of the depth; where unknown, the pixel's footprint
    footprints: Float32  # [M] m, width of the surface that a pixel sees head-on


def rgb(image: UInt8) -> UInt8:
    """Image [H, W, 3]; a mono (flexion) image is repeated over the channels."""
    return image if image.ndim == 3 else np.repeat(image[:, :, None], 3, axis=2)


def backproject(camera: Camera, T_map_camera: Float64, z: Float32, pixels: NDArray[np.intp]) -> tuple[Float32, Float32]:
    """Points [M, 3] m and unit viewing directions [M, 3], map frame, of flat pixel indices [M] with depth z [M]."""
    R = T_map_camera[:3, :3].astype(np.float32)
    row, column = np.divmod(pixels, camera.width)
    rays = np.empty((len(pixels), 3), np.float32)
    rays[:, 0] = (column + 0.5 - camera.cx) / camera.fx
    rays[:, 1] = (row + 0.5 - camera.cy) / camera.fy
    rays[:, 2] = 1
    points = (rays * z[:, None]) @ R.T + T_map_camera[:3, 3].astype(np.float32)
    return points, (rays / np.linalg.norm(rays, axis=1, keepdims=True)) @ R.T


def supported(z: Float32) -> NDArray[np.bool_]:
    """Pixels of a depth image [H, W] m that two of their eight neighbours agree with.

    Others fly between two surfaces or before one, as at the edges of a time-of-flight image; seen from close by, each
    would cover what is behind it.
    """
    height, width = z.shape
    around = np.pad(z, 1, constant_values=np.nan)
    agreeing = np.zeros(z.shape, np.uint8)
    for row, column in product(range(3), repeat=2):
        other = around[row : row + height, column : column + width]
        agreeing += np.abs(other - z) < _AGREEING * z
    return agreeing >= _NEIGHBOURS + 1  # the pixel agrees with itself


def observe(keyframe: Keyframe, config: ReconConfig) -> Observation:
    """Unproject the depth that is certain enough.

    Raises:
        FormatError: the keyframe has no depth, or its depth has another size than its image.
    """
    depth, camera = keyframe.depth, keyframe.camera
    if depth is None:
        raise FormatError(f"keyframe at {keyframe.stamp_ns} ns has no depth; put a depth block before reconstruction")
    if depth.z.shape != (camera.height, camera.width):
        raise FormatError(
            f"keyframe at {keyframe.stamp_ns} ns: depth is {depth.z.shape[1]}x{depth.z.shape[0]} but the "
            f"camera is {camera.width}x{camera.height}; register depth to the image first"
        )
    # A stated variance already tells what to trust; of a bare depth image only the neighbours do.
    bare = depth.variance is None and depth.density > _DENSE
    usable = (supported(depth.z) if bare else depth.valid).reshape(-1)
    weights = np.ones(usable.shape, np.float32)
    if depth.variance is not None:
        z, variance = depth.z.reshape(-1), depth.variance.reshape(-1)
        largest = (config.max_relative_sigma * np.where(usable, z, 1)) ** 2
        with np.errstate(invalid="ignore"):
            usable = usable & (variance >= 0) & (variance <= largest)
        known = np.where(usable, variance, largest)
        weights = (largest / np.maximum(known, _SIGMA_FLOOR**2 * largest)).astype(np.float32)
    pixels = np.flatnonzero(usable)
    kept = weights[pixels]
    footprints = (depth.z.reshape(-1)[pixels] / np.sqrt(camera.fx * camera.fy)).astype(np.float32)
    sigmas = footprints if depth.variance is None else np.sqrt(depth.variance.reshape(-1)[pixels])
    return Observation(
        pixels=pixels,
        points=backproject(camera, keyframe.T_map_camera, depth.z.reshape(-1)[pixels], pixels)[0],
        colors=rgb(keyframe.image).reshape(-1, 3)[pixels].astype(np.float32) / np.float32(255),
        weights=(kept / max(float(kept.mean()), 1e-12) if len(kept) else kept).astype(np.float32),
        sigmas=sigmas.astype(np.float32),
        footprints=footprints,
    )


def auto_resolution(depth: DepthMap, camera: Camera, floor: float) -> float:
    """Median pixel footprint z / f of a depth image, to two digits; metric depth has a lower bound in m.

    Raises:
        FormatError: the depth image is empty.
    """
    z = depth.z[depth.valid]
    if len(z) == 0:
        raise FormatError("the first keyframe has no valid depth; set recon.resolution")
    footprint = float(np.median(z)) / float(np.sqrt(camera.fx * camera.fy))
    rounded = float(f"{footprint:.1e}")
    return max(rounded, floor) if depth.scale is Scale.METRIC else rounded
