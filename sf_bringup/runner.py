"""``sf run``: from an input to a finished run folder, in one process or through the ROS graph."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import platform
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import yaml

from sf_bringup import inputs, preflight
from sf_bringup.calibration import calibrated
from sf_bringup.planner import INPUT, Plan, plan
from sf_bringup.preflight import BagInput
from sf_bringup.run_folder import RunFolder, unpack
from sf_bringup.summary import Summary, summarise, write_page
from sf_interfaces import topics
from sf_interfaces.blocks import Quantity, load_blocks
from sf_interfaces.config import ConfigFile
from sf_interfaces.errors import ConfigError
from sf_interfaces.io.calibration import read_camera, read_extrinsic
from sf_interfaces.io.datasets import ReadOptions
from sf_interfaces.types import Float64

_VERSIONED = (
    "scenefactory",
    "numpy",
    "torch",
    "opencv-python-headless",
    "open3d",
    "rosbags",
    "mcap",
    "ros-jazzy-rclpy",
)


@dataclass(frozen=True, slots=True)
class RunRequest:
    """What the user asked for; paths and overrides as given on the command line."""

    inputs: tuple[Path, ...]
    goal: str = "auto"
    engine: str = "inproc"
    out: Path = Path("out")
    calibration: Path | None = None
    poses: Path | None = None
    extrinsic: Path | None = None
    config: Path | None = None
    overrides: Mapping[str, str] = field(default_factory=dict)
    mapping: Mapping[str, str] = field(default_factory=dict)
    use: tuple[str, ...] = ()
    rate: float = 0.0
    reading: ReadOptions = field(default_factory=ReadOptions)


def versions() -> dict[str, str]:
    """What the result was made with, for its metadata."""
    found = {"python": platform.python_version(), "machine": platform.platform()}
    for name in _VERSIONED:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed as a wheel"
    return found


def prepare(request: RunRequest) -> tuple[BagInput, inputs.Resolved]:
    """The bag to play, with everything the user gave beside it, checked; and where it comes from.

    Raises:
        SceneFactoryError: one sentence about what is wrong with the input.
    """
    request.out.mkdir(parents=True, exist_ok=True)
    source = inputs.resolve(request.inputs, request.out, request.reading)
    mapping = dict(request.mapping)
    if request.reading.use_poses and source.bag in request.inputs:
        mapping.setdefault("pose", topics.GROUND_TRUTH_PREFIX + "pose")
    found = preflight.inspect(source.bag, mapping)
    leader = found.mapping.roles.get("rgb", found.mapping.roles.get("depth", ""))
    camera, distortion = (None, None) if request.calibration is None else read_camera(request.calibration)
    bag = inputs.with_given(
        source.bag,
        request.out,
        image_topic=leader,
        camera=camera,
        distortion=distortion,
        poses=request.poses,
        extrinsic=_extrinsic(request, found),
        limit=request.reading.limit,
    )
    return (found if bag == source.bag else preflight.inspect(bag, mapping)), source


def _planned(request: RunRequest, given: BagInput, source: inputs.Resolved) -> Plan:
    """The line for the user's goal, or without one for the goal that suits the input."""
    goal = source.goal if request.goal == "auto" else request.goal
    return plan(given.mapping.available, goal, load_blocks(), request.use)


def _extrinsic(request: RunRequest, found: BagInput) -> tuple[str, str, Float64] | None:
    """The user's (camera frame, lidar frame, T_camera_lidar)."""
    if request.extrinsic is None:
        return None
    if "lidar" not in found.mapping.roles:
        raise ConfigError(f"--extrinsic {request.extrinsic}: the input has no LiDAR to place")
    frame = found.frames["rgb" if "rgb" in found.frames else "depth"]
    return frame, found.frames["lidar"], read_extrinsic(request.extrinsic)


def explain(request: RunRequest) -> tuple[dict[str, Any], str]:
    """The line an input would get and why, as values and as text.

    Nothing is computed, and of a data set only the first frames are read.
    """
    from tempfile import TemporaryDirectory

    with TemporaryDirectory() as scratch:
        reading = replace(request.reading, limit=inputs.PROBE)
        given, source = prepare(replace(request, out=Path(scratch), reading=reading))
    made = _planned(request, given, source)
    reasons = [*source.notes, *given.mapping.reasons, *made.explain().splitlines()]
    return {
        "goal": made.goal,
        "line": list(made.ids),
        "topics": dict(given.mapping.roles),
        "reasons": reasons,
    }, "\n".join(reasons)


def run(request: RunRequest) -> Summary:
    """Run the line and leave a complete run folder; returns its measures.

    Raises:
        SceneFactoryError: bad input or configuration; nothing already written is lost.
    """
    given, source = prepare(request)
    for note in source.notes:
        print(f"sf: {note}", file=sys.stderr)
    made = _planned(request, given, source)
    made.check_runnable()
    if any(step.sources.get(q) == INPUT for step in made.steps for q in step.sources if q.name == "SPARSE_DEPTH"):
        preflight.check_extrinsic(given)
    config = with_shutter(ConfigFile.load(request.config, request.overrides), made, source.bag)
    config.check_sections({spec.name for spec in load_blocks()} | {"sync", "hosts"})
    folder = RunFolder(request.out)
    _write_facts(folder, request, given, source, made, config)
    started = time.monotonic()
    given, rest = calibrated(given, made, config, request.out)
    dropped = _engine(request.engine)(folder, given, rest, config, request.rate)
    facts = folder.info() | {"seconds": time.monotonic() - started, "dropped": dropped}
    (folder.path / "run.json").write_text(json.dumps(facts, indent=2))
    unpack(folder)
    summary = summarise(folder)
    write_page(summary)
    return summary


def with_shutter(config: ConfigFile, made: Plan, bag: Path) -> ConfigFile:
    """The configuration, with the readout that the bag says its images have, where tracking gets these as they are.

    Raises:
        FormatError: what it says is no number.
    """
    tracking = made.step("tracking")
    direct = tracking is not None and tracking.sources.get(Quantity.IMAGE) == INPUT
    readout = inputs.readout_of(bag) if direct else 0.0
    return config.with_default("tracking", "readout_s", readout) if readout else config


def _engine(name: str) -> Any:
    if name == "ros":
        from sf_bringup.graph_runner import run_graph

        return run_graph
    from sf_bringup.pipeline import run_inproc

    return run_inproc


def _write_facts(
    folder: RunFolder, request: RunRequest, given: BagInput, source: inputs.Resolved, made: Plan, config: ConfigFile
) -> None:
    """``run.json`` and the effective ``config.yaml``, before anything runs: a broken run explains itself too."""
    facts = {
        "input": [str(p) for p in request.inputs],
        "input_notes": source.notes,
        "bag": str(given.bag.resolve()),
        "engine": request.engine,
        "goal": made.goal,
        "line": list(made.ids),
        "topics": dict(given.mapping.roles),
        "frames": dict(given.frames),
        "explanation": "\n".join([*given.mapping.reasons, made.explain()]),
        "versions": versions(),
        "seconds": 0.0,
    }
    (folder.path / "run.json").write_text(json.dumps(facts, indent=2))
    (folder.path / "config.yaml").write_text(yaml.safe_dump({k: dict(v) for k, v in config.sections.items()}))
