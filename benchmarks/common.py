"""What the benchmarks share: simulated inputs, runs of a line, and one form of JSON with all that a number needs."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import argparse
import hashlib
import json
import os
import platform
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sf_bringup.measures import reference_trajectory
from sf_bringup.run_folder import RunFolder
from sf_bringup.runner import RunRequest, run, versions
from sf_bringup.simulate import SimulationSpec, simulate
from sf_interfaces.geometry.undistort import undistort_depth, undistort_image
from sf_interfaces.io.bag import BagReader
from sf_interfaces.io.sequence_writer import SequenceWriter
from sf_interfaces.ros.messages import decode_camera_info, decode_depth, decode_image, to_ns
from sf_interfaces.types import Frame

COLOUR, INFO = "/camera/color/image_raw", "/camera/color/camera_info"
DEPTH, TRUE_POSE = "/camera/depth/image_raw", "/ground_truth/pose"


class Benchmark:
    """One benchmark: its arguments, its clock, and the JSON it leaves in ``--out``."""

    def __init__(self, name: str, description: str) -> None:
        self.name = name
        self.parser = argparse.ArgumentParser(description=description)
        self.parser.add_argument("--out", type=Path, default=Path("bench"), help="folder of results and runs")
        self.notes: list[str] = []
        self._started = time.monotonic()

    def parse(self) -> argparse.Namespace:
        """The arguments; makes the output folder."""
        self.args = self.parser.parse_args()
        self.args.out.mkdir(parents=True, exist_ok=True)
        return self.args

    def note(self, words: str) -> None:
        """A sentence that the report prints above the tables."""
        print(words, flush=True)
        self.notes.append(words)

    def write(self, title: str, tables: Mapping[str, Sequence[Mapping[str, Any]]], models: Any = None) -> None:
        """Leave ``<name>.json``.

        Args:
            tables: title -> rows.
            models: which implementation filled each replaceable slot of the runs.
        """
        result = {
            "title": title,
            "notes": self.notes,
            **{name: list(rows) for name, rows in tables.items()},
            "models": models or {},
            "machine": {"cpus": os.cpu_count(), "cpu": _processor(), "system": platform.platform()},
            "versions": versions(),
            "command": " ".join(sys.argv),
            "seconds": round(time.monotonic() - self._started, 1),
        }
        path = self.args.out / f"{self.name}.json"
        path.write_text(json.dumps(result, indent=1, default=str) + "\n")
        print(f"wrote {path} after {result['seconds']} s", flush=True)


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    return next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), platform.processor())


def print_rows(rows: Sequence[Mapping[str, Any]]) -> None:
    """One line per row, floats with four digits."""
    for row in rows:
        cells = (f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items())
        print("  " + ", ".join(cells), flush=True)


def shrunk(spec: SimulationSpec, frames: int, stride: int, factor: float) -> SimulationSpec:
    """Fewer frames, every ``stride``-th of the original rate, at a fraction of the image size."""
    size = {"width": round(spec.width * factor), "height": round(spec.height * factor), "focal": spec.focal * factor}
    return replace(spec, frames=frames, fps=spec.fps / stride, **size)


def simulated(spec: SimulationSpec, out: Path) -> tuple[Path, Path]:
    """Bag and true mesh of a specification; what an earlier call left in ``out/data`` is used again."""
    key = hashlib.sha256(repr(spec).encode()).hexdigest()[:10]
    name = f"{Path(spec.scene).stem}-{key}"
    bag, mesh = (out / "data" / f"{name}.{suffix}" for suffix in ("mcap", "ply"))
    if not bag.is_file():
        bag.parent.mkdir(parents=True, exist_ok=True)
        unfinished = bag.with_suffix(".unfinished.mcap")
        simulate(spec, unfinished, mesh=mesh)
        unfinished.rename(bag)
    return bag, mesh


def keep_metadata(reader: BagReader, writer: SequenceWriter) -> None:
    """A copy of a bag knows what the bag says of its camera."""
    for name, values in reader.metadata().items():
        writer.bag.metadata(name, values)


def without(bag: Path, topics: Sequence[str], suffix: str) -> Path:
    """A copy of a bag beside it that lacks some topics."""
    out = bag.with_name(f"{bag.stem}-{suffix}.mcap")
    if not out.is_file():
        unfinished = out.with_suffix(".unfinished.mcap")
        with BagReader(bag) as reader, SequenceWriter(unfinished) as writer:
            keep_metadata(reader, writer)
            for raw in reader.messages([name for name in reader.topics if name not in topics]):
                writer.bag.write(raw.topic, raw.type, raw.stamp_ns, raw.data)
        unfinished.rename(out)
    return out


def thinned(bag: Path, frames: Sequence[int], suffix: str) -> Path:
    """A copy of a bag that keeps only some of its frames (numbers in order of time), and what belongs to none."""
    out = bag.with_name(f"{bag.stem}-{suffix}.mcap")
    with BagReader(bag) as reader, SequenceWriter(out) as writer:
        keep_metadata(reader, writer)
        stamps = [raw.stamp_ns for raw in reader.messages([COLOUR])]
        dropped = set(stamps) - {stamps[k] for k in frames}
        for raw in reader.messages():
            if raw.stamp_ns not in dropped:
                writer.bag.write(raw.topic, raw.type, raw.stamp_ns, raw.data)
    return out


def run_line(bag: Path, out: Path, goal: str = "auto", **request: Any) -> RunFolder:
    """One run in this process into ``out``, as ``sf run`` does it.

    Raises:
        SceneFactoryError: the line cannot be made or fails on this input.
    """
    run(RunRequest(inputs=(bag,), goal=goal, out=out, **request))
    return RunFolder.open(out)


def load_frames(bag: Path) -> list[Frame]:
    """Colour and depth of a bag, joined by stamp, with the true poses."""
    images: dict[int, Any] = {}
    depths: dict[int, Any] = {}
    camera, lens = None, None
    with BagReader(bag) as reader:
        for raw in reader.messages([COLOUR, INFO, DEPTH]):
            message = reader.decode(raw)
            if raw.topic == INFO:
                camera, lens = decode_camera_info(message)
            else:
                store, decode = (images, decode_image) if raw.topic == COLOUR else (depths, decode_depth)
                store[to_ns(message.header.stamp)] = decode(message)
    truth = reference_trajectory(bag)
    assert truth is not None and camera is not None
    poses = dict(zip(truth.stamps_ns.tolist(), truth.poses, strict=True))
    frames = []
    for s in (s for s in sorted(images) if s in depths and s in poses):
        image, depth = undistort_image(images[s], camera, lens), undistort_depth(depths[s], camera, lens)
        frames.append(Frame(s, camera, image, depth, None, poses[s]))
    return frames


def mean_row(rows: Sequence[Mapping[str, Any]], **fixed: Any) -> dict[str, Any]:
    """The mean of every numeric column, with ``fixed`` cells."""
    columns = {k for row in rows for k, v in row.items() if isinstance(v, float)} - fixed.keys()
    means = {k: float(np.mean([row[k] for row in rows if isinstance(row.get(k), float)])) for k in columns}
    return {**fixed, **{k: means[k] for row in rows for k in row if k in means}}
