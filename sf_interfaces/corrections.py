"""Corrected poses of keyframes on their way to a map, and the point of the stream from which on they hold."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from sf_interfaces.types import Trajectory


class Corrections:
    """Corrections that wait for their turn.

    A correction belongs to a keyframe and holds from just before that one on: the keyframe and all later ones
    have corrected poses already, earlier ones are moved. So its effect depends on the stamps alone, however long
    a keyframe was on its way.
    """

    def __init__(self) -> None:
        self._waiting: dict[int, Trajectory] = {}

    def push(self, stamp_ns: int, correction: Trajectory) -> None:
        """Take the correction that belongs to the keyframe with this stamp."""
        self._waiting[stamp_ns] = correction

    def due(self, stamp_ns: int | None = None) -> Trajectory | None:
        """What to apply before the keyframe with this stamp (None: at the end); the newest replaces older ones."""
        ready = sorted(t for t in self._waiting if stamp_ns is None or t <= stamp_ns)
        return [self._waiting.pop(t) for t in ready][-1] if ready else None
