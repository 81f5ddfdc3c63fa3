"""The flexion node: a depth image in, the flexion image with the same stamp out."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import sys
from dataclasses import replace
from typing import Any, ClassVar

from sf_flexion.config import FlexionConfig
from sf_flexion.core.flexion import Flexion
from sf_interfaces import topics
from sf_interfaces.ros import messages
from sf_interfaces.ros.node import BlockNode
from sf_interfaces.ros.process import run
from sf_interfaces.ros.sensors import SensorInputs


class FlexionNode(BlockNode):
    """Completes the image (Sec. III-A)."""

    short: ClassVar[str] = "flexion"
    config_class: ClassVar[type] = FlexionConfig

    def setup(self) -> None:
        """Depth leads; every depth image gives one image."""
        self._flexion = Flexion(self.config())
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

    def refresh(self) -> None:
        """Why depth images were dropped."""
        self.health.set_drops(dict(self._inputs.assembler.reasons) if self.leader else {})
        self.health.waiting(self._inputs.assembler.waiting_for if self.leader else "")
        self.health.value("step", self._flexion.step if self.leader else None)

    def _convert(self) -> None:
        for frame in self._inputs.assembler.ready():
            assert frame.depth is not None and frame.camera is not None
            image = self._flexion(frame.depth, frame.camera)
            sent = messages.encode_image(messages.rclpy_factory, image, frame.stamp_ns, frame.camera.frame_id)
            self.output(topics.FLEXION_IMAGE).publish(sent)
            self.sent(frame.stamp_ns)


def main() -> int:
    """Run the node."""
    return run(FlexionNode)


if __name__ == "__main__":
    sys.exit(main())
