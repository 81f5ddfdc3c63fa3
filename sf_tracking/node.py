"""The tracking node: sensor streams in, a pose for every frame and the final keyframes out."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import sys
from time import monotonic
from typing import Any, ClassVar

from sf_interfaces import topics
from sf_interfaces.geometry import se3
from sf_interfaces.io.trajectory import write_tum
from sf_interfaces.ros import messages
from sf_interfaces.ros.bundles import TRACKED, publish_bundle
from sf_interfaces.ros.node import BlockNode
from sf_interfaces.ros.process import run
from sf_interfaces.ros.sensors import SensorInputs
from sf_interfaces.types import Float64, Frame, Trajectory
from sf_tracking.config import TrackingConfig
from sf_tracking.core.session import TrackingSession
from sf_tracking.core.tracker import TrackingState, TrackingUpdate

_PATH_EVERY_NS = 1_000_000_000


class TrackingNode(BlockNode):
    """Completes the pose (Sec. III-B).

    /tf: ``map`` -> the topmost known ancestor of the camera's frame (``odom`` or ``base_link`` where a robot
    publishes them, else the optical frame itself), so no frame gets a second parent (REP-105).
    """

    short: ClassVar[str] = "tracking"
    config_class: ClassVar[type] = TrackingConfig

    def setup(self) -> None:
        """The tracker and the streams of this line (parameters ``sync.*``)."""
        self._config = self.config()
        self._inputs = SensorInputs(self.sync_config(), lossless=self.options.lossless)
        self.leader = self._inputs.leader
        for topic, kind, keep in self._inputs.subscriptions():
            self.listen(topic, kind, keep)
        for topic in (topics.TRACKING_POSE, topics.TRACKING_PATH, topics.TF, *TRACKED.values()):
            self.output(topic)
        self._next_save, self._lost = 0.0, False
        self._begin()
        if (snapshot := self.snapshot("tracking.npz")) is not None:
            self._tracker = TrackingSession.restore(self._config, snapshot)

    def _begin(self) -> None:
        self._tracker = TrackingSession(self._config)
        self._path_stamp_ns: int | None = None
        self._epoch = self._inputs.assembler.epoch

    def take(self, kind: str, msg: Any) -> None:
        """Push one message and track the frames it completes."""
        self._inputs.push(kind, msg)
        self._advance()

    def finish(self) -> None:
        """Track what is pending, make everything final, write and publish the trajectory."""
        self._inputs.assembler.end()
        self._advance()
        self._send_keyframes(self._tracker.finish())
        trajectory = self._tracker.trajectory()
        if self.out is not None:
            write_tum(self.out / "trajectory.tum", trajectory)
            write_tum(self.out / "keyframes.tum", self._tracker.keyframe_trajectory())
        self._publish_path(trajectory)

    def refresh(self) -> None:
        """Why messages were dropped and what the oldest image waits for."""
        if self.leader:
            self.health.set_drops(dict(self._inputs.assembler.reasons))
            lost = "the camera is lost and the map is kept: show it a place that it has seen before"
            self.health.waiting(self._inputs.assembler.waiting_for or (lost if self._lost else ""))

    def _advance(self) -> None:
        for frame in self._inputs.assembler.ready():
            if self._inputs.assembler.epoch != self._epoch:
                self._send_keyframes(self._tracker.finish())
                self._begin()
            self.guarded(lambda frame=frame: self._track(frame))  # type: ignore[misc]

    def _track(self, frame: Frame) -> None:
        update = self._tracker.track(frame)
        self._inputs.assembler.feed_back(frame.stamp_ns, update.T_odom_camera)
        self.health.count("frames tracked")
        self.health.value("state", update.state.name)
        self.health.value("scale", update.scale.value)
        if update.correction is not None:
            self.health.count("loops closed")
        self._lost = update.state is TrackingState.LOST
        if update.T_map_camera is not None:
            assert frame.camera is not None
            pose = messages.encode_pose(messages.rclpy_factory, update.T_map_camera, frame.stamp_ns, "map")
            self.output(topics.TRACKING_POSE).publish(pose)
            self._publish_tf(frame.camera.frame_id, frame.stamp_ns, update.T_map_camera)
        self._send_keyframes(update)
        self._save_state()
        due = self._path_stamp_ns is None or frame.stamp_ns - self._path_stamp_ns >= _PATH_EVERY_NS
        if due and self.wanted(topics.TRACKING_PATH):
            self._path_stamp_ns = frame.stamp_ns
            self._publish_path(self._tracker.trajectory())

    def _send_keyframes(self, update: TrackingUpdate) -> None:
        for keyframe, correction in update.corrected_keyframes():
            publish_bundle(self, keyframe, TRACKED, set(TRACKED), correction)
            self.health.count("keyframes")
            self.sent(keyframe.stamp_ns)

    def _save_state(self) -> None:
        """A snapshot for a successor; a long trajectory is written less often, so that it never costs much."""
        path, begin = self.state("tracking.npz"), monotonic()
        if path is None or begin < self._next_save:
            return
        self._tracker.save(path)
        self._next_save = begin + max(1.0, 20 * (monotonic() - begin))

    def _publish_path(self, trajectory: Trajectory) -> None:
        if len(trajectory):
            stamp_ns = int(trajectory.stamps_ns[-1])
            path = messages.encode_path(messages.rclpy_factory, trajectory, stamp_ns)
            self.output(topics.TRACKING_PATH).publish(path)

    def _publish_tf(self, camera_frame: str, stamp_ns: int, T_map_camera: Float64) -> None:
        root, T_root_camera = self._inputs.assembler.transforms.root(camera_frame, below="map")
        if root == "map":
            return
        T_map_root = T_map_camera @ se3.inverse(T_root_camera)
        link = messages.encode_tf(messages.rclpy_factory, [("map", root, stamp_ns, T_map_root)])
        self.output(topics.TF).publish(link)


def main() -> int:
    """Run the node."""
    return run(TrackingNode)


if __name__ == "__main__":
    sys.exit(main())
