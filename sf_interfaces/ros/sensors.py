"""The sensor inputs of a head node: which topics, and messages into the frame assembler."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from sf_interfaces import topics
from sf_interfaces.ros import messages
from sf_interfaces.sync import FrameAssembler, SyncConfig
from sf_interfaces.topics import Topic

_LIVE_WAIT_S = 0.3  # stream time a live image waits for its companions
# Live: messages held, then the latest wins. Deep enough for a second of jitter on a busy machine.
_KEEP = {"image": 20, "depth": 20, "lidar": 20, "pose": 400}


class SensorInputs:
    """Takes decoded ROS messages by kind and gives frames.

    Args:
        config: the streams of this line.
        lossless: nothing is dropped and nothing is decided by waiting.
    """

    def __init__(self, config: SyncConfig, *, lossless: bool) -> None:
        if not lossless and not config.max_wait_s:
            config = replace(config, max_wait_s=_LIVE_WAIT_S)
        self.assembler = FrameAssembler(config)
        self._lossless = lossless

    @property
    def leader(self) -> str:
        """The kind whose stamps the frames carry and whose consumption is credited."""
        return self.assembler.config.leader

    def subscriptions(self) -> Iterator[tuple[Topic, str, int | None]]:
        """(topic, kind, messages to keep live or None for all)."""
        config = self.assembler.config
        # The transforms and the calibration come first: then images seldom have to wait for them.
        yield topics.TF_STATIC, "tf_static", None
        yield topics.TF, "tf", None
        yield topics.RGB_INFO, "camera_info", None if self._lossless else 20
        for kind, topic, wanted in (
            ("depth", topics.DEPTH_IMAGE, config.depth or not config.image),
            ("lidar", topics.LIDAR_POINTS, config.lidar),
            ("pose", topics.GIVEN_POSE, config.pose),
            ("image", topics.RGB_IMAGE, config.image),
        ):
            if wanted:
                if kind in config.compressed:
                    topic = replace(topic, type=messages.COMPRESSED_IMAGE)
                yield topic, kind, None if self._lossless else _KEEP[kind]

    def push(self, kind: str, msg: Any) -> None:
        """Decode one message and hand it to the assembler.

        Raises:
            SceneFactoryError: the message is malformed.
        """
        a = self.assembler
        match kind:
            case "image":
                a.push_image(messages.to_ns(msg.header.stamp), messages.decode_image(msg), msg.header.frame_id)
            case "depth":
                a.push_depth(messages.to_ns(msg.header.stamp), messages.decode_depth(msg), msg.header.frame_id)
            case "lidar":
                a.push_cloud(messages.decode_cloud(msg))
            case "pose":
                stamp_ns, _, T = messages.decode_pose(msg)
                a.push_pose(stamp_ns, T)
            case "camera_info":
                a.push_camera(*messages.decode_camera_info(msg), messages.to_ns(msg.header.stamp))
            case "tf" | "tf_static":
                for parent, child, stamp_ns, T in messages.decode_tf(msg):
                    a.push_transform(parent, child, T, stamp_ns, static=kind == "tf_static")
