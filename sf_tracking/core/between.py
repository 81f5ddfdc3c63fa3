"""Frames between keyframes that see patches without measured depth: solved again once those depths are final.

While a frame is tracked, the depth of what it sees has parallax from earlier frames alone. Where the patches were
seen stays true; so once the keyframes they belong to leave the window, the pose follows from the refined depths.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from sf_interfaces.types import Camera, Float64
from sf_tracking.core.keyframes import TrackedKeyframe
from sf_tracking.core.locate import Placed, Sights
from sf_tracking.core.patches import Patches

_MOST = 40  # frames kept for one keyframe, so that a camera at rest takes no memory; the latest ones count


@dataclass(frozen=True, slots=True)
class _Final:
    """What remains of a keyframe that has left the window."""

    camera: Camera
    patches: Patches
    T_cw: Float64


@dataclass(frozen=True, slots=True)
class _Frame:
    stamp_ns: int
    sights: Sights
    keyframes: tuple[int, ...]  # stamps of those that the sights index


class Between:
    """The frames that wait for the newest keyframe they see to become final."""

    def __init__(self, window: int) -> None:
        self._waiting: dict[int, deque[_Frame]] = {}  # by stamp of the newest keyframe that they see
        self._final: dict[int, _Final] = {}
        self._room = window + 1  # final keyframes that a frame may still see
        self._due: deque[_Frame] = deque()

    def add(self, stamp_ns: int, sights: Sights, keyframes: Sequence[TrackedKeyframe]) -> None:
        """Remember a frame that saw patches of ``keyframes``, unless depth was measured there."""
        if keyframes[-1].patches.measured.any():
            return
        stamps = tuple(k.frame.stamp_ns for k in keyframes)
        self._waiting.setdefault(stamps[-1], deque(maxlen=_MOST)).append(_Frame(stamp_ns, sights, stamps))

    def settle(self, keyframe: TrackedKeyframe) -> None:
        """A keyframe is final: the frames that waited for it are due."""
        stamp = keyframe.frame.stamp_ns
        self._final[stamp] = _Final(keyframe.camera, keyframe.patches, keyframe.T_cw)
        while len(self._final) > self._room and not self._due:
            del self._final[next(iter(self._final))]
        self._due.extend(self._waiting.pop(stamp, ()))

    def due(self, most: int | None = None) -> Iterator[tuple[int, Sights, list[Placed]]]:
        """Frames whose keyframes are final, at most so many: stamp, sights and the keyframes these index."""
        for _ in range(len(self._due) if most is None else min(most, len(self._due))):
            frame = self._due.popleft()
            yield frame.stamp_ns, frame.sights, [self._final[stamp] for stamp in frame.keyframes]
