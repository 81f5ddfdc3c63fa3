"""Supervision decides without processes: back-off, resuming, giving up what keeps dying, forgetting old deaths."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from sf_bringup.wiring import NodeLaunch
from sf_interfaces.errors import SceneFactoryError

pytest.importorskip("rclpy")
from sf_bringup import line as line_module
from sf_bringup.line import Line


class Child:
    """A process that ends when the test says so."""

    def __init__(self, name: str) -> None:
        self.name, self.log, self.code = name, Path(f"{name}.log"), None

    def poll(self) -> int | None:
        return self.code

    def send(self, number: Any) -> None:
        self.code = 0


class Fake(Line):
    """A line whose nodes start at once."""

    def __init__(self, tmp_path: Path) -> None:
        super().__init__(SimpleNamespace(), tmp_path, {})  # type: ignore[arg-type]
        self.born: list[tuple[str, bool]] = []
        self.refuses = ""

    def _spawn(self, launch: NodeLaunch, *, resume: bool = False) -> Any:
        self.born.append((launch.name, resume))
        return Child(launch.name)

    def bring_up(self, name: str) -> None:
        if name == self.refuses:
            raise SceneFactoryError("it does not answer")

    def die(self, name: str, code: int = -9) -> None:
        next(p for p in self.processes if p.name == name).code = code  # type: ignore[attr-defined]


@pytest.fixture
def line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Fake:
    monkeypatch.setattr(line_module, "sweep_shared_memory", lambda: 0)
    made = Fake(tmp_path)
    made.apply([NodeLaunch(n, f"m.{n}", parameters={"lossless": False}) for n in ("tracking", "depth", "recon")])
    return made


def pass_time(line: Fake, begin: float) -> tuple[list[str], float]:
    """Look until nothing more happens; returns what was said and the time then."""
    said, now = [], begin
    for _ in range(30):
        now += 0.5
        said += line.supervise(now)
    return said, now


def test_a_killed_node_goes_on_from_its_snapshot_after_a_pause(line: Fake) -> None:
    line.die("depth")
    (first,) = line.supervise(1000.0)
    assert "was killed by SIGKILL, restart in 1 s" in first
    assert line.supervise(1000.5) == []
    assert line.supervise(1001.1) == ["node depth restarted"]
    assert line.born[-1] == ("depth", True) and ("depth", False) in line.born
    assert line.names == ("tracking", "depth", "recon")


def test_what_keeps_dying_is_given_up_with_all_that_follows(line: Fake) -> None:
    now = 1000.0
    for _ in range(3):
        line.die("depth", 1)
        said, now = pass_time(line, now)
        assert said[-1] == "node depth restarted"
    line.die("depth", 1)
    said, _ = pass_time(line, now)
    assert "died 4 times in a row, last it ended with exit code 1" in said[-1]
    assert "goes on without depth, recon" in said[-1] and line.names == ("tracking",)


def test_without_its_head_the_line_ends_with_the_reason(line: Fake) -> None:
    now = 1000.0
    for _ in range(3):
        line.die("tracking")
        _, now = pass_time(line, now)
    line.die("tracking")
    with pytest.raises(SceneFactoryError, match=r"tracking died 4 times .* see tracking\.log"):
        line.supervise(now)


def test_a_minute_of_health_forgives(line: Fake) -> None:
    now = 1000.0
    for _ in range(6):
        line.die("recon")
        said, now = pass_time(line, now)
        assert said[-1] == "node recon restarted"
        now += 61.0
    assert "recon" in line.names


def test_a_node_that_does_not_come_up_again_counts_as_dead(line: Fake) -> None:
    line.refuses = "recon"
    line.die("recon")
    said, _ = pass_time(line, 1000.0)
    said += pass_time(line, 1020.0)[0]
    assert sum("did not come back: it does not answer" in sentence for sentence in said) == 3
    assert "goes on without recon" in said[-1]
