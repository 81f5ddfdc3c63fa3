"""Time and headers of messages, and how a message class is obtained."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import array
from collections.abc import Callable
from struct import unpack_from
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sf_interfaces.errors import FormatError

Factory = Callable[[str], Any]
"""Type name such as 'sensor_msgs/msg/Image' -> message class (of rclpy or of a rosbags typestore)."""

_SECOND = 1_000_000_000
_TYPECODES = {"uint8": "B", "float64": "d"}


def to_ns(stamp: Any) -> int:
    """builtin_interfaces/Time (or Duration) -> integer nanoseconds."""
    return int(stamp.sec) * _SECOND + int(stamp.nanosec)


def to_stamp(make: Factory, stamp_ns: int) -> Any:
    """Integer nanoseconds -> builtin_interfaces/Time.

    Raises:
        FormatError: before 1970 or beyond the 32 bit seconds of the message.
    """
    sec, nanosec = divmod(int(stamp_ns), _SECOND)
    if not 0 <= sec < 2**31:
        raise FormatError(f"stamp {stamp_ns} ns does not fit a message; give nanoseconds since 1970")
    return make("builtin_interfaces/msg/Time")(sec=sec, nanosec=nanosec)


def stamp_of(raw: bytes) -> int:
    """Stamp in ns of a serialised message that begins with a std_msgs/Header (CDR), without decoding it."""
    seconds, nanoseconds = unpack_from("<iI" if raw[1] & 1 else ">iI", raw, 4)
    return int(seconds) * _SECOND + int(nanoseconds)


def header(make: Factory, stamp_ns: int, frame_id: str) -> Any:
    """std_msgs/Header."""
    return make("std_msgs/msg/Header")(stamp=to_stamp(make, stamp_ns), frame_id=frame_id)


def sequence(cls: Any, values: NDArray[Any]) -> Any:
    """A primitive array as ``cls`` stores it fastest: numpy for rosbags, array.array for rclpy."""
    flat = np.ascontiguousarray(values).reshape(-1)
    if hasattr(cls, "__dataclass_fields__"):
        return flat
    out = array.array(_TYPECODES[flat.dtype.name])
    out.frombytes(flat.view(np.uint8).data)
    return out
