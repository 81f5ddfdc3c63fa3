"""The tracking block: completes the pose (Sec. III-A)."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import TYPE_CHECKING

from sf_interfaces.blocks import BlockSpec, Quantity
from sf_interfaces.config import ConfigFile

if TYPE_CHECKING:
    from sf_tracking.core.session import TrackingSession

SPEC = BlockSpec(
    name="tracking",
    mode="",
    provides=frozenset({Quantity.POSE, Quantity.LANDMARKS}),
    requires=frozenset({Quantity.IMAGE, Quantity.INTRINSICS}),
    optional=frozenset({Quantity.DEPTH, Quantity.SPARSE_DEPTH}),
    executable="sf_tracking.node",
)


def make(config: ConfigFile) -> TrackingSession:
    """The tracker, configured by section ``tracking``."""
    from sf_tracking.config import TrackingConfig
    from sf_tracking.core.session import TrackingSession

    return TrackingSession(config.build("tracking", TrackingConfig))
