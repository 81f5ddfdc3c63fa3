"""The flexion block: completes the image from depth (Sec. III-B)."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Callable

from sf_interfaces.blocks import BlockSpec, Quantity
from sf_interfaces.config import ConfigFile
from sf_interfaces.types import Camera, DepthMap, UInt8

SPEC = BlockSpec(
    name="flexion",
    mode="",
    provides=frozenset({Quantity.IMAGE}),
    requires=frozenset({Quantity.DEPTH, Quantity.INTRINSICS}),
    executable="sf_flexion.node",
)


def make(config: ConfigFile) -> Callable[[DepthMap, Camera], UInt8]:
    """The conversion, configured by section ``flexion``."""
    from sf_flexion.config import FlexionConfig
    from sf_flexion.core.flexion import flexion_image

    chosen = config.build("flexion", FlexionConfig)
    return lambda depth, camera: flexion_image(depth, camera, chosen)
