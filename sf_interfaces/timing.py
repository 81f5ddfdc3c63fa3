"""Where the time of a run went, stage by stage."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from time import perf_counter
from typing import Any


@dataclass(slots=True)
class Timings:
    """Seconds and calls per stage. Stages may nest; each counts its own full duration."""

    each: dict[str, list[float]] = field(default_factory=dict)  # seconds of every call

    @contextmanager
    def measure(self, stage: str) -> Iterator[None]:
        """Add the duration of the ``with`` body to a stage, also when it raises."""
        start = perf_counter()
        try:
            yield
        finally:
            self.each.setdefault(stage, []).append(perf_counter() - start)

    def median_ms(self, stage: str) -> float:
        """Median duration of one call, ms (0 where the stage never ran)."""
        calls = sorted(self.each.get(stage, []))
        return 1e3 * calls[len(calls) // 2] if calls else 0.0

    def to_dict(self) -> dict[str, dict[str, Any]]:
        """Ready for timing.json: stage -> seconds, calls, median_ms and each_ms of every call."""
        return {
            stage: {
                "seconds": sum(each),
                "calls": len(each),
                "median_ms": self.median_ms(stage),
                "each_ms": [round(1e3 * s, 3) for s in each],
            }
            for stage, each in self.each.items()
        }
