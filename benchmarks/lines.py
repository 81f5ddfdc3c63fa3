"""All production lines in both engines on one simulated recording: line x engine x result.

    python benchmarks/lines.py [--work DIR] [--frames 24] [--only NAME ...] [--out lines.json] [--markdown lines.md]

One RGB-D and LiDAR recording is simulated; each line gets a copy that holds nothing but its own inputs (and the
references), so the line is derived from the topics alone. Equality is the largest difference of positions between the
engines. A line that this version cannot run is a row with the sentence it ends with.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import argparse
import json
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sf_bringup.simulate import SimulationSpec, simulate
from sf_interfaces.io.bag import BagReader
from sf_interfaces.io.sequence_writer import SequenceWriter
from sf_interfaces.io.trajectory import read_tum

COLOR, INFO = "/camera/color/image_raw", "/camera/color/camera_info"
DEPTH, LIDAR, POSE = "/camera/depth/image_raw", "/lidar/points", "/ground_truth/pose"
FAST = ["--set", "recon.iterations=8", "--set", "recon.final_iterations=8"]


@dataclass(frozen=True, slots=True)
class Line:
    """A row of the paper's table: what is given, what is wanted."""

    name: str
    goal: str
    topics: tuple[str, ...]
    posed: bool = False


LINES = (
    Line("photo set, uncalibrated", "mvd", (COLOR,)),
    Line("photo set", "mvd", (COLOR, INFO)),
    Line("photo set, posed", "mvd", (COLOR, INFO), posed=True),
    Line("LiDAR completion", "completion", (COLOR, INFO, LIDAR)),
    Line("mono SLAM", "slam", (COLOR, INFO)),
    Line("mono SLAM, uncalibrated", "slam", (COLOR,)),
    Line("mono reconstruction, posed", "recon", (COLOR, INFO), posed=True),
    Line("RGB-D SLAM", "slam", (COLOR, INFO, DEPTH)),
    Line("RGB-D reconstruction, posed", "recon", (COLOR, INFO, DEPTH), posed=True),
    Line("RGB-L SLAM", "slam", (COLOR, INFO, LIDAR)),
    Line("RGB-L reconstruction, posed", "recon", (COLOR, INFO, LIDAR), posed=True),
    Line("depth-only SLAM", "slam", (DEPTH, INFO)),
    Line("depth-only reconstruction, posed", "recon", (DEPTH, INFO), posed=True),
)


def derive(whole: Path, line: Line, target: Path) -> Path:
    """A bag with the inputs of a line, the references, and the static transforms."""
    depth_only = COLOR not in line.topics
    with BagReader(whole) as reader, SequenceWriter(target) as writer:
        for raw in reader.messages():
            if raw.topic not in line.topics and not raw.topic.startswith(("/ground_truth/", "/tf_static")):
                continue
            topic = raw.topic.replace("/color/", "/depth/") if depth_only and raw.topic == INFO else raw.topic
            writer.bag.write(topic, raw.type, raw.stamp_ns, raw.data)
            if line.posed and raw.topic == POSE:
                writer.bag.write("/given/pose", raw.type, raw.stamp_ns, raw.data)
    return target


def run(bag: Path, line: Line, engine: str, out: Path) -> dict[str, Any]:
    """One line in one engine: its blocks, its measures, or the sentence it ended with."""
    words = ["run", str(bag), "--goal", line.goal, "--engine", engine, "--out", str(out), *FAST]
    done = subprocess.run([sys.executable, "-m", "sf_bringup.cli", *words], capture_output=True, text=True)
    row = {"line": line.name, "engine": engine, "command": f"sf {' '.join(words)}", "exit_code": done.returncode}
    if done.returncode:
        return {**row, "said": done.stderr.strip().splitlines()[-1] if done.stderr.strip() else ""}
    summary = json.loads((out / "summary.json").read_text())
    measures = {key: summary[key] for key in ("trajectory", "depth", "render") if isinstance(summary.get(key), dict)}
    return {**row, "blocks": summary["line"], "seconds": summary["seconds"], **measures}


def difference(first: Path, second: Path) -> float | None:
    """Largest distance between the positions of two runs, m."""
    paths = [folder / "trajectory.tum" for folder in (first, second)]
    if not all(path.is_file() for path in paths):
        return None
    a, b = map(read_tum, paths)
    if not np.array_equal(a.stamps_ns, b.stamps_ns):
        return float("inf")
    return float(np.linalg.norm(a.positions - b.positions, axis=1).max())


def result(row: dict[str, Any]) -> str:
    """The measures of a row in a few words."""
    if row["exit_code"]:
        return row.get("said", "")
    parts = []
    if "trajectory" in row:
        parts.append(f"ATE {row['trajectory']['rmse'] * 100:.2f} cm")
    if "depth" in row:
        parts.append(f"absrel {row['depth']['absrel']:.2f} %")
    if "render" in row:
        parts.append(f"PSNR {row['render']['psnr_surface']:.1f} dB")
    return ", ".join(parts) or "done"


def table(rows: list[dict[str, Any]]) -> str:
    """All rows as Markdown."""
    lines = [
        "| line | engine | blocks | result | engines differ by | command |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for row in rows:
        apart = row.get("apart")
        differ = "" if apart is None else f"{apart:.1e} m"
        blocks = " -> ".join(row.get("blocks", [])) or "-"
        lines.append(f"| {row['line']} | {row['engine']} | {blocks} | {result(row)} | {differ} | `{row['command']}` |")
    return "\n".join(lines)


def main() -> None:
    """Simulate, run, tell."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=Path("out/lines"))
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--only", nargs="+", default=[], help="names of lines, see LINES")
    parser.add_argument("--out", type=Path, default=Path("lines.json"))
    parser.add_argument("--markdown", type=Path)
    args = parser.parse_args()
    args.work.mkdir(parents=True, exist_ok=True)
    whole = args.work / "whole.mcap"
    if not whole.is_file():
        size = {"width": 320, "height": 240, "focal": 240.0, "supersampling": 1}
        simulate(
            SimulationSpec("lounge", frames=args.frames, fps=15.0, depth="exact", lidar="spinning64", **size), whole
        )
    rows: list[dict[str, Any]] = []
    for index, line in enumerate(LINES):
        if args.only and line.name not in args.only:
            continue
        bag = derive(whole, line, args.work / f"{index:02}.mcap")
        outs = {engine: args.work / f"{index:02}_{engine}" for engine in ("inproc", "ros")}
        made = [run(bag, line, engine, out) for engine, out in outs.items()]
        made[1]["apart"] = difference(*outs.values())
        rows += made
        for row in made:
            print(
                f"{line.name:34} {row['engine']:7} {' -> '.join(row.get('blocks', ['-'])):44} {result(row)}", flush=True
            )
        args.out.write_text(json.dumps(rows, indent=2))
    if args.markdown:
        args.markdown.write_text(table(rows) + "\n")


if __name__ == "__main__":
    main()
