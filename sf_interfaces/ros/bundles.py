"""Keyframes on the wire: a bundle of standard messages with one stamp, out and in."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import Any

import numpy as np

from sf_interfaces import topics
from sf_interfaces.corrections import Correction, Corrections
from sf_interfaces.ros import messages
from sf_interfaces.ros.inbox import KeyframeJoiner
from sf_interfaces.ros.node import BlockNode
from sf_interfaces.topics import Topic
from sf_interfaces.types import DepthMap, Keyframe, PointCloud

TRACKED: dict[str, Topic] = {
    "image": topics.KEYFRAME_IMAGE,
    "camera_info": topics.KEYFRAME_INFO,
    "pose": topics.KEYFRAME_POSE,
    "depth": topics.KEYFRAME_DEPTH,
    "landmarks": topics.KEYFRAME_LANDMARKS,
    "state": topics.KEYFRAME_STATE,
}
COMPLETED: dict[str, Topic] = {
    "image": topics.KEYFRAME_IMAGE,
    "camera_info": topics.DENSE_INFO,
    "pose": topics.DENSE_POSE,
    "depth": topics.DENSE_IMAGE,
    "variance": topics.DENSE_VARIANCE,
    "state": topics.KEYFRAME_STATE,
}


def publish_bundle(
    node: BlockNode,
    keyframe: Keyframe,
    bundle: dict[str, Topic],
    parts: set[str],
    correction: Correction | None = None,
) -> None:
    """Publish the named parts of a keyframe on the topics of a bundle.

    Corrected poses of earlier keyframes, where there are any, travel in its state. A keyframe without depth or
    landmarks sends an all-NaN image or an empty cloud, so that a bundle is always complete.
    """
    make, stamp_ns, frame = messages.rclpy_factory, keyframe.stamp_ns, keyframe.camera.frame_id
    depth = keyframe.depth
    if depth is None:
        depth = DepthMap(np.full((keyframe.camera.height, keyframe.camera.width), np.nan))
    cloud = keyframe.landmarks
    points = cloud.points if cloud is not None else np.zeros((0, 3))
    encode = {
        "image": lambda: messages.encode_image(make, keyframe.image, stamp_ns, frame),
        "camera_info": lambda: messages.encode_camera_info(make, keyframe.camera, stamp_ns),
        "pose": lambda: messages.encode_pose(make, keyframe.T_map_camera, stamp_ns, "map"),
        "depth": lambda: messages.encode_depth(make, depth, stamp_ns, frame),
        "variance": lambda: messages.encode_variance(make, depth, stamp_ns, frame),
        "landmarks": lambda: messages.encode_cloud(
            make, PointCloud(points, cloud.colors if cloud else None, stamp_ns=stamp_ns, frame_id=frame)
        ),
        "state": lambda: messages.encode_keyframe_state(make, keyframe.scale, keyframe.stamp_ns, correction),
    }
    for kind, topic in bundle.items():
        if kind in parts:
            node.output(topic).publish(encode[kind]())


class BundleInputs:
    """Takes decoded messages of a bundle by kind and gives keyframes.

    Attributes:
        corrections: corrected poses that came and wait for the keyframe from which on they hold.
    """

    def __init__(self, bundle: dict[str, Topic], without: set[str] = frozenset()) -> None:  # type: ignore[assignment]
        self.topics = {kind: topic for kind, topic in bundle.items() if kind not in without}
        self.joiner = KeyframeJoiner(self.topics)
        self.corrections = Corrections()

    def push(self, kind: str, msg: Any) -> Keyframe | None:
        """Add one message; the keyframe when its bundle is complete.

        Raises:
            SceneFactoryError: a message is malformed or the parts do not fit together.
        """
        stamp_ns = messages.to_ns(msg.header.stamp)
        if kind == "state" and (correction := messages.decode_keyframe_state(msg)[1]) is not None:
            self.corrections.push(stamp_ns, correction)
        parts = self.joiner.push(kind, stamp_ns, msg)
        if parts is None:
            return None
        camera, _ = messages.decode_camera_info(parts["camera_info"])
        stamp_ns, _, T = messages.decode_pose(parts["pose"])
        scale, _ = messages.decode_keyframe_state(parts["state"])
        variance = messages.decode_variance(parts["variance"]) if "variance" in parts else None
        depth = DepthMap(messages.decode_depth(parts["depth"]).z, variance, scale)
        landmarks = messages.decode_cloud(parts["landmarks"]) if "landmarks" in parts else None
        image = messages.decode_image(parts["image"])
        return Keyframe(stamp_ns, camera, image, T, depth if depth.valid.any() else None, landmarks, scale)
