"""Joining the streams of sensors into frames: the same frames however the messages interleave.

An image is decided only when every other stream has reached its stamp, so nothing depends on which
message arrived first. In real time a limit on waiting, counted in the stream's own time, bounds the delay.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from sf_interfaces.calibrations import Calibration, Calibrations
from sf_interfaces.config import option
from sf_interfaces.errors import CalibrationError, SceneFactoryError
from sf_interfaces.geometry import se3
from sf_interfaces.geometry.lidar import deskew, project_sweep
from sf_interfaces.geometry.undistort import Distortion, undistort_depth, undistort_image
from sf_interfaces.ros.frames import FrameTree
from sf_interfaces.streams import Stream, StreamItem, StreamKey
from sf_interfaces.types import Camera, DepthMap, Float64, Frame, PointCloud, SparseDepth, UInt8, check_pose

_S = 1_000_000_000  # ns


@dataclass(frozen=True, slots=True)
class SyncConfig:
    """Which streams make a frame, and how close in time they have to be."""

    image: bool = option(True, "frames carry an image; without it the depth image leads (depth-only input)")
    camera: bool = option(True, "frames carry intrinsics; without them images are taken as they are")
    depth: bool = option(False, "frames carry a dense depth image")
    lidar: bool = option(False, "frames carry a LiDAR sweep")
    pose: bool = option(False, "frames carry a given pose; frames without one are dropped")
    depth_slop_s: float = option(0.02, "largest time between image and depth, s", low=0.0, high=1.0)
    lidar_slop_s: float = option(0.06, "largest time between image and sweep, s", low=0.0, high=1.0)
    pose_gap_s: float = option(0.5, "poses further apart are not interpolated, s", low=0.0, high=60.0)
    max_wait_s: float = option(0.0, "live: decide an image after this stream time, s (0: wait)", low=0.0)
    max_pending: int = option(200, "images that may wait for the other streams", low=1)
    reset_s: float = option(1.0, "a backward jump in time beyond this starts anew, s", low=0.0)
    depth_registered: bool = option(False, "take depth as registered to the image though its frame differs")
    pose_frame: str = option("", "frame whose pose is given, such as base_link (empty: the optical frame)")
    compressed: tuple[str, ...] = option((), "streams that arrive as CompressedImage: image, depth")
    extrinsic: tuple[float, ...] = option((), "T_camera_lidar as x y z qx qy qz qw (empty: from /tf_static)")

    @property
    def leader(self) -> str:
        """The stream whose stamps the frames carry."""
        return "image" if self.image else "depth"


class FrameAssembler:
    """Joins pushed messages into frames, in the order of their image stamps.

    Push every message with its stamp, then take the frames that are decided from :meth:`ready`. Each frame is
    assembled when it is taken, so a caller that tracks between two frames can hand back the motion that
    de-skews the next sweep (:meth:`feed_back`) and the result still depends on the data alone.

    Attributes:
        reasons: why messages were dropped or left unmatched, with counts.
        epoch: grows by one whenever the leading stream's time jumped back; valid for the frame last taken.
            A changed calibration begins no epoch: frames carry their camera, and its change shows there.
    """

    def __init__(self, config: SyncConfig = SyncConfig()) -> None:
        if config.extrinsic and len(config.extrinsic) != 7:
            raise CalibrationError("extrinsic needs the 7 numbers x y z qx qy qz qw of T_camera_lidar")
        self.config = config
        self.reasons: dict[str, int] = {}
        self.epoch = 0
        self.transforms = FrameTree()
        self._cameras: dict[str, Calibrations] = {}
        self._calibration: dict[str, Calibration] = {}  # of the frame last taken
        self._pending: deque[StreamItem] = deque()
        wanted = {"image": config.image, "depth": config.depth, "lidar": config.lidar, "pose": config.pose}
        wanted[config.leader] = True
        self._streams = {name: Stream(name, config.reset_s) for name, on in wanted.items() if on}
        self._extrinsics: dict[tuple[str, str], Float64] = {}
        self._lidar_frame = ""
        self._sweeps_without_extrinsic = 0
        self._poses: deque[tuple[int, Float64]] = deque(maxlen=2)
        self._ended = False

    # ---- in

    def push_image(self, stamp_ns: int, image: UInt8, frame_id: str) -> None:
        """A colour or mono image [H, W(, 3)] uint8, as the camera gave it (distorted)."""
        self._push("image", stamp_ns, image, frame_id)

    def push_depth(self, stamp_ns: int, depth: DepthMap, frame_id: str) -> None:
        """A dense depth image registered to the colour image."""
        self._push("depth", stamp_ns, depth, frame_id)

    def push_cloud(self, cloud: PointCloud) -> None:
        """A LiDAR sweep in its own frame, at its own stamp."""
        self._lidar_frame = cloud.frame_id.lstrip("/")
        if not np.isfinite(cloud.points).all(axis=1).any():
            if "lidar" in self._streams:
                self._streams["lidar"].advance(cloud.stamp_ns)
                self._count("lidar sweep dropped: it has no finite point")
            return
        self._push("lidar", cloud.stamp_ns, cloud, cloud.frame_id)
        self._sweeps_without_extrinsic += 1

    def push_pose(self, stamp_ns: int, T: Float64) -> None:
        """A given pose ``T_map_<pose_frame>`` [4, 4].

        Raises:
            FormatError: T is not a rigid motion.
        """
        self._push("pose", stamp_ns, check_pose(T, "given pose"), "")

    def push_camera(self, camera: Camera, distortion: Distortion | None = None, stamp_ns: int = 0) -> None:
        """The calibration of ``camera.frame_id`` from ``stamp_ns`` on; images before the first use the first.

        Args:
            camera: intrinsics; they stay those of the undistorted image.
            distortion: the lens distortion still in the images, taken out when a frame is assembled.
        """
        known = self._cameras.setdefault(camera.frame_id, Calibrations())
        ignored = known.ignored
        known.add(stamp_ns, (camera, distortion))
        if known.ignored > ignored:
            self._count("camera_info changed too little to matter, or not in time: the one in use is kept")

    def push_transform(self, parent: str, child: str, T: Float64, stamp_ns: int = 0, *, static: bool = True) -> None:
        """One link ``T_parent_child`` of /tf_static (or /tf: used for publishing, never for extrinsics)."""
        self.transforms.add(parent, child, T, stamp_ns, static=static)

    def feed_back(self, stamp_ns: int, T_map_camera: Float64 | None) -> None:
        """The metric pose just tracked (None: lost); the last two predict the motion that de-skews."""
        if T_map_camera is None or (self._poses and stamp_ns <= self._poses[-1][0]):
            self._poses.clear()
        if T_map_camera is not None:
            self._poses.append((stamp_ns, T_map_camera))

    def end(self) -> None:
        """Declare the end of all streams: what is pending is decided with what is there."""
        self._ended = True

    # ---- out

    def ready(self) -> Iterator[Frame]:
        """The frames decided by now, in stamp order; each is assembled when it is taken."""
        while self._pending and self._decidable(self._pending[0]):
            item = self._pending.popleft()
            if item.key.epoch != self.epoch:
                self.epoch = item.key.epoch
                self._poses.clear()
            try:
                frame = self._assemble(item)
            except SceneFactoryError as error:
                self._count(f"{self.config.leader} dropped: {error}")
                frame = None
            self._forget(item.key)
            if frame is not None:
                yield frame
        if self._ended and not self._pending:
            self._forget(StreamKey(np.iinfo(np.int64).max, 0))

    @property
    def waiting_for(self) -> str:
        """What the oldest undecided image still lacks, in words; empty when nothing waits."""
        if not self._pending:
            return ""
        item = self._pending[0]
        late = [name for name, s in self._streams.items() if not s.passed(item.key)]
        if item.frame_id not in self._cameras:
            return self._no_camera(item.frame_id)
        if not self._cameras[item.frame_id].settled(item.key.stamp_ns, self._leading_ns):
            late.append("camera_info")
        if self._lacks_extrinsic(item.frame_id) and self._sweeps_without_extrinsic >= 3:
            return self._no_extrinsic(item.frame_id)
        return f"waiting for {' and '.join(late)} up to the stamp of the image" if late else ""

    def __len__(self) -> int:
        """Images not decided yet."""
        return len(self._pending)

    # ---- inside

    def _count(self, reason: str) -> None:
        self.reasons[reason] = self.reasons.get(reason, 0) + 1

    def _push(self, name: str, stamp_ns: int, value: Any, frame_id: str) -> None:
        stream = self._streams.get(name)
        if stream is None:
            self._count(f"{name} dropped: this line has no {name} input")
            return
        key, reason = stream.advance(stamp_ns)
        if reason:
            self._count(reason)
        if key is not None:
            queue = self._pending if name == self.config.leader else stream.items
            queue.append(StreamItem(key, value, frame_id.lstrip("/")))

    def _decidable(self, item: StreamItem) -> bool:
        if self._ended or not self.config.camera or len(self._pending) > self.config.max_pending:
            return True
        complete = (
            item.frame_id in self._cameras
            and self._cameras[item.frame_id].settled(item.key.stamp_ns, self._leading_ns)
            and not self._lacks_extrinsic(item.frame_id)
            and all(stream.passed(item.key) for stream in self._streams.values())
        )
        if complete or not self.config.max_wait_s:
            return complete
        newest = max(s.newest for s in self._streams.values() if s.newest is not None)
        late_ns = newest.stamp_ns - item.key.stamp_ns
        return newest.epoch > item.key.epoch or late_ns > self.config.max_wait_s * _S

    def _assemble(self, item: StreamItem) -> Frame | None:
        if not self.config.camera:  # nothing can be placed relative to an unknown camera
            return Frame(item.key.stamp_ns, None, item.value)
        if item.frame_id not in self._cameras:
            raise CalibrationError(self._no_camera(item.frame_id))
        camera, distortion = self._calibrated(item)
        T, twist = self._pose(item, camera.frame_id) if self.config.pose else (None, self._twist())
        if self.config.pose and T is None:
            return None
        depth = self._depth(item)
        if depth is not None:
            depth = undistort_depth(depth, camera, distortion)
        image = undistort_image(item.value, camera, distortion) if self.config.image else None
        sparse = self._sparse(item, camera, twist) if self.config.lidar else None
        return Frame(item.key.stamp_ns, camera, image, depth, sparse, T)

    @property
    def _leading_ns(self) -> int:
        newest = self._streams[self.config.leader].newest
        return 0 if newest is None else newest.stamp_ns

    def _calibrated(self, item: StreamItem) -> Calibration:
        """The calibration valid at the image; a change is said."""
        found = self._cameras[item.frame_id].at(item.key.stamp_ns)
        if self._calibration.setdefault(item.frame_id, found) != found:
            self._count(f"camera_info of '{item.frame_id}' changed: frames use the new calibration from here on")
            self._calibration[item.frame_id] = found
        return found

    def _depth(self, item: StreamItem) -> DepthMap | None:
        if not self.config.image:
            leading: DepthMap = item.value
            return leading
        if not self.config.depth:
            return None
        found = self._streams["depth"].nearest(item.key, self.config.depth_slop_s)
        if found is None:
            self._count(f"image without depth within {self.config.depth_slop_s:g} s")
            return None
        if found.frame_id != item.frame_id and not self.config.depth_registered:
            raise CalibrationError(
                f"depth is in frame '{found.frame_id}', the image in '{item.frame_id}'; register depth to "
                "the image, or set sync.depth_registered if it is registered"
            )
        matched: DepthMap = found.value
        return matched

    def _sparse(self, item: StreamItem, camera: Camera, twist: Float64 | None) -> SparseDepth | None:
        found = self._streams["lidar"].nearest(item.key, self.config.lidar_slop_s)
        if found is None:
            self._count(f"image without a lidar sweep within {self.config.lidar_slop_s:g} s")
            return None
        cloud: PointCloud = found.value
        T_camera_lidar = self._extrinsic(item.frame_id, found.frame_id)
        if T_camera_lidar is None:
            self._count(self._no_extrinsic(item.frame_id))
            return None
        finite = np.isfinite(cloud.points).all(axis=1)
        points = cloud.points[finite].astype(np.float64)
        if twist is not None:
            offset_ns = np.full(len(points), cloud.stamp_ns - item.key.stamp_ns, dtype=np.int64)
            if cloud.time_offset_ns is not None:
                offset_ns += cloud.time_offset_ns[finite]
            twist_lidar = se3.adjoint(se3.inverse(T_camera_lidar)) @ twist
            points = deskew(points, offset_ns, twist_lidar)
        return project_sweep(points, camera, T_camera_lidar)

    def _pose(self, item: StreamItem, camera_frame: str) -> tuple[Float64 | None, Float64 | None]:
        """The given ``T_map_camera`` at the image stamp and the camera's twist there, or None."""
        before, after = self._streams["pose"].around(item.key)
        if before is None or after is None:
            self._count("image dropped: no given pose on both sides of its stamp")
            return None, None
        t0, t1 = before.key.stamp_ns, after.key.stamp_ns
        if t1 - t0 > self.config.pose_gap_s * _S:
            self._count(f"image dropped: given poses around it are over {self.config.pose_gap_s:g} s apart")
            return None, None
        T_child_camera = np.eye(4)
        if self.config.pose_frame and self.config.pose_frame != camera_frame:
            found = self.transforms.lookup(self.config.pose_frame, camera_frame, static_only=True)
            if found is None:
                raise CalibrationError(
                    f"no transform from '{camera_frame}' to '{self.config.pose_frame}': publish it on /tf_static"
                )
            T_child_camera = found
        if t0 == t1:
            return before.value @ T_child_camera, None
        T0, T1 = before.value @ T_child_camera, after.value @ T_child_camera
        alpha = (item.key.stamp_ns - t0) / (t1 - t0)
        return se3.interpolate(T0, T1, alpha), se3.twist_between(t0, T0, t1, T1)

    def _twist(self) -> Float64 | None:
        if len(self._poses) < 2:
            return None
        (t0, T0), (t1, T1) = self._poses
        return se3.twist_between(t0, T0, t1, T1)

    def _extrinsic(self, camera_frame: str, lidar_frame: str) -> Float64 | None:
        """``T_camera_lidar``: given, or from the static tree; the first that is found holds."""
        key = (camera_frame, lidar_frame)
        if key not in self._extrinsics:
            given = np.array(self.config.extrinsic)
            if len(given):
                T = se3.from_quaternion(given[:3], given[3:])
            else:
                found = self.transforms.lookup(camera_frame, lidar_frame, static_only=True)
                if found is None:
                    return None
                T = found
            self._extrinsics[key] = T
        return self._extrinsics[key]

    def _lacks_extrinsic(self, camera_frame: str) -> bool:
        lidar = self._streams.get("lidar")
        if lidar is None or lidar.newest is None:
            return False
        return self._extrinsic(camera_frame, self._lidar_frame) is None

    def _no_camera(self, frame_id: str) -> str:
        others = ", ".join(f"'{name}'" for name in sorted(self._cameras))
        seen = f"; camera_info came only for {others}" if others else ""
        return f"no camera_info for frame '{frame_id}'{seen}; publish it or pass --calibration"

    def _no_extrinsic(self, camera_frame: str) -> str:
        return (
            f"no transform from '{self._lidar_frame}' to '{camera_frame}': publish it on /tf_static or pass --extrinsic"
        )

    def _forget(self, key: StreamKey) -> None:
        for name, stream in self._streams.items():
            unused = stream.forget(key)
            if unused and name in ("depth", "lidar"):
                reason = f"{name} message matched no image"
                self.reasons[reason] = self.reasons.get(reason, 0) + unused
