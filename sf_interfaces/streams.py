"""One sensor stream: its messages in time order, across gaps and backward jumps of time."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any, NamedTuple

_S = 1_000_000_000  # ns


class StreamKey(NamedTuple):
    """A point in time that survives backward jumps: jumps so far, then the stamp."""

    epoch: int
    stamp_ns: int


@dataclass(slots=True)
class StreamItem:
    """One message that may still be needed."""

    key: StreamKey
    value: Any
    frame_id: str = ""
    used: bool = False


class Stream:
    """One sensor: its messages that may still be needed, in time order."""

    def __init__(self, name: str, reset_s: float) -> None:
        self.name = name
        self.items: deque[StreamItem] = deque()
        self.newest: StreamKey | None = None
        self._reset_ns = int(reset_s * _S)

    def advance(self, stamp_ns: int) -> tuple[StreamKey | None, str]:
        """The key of a new message (None: refuse it) and a reason worth counting ("" if none)."""
        reason = ""
        if stamp_ns == 0:
            return None, f"{self.name} dropped: its stamp is 0; let the driver fill header.stamp"
        if self.newest is None:
            key = StreamKey(0, stamp_ns)
        elif stamp_ns > self.newest.stamp_ns:
            key = StreamKey(self.newest.epoch, stamp_ns)
        elif self.newest.stamp_ns - stamp_ns > self._reset_ns:
            key = StreamKey(self.newest.epoch + 1, stamp_ns)
            reason = f"time of {self.name} jumped back: a new sequence begins"
        else:
            return None, f"{self.name} dropped: its stamp is not newer than the one before"
        self.newest = key
        return key, reason

    def passed(self, key: StreamKey) -> bool:
        """Nothing that arrives from now on can be nearer to ``key`` than what is here."""
        return self.newest is not None and self.newest >= key

    def around(self, key: StreamKey) -> tuple[StreamItem | None, StreamItem | None]:
        """The last message at or before ``key`` and the first at or after it, of the same epoch."""
        before = after = None
        for item in self.items:
            if item.key.epoch == key.epoch and item.key <= key:
                before = item
            if item.key.epoch == key.epoch and item.key >= key:
                after = item
                break
        return before, after

    def nearest(self, key: StreamKey, slop_s: float) -> StreamItem | None:
        """The message nearest in time within the slop; of two equally near the earlier."""
        found = [item for item in self.around(key) if item is not None]
        if not found:
            return None
        best = min(found, key=lambda item: abs(item.key.stamp_ns - key.stamp_ns))
        if abs(best.key.stamp_ns - key.stamp_ns) > round(slop_s * _S):
            return None
        best.used = True
        return best

    def forget(self, key: StreamKey) -> int:
        """Drop what no frame after ``key`` can need; returns how many of it were never used."""
        unused = 0
        # The last message at or before the key may still be the nearest to the next frame.
        while len(self.items) > 1 and self.items[1].key <= key:
            unused += not self.items.popleft().used
        return unused
