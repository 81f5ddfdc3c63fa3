"""The production line in one process: the paper's ``EstablishProductLine`` and ``Step`` (Algorithm 1).

The ROS graph runs the same cores on the same data; on a lossless replay both give the same result.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from sf_bringup.result_writer import ResultWriter
from sf_interfaces.config import ConfigFile
from sf_interfaces.errors import ConfigError
from sf_interfaces.types import Frame, Keyframe

PARTS_GROUP = "scenefactory.parts"


def make_part(block_id: str, config: ConfigFile) -> Any:
    """The core of an installed block mode, built from its section of the configuration.

    Raises:
        ConfigError: the block is not installed, or its section is wrong.
    """
    for point in entry_points(group=PARTS_GROUP):
        if point.name == block_id:
            return point.load()(config)
    raise ConfigError(f"no installed package provides a runnable '{block_id}'; see 'sf blocks'")


def make_completer(config: ConfigFile) -> Any:
    """The depth completer, for measuring it on held-out points."""
    return make_part("depth:complete", config)


def load_map(path: Path) -> Any:
    """The reconstruction saved in an ``.sfmap`` file, ready to render."""
    return make_part("recon", ConfigFile({})).load(path)


class ProductionLine:
    """Parts in the order of the plan; each maps what it gets to what it completes."""

    def __init__(self, blocks: Sequence[str], config: ConfigFile, writer: ResultWriter) -> None:
        parts = {block: make_part(block, config) for block in blocks}
        self._flexion = parts.get("flexion")
        self.tracker = parts.get("tracking")
        self._completer = parts.get("depth:complete")
        self.reconstruction = parts.get("recon")
        self._writer = writer

    def step(self, frame: Frame) -> None:
        """Take one frame through the line; everything it completes goes to the writer."""
        if self._flexion is not None and frame.image is None:
            image = self._flexion(frame.depth, frame.camera)
            self._writer.flexion(frame, image)
            frame = replace(frame, image=image)
        if self.tracker is not None:
            update = self.tracker.track(frame)
            self._writer.tracked(frame, update)
            self._finish_keyframes(update.keyframes)
        elif frame.T_map_camera is not None and frame.image is not None and frame.camera is not None:
            sparse = frame.sparse_depth
            depth = frame.depth if sparse is None else sparse.to_map(frame.camera.height, frame.camera.width)
            keyframe = Keyframe(frame.stamp_ns, frame.camera, frame.image, frame.T_map_camera, depth)
            self._writer.keyframe(keyframe)
            self._complete(keyframe)

    def finish(self) -> None:
        """End of the input: the tracker's window becomes final, the colour field gets its last sweeps."""
        if self.tracker is not None:
            self._finish_keyframes(self.tracker.finish().keyframes)
        if self.reconstruction is not None:
            self.reconstruction.finish()

    def _finish_keyframes(self, keyframes: Sequence[Keyframe]) -> None:
        for keyframe in keyframes:
            self._writer.keyframe(keyframe)
            self._complete(keyframe)

    def _complete(self, keyframe: Keyframe) -> None:
        if self._completer is not None:
            keyframe = self._completer.complete(keyframe)
            self._writer.dense(keyframe)
        if self.reconstruction is not None:
            self._writer.surface(keyframe.stamp_ns, self.reconstruction.add(keyframe))
