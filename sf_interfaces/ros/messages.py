"""The one place where messages become data and data become messages.

Duck-typed: ``decode_*`` read attributes, so messages of rclpy and of rosbags work alike; ``encode_*`` take
a :data:`Factory` that maps a type name to the message class of either. Nothing of ROS is imported.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from sf_interfaces.corrections import Correction
from sf_interfaces.errors import CalibrationError, FormatError
from sf_interfaces.geometry import se3
from sf_interfaces.geometry.undistort import Distortion
from sf_interfaces.ros.clouds import decode_cloud, decode_field, encode_cloud
from sf_interfaces.ros.compressed import COMPRESSED_IMAGE, encoding_of
from sf_interfaces.ros.images import (
    decode_depth,
    decode_image,
    decode_variance,
    encode_depth,
    encode_image,
    encode_variance,
    is_depth_encoding,
)
from sf_interfaces.ros.stamps import Factory, header, sequence, to_ns, to_stamp
from sf_interfaces.types import Camera, Float64, Scale, Trajectory

__all__ = [
    "COMPRESSED_IMAGE",
    "Distortion",
    "Factory",
    "decode_camera_info",
    "decode_cloud",
    "decode_depth",
    "decode_field",
    "decode_image",
    "decode_keyframe_state",
    "decode_pose",
    "decode_tf",
    "decode_variance",
    "encode_camera_info",
    "encode_cloud",
    "encode_depth",
    "encode_image",
    "encode_keyframe_state",
    "encode_path",
    "encode_pose",
    "encode_tf",
    "encode_variance",
    "encoding_of",
    "header",
    "is_depth_encoding",
    "rclpy_factory",
    "to_ns",
    "to_stamp",
]

_SCALES = (Scale.METRIC, Scale.ARBITRARY)  # as sf_interfaces/KeyframeState numbers them
StampedTransform = tuple[str, str, int, Float64]
"""(parent frame, child frame, stamp ns, T_parent_child)."""


def rclpy_factory(name: str) -> Any:
    """The rclpy class of a type name such as 'sensor_msgs/msg/Image', imported on demand.

    Raises:
        FormatError: no such type is installed.
    """
    from importlib import import_module

    package, _, short = name.partition("/msg/")
    try:
        return getattr(import_module(f"{package}.msg"), short)
    except (ImportError, AttributeError) as error:
        raise FormatError(f"message type {name} is not installed; install the package '{package}'") from error


def decode_camera_info(msg: Any, rectified: bool = False) -> tuple[Camera, Distortion | None]:
    """sensor_msgs/CameraInfo -> pinhole camera, and the lens distortion still in the image (None: none).

    Binning and region of interest are applied, so the camera is that of the image as published.

    Args:
        rectified: the image is an ``image_rect``: P describes it and no distortion is left.

    Raises:
        CalibrationError: K (or P) is all zero, has skew or no size, or the distortion model is unknown.
    """
    if rectified:
        p = np.asarray(msg.p, dtype=np.float64).reshape(3, 4)[:, :3]
    else:
        p = np.asarray(msg.k, dtype=np.float64).reshape(3, 3)
    name, frame = "P" if rectified else "K", msg.header.frame_id
    if not p.any():
        raise CalibrationError(
            f"camera_info of '{frame}' is uncalibrated ({name} is all zero); calibrate the camera or give --calibration"
        )
    if abs(p[0, 1]) > 1e-9 * abs(p[0, 0]) or p[1, 0]:
        raise CalibrationError(f"camera_info of '{frame}' has a {name} with skew; rectify the images first")
    binning = max(1, int(msg.binning_x)), max(1, int(msg.binning_y))
    roi = msg.roi
    width, height = int(roi.width) or int(msg.width), int(roi.height) or int(msg.height)
    camera = Camera(
        width=width // binning[0],
        height=height // binning[1],
        fx=float(p[0, 0]) / binning[0],
        fy=float(p[1, 1]) / binning[1],
        cx=(float(p[0, 2]) + 0.5 - int(roi.x_offset)) / binning[0],
        cy=(float(p[1, 2]) + 0.5 - int(roi.y_offset)) / binning[1],
        frame_id=frame,
    )
    coefficients = tuple(float(c) for c in msg.d)
    if rectified or not any(coefficients):
        return camera, None
    return camera, Distortion(msg.distortion_model, coefficients)


def encode_camera_info(make: Factory, camera: Camera, stamp_ns: int, distortion: Distortion | None = None) -> Any:
    """Camera -> CameraInfo: cx, cy in ROS convention (- 0.5), R identity, P = [K | 0]."""
    K = camera.K
    K[:2, 2] -= 0.5
    cls = make("sensor_msgs/msg/CameraInfo")
    lens = distortion or Distortion("plumb_bob", (0.0,) * 5)
    return cls(
        header=header(make, stamp_ns, camera.frame_id),
        height=camera.height,
        width=camera.width,
        distortion_model=lens.model,
        d=sequence(cls, np.array(lens.coefficients, dtype=np.float64)),
        k=K.reshape(-1),
        r=np.eye(3).reshape(-1),
        p=np.hstack([K, np.zeros((3, 1))]).reshape(-1),
        binning_x=0,
        binning_y=0,
        roi=make("sensor_msgs/msg/RegionOfInterest")(x_offset=0, y_offset=0, height=0, width=0, do_rectify=False),
    )


def _pose(translation: Any, rotation: Any, what: str) -> Float64:
    t = np.array([translation.x, translation.y, translation.z], dtype=np.float64)
    q = np.array([rotation.x, rotation.y, rotation.z, rotation.w], dtype=np.float64)
    if not (np.isfinite(t).all() and np.isfinite(q).all()):
        raise FormatError(f"{what} holds values that are not finite; mend the node that wrote it")
    if abs(np.linalg.norm(q) - 1.0) > 1e-2:
        raise FormatError(f"{what} has quaternion {q.tolist()}, not of unit length; mend the node that wrote it")
    return se3.from_quaternion(t, q)


def _plain(frame: str) -> str:
    """Frame names without the leading slash of ROS 1."""
    return frame.lstrip("/")


def decode_pose(msg: Any) -> tuple[int, str, Float64]:
    """PoseStamped, PoseWithCovarianceStamped or Odometry -> (stamp ns, frame_id, T_frame_body).

    Raises:
        FormatError: not finite, or the quaternion is not of unit length.
    """
    pose = msg.pose
    while hasattr(pose, "pose"):
        pose = pose.pose
    T = _pose(pose.position, pose.orientation, f"pose in '{msg.header.frame_id}'")
    return to_ns(msg.header.stamp), _plain(msg.header.frame_id), T


def decode_tf(msg: Any) -> list[StampedTransform]:
    """tf2_msgs/TFMessage -> (parent, child, stamp ns, T_parent_child) each.

    Raises:
        FormatError: not finite, or a quaternion is not of unit length.
    """
    out = []
    for item in msg.transforms:
        parent, child = _plain(item.header.frame_id), _plain(item.child_frame_id)
        T = _pose(item.transform.translation, item.transform.rotation, f"transform {parent} -> {child}")
        out.append((parent, child, to_ns(item.header.stamp), T))
    return out


def _point(make: Factory, kind: str, t: Float64) -> Any:
    return make(f"geometry_msgs/msg/{kind}")(x=float(t[0]), y=float(t[1]), z=float(t[2]))


def _quaternion(make: Factory, q: Float64) -> Any:
    return make("geometry_msgs/msg/Quaternion")(x=float(q[0]), y=float(q[1]), z=float(q[2]), w=float(q[3]))


def encode_pose(make: Factory, T: Float64, stamp_ns: int, frame_id: str) -> Any:
    """T_frame_body -> geometry_msgs/PoseStamped."""
    t, q = se3.to_quaternion(T)
    pose = make("geometry_msgs/msg/Pose")(position=_point(make, "Point", t), orientation=_quaternion(make, q))
    return make("geometry_msgs/msg/PoseStamped")(header=header(make, stamp_ns, frame_id), pose=pose)


def encode_tf(make: Factory, transforms: Iterable[StampedTransform]) -> Any:
    """(parent, child, stamp ns, T_parent_child) each -> tf2_msgs/TFMessage."""
    items = []
    for parent, child, stamp_ns, T in transforms:
        t, q = se3.to_quaternion(T)
        transform = make("geometry_msgs/msg/Transform")(
            translation=_point(make, "Vector3", t), rotation=_quaternion(make, q)
        )
        items.append(
            make("geometry_msgs/msg/TransformStamped")(
                header=header(make, stamp_ns, parent), child_frame_id=child, transform=transform
            )
        )
    return make("tf2_msgs/msg/TFMessage")(transforms=items)


def encode_path(make: Factory, trajectory: Trajectory, stamp_ns: int) -> Any:
    """Trajectory -> nav_msgs/Path in the trajectory's frame, each pose with its own stamp."""
    pairs = zip(trajectory.stamps_ns.tolist(), trajectory.poses, strict=True)
    poses = [encode_pose(make, T, stamp, trajectory.frame) for stamp, T in pairs]
    return make("nav_msgs/msg/Path")(header=header(make, stamp_ns, trajectory.frame), poses=poses)


def decode_keyframe_state(msg: Any) -> tuple[Scale, Correction | None]:
    """sf_interfaces/KeyframeState -> scale, and the correction of keyframes where it brings one.

    Raises:
        FormatError: an unknown scale, a pose that is none, or not one scale for each pose.
    """
    if not 0 <= int(msg.scale) < len(_SCALES):
        raise FormatError(f"keyframe state has scale {msg.scale}; this program knows 0 (metric) and 1 (arbitrary)")
    scale, poses = _SCALES[int(msg.scale)], [decode_pose(pose) for pose in msg.corrected]
    if not poses:
        return scale, None
    keyframes = Trajectory(np.array([t for t, _, _ in poses]), np.array([T for _, _, T in poses]), scale)
    return scale, Correction(keyframes, np.array(msg.corrected_scale))


def encode_keyframe_state(make: Factory, scale: Scale, stamp_ns: int, correction: Correction | None = None) -> Any:
    """Scale of a keyframe, and the correction of earlier ones it brings -> sf_interfaces/KeyframeState."""
    corrected = [] if correction is None else encode_path(make, correction.keyframes, stamp_ns).poses
    return make("sf_interfaces/msg/KeyframeState")(
        header=header(make, stamp_ns, "map"),
        scale=_SCALES.index(scale),
        corrected=corrected,
        corrected_scale=np.zeros(0) if correction is None else correction.scales,
    )
