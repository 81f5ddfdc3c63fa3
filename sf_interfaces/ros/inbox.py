"""Between the thread that receives and the one that works: the queue, and the joining of bundles. Pure."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Collection
from typing import Any

DropCallback = Callable[[str, Any, str], None]


class Inbox:
    """Messages in order of arrival, over all kinds.

    A kind put with ``keep`` holds at most so many: the oldest of that kind makes room (latest wins), and
    ``on_drop(kind, data, reason)`` is told. Without ``keep`` nothing is ever dropped.
    """

    END = "end"

    def __init__(self, on_drop: DropCallback) -> None:
        self._items: deque[tuple[str, Any]] = deque()
        self._held: dict[str, int] = {}
        self._changed = threading.Condition()
        self._on_drop = on_drop

    def put(self, kind: str, data: Any, keep: int | None = None) -> None:
        """Append one message of a kind."""
        dropped = None
        with self._changed:
            if keep is not None and self._held.get(kind, 0) >= keep:
                index = next(i for i, (held, _) in enumerate(self._items) if held == kind)
                dropped = self._items[index][1]
                del self._items[index]
                self._held[kind] -= 1
            self._items.append((kind, data))
            self._held[kind] = self._held.get(kind, 0) + 1
            self._changed.notify()
        if dropped is not None:
            self._on_drop(kind, dropped, f"{kind} dropped: the node is slower than its input, the latest wins")

    def end(self, *, discard: bool = False) -> None:
        """Mark the end: after what is queued, or (``discard``) at once."""
        with self._changed:
            if discard:
                self._items.clear()
                self._held.clear()
            self._items.append((self.END, None))
            self._changed.notify()

    def get(self, timeout_s: float | None = None) -> tuple[str, Any] | None:
        """The oldest message as (kind, data), waiting for one; None after the timeout."""
        with self._changed:
            if not self._changed.wait_for(lambda: self._items, timeout_s):
                return None
            kind, data = self._items.popleft()
            self._held[kind] = self._held.get(kind, 1) - 1
            return kind, data

    def __len__(self) -> int:
        return len(self._items)


class KeyframeJoiner:
    """Joins the topics of a bundle by their identical stamps.

    Each topic delivers in order, so when a bundle is complete, an older one that still lacks a part will
    never get it: it is dropped and counted.

    Attributes:
        reasons: why bundles were dropped, with counts.
    """

    def __init__(self, kinds: Collection[str]) -> None:
        self._kinds = frozenset(kinds)
        self._open: dict[int, dict[str, Any]] = {}
        self.reasons: dict[str, int] = {}

    def push(self, kind: str, stamp_ns: int, part: Any) -> dict[str, Any] | None:
        """Add one part; the whole bundle when it is the last of them."""
        bundle = self._open.setdefault(stamp_ns, {})
        bundle[kind] = part
        if len(bundle) < len(self._kinds):
            return None
        for other in list(self._open):
            if other == stamp_ns:
                break
            self._drop(other)
        return self._open.pop(stamp_ns)

    def end(self) -> None:
        """No more parts will come."""
        for stamp_ns in list(self._open):
            self._drop(stamp_ns)

    def _drop(self, stamp_ns: int) -> None:
        missing = ", ".join(sorted(self._kinds - set(self._open.pop(stamp_ns))))
        reason = f"keyframe dropped: no {missing} with its stamp"
        self.reasons[reason] = self.reasons.get(reason, 0) + 1
