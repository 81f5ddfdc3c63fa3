"""What the in-process line makes, written as the messages the graph would have published."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from types import TracebackType
from typing import Any

from sf_interfaces import topics
from sf_interfaces.corrections import Correction
from sf_interfaces.io.sequence_writer import SequenceWriter
from sf_interfaces.types import Frame, Keyframe, PointCloud, Trajectory, UInt8


class ResultWriter:
    """Context manager around ``result.mcap``; one method per bundle of topics."""

    def __init__(self, writer: SequenceWriter) -> None:
        self._writer = writer
        self.counts: dict[str, int] = {}
        self.posed = True  # False: frames are completed one by one, and no pose is known or written

    def __enter__(self) -> ResultWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._writer.close()

    def _count(self, what: str) -> None:
        self.counts[what] = self.counts.get(what, 0) + 1

    def flexion(self, frame: Frame, image: UInt8) -> None:
        """The trackable image made from depth."""
        assert frame.camera is not None
        self._writer.image(topics.FLEXION_IMAGE.name, frame.stamp_ns, image, frame.camera.frame_id)

    def tracked(self, frame: Frame, update: Any) -> None:
        """Provisional pose of a frame, with its transform and the path so far; lost frames write nothing."""
        if update.T_map_camera is None:
            self._count("lost")
            return
        assert frame.camera is not None
        T, stamp = update.T_map_camera, frame.stamp_ns
        self._writer.pose(topics.TRACKING_POSE.name, stamp, T, "map")
        self._writer.tf(stamp, "map", frame.camera.frame_id, T)

    def keyframe(self, keyframe: Keyframe, correction: Correction | None = None) -> None:
        """The bundle of a final keyframe, with the poses it corrects."""
        stamp, frame_id = keyframe.stamp_ns, keyframe.camera.frame_id
        w = self._writer
        w.image(topics.KEYFRAME_IMAGE.name, stamp, keyframe.image, frame_id)
        w.camera_info(topics.KEYFRAME_INFO.name, stamp, keyframe.camera)
        if self.posed:
            w.pose(topics.KEYFRAME_POSE.name, stamp, keyframe.T_map_camera, "map")
        if keyframe.depth is not None:
            w.depth(topics.KEYFRAME_DEPTH.name, stamp, keyframe.depth, frame_id, "32FC1")
        if keyframe.landmarks is not None:
            cloud = PointCloud(keyframe.landmarks.points, stamp_ns=stamp, frame_id=frame_id)
            w.cloud(topics.KEYFRAME_LANDMARKS.name, cloud)
        w.keyframe_state(topics.KEYFRAME_STATE.name, stamp, keyframe.scale, correction)
        self._count("keyframes")

    def dense(self, keyframe: Keyframe) -> None:
        """Completed depth with variance."""
        stamp, frame_id, depth = keyframe.stamp_ns, keyframe.camera.frame_id, keyframe.depth
        assert depth is not None
        w = self._writer
        w.depth(topics.DENSE_IMAGE.name, stamp, depth, frame_id, "32FC1")
        if depth.variance is not None:
            w.variance(topics.DENSE_VARIANCE.name, stamp, depth, frame_id)
        w.camera_info(topics.DENSE_INFO.name, stamp, keyframe.camera)
        if self.posed:
            w.pose(topics.DENSE_POSE.name, stamp, keyframe.T_map_camera, "map")

    def surface(self, stamp_ns: int, cloud: PointCloud) -> None:
        """The coloured points that a keyframe added to the surface."""
        named = PointCloud(cloud.points, cloud.colors, stamp_ns=stamp_ns, frame_id="map")
        self._writer.cloud(topics.SURFACE.name, named)

    def path(self, trajectory: Trajectory) -> None:
        """The final path of all frames, once at the end."""
        if len(trajectory):
            self._writer.path(topics.TRACKING_PATH.name, int(trajectory.stamps_ns[-1]), trajectory)
