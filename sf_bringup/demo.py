"""``sf demo``: simulate an RGB-L sequence, run it through the graph of processes, record, measure, report."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

from sf_bringup.progress import Progress
from sf_bringup.runner import RunRequest, run
from sf_bringup.simulate import PRESETS, simulate
from sf_bringup.summary import Summary
from sf_interfaces.io.atomic import replace_file


def demo(out: Path, engine: str = "ros") -> Summary:
    """Run the demonstration into ``out``; the simulated bag is kept and used again by the next call."""
    bag = out / "demo.mcap"
    if not bag.is_file():
        with replace_file(bag) as draft, Progress("simulating", "frames") as progress:
            simulate(PRESETS["demo"], draft, progress.update)
    return run(RunRequest(inputs=(bag,), goal="auto", engine=engine, out=out))
