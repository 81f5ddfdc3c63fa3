"""Depth of one image from a few others at once: what the service of the node computes."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sf_depth.config import DepthConfig
from sf_depth.core.filling import Filler
from sf_depth.core.mvd import MultiViewDepth
from sf_interfaces.errors import FormatError
from sf_interfaces.geometry import se3
from sf_interfaces.types import Float64, Frame, Keyframe


@dataclass(frozen=True, slots=True)
class Estimated:
    """The first image with completed depth and its camera, and T_map_camera of all (None: could not be placed)."""

    keyframe: Keyframe
    poses: tuple[Float64 | None, ...]


class OneShot:
    """U2-MVD with the first image as reference and all others as sources, then completion (paper Sec. V)."""

    def __init__(self, config: DepthConfig) -> None:
        self._mvd = MultiViewDepth(config)
        self._filler = Filler(config)

    def estimate(self, frames: Sequence[Frame]) -> Estimated:
        """Depth, and what is missing of camera and poses.

        Args:
            frames: images; all with a camera or none, all with a pose (of the map, metric) or none. Without poses
                the map is the first camera, and its unit the median depth.

        Raises:
            FormatError: images that do not fit together, or things known of some images only.
            InsufficientParallax: the images do not constrain depth.
        """
        images = [frame.image for frame in frames if frame.image is not None]
        if len(images) < len(frames) or len(images) < 2:
            raise FormatError(f"multi-view depth needs at least 2 images, got {len(images)}")
        camera, given = frames[0].camera, [frame.T_map_camera for frame in frames]
        if any(frame.camera != camera for frame in frames):
            raise FormatError("the images have different cameras; give images of one camera")
        known = [T for T in given if T is not None]
        if known and (len(known) < len(given) or camera is None):
            raise FormatError("poses need intrinsics, and a pose for every image; give both or neither")
        first = known[0] if known else np.eye(4)
        T = np.stack([se3.inverse(other) @ first for other in known[1:]]) if known else None
        got = self._mvd.recover(images[0], images[1:], camera, T)
        placed = [first @ se3.inverse(step) for step in got.T_source_reference]
        poses = known or [first, *(pose if good else None for pose, good in zip(placed, got.registered, strict=True))]
        keyframe = Keyframe(frames[0].stamp_ns, got.camera, images[0], first, got.depth)
        return Estimated(self._filler.fill(keyframe), tuple(poses))
