"""The health of a node in words: rates, queues and drops, with their reasons, once a second.

:class:`Health` is pure and thread-safe; :class:`DiagnosticsPublisher` turns it into /diagnostics.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from time import monotonic
from typing import TYPE_CHECKING

from sf_interfaces.topics import DIAGNOSTICS

if TYPE_CHECKING:
    from rclpy.node import Node


class Level(IntEnum):
    """Severity, with the values of diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2


@dataclass(frozen=True, slots=True)
class Report:
    """One diagnostic: its level, a sentence, and key-value details."""

    level: Level
    message: str
    values: Mapping[str, str]


class Health:
    """Collects what a node did since the last report.

    A drop raises the next report to WARN, an error to ERROR; :meth:`fail` is an error that stays.
    """

    def __init__(self, clock: Callable[[], float] = monotonic) -> None:
        self._lock = threading.Lock()
        self._clock = clock
        self._since = clock()
        self._counts: dict[str, int] = {}
        self._reported: dict[str, int] = {}
        self._drops: dict[str, int] = {}
        self._reported_drops: dict[str, int] = {}
        self._values: dict[str, str] = {}
        self._error = ""
        self._failure = ""
        self._waiting = ""

    def count(self, what: str, n: int = 1) -> None:
        """Something was received, tracked, published, ...: reported as total and rate."""
        with self._lock:
            self._counts[what] = self._counts.get(what, 0) + n

    def drop(self, reason: str, n: int = 1) -> None:
        """Something was dropped, for a reason in words."""
        with self._lock:
            self._drops[reason] = self._drops.get(reason, 0) + n

    def set_drops(self, reasons: Mapping[str, int]) -> None:
        """Take over counts kept elsewhere (totals per reason)."""
        with self._lock:
            self._drops.update(reasons)

    def value(self, key: str, value: object) -> None:
        """A current value, such as the scale state or a queue length."""
        with self._lock:
            self._values[key] = str(value)

    def waiting(self, sentence: str) -> None:
        """What the node lacks to go on; empty when it lacks nothing."""
        with self._lock:
            self._waiting = sentence

    def error(self, sentence: str) -> None:
        """An error the node lives on after: ERROR in the next report."""
        with self._lock:
            self._error = sentence

    def fail(self, sentence: str) -> None:
        """An error the node cannot live on after: ERROR in every report from now on."""
        with self._lock:
            self._failure = sentence

    @property
    def drops(self) -> dict[str, int]:
        """All drops so far, per reason."""
        with self._lock:
            return dict(self._drops)

    def report(self) -> Report:
        """What happened since the last report."""
        with self._lock:
            now = self._clock()
            elapsed, self._since = max(now - self._since, 1e-9), now
            values = dict(self._values)
            for what, total in self._counts.items():
                values[what] = str(total)
                values[f"{what} per s"] = f"{(total - self._reported.get(what, 0)) / elapsed:.1f}"
            new = {r: n - self._reported_drops.get(r, 0) for r, n in self._drops.items()}
            values.update({f"dropped: {reason}": str(n) for reason, n in self._drops.items()})
            level, message = self._verdict({reason: n for reason, n in new.items() if n > 0})
            self._reported, self._reported_drops, self._error = dict(self._counts), dict(self._drops), ""
            return Report(level, message, values)

    def _verdict(self, new_drops: Mapping[str, int]) -> tuple[Level, str]:
        if self._failure or self._error:
            return Level.ERROR, self._failure or self._error
        if new_drops:
            reason = max(new_drops, key=lambda r: new_drops[r])
            return Level.WARN, f"{new_drops[reason]}x {reason}"
        if self._waiting:
            return Level.WARN, self._waiting
        return Level.OK, "running"


class DiagnosticsPublisher:
    """Publishes a node's health on /diagnostics at 1 Hz; this is also the node's heartbeat."""

    def __init__(self, node: Node, health: Health, refresh: Callable[[], None], period_s: float = 1.0) -> None:
        from diagnostic_msgs.msg import DiagnosticArray

        from sf_interfaces.ros.qos import qos_profile

        self._node, self._health, self._refresh = node, health, refresh
        self._publisher = node.create_publisher(DiagnosticArray, DIAGNOSTICS.name, qos_profile(DIAGNOSTICS.qos))
        self._timer = node.create_timer(period_s, self.publish)

    def publish(self) -> None:
        """Send one report now."""
        from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

        self._refresh()
        report = self._health.report()
        status = DiagnosticStatus(
            level=bytes([report.level]),
            name=self._node.get_fully_qualified_name().lstrip("/"),
            message=report.message,
            hardware_id="scenefactory",
            values=[KeyValue(key=key, value=value) for key, value in sorted(report.values.items())],
        )
        message = DiagnosticArray(status=[status])
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(message)
