"""Takes the rolling shutter out of frames while they are tracked: by the motion so far, then by the pose found."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from sf_interfaces.geometry.rolling_shutter import Readout, shift, unrolled, unrolled_by_flow, velocity_between
from sf_interfaces.types import Float32, Float64, Frame, UInt8
from sf_tracking.config import TrackingConfig
from sf_tracking.core.patches import to_gray

_SAME_PX = 0.1  # shifts that differ by less are one
_AHEAD = 0.25  # of the change of velocity between frames: half of what a constant acceleration makes of it
_REGULAR = 1.5  # relation of two frame intervals, up to which they tell an acceleration
_LONGEST_NS = 200_000_000  # between images that tell a velocity
_SMOOTH = (9, 9)  # px over which the motion of an image is averaged


class Shutter:
    """The frames of a tracker as a global shutter would have taken them."""

    def __init__(self, config: TrackingConfig) -> None:
        self._readout = Readout(config.readout_s, config.depth_readout_s)
        self._last: tuple[int, UInt8] | None = None  # stamp and image of the last frame before the map

    def __bool__(self) -> bool:
        return bool(self._readout)

    def before_map(self, frame: Frame) -> Frame | None:
        """Undone by how the image moved since the last frame; None for the first one, of which that is not known."""
        if not self._readout or frame.image is None or frame.camera is None:
            return frame
        last, self._last = self._last, (frame.stamp_ns, to_gray(frame.image))
        if last is None or frame.stamp_ns - last[0] > _LONGEST_NS:
            return frame if frame.measured else None
        return unrolled_by_flow(frame, image_velocity(*last, *self._last), self._readout)

    def expected(self, frame: Frame, recent: Sequence[tuple[int, Float64]], near: Float32) -> Frame:
        """Undone as if the camera moved on as it did between the last two frames.

        Args:
            recent: their stamps and T_cw; fewer where the camera was lost.
            near: inverse depth of what is seen, in the unit of the poses.
        """
        return unrolled(frame, _so_far(recent), near, self._readout)

    def corrected(
        self, frame: Frame, recent: Sequence[tuple[int, Float64]], T_cw: Float64, near: Float32
    ) -> Frame | None:
        """Undone again, where the pose found for the frame shows that the camera moved otherwise; else None."""
        if not recent or frame.camera is None:
            return None
        used, now = _so_far(recent), velocity_between(recent[-1], (frame.stamp_ns, T_cw))  # now: half an interval ago
        if len(recent) > 1 and frame.stamp_ns - recent[-1][0] < _REGULAR * (recent[-1][0] - recent[-2][0]):
            now += _AHEAD * (now - used)
        if shift(frame.camera, now - used, near, self._readout.image) < _SAME_PX:
            return None
        return unrolled(frame, now, near, self._readout)


def _so_far(recent: Sequence[tuple[int, Float64]]) -> Float64:
    """Velocity between the last two frames; 0 where they are not known."""
    return velocity_between(*recent[-2:]) if len(recent) > 1 else np.zeros(6)


def image_velocity(stamp_ns: int, first: UInt8, later_ns: int, second: UInt8) -> Float32:
    """px/s at which what each pixel of the second image shows moves, at half its size, [h, w, 2]."""
    small = [cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for image in (second, first)]
    back = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM).calc(*small, None)
    return np.asarray(cv2.blur(back, _SMOOTH) * np.float32(-2.0 / (1e-9 * (later_ns - stamp_ns))))
