"""Mode ``mvd`` as the head of a line: the images of the sensors, estimated at once when they have ended."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Callable
from typing import Any

from sf_depth.core.photoset import PhotoSet, PhotoSetDepth
from sf_interfaces.errors import FormatError
from sf_interfaces.ros.node import BlockNode
from sf_interfaces.ros.sensors import SensorInputs
from sf_interfaces.types import Frame


class ImageSet:
    """Collects frames from the sensors' topics.

    Attributes:
        reasons: why images were left out, with counts.
    """

    def __init__(self, node: BlockNode, part: PhotoSetDepth) -> None:
        self._part, self._sensors = part, SensorInputs(node.sync_config(), lossless=node.options.lossless)
        self._frames: list[Frame] = []
        self._left_out: dict[str, int] = {}
        for topic, kind, keep in self._sensors.subscriptions():
            node.listen(topic, kind, keep)
        node.leader = self._sensors.leader

    def push(self, kind: str, msg: Any) -> None:
        """Take one message.

        Raises:
            SceneFactoryError: it is malformed.
        """
        self._sensors.push(kind, msg)
        self._frames += self._sensors.assembler.ready()

    def finish(self, heard: Callable[[int], None]) -> PhotoSet:
        """Estimate everything that has come; ``heard`` is told after every reference.

        Raises:
            FormatError: no image could be used, or they do not fit together.
            InsufficientParallax: the images do not constrain depth.
        """
        self._sensors.assembler.end()
        self._frames += self._sensors.assembler.ready()
        if not self._frames:
            reasons = "; ".join(self._sensors.assembler.reasons) or "none came"
            raise FormatError(f"no image could be used: {reasons}")
        found = self._part.estimate(self._frames, heard)
        self._left_out = found.reasons
        return found

    @property
    def reasons(self) -> dict[str, int]:
        """Why images were left out."""
        return dict(self._sensors.assembler.reasons) | self._left_out
