"""Intrinsics from the first images of a sequence (mode ``calibrate``): theta of an uncalibrated U2-MVD."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np

from sf_depth.config import DepthConfig
from sf_depth.core.matching import grey
from sf_depth.core.mvd import MultiViewDepth, Recovered
from sf_depth.core.seeds import Features, detect, match_features
from sf_interfaces.errors import InsufficientParallax
from sf_interfaces.types import Camera, UInt8

_STEP = 0.035  # image widths of motion between two views that are used
_VIEWS = 6  # views a calibration is made from
_GOOD = 0.01  # relative deviation of the focal length that is good enough to go on
_ENOUGH = 10  # views after which more of the same would not make it surer: what the lens adds does not average out


class Calibrator:
    """Chooses views as they come and calibrates as soon as they constrain the focal length.

    Attributes:
        result: the last calibration with its certainty, None before one succeeded.
    """

    def __init__(self, config: DepthConfig) -> None:
        self._mvd = MultiViewDepth(config)
        self._views: list[tuple[UInt8, Features]] = []
        self.result: Recovered | None = None

    def add(self, image: UInt8) -> Camera | None:
        """Take the next image; the camera once the views suffice.

        Raises:
            FormatError: an image is blank or of another size.
        """
        features = detect(grey(image))
        if self._views and self._motion(features) < _STEP * image.shape[1]:
            return None
        self._views.append((image, features))
        if len(self._views) < _VIEWS:
            return None
        try:
            self._calibrate()
        except InsufficientParallax:
            self._views = self._views[::2]
            return None
        assert self.result is not None
        done = self.result.focal_sigma < _GOOD or len(self._views) >= _ENOUGH
        return self.result.camera if done else None

    def finish(self) -> Camera:
        """The camera from what has come, at the end of the input.

        Raises:
            InsufficientParallax: the images do not constrain it.
        """
        if self.result is None:
            if len(self._views) < 3:
                raise InsufficientParallax(
                    f"only {len(self._views)} images differ enough to calibrate the camera from; move it sideways, "
                    "or give the intrinsics with --calibration"
                )
            self._calibrate()
        assert self.result is not None
        return self.result.camera

    def _motion(self, features: Features) -> float:
        """Median motion of matches since the last view used, px; infinite where nothing matches any more."""
        matches = match_features(self._views[-1][1], features)
        return float(np.median(np.linalg.norm(matches.second - matches.first, axis=1))) if len(matches) else np.inf

    def _calibrate(self) -> None:
        images = [image for image, _ in self._views]
        middle = len(images) // 2
        self.result = self._mvd.recover(images[middle], images[:middle] + images[middle + 1 :])
