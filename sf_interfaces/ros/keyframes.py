"""Where a depth or reconstruction node gets its keyframes: a bundle upstream, or posed sensor frames."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

from sf_interfaces.corrections import Correction
from sf_interfaces.errors import ConfigError
from sf_interfaces.io.atomic import replace_file
from sf_interfaces.ros.bundles import COMPLETED, TRACKED, BundleInputs, publish_bundle
from sf_interfaces.ros.node import BlockNode
from sf_interfaces.ros.sensors import SensorInputs
from sf_interfaces.types import Keyframe


class KeyframeSource:
    """Keyframes by the node option ``source``: ``tracking``, ``depth``, or ``sensors`` with poses given or none.

    Attributes:
        posed: False where the sensors' frames come without a pose, each in its own optical frame.

    Raises:
        ConfigError: another source.
    """

    def __init__(self, node: BlockNode, *, landmarks: bool) -> None:
        self._node, self._announced = node, set[str]()
        self._sensors: SensorInputs | None = None
        self.posed = True
        self._done = _Progress(node)
        source = node.options.source
        if source == "sensors":
            sync = node.sync_config()
            self.posed = sync.pose
            self._sensors = SensorInputs(sync, lossless=node.options.lossless)
            for topic, kind, keep in self._sensors.subscriptions():
                node.listen(topic, kind, keep)
            node.leader = self._sensors.leader
            return
        if source not in ("tracking", "depth"):
            raise ConfigError(f"source '{source}' is not known; use sensors, tracking or depth")
        bundle = TRACKED if source == "tracking" else COMPLETED
        self._bundles = BundleInputs(bundle, set() if landmarks else {"landmarks"})
        for kind, topic in self._bundles.topics.items():
            node.listen(topic, kind)
        node.leader, node.counted = "image", set(self._bundles.topics)

    def push(self, kind: str, msg: Any) -> Iterator[Keyframe]:
        """The keyframes that one message completes.

        Raises:
            SceneFactoryError: the message is malformed.
        """
        if self._sensors is None:
            keyframe = self._bundles.push(kind, msg)
            if keyframe is not None and keyframe.stamp_ns > self._done.stamp_ns:
                yield keyframe
            return
        self._sensors.push(kind, msg)
        yield from map(Keyframe.of, self._sensors.assembler.ready())

    def end(self) -> Iterator[Keyframe]:
        """The keyframes that were still waiting when the input ended."""
        if self._sensors is None:
            self._bundles.joiner.end()
            return
        self._sensors.assembler.end()
        yield from map(Keyframe.of, self._sensors.assembler.ready())

    def announces(self, parts: set[str]) -> None:
        """As the head of its line, tell which frames are keyframes: these parts go out on the tracker's topics."""
        if self._sensors is not None:
            self._announced = parts if self.posed else parts - {"pose"}
            for kind in self._announced:
                self._node.output(TRACKED[kind])

    def announce(self, keyframe: Keyframe) -> None:
        """Send a keyframe's parts where no tracker does."""
        if self._announced:
            publish_bundle(self._node, keyframe, TRACKED, self._announced)

    def done(self, stamp_ns: int) -> None:
        """Everything up to this keyframe is dealt with and safe: a successor of this process need not repeat it."""
        self._done.write(stamp_ns)

    def correction(self, stamp_ns: int | None = None) -> Correction | None:
        """The correction of keyframes to be applied before the one with this stamp (None: at the end)."""
        return None if self._sensors is not None else self._bundles.corrections.due(stamp_ns)

    @property
    def reasons(self) -> dict[str, int]:
        """Why input was dropped, with counts."""
        part = self._bundles.joiner if self._sensors is None else self._sensors.assembler
        return dict(part.reasons)

    @property
    def waiting_for(self) -> str:
        """What the oldest image still lacks, in words."""
        return "" if self._sensors is None else self._sensors.assembler.waiting_for


class _Progress:
    """The last keyframe that is dealt with, on disk. After a restart upstream sends its last ones again."""

    def __init__(self, node: BlockNode) -> None:
        name = f"{node.short}.json"
        self._path, found = node.state(name), node.snapshot(name)
        self.stamp_ns = int(json.loads(found.read_text())["stamp_ns"]) if found is not None else -1

    def write(self, stamp_ns: int) -> None:
        if self._path is not None:
            with replace_file(self._path) as draft:
                draft.write_text(json.dumps({"stamp_ns": stamp_ns}))
