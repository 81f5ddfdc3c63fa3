"""KISS-ICP on depth images."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
from kiss_icp.config import KISSConfig
from kiss_icp.kiss_icp import KissICP

from peers import points_of
from sf_interfaces.types import Camera, Float64, Frame

RANGE, VOXEL = (0.1, 10.0), 0.05  # m


class KissIcp:
    """With a voxel for rooms and no de-skewing: a depth image has one time."""

    def __init__(self, camera: Camera) -> None:
        config = KISSConfig()
        config.data.min_range, config.data.max_range, config.data.deskew = *RANGE, False
        config.mapping.voxel_size = VOXEL
        self._odometry = KissICP(config)

    def track(self, frame: Frame) -> Float64 | None:
        self._odometry.register_frame(points_of(frame), np.zeros(0))
        return np.array(self._odometry.last_pose)


PEERS = {"KISS-ICP": KissIcp}
