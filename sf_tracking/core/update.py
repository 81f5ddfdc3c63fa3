"""The update operator: for each edge a correction of the reprojected patch and the confidence in it."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from sf_interfaces.errors import ConfigError
from sf_interfaces.types import Float32, Float64, UInt8
from sf_tracking.config import TrackingConfig
from sf_tracking.core.align import Limits, Templates, align, describe, judge
from sf_tracking.core.patches import to_gray

_CONTRAST, _MIDDLE = 45.0, 128.0  # grey levels of a normalised image: standard deviation and mean
_MAX_GAIN = 4.0  # change of contrast between two sights of a patch
_REACH = 0.5  # of the patch side: how far alignment may move a patch from where the search left it
_STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.02)


@dataclass(frozen=True, slots=True)
class View:
    """An image prepared once for all its edges."""

    gray: UInt8  # [H, W] in normal contrast, for corners, search and descriptors
    fine: Float32  # [H, W] grey levels as they are, for alignment


@dataclass(frozen=True, slots=True)
class Update:
    """Where the patches were found: target = reprojection + delta, with its information."""

    target: Float64  # [E, 2] continuous px
    information: Float64  # [E, 2, 2] 1/px^2, Sigma_kj^-1 of the paper
    valid: NDArray[np.bool_]  # [E]


class UpdateOperator(Protocol):
    """Maps patches of keyframes and their reprojections into an image to corrected positions."""

    def view(self, image: UInt8) -> Any:
        """Prepare an image, RGB [H, W, 3] or mono [H, W], once for all its edges: a :class:`View` or more."""
        ...

    def describe(self, view: Any, uv: Float64) -> Any:
        """What is kept of the patches at ``uv`` [M, 2] px; has ``take(index)``."""
        ...

    def __call__(self, patches: Any, target: Any, start: Float64, warp: Float64) -> Update:
        """Correct E reprojections.

        Args:
            patches: descriptions of E patches.
            target: the image they are looked for in.
            start: [E, 2] px, the reprojections.
            warp: [E, 2, 2] how offsets from the patch centre map into the target.
        """
        ...


def make_operator(config: TrackingConfig) -> UpdateOperator:
    """The operator that the configuration asks for.

    Raises:
        ConfigError: it is unknown, or its checkpoint does not fit.
    """
    if config.operator == "patches":
        return PatchAlignment(config)
    if config.operator == "dpvo":
        # Torch takes seconds to load: only who asks for the network waits for it.
        from sf_tracking.core.dpvo_operator import DPVOOperator

        return DPVOOperator(config)
    raise ConfigError(f"tracking.operator '{config.operator}' is unknown; choose patches or dpvo")


class PatchAlignment:
    """Training-free operator: inverse compositional alignment with gain and bias, from the reprojection.

    The information of an edge is the patch's structure tensor over the variance of the grey-level residual:
    certain along gradients, uncertain along edges of the image, weaker where the patches differ.
    """

    def __init__(self, config: TrackingConfig) -> None:
        self._config = c = config
        self._limits = Limits(
            c.patch_px / 2,
            _REACH * c.patch_px,
            c.min_explained,
            c.image_sigma,
            c.max_residual,
            _MAX_GAIN,
            c.position_sigma,
        )

    def view(self, image: UInt8) -> View:
        """See :class:`UpdateOperator`; changes of exposure do not read as motion in the search either."""
        gray = to_gray(image)
        mean, deviation = cv2.meanStdDev(gray)
        gain = _CONTRAST / max(float(deviation[0, 0]), 1.0)
        normal = cv2.convertScaleAbs(gray, alpha=gain, beta=_MIDDLE - gain * float(mean[0, 0]))
        fine = cv2.GaussianBlur(gray.astype(np.float32), (3, 3), 0.6)
        return View(np.asarray(normal), np.asarray(fine))

    def describe(self, view: View, uv: Float64) -> Templates:
        """See :class:`UpdateOperator`."""
        return describe(view.fine, uv, self._config.patch_px)

    def __call__(self, patches: Templates, target: View, start: Float64, warp: Float64) -> Update:
        """See :class:`UpdateOperator`."""
        found = align(target.fine, patches, start, warp, self._config.iterations)
        information, valid = judge(found, start, target.fine.shape, self._limits)
        return Update(found.centre, information, valid)


def search(
    config: TrackingConfig, source: View, uv: Float64, target: View, start: Float64, *, wide: bool
) -> tuple[Float64, NDArray[np.bool_]]:
    """Pyramidal Lucas-Kanade of patches ``uv`` [M, 2] from ``start`` [M, 2] px, checked backwards.

    ``wide`` searches all levels because the motion is not known. Returns positions [M, 2] and success [M].
    """
    if len(uv) == 0:
        return uv.copy(), np.zeros(0, dtype=bool)
    levels = config.wide_levels if wide else config.levels
    side = config.search_px
    height, width = target.gray.shape
    # OpenCV counts pixel centres from 0, the project from 0.5.
    points = (uv - 0.5).astype(np.float32)
    guess = (start - 0.5).astype(np.float32)
    inside = np.isfinite(guess).all(axis=1)
    inside &= (guess >= -side).all(1) & (guess < np.float32([width, height]) + side).all(1)
    guess[~inside] = points[~inside]
    found, ok = _flow(source, target, points, guess, levels, side)
    back, ok_back = _flow(target, source, found, points, 1, side)
    ok &= inside & ok_back & (np.linalg.norm(back - points, axis=1) < 1.0)
    ok &= (found >= 0).all(axis=1) & (found < np.float32([width, height])).all(axis=1)
    return found.astype(np.float64) + 0.5, ok


def _flow(
    a: View, b: View, points: Float32, start: Float32, levels: int, side: int
) -> tuple[Float32, NDArray[np.bool_]]:
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        a.gray,
        b.gray,
        points,
        start.copy(),
        winSize=(side, side),
        maxLevel=levels,
        criteria=_STOP,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        minEigThreshold=1e-5,
    )
    ok = status.ravel().astype(bool)
    # OpenCV leaves the position undefined where it found nothing.
    return np.where(ok[:, None], found, points), ok
