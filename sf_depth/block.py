"""The depth block and its modes: completes depth and, where asked, intrinsics (Sec. III-C, V)."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import TYPE_CHECKING

from sf_interfaces.blocks import BlockSpec, Quantity
from sf_interfaces.config import ConfigFile

if TYPE_CHECKING:
    from sf_depth.config import DepthConfig
    from sf_depth.core.calibrate import Calibrator
    from sf_depth.core.photoset import PhotoSetDepth
    from sf_depth.core.sequence import EachDepth, SequenceDepth

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
    executable="sf_depth.node",
    goals=_DENSE_GOALS,
)
SLAM = BlockSpec(
    name="depth",
    mode="slam",
    provides=frozenset({_DEPTH}),
    requires=frozenset({_IMAGE, _INTRINSICS, Quantity.POSE, Quantity.LANDMARKS}),
    cost=3.0,
    executable="sf_depth.node",
    goals=_DENSE_GOALS,
)
CALIBRATE = BlockSpec(
    name="depth",
    mode="calibrate",
    provides=frozenset({_INTRINSICS}),
    requires=frozenset({_IMAGE}),
    cost=4.0,
    executable="sf_depth.node",
    goals=frozenset({"tracking", "slam", "recon"}),
)
MVD = BlockSpec(
    name="depth",
    mode="mvd",
    provides=frozenset({_DEPTH}),
    requires=frozenset({_IMAGE}),
    optional=frozenset({_INTRINSICS, Quantity.GIVEN_POSE}),
    cost=2.0,
    executable="sf_depth.node",
    sequence=False,
    goals=frozenset({"mvd"}),
)
SPECS = (COMPLETE, POSED, SLAM, CALIBRATE, MVD)


def make(config: ConfigFile) -> EachDepth:
    """The completer of mode ``complete``, configured by section ``depth``."""
    from sf_depth.core.estimator import DepthCompleter
    from sf_depth.core.sequence import EachDepth

    return EachDepth(DepthCompleter(config.build("depth", _config_class())))


def make_slam(config: ConfigFile) -> SequenceDepth:
    """Depth of tracked keyframes, mode ``slam``."""
    from sf_depth.core.sequence import SequenceDepth, SlamSetting

    return SequenceDepth(config.build("depth", _config_class()), SlamSetting())


def make_posed(config: ConfigFile) -> SequenceDepth:
    """Depth of frames with given poses, mode ``posed``."""
    from sf_depth.core.sequence import PosedSetting, SequenceDepth

    built = config.build("depth", _config_class())
    return SequenceDepth(built, PosedSetting(built.keyframe_baseline))


def make_mvd(config: ConfigFile) -> PhotoSetDepth:
    """Depth of an image set, mode ``mvd``."""
    from sf_depth.core.photoset import PhotoSetDepth

    return PhotoSetDepth(config.build("depth", _config_class()))


def make_calibrate(config: ConfigFile) -> Calibrator:
    """Intrinsics from the first images, mode ``calibrate``."""
    from sf_depth.core.calibrate import Calibrator

    return Calibrator(config.build("depth", _config_class()))


def _config_class() -> type[DepthConfig]:
    from sf_depth.config import DepthConfig

    return DepthConfig
