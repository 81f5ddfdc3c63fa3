"""The depth node: keyframes in, the same keyframes with dense depth and variance out."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np

from sf_depth import service
from sf_depth.config import DepthConfig
from sf_depth.core.estimator import DepthCompleter
from sf_depth.core.one_shot import OneShot
from sf_depth.core.photoset import PhotoSetDepth
from sf_depth.core.sequence import EachDepth, PosedSetting, SequenceDepth, SlamSetting
from sf_depth.image_set import ImageSet
from sf_interfaces import topics
from sf_interfaces.errors import ConfigError
from sf_interfaces.ros import messages
from sf_interfaces.ros.bundles import COMPLETED, TRACKED, publish_bundle
from sf_interfaces.ros.calls import forwarded
from sf_interfaces.ros.keyframes import KeyframeSource
from sf_interfaces.ros.node import BlockNode
from sf_interfaces.ros.process import run
from sf_interfaces.types import Keyframe, PointCloud

# What goes out of an image set: its keyframes as a tracker would send them, and their completed depth.
_SET_BUNDLES = (
    (TRACKED, {"image", "camera_info", "pose", "depth", "state"}),
    (COMPLETED, {"camera_info", "pose", "depth", "variance"}),
)


class DepthNode(BlockNode):
    """Completes the depth (Sec. III-C): sparse depth (mode ``complete``) or none (``slam``, ``posed``).

    With ``source: sensors`` it is the head of its line and sends what a tracker would of its keyframes too; in mode
    ``mvd`` it then estimates all images at once when they have ended. The service ``estimate_depth`` is there in every
    mode, and alone in mode ``mvd`` without ``source: sensors``.
    """

    short: ClassVar[str] = "depth"
    config_class: ClassVar[type] = DepthConfig
    defaults: ClassVar[dict[str, Any]] = {"source": "tracking"}

    def __init__(self) -> None:
        from sf_interfaces.srv import EstimateDepth

        super().__init__()
        self._config: DepthConfig | None = None
        self._one_shot: OneShot | None = None
        self._images: ImageSet | None = None
        self.service(EstimateDepth, "estimate_depth", forwarded(self, "estimate"))

    def setup(self) -> None:
        """The completer and its keyframes."""
        self.leader = ""
        config = self.config()
        self._config, self._one_shot = config, None
        self._images = None
        self._depth = self._part(config)
        if self._depth is None:
            if self.options.source == "sensors":
                self._collect(config)
            return
        self._source = KeyframeSource(self, landmarks=True)
        # Which frames get depth is known at once (complete), or only when they have it (posed).
        self._at_once = config.mode == "complete"
        self._source.announces({"image", "camera_info", "pose", "state", *(("depth",) if self._at_once else ())})
        self._parts = set(COMPLETED) - {"image", "state"} - (set() if self._source.posed else {"pose"})
        for kind in self._parts:
            self.output(COMPLETED[kind])
        self.output(topics.DENSE_POINTS)

    def take(self, kind: str, msg: Any) -> None:
        """Complete the keyframes one message makes ready, or answer a call."""
        if kind == "estimate":
            msg.answer(self._estimate)
            return
        if self._images is not None:
            self._images.push(kind, msg)
            return
        for keyframe in self._source.push(kind, msg):
            self.guarded(lambda keyframe=keyframe: self._add(keyframe))  # type: ignore[misc]

    def finish(self) -> None:
        """Complete what was still waiting."""
        if self._images is not None:
            self._estimate_all(self._images)
        if self._depth is None:
            return
        for keyframe in self._source.end():
            self.guarded(lambda keyframe=keyframe: self._add(keyframe))  # type: ignore[misc]
        self.guarded(lambda: self._send(self._depth.finish()))

    def refresh(self) -> None:
        """Why input was dropped."""
        if self._images is not None:
            self.health.set_drops(self._images.reasons)
        if self.leader and self._depth is not None:
            self.health.set_drops(self._source.reasons | self._depth.reasons)
            self.health.waiting(self._source.waiting_for)

    @staticmethod
    def _part(config: DepthConfig) -> SequenceDepth | EachDepth | None:
        """The core of the configured mode that works on keyframes one after the other; none for ``mvd``.

        Raises:
            ConfigError: the mode does not run as a node.
        """
        if config.mode == "complete":
            return EachDepth(DepthCompleter(config))
        if config.mode == "slam":
            return SequenceDepth(config, SlamSetting())
        if config.mode == "posed":
            return SequenceDepth(config, PosedSetting(config.keyframe_baseline))
        if config.mode == "mvd":
            return None
        raise ConfigError(f"mode '{config.mode}' of the depth node is not known; use complete, slam, posed or mvd")

    def _estimate(self, request: Any, response: Any) -> None:
        if self._config is None:
            response.message = "the depth node is not configured yet; configure it and call again"
            return
        if self._one_shot is None:  # with the first call: most lines never make one
            self._one_shot = OneShot(self._config)
        service.answer(self._one_shot, request, response)
        self.health.count("calls answered")

    def _collect(self, config: DepthConfig) -> None:
        """Mode ``mvd`` as the head of a line."""
        self._images = ImageSet(self, PhotoSetDepth(config))
        for bundle, parts in _SET_BUNDLES:
            for kind in parts:
                self.output(bundle[kind])
        self.output(topics.DENSE_POINTS)

    def _estimate_all(self, images: ImageSet) -> None:
        """Depth and pose of all images, sent and saved."""
        found = images.finish(lambda done: self.sent(0, count=0))
        for keyframe in found.keyframes:
            for bundle, parts in _SET_BUNDLES:
                publish_bundle(self, keyframe, bundle, parts)
            self._sent_dense(keyframe)
        if self.out is not None:
            found.save_products(self.out)

    def _add(self, keyframe: Keyframe) -> None:
        assert self._depth is not None
        if self._at_once:
            self._source.announce(keyframe)
        self._send(self._depth.add(keyframe))

    def _send(self, keyframes: Sequence[Keyframe]) -> None:
        for dense in keyframes:
            if not self._at_once:
                self._source.announce(dense)
            publish_bundle(self, dense, COMPLETED, self._parts)
            self._sent_dense(dense)
            self._source.done(dense.stamp_ns)

    def _sent_dense(self, dense: Keyframe) -> None:
        """Count a keyframe that was sent; its points go to whoever wants them."""
        self.health.count("keyframes completed")
        if self.wanted(topics.DENSE_POINTS):
            self.output(topics.DENSE_POINTS).publish(messages.encode_cloud(messages.rclpy_factory, _points(dense)))
        self.sent(dense.stamp_ns)


def _points(keyframe: Keyframe) -> PointCloud:
    """The valid pixels as coloured points in the optical frame."""
    assert keyframe.depth is not None
    valid, image = keyframe.depth.valid, keyframe.image
    z = keyframe.depth.z[valid].astype(np.float64)
    points = keyframe.camera.unproject(keyframe.camera.pixel_grid()[valid], z)
    colors = image[valid] if image.ndim == 3 else np.repeat(image[valid][:, None], 3, axis=1)
    return PointCloud(points, colors, stamp_ns=keyframe.stamp_ns, frame_id=keyframe.camera.frame_id)


def main() -> int:
    """Run the node."""
    return run(DepthNode)


if __name__ == "__main__":
    sys.exit(main())
