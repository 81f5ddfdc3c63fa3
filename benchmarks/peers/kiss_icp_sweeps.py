"""KISS-ICP on the sweeps of a LiDAR, as it comes."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
from kiss_icp.config import KISSConfig
from kiss_icp.kiss_icp import KissICP

from sf_interfaces.types import Camera, Float64, PointCloud


class KissIcpSweeps:
    """With its own settings for cars; sweeps without times of their points are not de-skewed."""

    def __init__(self, camera: Camera | None) -> None:
        config = KISSConfig()
        config.data.deskew = False
        config.mapping.voxel_size = config.data.max_range / 100.0  # what its command line chooses
        self._odometry = KissICP(config)

    def track(self, sweep: PointCloud) -> Float64:
        self._odometry.register_frame(sweep.points.astype(np.float64), np.zeros(0))
        return np.array(self._odometry.last_pose)


PEERS = {"KISS-ICP": KissIcpSweeps}
