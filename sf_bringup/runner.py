"""``sf run``: from an input to a finished run folder, in one process or through the ROS graph."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import platform
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import yaml

from sf_bringup import inputs, preflight
from sf_bringup.calibration import calibrated
from sf_bringup.planner import Plan, plan
from sf_bringup.preflight import BagInput
from sf_bringup.run_folder import RunFolder, unpack
from sf_bringup.summary import Summary, summarise, write_page
from sf_interfaces.blocks import load_blocks
from sf_interfaces.config import ConfigFile
from sf_interfaces.errors import ConfigError

SECTIONS = {"tracking", "depth", "recon", "flexion", "sync"}
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
    rate: float = 0.0


def versions() -> dict[str, str]:
    """What the result was made with, for its metadata."""
    found = {"python": platform.python_version(), "machine": platform.platform()}
    for name in _VERSIONED:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed as a wheel"
    return found


def prepare(request: RunRequest) -> BagInput:
    """The bag to play, with everything the user gave beside it, checked.

    Raises:
        SceneFactoryError: one sentence about what is wrong with the input.
    """
    request.out.mkdir(parents=True, exist_ok=True)
    bag = inputs.resolve(request.inputs, request.out)
    given = preflight.inspect(bag, request.mapping)
    if request.calibration is None and request.poses is None and request.extrinsic is None:
        return given
    leader = given.mapping.roles.get("rgb", given.mapping.roles.get("depth", ""))
    extrinsic = None
    if request.extrinsic is not None:
        if "lidar" not in given.mapping.roles:
            raise ConfigError(f"--extrinsic {request.extrinsic}: the input has no LiDAR to place")
        frame = given.frames["rgb" if "rgb" in given.frames else "depth"]
        extrinsic = (frame, given.frames["lidar"], inputs.read_extrinsic(request.extrinsic))
    camera = None if request.calibration is None else inputs.read_camera(request.calibration)
    bag = inputs.with_given(
        bag, request.out, image_topic=leader, camera=camera, poses=request.poses, extrinsic=extrinsic
    )
    return preflight.inspect(bag, request.mapping)


def explain(
    paths: tuple[Path, ...], goal: str, calibration: Path | None, poses: Path | None, user: Mapping[str, str]
) -> tuple[dict[str, Any], str]:
    """The line an input would get and why, as values and as text; nothing is computed."""
    from tempfile import TemporaryDirectory

    with TemporaryDirectory() as scratch:
        request = RunRequest(paths, goal, out=Path(scratch), calibration=calibration, poses=poses, mapping=user)
        given = prepare(request)
    made = plan(given.mapping.available, goal, load_blocks())
    reasons = [*given.mapping.reasons, *made.explain().splitlines()]
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
    given = prepare(request)
    made = plan(given.mapping.available, request.goal, load_blocks())
    made.check_runnable()
    if any(step.sources.get(q) == "input" for step in made.steps for q in step.sources if q.name == "SPARSE_DEPTH"):
        preflight.check_extrinsic(given)
    config = ConfigFile.load(request.config, request.overrides)
    config.check_sections(SECTIONS)
    folder = RunFolder(request.out)
    _write_facts(folder, request, given, made, config)
    started = time.monotonic()
    given, rest = calibrated(given, made, config, request.out)
    dropped = _engine(request.engine)(folder, given, rest, config, request.rate)
    facts = folder.info() | {"seconds": time.monotonic() - started, "dropped": dropped}
    (folder.path / "run.json").write_text(json.dumps(facts, indent=2))
    unpack(folder)
    summary = summarise(folder)
    write_page(summary)
    return summary


def _engine(name: str) -> Any:
    if name == "ros":
        from sf_bringup.graph_runner import run_graph

        return run_graph
    from sf_bringup.pipeline import run_inproc

    return run_inproc


def _write_facts(folder: RunFolder, request: RunRequest, given: BagInput, made: Plan, config: ConfigFile) -> None:
    """``run.json`` and the effective ``config.yaml``, before anything runs: a broken run explains itself too."""
    facts = {
        "input": [str(p) for p in request.inputs],
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
