"""What a keyframe says about the surface: coloured points with a confidence."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sf_interfaces.errors import FormatError
from sf_interfaces.types import Camera, DepthMap, Float32, Float64, Keyframe, Scale, UInt8
from sf_recon.config import ReconConfig

_SIGMA_FLOOR = 0.1  # of the largest accepted sigma: weights stay within a factor of 100


@dataclass(frozen=True, slots=True)
class Observation:
    """The usable pixels of one keyframe, in row-major order."""

    pixels: NDArray[np.intp]  # [M] flat pixel index
    points: Float32  # [M, 3] m, map frame
    colors: Float32  # [M, 3] in 0..1
    weights: Float32  # [M] inverse variance relative to the mean, mean 1


def rgb(image: UInt8) -> UInt8:
    """Image [H, W, 3]; a mono (flexion) image is repeated over the channels."""
    return image if image.ndim == 3 else np.repeat(image[:, :, None], 3, axis=2)


def to_map(camera: Camera, T_map_camera: Float64, z: Float32, pixels: NDArray[np.intp]) -> Float32:
    """Points [M, 3] m (map frame) of flat pixel indices [M] with the depth image z [H, W]."""
    row, column = np.divmod(pixels, camera.width)
    uv = np.stack([column + 0.5, row + 0.5], axis=-1)
    local = camera.unproject(uv, z.reshape(-1)[pixels].astype(np.float64))
    return (local @ T_map_camera[:3, :3].T + T_map_camera[:3, 3]).astype(np.float32)


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
    usable = depth.valid.reshape(-1)
    weights = np.ones(usable.shape, np.float32)
    if depth.variance is not None:
        z, variance = depth.z.reshape(-1), depth.variance.reshape(-1)
        largest = (config.max_relative_sigma * np.where(usable, z, 1)) ** 2
        with np.errstate(invalid="ignore"):
            usable = usable & (variance <= largest)
        known = np.where(usable, variance, largest)
        weights = (largest / np.maximum(known, _SIGMA_FLOOR**2 * largest)).astype(np.float32)
    pixels = np.flatnonzero(usable)
    kept = weights[pixels]
    return Observation(
        pixels=pixels,
        points=to_map(camera, keyframe.T_map_camera, depth.z, pixels),
        colors=rgb(keyframe.image).reshape(-1, 3)[pixels].astype(np.float32) / np.float32(255),
        weights=(kept / max(float(kept.mean()), 1e-12) if len(kept) else kept).astype(np.float32),
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
