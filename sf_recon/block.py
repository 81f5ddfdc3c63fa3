"""The reconstruction block: surface, colour and renderer (Sec. III-D, IV)."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import TYPE_CHECKING

from sf_interfaces.blocks import BlockSpec, Quantity
from sf_interfaces.config import ConfigFile

if TYPE_CHECKING:
    from sf_recon.core.reconstruction import Reconstruction

SPEC = BlockSpec(
    name="recon",
    mode="",
    provides=frozenset({Quantity.SURFACE}),
    requires=frozenset({Quantity.IMAGE, Quantity.INTRINSICS, Quantity.DEPTH, Quantity.POSE}),
    executable="sf_recon.node",
    goals=frozenset({"slam", "recon"}),
)


def make(config: ConfigFile) -> Reconstruction:
    """The reconstruction, configured by section ``recon``."""
    from sf_recon.config import ReconConfig
    from sf_recon.core.reconstruction import Reconstruction

    return Reconstruction(config.build("recon", ReconConfig))
