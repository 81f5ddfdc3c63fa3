"""Where the time of a run went, stage by stage."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from time import perf_counter


@dataclass(slots=True)
class Timings:
    """Seconds and calls per stage. Stages may nest; each counts its own full duration."""

    seconds: dict[str, float] = field(default_factory=dict)
    calls: dict[str, int] = field(default_factory=dict)

    @contextmanager
    def measure(self, stage: str) -> Iterator[None]:
        """Add the duration of the ``with`` body to a stage, also when it raises."""
        start = perf_counter()
        try:
            yield
        finally:
            self.seconds[stage] = self.seconds.get(stage, 0.0) + perf_counter() - start
            self.calls[stage] = self.calls.get(stage, 0) + 1

    def mean_ms(self, stage: str) -> float:
        """Mean duration of one call, ms (0 where the stage never ran)."""
        calls = self.calls.get(stage, 0)
        return 1e3 * self.seconds[stage] / calls if calls else 0.0

    def to_dict(self) -> dict[str, dict[str, float]]:
        """Ready for timing.json: stage -> seconds, calls, mean_ms."""
        return {
            stage: {
                "seconds": self.seconds[stage],
                "calls": self.calls[stage],
                "mean_ms": self.mean_ms(stage),
            }
            for stage in self.seconds
        }
