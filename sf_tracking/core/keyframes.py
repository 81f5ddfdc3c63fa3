"""Keyframes of the tracker: what is kept of them, and when a new one is made."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from sf_interfaces.geometry import se3
from sf_interfaces.types import Camera, DepthMap, Float64, Frame, Keyframe, PointCloud, UInt8
from sf_tracking.config import TrackingConfig
from sf_tracking.core.bundle import Edges
from sf_tracking.core.patches import Patches


@dataclass(slots=True)
class TrackedKeyframe:
    """A keyframe inside the optimisation window; its pose still moves."""

    frame: Frame
    gray: UInt8
    patches: Patches
    T_cw: Float64  # world to camera
    observed: list[tuple[int, Edges]] = field(default_factory=list)  # (stamp of the source keyframe, its edges)

    @property
    def camera(self) -> Camera:
        """Intrinsics; the tracker only takes frames that have them."""
        assert self.frame.camera is not None
        return self.frame.camera

    def final(self) -> Keyframe:
        """What leaves the window: the pose is final now."""
        camera, frame = self.camera, self.frame
        assert frame.image is not None
        depth: DepthMap | None = frame.depth
        if frame.sparse_depth is not None:
            depth = frame.sparse_depth.to_map(camera.height, camera.width)
        landmarks = PointCloud(self.patches.points.astype(np.float32), None, None, frame.stamp_ns, camera.frame_id)
        return Keyframe(frame.stamp_ns, camera, frame.image, se3.inverse(self.T_cw), depth, landmarks)


def wants_keyframe(config: TrackingConfig, camera: Camera, flow_px: Float64, aligned_share: float) -> bool:
    """Enough motion for new information, or too little overlap to go on with the old patches.

    Args:
        flow_px: displacement of the newest keyframe's aligned patches, [M] px.
        aligned_share: how many of its patches were found again, 0 to 1.
    """
    if aligned_share < config.keyframe_overlap:
        return True
    return len(flow_px) > 0 and float(flow_px.mean()) > config.keyframe_flow * camera.width
