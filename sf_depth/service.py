"""The service ``estimate_depth``: messages in, the core's answer as messages out."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import Any

from sf_depth.core.one_shot import OneShot
from sf_interfaces.errors import CalibrationError, FormatError, SceneFactoryError
from sf_interfaces.ros import messages
from sf_interfaces.types import Camera, Frame


def answer(part: OneShot, request: Any, response: Any) -> None:
    """Fill in the response; what the request lacks is said in its ``message``."""
    try:
        frames = _frames(request)
        made = part.estimate(frames)
    except SceneFactoryError as error:
        response.message = str(error)
        return
    make, keyframe = messages.rclpy_factory, made.keyframe
    stamp_ns, camera = keyframe.stamp_ns, keyframe.camera
    assert keyframe.depth is not None
    response.depth = messages.encode_depth(make, keyframe.depth, stamp_ns, camera.frame_id)
    response.variance = messages.encode_variance(make, keyframe.depth, stamp_ns, camera.frame_id)
    response.info = messages.encode_camera_info(make, camera, stamp_ns)
    unplaced = make("geometry_msgs/msg/PoseStamped")
    response.poses = [
        unplaced() if T is None else messages.encode_pose(make, T, frame.stamp_ns, "map")
        for frame, T in zip(frames, made.poses, strict=True)
    ]
    response.success = True


def _frames(request: Any) -> list[Frame]:
    """The images with what is known of them.

    Raises:
        FormatError: a number of infos or poses that fits neither all images nor none.
        CalibrationError: images with lens distortion.
    """
    count = len(request.images)
    if len(request.infos) not in (0, 1, count) or len(request.poses) not in (0, count):
        raise FormatError(
            f"{count} images came with {len(request.infos)} camera infos and {len(request.poses)} poses; "
            "give one info per image, or one for all, or none, and a pose per image or none"
        )
    cameras = [_camera(info) for info in request.infos] or [None]
    cameras = cameras * count if len(cameras) == 1 else cameras
    poses = [messages.decode_pose(pose)[2] for pose in request.poses] or [None] * count
    return [
        Frame(messages.to_ns(image.header.stamp), camera, messages.decode_image(image), None, None, T)
        for image, camera, T in zip(request.images, cameras, poses, strict=True)
    ]


def _camera(info: Any) -> Camera:
    camera, distortion = messages.decode_camera_info(info)
    if distortion is not None:
        raise CalibrationError("the images have lens distortion; rectify them before asking for depth")
    return camera
