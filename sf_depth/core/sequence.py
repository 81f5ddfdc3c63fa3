"""Depth of the keyframes of a sequence (modes ``slam`` and ``posed``).

A keyframe waits until frames after it have come too; then its good neighbours are chosen. With given poses, which may
contradict the images, U2-MVD runs on them (posed); with the tracker's a sweep, whose depth waits until that of
others confirms it (slam). What neither knows is completed.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Protocol

import numpy as np

from sf_depth.config import DepthConfig
from sf_depth.core.estimator import DepthCompleter
from sf_depth.core.filling import Filler
from sf_depth.core.mvd import CONTRADICTED, MultiViewDepth
from sf_depth.core.neighbors import NeighborLimits, before_and_after, nearest
from sf_depth.core.overlap import sighted_depth
from sf_depth.core.swept import Consensus, relative, swept
from sf_interfaces.errors import SceneFactoryError
from sf_interfaces.geometry import se3
from sf_interfaces.types import Keyframe

_AHEAD = 6  # later frames a keyframe waits for
_KEPT = 24  # frames that may still become neighbours
_LEAST_DENSITY = 0.01  # share of the pixels whose depth has to be known before gaps are filled
_NOTHING_MEASURED = "keyframe without measured depth, as between the sweeps of a LiDAR"


class Setting(Protocol):
    """What tells the two modes apart."""

    least_neighbors: ClassVar[int]  # neighbours a reference needs
    nearest: ClassVar[int]  # that are taken beside the good ones because they are close by

    def wants(self, frame: Keyframe, last: Keyframe | None, depth: float) -> bool:
        """Whether a frame becomes a reference; ``last`` was one, the scene is ``depth`` away."""

    def scene_depth(self, frame: Keyframe, others: list[Keyframe]) -> float | None:
        """Typical depth that a frame sees, in the unit of its pose; None while unknown."""

    def recover(self, mvd: MultiViewDepth, frame: Keyframe, sources: list[Keyframe]) -> tuple[list[Keyframe], bool]:
        """Keyframes that have depth now, with gaps, and whether the poses of this one contradict its images.

        Raises:
            InsufficientParallax: the neighbours do not constrain the depth of this one.
        """

    def finish(self) -> list[Keyframe]:
        """The end of the sequence: the keyframes that still waited, with depth."""


class SlamSetting:
    """Every keyframe of the tracker gets depth, by a sweep at its pose that other keyframes confirm."""

    least_neighbors: ClassVar[int] = 1  # what one source alone tells others still have to confirm
    nearest: ClassVar[int] = 2  # far sources lose sight of what is near, and of what the camera turns away from

    def __init__(self) -> None:
        self._consensus = Consensus()

    def wants(self, frame: Keyframe, last: Keyframe | None, depth: float) -> bool:
        """Always: the tracker has chosen."""
        return True

    def scene_depth(self, frame: Keyframe, others: list[Keyframe]) -> float | None:
        """Median depth of its landmarks."""
        if frame.landmarks is None or not len(frame.landmarks):
            return None
        z = frame.landmarks.points[:, 2]
        return float(np.median(z[z > 0])) if (z > 0).any() else None

    def recover(self, mvd: MultiViewDepth, frame: Keyframe, sources: list[Keyframe]) -> tuple[list[Keyframe], bool]:
        """Sweep this one; those before it that have been asked about now."""
        return self._consensus.add(swept(frame, sources)), False

    def finish(self) -> list[Keyframe]:
        """Those for which no more witnesses come."""
        return self._consensus.finish()


@dataclass(frozen=True, slots=True)
class PosedSetting:
    """Frames with given poses; those that moved on become references. The poses hold the scale."""

    spacing: float
    least_neighbors: ClassVar[int] = 2  # tau_nb of the paper
    nearest: ClassVar[int] = 0

    def wants(self, frame: Keyframe, last: Keyframe | None, depth: float) -> bool:
        """It moved or turned enough since the last one."""
        if last is None:
            return True
        T = se3.inverse(last.T_map_camera) @ frame.T_map_camera
        turned = np.arccos(np.clip((np.trace(T[:3, :3]) - 1) / 2, -1, 1))
        return float(np.linalg.norm(T[:3, 3])) / depth + turned > self.spacing

    def scene_depth(self, frame: Keyframe, others: list[Keyframe]) -> float | None:
        """Median depth of sparse matches, triangulated with the given poses."""
        return sighted_depth(frame, others)

    def recover(self, mvd: MultiViewDepth, frame: Keyframe, sources: list[Keyframe]) -> tuple[list[Keyframe], bool]:
        """Depth with the given poses; where they fit the images badly, their translations only give the scale."""
        got = mvd.recover(frame.image, [s.image for s in sources], frame.camera, relative(frame, sources))
        depth = replace(got.depth, scale=frame.depth.scale) if frame.depth else got.depth
        return [replace(frame, depth=depth)], got.contradicted

    def finish(self) -> list[Keyframe]:
        """Nothing waits."""
        return []


class EachDepth:
    """Completes keyframes one by one, as they come (mode ``complete``)."""

    def __init__(self, completer: DepthCompleter) -> None:
        self.completer = completer
        self.reasons: dict[str, int] = {}

    def add(self, frame: Keyframe) -> list[Keyframe]:
        """The keyframe with dense depth; none where nothing was measured, as between the sweeps of a LiDAR."""
        if frame.depth is None or not frame.depth.valid.any():
            self.reasons[_NOTHING_MEASURED] = self.reasons.get(_NOTHING_MEASURED, 0) + 1
            return []
        return [self.completer.complete(frame)]

    def finish(self) -> list[Keyframe]:
        """Nothing waits."""
        return []


class SequenceDepth:
    """Takes the frames of a sequence and gives those that got dense depth.

    Attributes:
        reasons: why keyframes got no depth, with counts.
    """

    def __init__(self, config: DepthConfig, setting: Setting) -> None:
        self._config, self._setting = config, setting
        self._mvd = MultiViewDepth(config)
        self._filler = Filler(config)
        self._limits = NeighborLimits(config.max_angle, config.min_baseline, config.max_baseline)
        self._frames: list[Keyframe] = []
        self._next = 0  # index of the first frame that was not yet considered
        self._last: Keyframe | None = None
        self._depth = 0.0
        self.reasons: dict[str, int] = {}

    def add(self, frame: Keyframe) -> list[Keyframe]:
        """Take the next frame, whose pose is final; returns the keyframes that have depth now."""
        self._frames.append(frame)
        done = []
        while len(self._frames) - self._next > _AHEAD:
            done += self._consider()
        while self._next > _KEPT:
            del self._frames[0]
            self._next -= 1
        return done

    def finish(self) -> list[Keyframe]:
        """The end of the sequence: the last frames have neighbours on one side only."""
        done = []
        while self._next < len(self._frames):
            done += self._consider()
        self._frames, self._next, self._last, self._depth = [], 0, None, 0.0
        return done + self._filled(self._setting.finish())

    def _consider(self) -> list[Keyframe]:
        """Depth of the next frame, if it is to be a keyframe and its neighbours allow it."""
        index, frame = self._next, self._frames[self._next]
        self._next += 1
        others = [other for other in self._frames if other is not frame]
        known = self._setting.scene_depth(frame, others) if self._depth == 0.0 else None
        self._depth = self._depth or known or 0.0
        if self._depth == 0.0:
            return self._skip("the depth of the scene is not known yet: too little parallax")
        if not self._setting.wants(frame, self._last, self._depth):
            return []
        self._depth = self._setting.scene_depth(frame, others) or self._depth
        poses = [other.T_map_camera for other in self._frames]
        chosen = before_and_after(index, poses, self._depth, self._limits, self._config.max_sources)
        chosen += nearest(index, poses, self._depth, self._limits, chosen, self._setting.nearest)
        if len(chosen) < self._setting.least_neighbors:
            return self._skip("too few good neighbours: the camera hardly moves, or turns too fast")
        try:
            found, contradicted = self._setting.recover(self._mvd, frame, [self._frames[j] for j in chosen])
        except SceneFactoryError as error:
            return self._skip(str(error))
        if contradicted:
            self._count(CONTRADICTED)
        self._last = frame
        return self._filled(found)

    def _filled(self, found: list[Keyframe]) -> list[Keyframe]:
        """Keyframes without gaps; those that know too little to fill them are left out."""
        done: list[Keyframe] = []
        for keyframe in found:
            density = 0.0 if keyframe.depth is None else keyframe.depth.density
            if density < _LEAST_DENSITY:
                self._skip(f"other keyframes confirm {density:.1%} of its depth; it takes more parallax and overlap")
                continue
            try:
                done.append(self._filler.fill(keyframe))
            except SceneFactoryError as error:
                self._skip(str(error))
        return done

    def _skip(self, reason: str) -> list[Keyframe]:
        self._count(f"keyframe without depth: {reason}")
        return []

    def _count(self, words: str) -> None:
        self.reasons[words] = self.reasons.get(words, 0) + 1
