"""Write a sensor sequence (images, depth, LiDAR, poses) as a bag. Used by the simulator and by importers."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import Any

from numpy.typing import NDArray

from sf_interfaces.corrections import Correction
from sf_interfaces.geometry.undistort import Distortion
from sf_interfaces.io.definitions import definition, typestore
from sf_interfaces.io.mcap_writer import McapWriter
from sf_interfaces.ros import messages
from sf_interfaces.types import Camera, DepthMap, Float64, PointCloud, Scale, Trajectory, UInt8

_IMAGE, _INFO = "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo"
_STATE = "sf_interfaces/msg/KeyframeState"
SHUTTER = "shutter"  # metadata of a bag: no message of ROS says how a camera reads its rows


class SequenceWriter:
    """An mcap bag of typed data; every message is logged at its own stamp. Also a context manager."""

    def __init__(self, path: Path, **options: Any):
        self.bag = McapWriter(path, **options)
        self._store = typestore()
        self._static: list[messages.StampedTransform] = []

    def __enter__(self) -> SequenceWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, e: BaseException | None, t: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Finish the file."""
        self.bag.close()

    def _make(self, name: str) -> Any:
        return self._store.types[name]

    def _write(self, topic: str, kind: str, stamp_ns: int, msg: Any) -> None:
        self.bag.write(topic, kind, stamp_ns, bytes(self._store.serialize_cdr(msg, kind)))

    def shutter(self, readout_s: float) -> None:
        """That rows of the colour images are read one after the other, the last one ``readout_s`` after the first."""
        self.bag.metadata(SHUTTER, {"readout_s": f"{readout_s:g}"})

    def image(self, topic: str, stamp_ns: int, image: UInt8, frame_id: str) -> None:
        """RGB [H, W, 3] or mono [H, W] uint8."""
        self._write(topic, _IMAGE, stamp_ns, messages.encode_image(self._make, image, stamp_ns, frame_id))

    def depth(self, topic: str, stamp_ns: int, depth: DepthMap, frame_id: str, encoding: str = "16UC1") -> None:
        """Depth as 16UC1 (mm) or 32FC1 (m)."""
        msg = messages.encode_depth(self._make, depth, stamp_ns, frame_id, encoding)
        self._write(topic, _IMAGE, stamp_ns, msg)

    def variance(self, topic: str, stamp_ns: int, depth: DepthMap, frame_id: str) -> None:
        """The variance of a depth map as 32FC1 (m^2)."""
        self._write(topic, _IMAGE, stamp_ns, messages.encode_variance(self._make, depth, stamp_ns, frame_id))

    def path(self, topic: str, stamp_ns: int, trajectory: Trajectory) -> None:
        """All poses of a trajectory as nav_msgs/Path."""
        self._write(topic, "nav_msgs/msg/Path", stamp_ns, messages.encode_path(self._make, trajectory, stamp_ns))

    def keyframe_state(self, topic: str, stamp_ns: int, scale: Scale, correction: Correction | None) -> None:
        """Scale of a keyframe and the poses it corrects."""
        definition(_STATE)  # makes the type known
        msg = messages.encode_keyframe_state(self._make, scale, stamp_ns, correction)
        self._write(topic, _STATE, stamp_ns, msg)

    def camera_info(self, topic: str, stamp_ns: int, camera: Camera, distortion: Distortion | None = None) -> None:
        """Intrinsics and the lens distortion still in the image, in the camera's frame."""
        self._write(topic, _INFO, stamp_ns, messages.encode_camera_info(self._make, camera, stamp_ns, distortion))

    def cloud(self, topic: str, cloud: PointCloud, intensity: NDArray[Any] | None = None) -> None:
        """Points with the cloud's own stamp and frame."""
        msg = messages.encode_cloud(self._make, cloud, intensity)
        self._write(topic, "sensor_msgs/msg/PointCloud2", cloud.stamp_ns, msg)

    def pose(self, topic: str, stamp_ns: int, T: Float64, frame_id: str) -> None:
        """T_frame_body as PoseStamped."""
        msg = messages.encode_pose(self._make, T, stamp_ns, frame_id)
        self._write(topic, "geometry_msgs/msg/PoseStamped", stamp_ns, msg)

    def tf(self, stamp_ns: int, parent: str, child: str, T: Float64) -> None:
        """T_parent_child on /tf."""
        msg = messages.encode_tf(self._make, [(parent, child, stamp_ns, T)])
        self._write("/tf", "tf2_msgs/msg/TFMessage", stamp_ns, msg)

    def tf_static(self, parent: str, child: str, T: Float64, stamp_ns: int = 0) -> None:
        """T_parent_child on /tf_static, latched; one message holds all given so far.

        It is logged at ``stamp_ns``, which should be the start of the sequence.
        """
        self._static.append((parent, child, stamp_ns, T))
        msg = messages.encode_tf(self._make, self._static)
        self._write("/tf_static", "tf2_msgs/msg/TFMessage", stamp_ns, msg)
