"""The relief node: a depth image in, an image with the same stamp out."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import sys
from dataclasses import replace
from typing import Any, ClassVar

from my_relief.config import ReliefConfig
from my_relief.core.relief import relief_image
from sf_interfaces import topics
from sf_interfaces.ros import messages
from sf_interfaces.ros.node import BlockNode
from sf_interfaces.ros.process import run
from sf_interfaces.ros.sensors import SensorInputs


class ReliefNode(BlockNode):
    """Completes the image."""

    short: ClassVar[str] = "relief"
    config_class: ClassVar[type] = ReliefConfig

    def setup(self) -> None:
        """Depth leads; every depth image gives one image, on the topic every provider of images uses."""
        self._config = self.config()
        sync = replace(self.sync_config(), image=False, depth=True, lidar=False, pose=False)
        self._inputs = SensorInputs(sync, lossless=self.options.lossless)
        self.leader = self._inputs.leader
        for topic, kind, keep in self._inputs.subscriptions():
            self.listen(topic, kind, keep)
        self.output(topics.FLEXION_IMAGE)

    def take(self, kind: str, msg: Any) -> None:
        """Convert every depth image whose calibration is known."""
        self._inputs.push(kind, msg)
        self._convert()

    def finish(self) -> None:
        """Convert what waited for its calibration."""
        self._inputs.assembler.end()
        self._convert()

    def _convert(self) -> None:
        for frame in self._inputs.assembler.ready():
            assert frame.depth is not None and frame.camera is not None
            image = relief_image(frame.depth, frame.camera, self._config)
            sent = messages.encode_image(messages.rclpy_factory, image, frame.stamp_ns, frame.camera.frame_id)
            self.output(topics.FLEXION_IMAGE).publish(sent)
            self.sent(frame.stamp_ns)


if __name__ == "__main__":
    sys.exit(run(ReliefNode))
