"""The update operator: for each edge a correction of the reprojected patch and the confidence in it."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from sf_interfaces.types import Float64, UInt8
from sf_tracking.config import TrackingConfig
from sf_tracking.core.patches import Patches

_REACH = 0.5  # of the patch side: how far alignment may move a patch on the finest level of a known motion
_CONTRAST, _MIDDLE = 45.0, 128.0  # grey levels of a normalised image: standard deviation and mean
_STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.01)


@dataclass(frozen=True, slots=True)
class Update:
    """Where the patches were found: target = reprojection + delta, with its information."""

    target: Float64  # [M, 2] continuous px
    information: Float64  # [M, 2, 2] 1/px^2, Sigma_kj^-1 of the paper
    valid: NDArray[np.bool_]  # [M]


class UpdateOperator(Protocol):
    """Maps patches of one image and their reprojections into another to corrected positions."""

    def prepare(self, gray: UInt8) -> UInt8:
        """Prepare an image [H, W] once for all its edges."""
        ...

    def __call__(self, source: UInt8, patches: Patches, target: UInt8, start: Float64, *, wide: bool) -> Update:
        """Align ``patches`` of ``source`` in ``target``, starting from ``start`` [M, 2] px.

        ``wide`` asks for the full search range because the motion is not known.
        """
        ...


class PatchAlignment:
    """Training-free operator: pyramidal Lucas-Kanade from the reprojection, checked backwards.

    The information of an edge is the patch's structure tensor over the variance of the grey-level residual:
    certain along gradients, uncertain along edges of the image, weaker where the patches differ.
    """

    def __init__(self, config: TrackingConfig) -> None:
        self._config = config
        self._window = (config.patch_px, config.patch_px)

    def prepare(self, gray: UInt8) -> UInt8:
        """The image in normal contrast, so that changes of exposure do not read as motion."""
        mean, deviation = cv2.meanStdDev(gray)
        gain = _CONTRAST / max(float(deviation[0, 0]), 1.0)
        return np.asarray(cv2.convertScaleAbs(gray, alpha=gain, beta=_MIDDLE - gain * float(mean[0, 0])))

    def _flow(
        self, a: UInt8, b: UInt8, points: NDArray[np.float32], start: NDArray[np.float32], levels: int
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_], NDArray[np.float32]]:
        found, status, error = cv2.calcOpticalFlowPyrLK(
            a,
            b,
            points,
            start.copy(),
            winSize=self._window,
            maxLevel=levels,
            criteria=_STOP,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
            minEigThreshold=1e-5,
        )
        ok = status.ravel().astype(bool)
        # OpenCV leaves position and error undefined where it found nothing.
        return np.where(ok[:, None], found, points), ok, np.where(ok, error.ravel(), 0.0)

    def __call__(self, source: UInt8, patches: Patches, target: UInt8, start: Float64, *, wide: bool) -> Update:
        """See :class:`UpdateOperator`."""
        c = self._config
        count = len(patches)
        if count == 0:
            return Update(np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0, dtype=bool))
        height, width = target.shape
        levels = c.wide_levels if wide else c.levels
        # OpenCV counts pixel centres from 0, the project from 0.5.
        points = (patches.uv - 0.5).astype(np.float32)
        guess = (start - 0.5).astype(np.float32)
        inside = (guess >= -c.patch_px).all(1) & (guess < np.float32([width, height]) + c.patch_px).all(1)
        inside &= np.isfinite(guess).all(axis=1)
        guess[~inside] = points[~inside]
        found, ok, error = self._flow(source, target, points, guess, levels)
        back, ok_back, _ = self._flow(target, source, found, points, min(levels, 1))
        border = c.patch_px // 2
        ok &= inside & ok_back & (np.linalg.norm(back - points, axis=1) < 1.0) & (error < c.max_residual)
        ok &= (found >= border).all(axis=1) & (found < np.float32([width, height]) - border - 1).all(axis=1)
        if not wide:
            ok &= np.linalg.norm(found - guess, axis=1) < _REACH * c.patch_px * 2**levels
        variance = c.image_sigma**2 + error.astype(np.float64) ** 2
        covariance = np.linalg.inv(patches.tensor) * (variance / c.patch_px**2)[:, None, None]
        covariance += c.position_sigma**2 * np.eye(2)
        return Update(found.astype(np.float64) + 0.5, np.linalg.inv(covariance), ok)
