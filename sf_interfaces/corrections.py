"""Corrected poses of keyframes on their way to a map, and the point of the stream from which on they hold."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sf_interfaces.errors import FormatError
from sf_interfaces.types import Float64, Trajectory


@dataclass(frozen=True, slots=True)
class Correction:
    """Where keyframes are after a loop was closed, and how long their units have become.

    Args:
        keyframes: corrected T_map_camera by keyframe stamp.
        scales: [N] units of the map per unit in which the keyframe, its depth and its landmarks were sent; 1 where
            the scale is metric. Always relative to that, so that a newer correction replaces an older one.

    Raises:
        FormatError: not one positive scale for each pose.
    """

    keyframes: Trajectory
    scales: Float64

    def __post_init__(self) -> None:
        scales = np.array(self.scales, dtype=np.float64)
        if scales.shape != self.keyframes.stamps_ns.shape or not (np.isfinite(scales) & (scales > 0)).all():
            raise FormatError("a correction must bring one positive scale for each pose")
        object.__setattr__(self, "scales", scales)


class Corrections:
    """Corrections that wait for their turn.

    A correction belongs to a keyframe and holds from just before that one on: the keyframe and all later ones
    have corrected poses already, earlier ones are moved. So its effect depends on the stamps alone, however long
    a keyframe was on its way.
    """

    def __init__(self) -> None:
        self._waiting: dict[int, Correction] = {}

    def push(self, stamp_ns: int, correction: Correction) -> None:
        """Take the correction that belongs to the keyframe with this stamp."""
        self._waiting[stamp_ns] = correction

    def due(self, stamp_ns: int | None = None) -> Correction | None:
        """What to apply before the keyframe with this stamp (None: at the end); the newest replaces older ones."""
        ready = sorted(t for t in self._waiting if stamp_ns is None or t <= stamp_ns)
        return [self._waiting.pop(t) for t in ready][-1] if ready else None
