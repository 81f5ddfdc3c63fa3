"""The calibrations a camera has had: which one belongs to an image, and when a new sequence begins."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass, field

from sf_interfaces.geometry.undistort import Distortion
from sf_interfaces.types import Camera

_NEGLIGIBLE = 0.005  # of the image width: shift of a corner below which a changed calibration is ignored (autofocus)
_LATE_NS = 3_000_000_000  # an image waits no longer than this for a calibration that may have changed

Calibration = tuple[Camera, Distortion | None]


def differs(one: Calibration, other: Calibration) -> bool:
    """Whether two calibrations place a corner of the image noticeably apart, or differ in size or lens."""
    (a, lens_a), (b, lens_b) = one, other
    if (a.width, a.height) != (b.width, b.height) or lens_a != lens_b:
        return True
    shift = max(
        abs((u - b.cx) / b.fx * a.fx + a.cx - u) + abs((v - b.cy) / b.fy * a.fy + a.cy - v)
        for u in (0, a.width)
        for v in (0, a.height)
    )
    return shift > _NEGLIGIBLE * a.width


@dataclass(slots=True)
class Calibrations:
    """One camera's calibrations in the order of their stamps; small changes are not kept.

    Attributes:
        ignored: calibrations that differed too little to matter.
    """

    changes: list[tuple[int, Calibration]] = field(default_factory=list)
    newest_ns: int = 0
    repeated: bool = False  # it comes again and again: a change may be on its way with the next
    ignored: int = 0

    def add(self, stamp_ns: int, calibration: Calibration) -> None:
        """Take in one camera_info; stamp 0 where it has none."""
        self.repeated = self.repeated or (bool(self.changes) and stamp_ns > self.newest_ns > 0)
        self.newest_ns = max(self.newest_ns, stamp_ns)
        if not self.changes:
            self.changes.append((stamp_ns, calibration))
            return
        since_ns, current = self.changes[-1]
        if not differs(current, calibration):
            self.ignored += current != calibration
        elif stamp_ns > since_ns:
            self.changes.append((stamp_ns, calibration))
        else:
            self.ignored += 1  # older than, or as old as, the one it contradicts: nothing says which is right

    def at(self, stamp_ns: int) -> Calibration:
        """The one that was valid at an instant; the first also before its own."""
        for since_ns, calibration in reversed(self.changes):
            if since_ns <= stamp_ns:
                return calibration
        return self.changes[0][1]

    def settled(self, stamp_ns: int, leader_ns: int) -> bool:
        """Whether no calibration that arrives from now on should change the one valid at ``stamp_ns``.

        Args:
            leader_ns: newest stamp of the images; one that is far behind it is not held back any longer.
        """
        return not self.repeated or self.newest_ns >= stamp_ns or leader_ns - stamp_ns > _LATE_NS
