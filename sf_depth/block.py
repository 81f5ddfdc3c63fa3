"""The depth block and its modes: completes depth and, where asked, intrinsics (Sec. III-C, V)."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import TYPE_CHECKING

from sf_interfaces.blocks import BlockSpec, Quantity
from sf_interfaces.config import ConfigFile

if TYPE_CHECKING:
    from sf_depth.core.estimator import DepthCompleter

_IMAGE, _INTRINSICS, _DEPTH = Quantity.IMAGE, Quantity.INTRINSICS, Quantity.DEPTH
_DENSE_GOALS = frozenset({"slam", "recon"})

COMPLETE = BlockSpec(
    name="depth",
    mode="complete",
    provides=frozenset({_DEPTH}),
    requires=frozenset({_IMAGE, _INTRINSICS, Quantity.SPARSE_DEPTH}),
    optional=frozenset({Quantity.POSE}),
    cost=1.0,
    executable="sf_depth.node",
    goals=frozenset({"slam", "recon", "completion"}),
)
POSED = BlockSpec(
    name="depth",
    mode="posed",
    provides=frozenset({_DEPTH}),
    requires=frozenset({_IMAGE, _INTRINSICS, Quantity.GIVEN_POSE}),
    cost=2.0,
    goals=_DENSE_GOALS,
)
SLAM = BlockSpec(
    name="depth",
    mode="slam",
    provides=frozenset({_DEPTH}),
    requires=frozenset({_IMAGE, _INTRINSICS, Quantity.POSE, Quantity.LANDMARKS}),
    cost=3.0,
    goals=_DENSE_GOALS,
)
CALIBRATE = BlockSpec(
    name="depth",
    mode="calibrate",
    provides=frozenset({_INTRINSICS}),
    requires=frozenset({_IMAGE}),
    cost=4.0,
    goals=frozenset({"tracking", "slam", "recon"}),
)
MVD = BlockSpec(
    name="depth",
    mode="mvd",
    provides=frozenset({_DEPTH}),
    requires=frozenset({_IMAGE}),
    optional=frozenset({_INTRINSICS, Quantity.GIVEN_POSE}),
    cost=2.0,
    sequence=False,
    goals=frozenset({"mvd"}),
)
SPECS = (COMPLETE, POSED, SLAM, CALIBRATE, MVD)


def make(config: ConfigFile) -> DepthCompleter:
    """The completer of mode ``complete``, configured by section ``depth``."""
    from sf_depth.config import DepthConfig
    from sf_depth.core.estimator import DepthCompleter

    return DepthCompleter(config.build("depth", DepthConfig))
