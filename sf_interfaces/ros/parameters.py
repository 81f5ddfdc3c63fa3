"""Configuration dataclasses as ROS parameters: same keys, defaults, ranges and help texts."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import difflib
from dataclasses import fields
from typing import Any, TypeVar

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node

from sf_interfaces.config import build
from sf_interfaces.errors import ConfigError

C = TypeVar("C")

_MIDDLEWARE = ("use_sim_time", "start_type_description_service", "qos_overrides.")
_OPEN_END = {int: 2**31 - 1, float: 1e12}


def _descriptor(help: str, default: Any, low: float | None, high: float | None) -> ParameterDescriptor:
    out = ParameterDescriptor(description=help, dynamic_typing=isinstance(default, (tuple, float)))
    kind = type(default)
    if kind not in _OPEN_END or (low is None and high is None):
        return out
    end = _OPEN_END[kind]
    low, high = kind(-end if low is None else low), kind(end if high is None else high)
    if kind is int:
        out.integer_range = [IntegerRange(from_value=low, to_value=high, step=0)]
    else:
        out.floating_point_range = [FloatingPointRange(from_value=low, to_value=high, step=0.0)]
    return out


def _name(prefix: str, key: str) -> str:
    return f"{prefix}.{key}" if prefix else key


def declare(node: Node, cls: type, prefix: str = "", defaults: dict[str, Any] | None = None) -> None:
    """Declare one parameter per field of a configuration dataclass.

    Raises:
        ConfigError: a value given at start has the wrong type or is out of range.
    """
    for f in fields(cls):
        default = (defaults or {}).get(f.name, f.default)
        described = _descriptor(f.metadata.get("help", ""), default, f.metadata.get("low"), f.metadata.get("high"))
        value = list(default) if isinstance(default, tuple) else default
        try:
            node.declare_parameter(_name(prefix, f.name), value, described)
        except Exception as error:  # rclpy has no common base for its parameter errors
            raise ConfigError(f"parameter '{_name(prefix, f.name)}': {error}") from error


def read(node: Node, cls: type[C], prefix: str = "") -> C:
    """The configuration as the parameters have it now.

    Raises:
        ConfigError: wrong type or out of range.
    """
    values = {f.name: node.get_parameter(_name(prefix, f.name)).value for f in fields(cls)}  # type: ignore[arg-type]
    # rclpy gives arrays as array.array, and None for an empty one.
    plain = {
        key: tuple(value or ()) if isinstance(default, tuple) else value
        for (key, value), default in zip(values.items(), (f.default for f in fields(cls)), strict=True)  # type: ignore[arg-type]
    }
    return build(cls, plain, where=f"parameters of {node.get_fully_qualified_name()}")


def refuse_unknown(node: Node) -> None:
    """Raise ConfigError for a parameter given at start that the node does not have."""
    known = set(node._parameters)
    for name in node._parameter_overrides:
        if name in known or name.startswith(_MIDDLEWARE):
            continue
        near = difflib.get_close_matches(name, known, n=1)
        hint = f"did you mean '{near[0]}'?" if near else f"known: {', '.join(sorted(known))}"
        raise ConfigError(f"{node.get_fully_qualified_name()} has no parameter '{name}'; {hint}")
