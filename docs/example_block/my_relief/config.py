"""Configuration of the relief block."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass

from sf_interfaces.config import option


@dataclass(frozen=True, slots=True)
class ReliefConfig:
    """How depth is shaded."""

    azimuth_deg: float = option(135.0, "where the light comes from, deg counter-clockwise from the right")
    blur: float = option(1.5, "standard deviation of the blur before the slope is taken, px", low=0.1, high=20.0)
