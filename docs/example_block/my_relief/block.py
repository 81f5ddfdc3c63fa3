"""What the relief block needs and gives, and its core for a line in one process."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Callable

from sf_interfaces.blocks import BlockSpec, Quantity
from sf_interfaces.config import ConfigFile
from sf_interfaces.types import Camera, DepthMap, UInt8

SPEC = BlockSpec(
    name="relief",
    mode="",
    provides=frozenset({Quantity.IMAGE}),
    requires=frozenset({Quantity.DEPTH, Quantity.INTRINSICS}),
    cost=2.0,  # dearer than flexion, so it runs only where somebody asks: --use relief
    executable="my_relief.node",
)


def make(config: ConfigFile) -> Callable[[DepthMap, Camera], UInt8]:
    """The conversion, configured by section ``relief``."""
    from my_relief.config import ReliefConfig
    from my_relief.core.relief import relief_image

    chosen = config.build("relief", ReliefConfig)
    return lambda depth, camera: relief_image(depth, camera, chosen)
