"""DepthCompleter: the sparse depth of a keyframe becomes dense depth with variance (paper Sec. ScaleCov)."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace

from sf_depth.config import DepthConfig
from sf_depth.core.covariance import CovarianceModel, make_covariance
from sf_depth.core.scalecov import complete
from sf_interfaces.errors import FormatError
from sf_interfaces.types import Float32, Keyframe


class DepthCompleter:
    """Completes the depth of keyframes; holds no state between them.

    Args:
        config: see :class:`DepthConfig`.
        covariance: replaces the covariance that the configuration names.
    """

    def __init__(self, config: DepthConfig, covariance: CovarianceModel | None = None) -> None:
        self._config = config
        self._covariance = covariance or make_covariance(config)

    def complete(self, keyframe: Keyframe, base: Float32 | None = None) -> Keyframe:
        """The keyframe with depth at every pixel and its variance, m^2.

        Measured pixels keep their depth and carry the sensor's variance. Pixels far from any measurement
        carry a large variance; with ``max_sigma`` they become NaN.

        Args:
            keyframe: with the depth to complete.
            base: monocular depth [H, W] of any scale, where there is one (:func:`scalecov.complete`).

        Raises:
            FormatError: the keyframe has no depth, of another size, or fewer than four measured pixels.
        """
        if keyframe.depth is None:
            raise FormatError(
                f"keyframe {keyframe.stamp_ns} has no depth to complete; give sparse depth, as of a LiDAR"
            )
        try:
            depth = complete(base, keyframe.depth, keyframe.image, self._config, self._covariance)
        except FormatError as error:
            raise FormatError(f"keyframe {keyframe.stamp_ns}: {error}") from error
        return replace(keyframe, depth=depth)
