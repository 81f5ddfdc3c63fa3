"""The flexion block: completes the image from depth (Sec. III-B)."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Callable

import numpy as np

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
    """The conversion, configured by section ``flexion``; of 16 bits the upper byte goes on, as over the wire."""
    from sf_flexion.config import FlexionConfig
    from sf_flexion.core.flexion import Flexion

    convert = Flexion(config.build("flexion", FlexionConfig))

    def image(depth: DepthMap, camera: Camera) -> UInt8:
        made = convert(depth, camera)
        return made if made.dtype == np.uint8 else np.right_shift(made, 8).astype(np.uint8)

    return image
