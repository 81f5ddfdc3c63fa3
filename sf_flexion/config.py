"""Configuration of the flexion block."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass

from sf_interfaces.config import option
from sf_interfaces.errors import ConfigError

VARIANTS = ("standard", "normalized", "angle")


@dataclass(frozen=True, slots=True)
class FlexionConfig:
    """How depth becomes a flexion image.

    Raises:
        ConfigError: an unknown variant, an even median size, or bits other than 8 and 16.
    """

    variant: str = option(
        "standard", "standard (|n0.n1| of raw normals), normalized (unit normals) or angle (1 - acos/pi)"
    )
    step: int = option(0, "distance of the neighbours in px, larger is calmer (0: from the noise)", low=0, high=32)
    median: int = option(5, "side of the median filter on depth in px, odd; 1 = none", low=1, high=9)
    bits: int = option(8, "depth of the image: 8 (mono8) or 16 (mono16)", low=8, high=16)

    def __post_init__(self) -> None:
        if self.variant not in VARIANTS:
            raise ConfigError(f"flexion variant '{self.variant}' is unknown; choose one of {', '.join(VARIANTS)}")
        if self.median % 2 == 0:
            raise ConfigError(f"flexion median must be odd, got {self.median}")
        if self.bits not in (8, 16):
            raise ConfigError(f"flexion bits must be 8 or 16, got {self.bits}")
