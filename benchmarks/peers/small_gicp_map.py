"""small_gicp: voxelised GICP of each depth image against the map of those before it."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import small_gicp

from peers import points_of
from sf_interfaces.geometry import se3
from sf_interfaces.types import Camera, Float64, Frame

DOWNSAMPLE, VOXEL, REACH, THREADS = 0.02, 0.05, 0.1, 2  # m, m, m


class SmallGicp:
    """Starts from the motion of the frame before."""

    def __init__(self, camera: Camera) -> None:
        self._map = small_gicp.GaussianVoxelMap(VOXEL)
        self._T, self._motion, self._started = np.eye(4), np.eye(4), False

    def track(self, frame: Frame) -> Float64 | None:
        cloud, _ = small_gicp.preprocess_points(points_of(frame), DOWNSAMPLE, num_threads=THREADS)
        if self._started:
            guess = self._T @ self._motion
            result = small_gicp.align(self._map, cloud, guess, max_correspondence_distance=REACH, num_threads=THREADS)
            # Products of products: rounding grows without bound where rotations are inverted by transposition.
            found = se3.orthonormalise(result.T_target_source)
            self._motion, self._T = se3.inverse(self._T) @ found, found
        self._map.insert(cloud, self._T)
        self._started = True
        return self._T


PEERS = {"small_gicp, scan to map": SmallGicp}
