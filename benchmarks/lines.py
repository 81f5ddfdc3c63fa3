"""All production lines in both engines, on a simulated recording and on real ones: line x data x engine x result.

    python benchmarks/lines.py [--data FOLDER] [--work DIR] [--frames 24] [--real-frames 100] [--only NAME ...]
                               [--markdown lines.md]

One RGB-D and LiDAR recording is simulated, real ones are read from ``--data``; each line gets a copy that holds nothing
but its own inputs (and the references), so the line is derived from the topics alone; of a photo set eight images.
Equality is the largest difference of positions between the engines. A line that this version cannot run is a row with
the sentence it ends with.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import argparse
import json
import subprocess
import sys
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from common import keep_metadata

from sf_bringup.eval_files import read_surface
from sf_bringup.inputs import convert
from sf_bringup.simulate import SimulationSpec, simulate
from sf_interfaces.io.bag import BagReader
from sf_interfaces.io.datasets import ReadOptions
from sf_interfaces.io.sequence_writer import SequenceWriter
from sf_interfaces.io.trajectory import read_tum
from sf_interfaces.types import Float64

COLOR, INFO = "/camera/color/image_raw", "/camera/color/camera_info"
TRUE_DEPTH = "/ground_truth/depth/image"
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


PHOTOS = 8  # images of a photo set, evenly from the recording
# Name in the table -> folder below --data; each line runs on those that have what it needs.
REAL = {"7-Scenes": "rgbd_7scenes_redkitchen_000_199", "KITTI odometry": "rgbl_kitti_odometry04_000_017"}


def recordings(work: Path, data: Path | None, frames: int, real_frames: int) -> dict[str, Path]:
    """Name -> bag of everything there is to run on; what an earlier call left in ``work`` is used again."""
    bags = {"simulated": work / "simulated.mcap"}
    if not bags["simulated"].is_file():
        size = {"width": 320, "height": 240, "focal": 240.0, "supersampling": 1}
        spec = SimulationSpec("lounge", frames=frames, fps=15.0, depth="exact", lidar="spinning64", **size)
        simulate(spec, bags["simulated"])
    for name, folder in REAL.items() if data is not None else ():
        assert data is not None
        bags[name] = work / f"{folder}.mcap"
        if not bags[name].is_file():
            convert(data / folder, bags[name], ReadOptions(limit=real_frames))
    return bags


def suits(bag: Path, line: Line) -> bool:
    """Whether a recording holds what a line takes in."""
    with BagReader(bag) as reader:
        return all(topic in reader.topics for topic in (*line.topics, POSE))


def skipped(whole: Path) -> frozenset[int]:
    """Stamps of the images that a photo set of :data:`PHOTOS` leaves out."""
    with BagReader(whole) as reader:
        stamps = [raw.stamp_ns for raw in reader.messages([COLOR])]
    return frozenset(stamps) - frozenset(stamps[:: -(-len(stamps) // PHOTOS)])


def derive(whole: Path, line: Line, target: Path) -> Path:
    """A bag with the inputs of a line, the references, and the static transforms."""
    depth_only = COLOR not in line.topics
    left_out = skipped(whole) if line.goal == "mvd" else frozenset()
    with BagReader(whole) as reader, SequenceWriter(target) as writer:
        # Where nothing better is known, a depth camera is the reference of what is estimated from images.
        keep_metadata(reader, writer)
        wanted = line.topics if TRUE_DEPTH in reader.topics else {*line.topics, DEPTH}
        for raw in reader.messages():
            if raw.topic not in wanted and not raw.topic.startswith(("/ground_truth/", "/tf_static")):
                continue
            if raw.topic in (COLOR, INFO) and raw.stamp_ns in left_out:
                continue
            topic = raw.topic.replace("/color/", "/depth/") if depth_only and raw.topic == INFO else raw.topic
            topic = TRUE_DEPTH if raw.topic == DEPTH and DEPTH not in line.topics else topic
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
    kinds = ("trajectory", "depth", "completion", "render")
    measures = {key: summary[key] for key in kinds if isinstance(summary.get(key), dict)}
    surface = out / "surface.ply"
    points = len(read_surface(surface).vertices) if surface.is_file() else None
    return {**row, "blocks": summary["line"], "seconds": summary["seconds"], "points": points, **measures}


def geometry(folder: Path) -> Float64 | None:
    """What a run has estimated, [N, D] m: its positions, else its surface, else its depth."""
    if (folder / "trajectory.tum").is_file() and (folder / "trajectory.tum").stat().st_size:
        return read_tum(folder / "trajectory.tum").positions
    if (folder / "surface.ply").is_file():
        return read_surface(folder / "surface.ply").vertices
    maps = [np.load(path)["z"].reshape(-1, 1) for path in sorted((folder / "depth").glob("*.npz"))]
    return np.concatenate(maps).astype(np.float64) if maps else None


def difference(first: Path, second: Path) -> float | None:
    """Largest distance between what two runs have estimated, m; infinite where they differ in number."""
    a, b = geometry(first), geometry(second)
    if a is None or b is None:
        return None
    return float(np.nanmax(np.linalg.norm(a - b, axis=1))) if a.shape == b.shape else float("inf")


def result(row: dict[str, Any]) -> str:
    """The measures of a row in a few words."""
    if row["exit_code"]:
        return row.get("said", "")
    parts = []
    if "trajectory" in row:
        parts.append(f"ATE {row['trajectory']['rmse'] * 100:.2f} cm")
    if "depth" in row:
        parts.append(f"absrel {row['depth']['absrel']:.2f} %")
    if "completion" in row:
        parts.append(f"held-out LiDAR MAE {row['completion']['mae']:.3f} m")
    if row.get("points"):
        parts.append(f"{row['points'] / 1e3:.0f} k points")
    if "render" in row:
        parts.append(f"PSNR {row['render']['psnr_surface']:.1f} dB")
    return ", ".join(parts) or "done"


PREFACE = """# Every line, in both engines, on simulated and real data

Made by `python benchmarks/lines.py --data FOLDER --markdown docs/lines.md`: each bag below `out/lines` holds nothing
but the inputs of its line (and the references), so the blocks are derived from the topics alone. Recon learns little
here (8 steps a keyframe): the table is about lines, not about quality. "Engines differ by" is the largest
distance between what the two engines estimated: positions, else points of the surface, else depth. What is not
offered says so in its row.
"""


def table(rows: list[dict[str, Any]]) -> str:
    """All rows as Markdown."""
    lines = [
        PREFACE,
        "| line | data | engine | blocks | result | seconds | engines differ by | command |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for row in rows:
        apart = row.get("apart")
        differ = "" if apart is None else f"{apart:.1e} m"
        blocks = " -> ".join(row.get("blocks", [])) or "-"
        cells = [row["line"], row["data"], row["engine"], blocks, result(row), f"{row.get('seconds', 0):.0f}", differ]
        lines.append(f"| {' | '.join(cells)} | `{row['command']}` |")
    return "\n".join(lines)


def main() -> None:
    """Simulate, run, tell."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=Path("out/lines"))
    parser.add_argument("--data", type=Path, help="folder that holds the real recordings")
    parser.add_argument("--frames", type=int, default=24, help="of the simulated recording")
    parser.add_argument("--real-frames", type=int, default=100, help="of each real one, at most")
    parser.add_argument("--only", nargs="+", default=[], help="names of lines, see LINES")
    parser.add_argument("--out", type=Path, default=Path("lines.json"))
    parser.add_argument("--markdown", type=Path)
    args = parser.parse_args()
    args.work.mkdir(parents=True, exist_ok=True)
    bags = recordings(args.work, args.data, args.frames, args.real_frames)
    rows: list[dict[str, Any]] = []
    for line, (data, whole) in product(LINES, bags.items()):
        if (args.only and line.name not in args.only) or not suits(whole, line):
            continue
        stem = f"{LINES.index(line) + 1:02}-{data.split()[0].lower()}"
        bag = derive(whole, line, args.work / f"{stem}.mcap")
        outs = {engine: args.work / f"{stem}-{engine}" for engine in ("inproc", "ros")}
        made = [{"data": data, **run(bag, line, engine, out)} for engine, out in outs.items()]
        made[1]["apart"] = difference(*outs.values())
        rows += made
        for row in made:
            blocks = " -> ".join(row.get("blocks", ["-"]))
            print(f"{line.name:32} {data:15} {row['engine']:7} {blocks:44} {result(row)}", flush=True)
        args.out.write_text(json.dumps(rows, indent=2))
    if args.markdown:
        args.markdown.write_text(table(rows) + "\n")


if __name__ == "__main__":
    main()
