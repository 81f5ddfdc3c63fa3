"""References in the input of a run, freed from the rolling shutter as the run has freed its images."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np

from sf_bringup.run_folder import RunFolder
from sf_interfaces.config import ConfigFile
from sf_interfaces.geometry import se3
from sf_interfaces.geometry.rolling_shutter import Readout, nearness, unrolled, velocity_between
from sf_interfaces.types import DepthMap, Float64, Frame, UInt8

_THINNED = 7  # every n-th pixel of a view tells how near the scene is


class Unroller:
    """Makes of images between keyframes what a global shutter would have taken, by the trajectory of their run."""

    def __init__(self, run: RunFolder) -> None:
        config = run.path / "config.yaml"
        values = ConfigFile.load(config).sections.get("tracking", {}) if config.is_file() else {}
        self._readout = Readout(float(values.get("readout_s", 0.0)))
        self._camera = run.camera()
        if self._readout:
            self._trajectory = run.trajectory()

    def __call__(self, stamp_ns: int, image: UInt8, depth: DepthMap) -> UInt8:
        """The image [H, W] or [H, W, 3] of a tracked frame; ``depth`` [H, W] is what is seen there."""
        if not self._readout:
            return image
        camera, seen = self._camera, depth.valid
        near = nearness(camera, camera.pixel_grid()[seen][::_THINNED], 1.0 / depth.z[seen][::_THINNED].astype(float))
        frame = Frame(stamp_ns, camera, image)
        found = unrolled(frame, self._velocity(stamp_ns), near, self._readout).image
        assert found is not None
        return found

    def _velocity(self, stamp_ns: int) -> Float64:
        """[6] of points in the camera's frame, between the frames before and after; zero where there are none."""
        stamps, poses = self._trajectory.stamps_ns, self._trajectory.poses
        at = int(np.searchsorted(stamps, stamp_ns))
        first, last = max(at - 1, 0), min(at + 1, len(stamps) - 1)
        if last <= first:
            return np.zeros(6)
        before, after = ((int(stamps[k]), se3.inverse(poses[k])) for k in (first, last))
        return velocity_between(before, after)
