"""Credits of a lossless replay: which images are still owed."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections import deque


class Credits:
    """Which images each consumer still owes. A consumed stamp settles all earlier ones too."""

    def __init__(self, consumers: tuple[str, ...]):
        self._owed: dict[str, deque[int]] = {name: deque() for name in consumers}

    def sent(self, stamp_ns: int) -> None:
        """An image has been published."""
        for owed in self._owed.values():
            owed.append(stamp_ns)

    def consumed(self, consumer: str, stamp_ns: int) -> None:
        """A consumer has taken in the image of this stamp."""
        owed = self._owed[consumer]
        while owed and owed[0] <= stamp_ns:
            owed.popleft()

    @property
    def in_flight(self) -> int:
        """Images the slowest consumer still owes."""
        return max((len(owed) for owed in self._owed.values()), default=0)
