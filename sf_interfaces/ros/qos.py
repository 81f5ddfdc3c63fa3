"""Quality of service: the few kinds of connection as rclpy profiles."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from sf_interfaces.topics import Qos

_LOSSLESS_DEPTH = 1000  # messages DDS may hold; credits keep far fewer images in flight
_KEYFRAMES_KEPT = 30  # more than a reconstruction takes in between two of its snapshots


def _profile(depth: int, *, reliable: bool = True, latched: bool = False) -> QoSProfile:
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


def qos_profile(kind: Qos, *, lossless: bool = False) -> QoSProfile:
    """The rclpy profile of a kind of connection.

    Args:
        lossless: sensor streams become reliable and deep, for replay under credits.
    """
    match kind:
        case Qos.SENSOR:
            return _profile(_LOSSLESS_DEPTH) if lossless else _profile(5, reliable=False)
        case Qos.RELIABLE:
            return _profile(_LOSSLESS_DEPTH if lossless else 100)
        case Qos.KEYFRAME:
            return _profile(_LOSSLESS_DEPTH) if lossless else _profile(_KEYFRAMES_KEPT, latched=True)
        case Qos.LATEST:
            return _profile(1)
        case Qos.LATCHED:
            return _profile(1, latched=True)
        case Qos.MAP:
            return _profile(100, latched=True)
        case Qos.CLOCK:
            return _profile(1, reliable=False)
