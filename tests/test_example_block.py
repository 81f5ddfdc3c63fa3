"""The example of docs/add_a_block.md works as it stands: listed, planned, and running in both engines."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from sf_bringup.simulate import SimulationSpec, simulate
from sf_interfaces.io.bag import BagReader
from sf_interfaces.io.sequence_writer import SequenceWriter

EXAMPLE = Path(__file__).resolve().parents[1] / "docs" / "example_block"


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """An environment in which the example package is installed: its modules and the metadata pip would write."""
    site = tmp_path_factory.mktemp("site")
    shutil.copytree(EXAMPLE / "my_relief", site / "my_relief")
    project = tomllib.loads((EXAMPLE / "pyproject.toml").read_text())["project"]
    info = site / "my_relief-0.1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n")
    groups = project["entry-points"].items()
    text = "\n".join(
        f"[{group}]\n" + "\n".join(f"{k} = {v}" for k, v in points.items()) + "\n" for group, points in groups
    )
    (info / "entry_points.txt").write_text(text)
    path = os.pathsep.join(filter(None, [str(site), os.environ.get("PYTHONPATH", "")]))
    own = {"ROS_DOMAIN_ID": str(120 + os.getpid() % 80), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    return {**os.environ, **own, "PYTHONPATH": path}


@pytest.fixture(scope="module")
def depth_only(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("depth")
    size = {"width": 320, "height": 240, "focal": 240.0, "supersampling": 1}
    simulate(SimulationSpec("lounge", frames=5, fps=30.0, depth="exact", **size), folder / "rgbd.mcap")
    with BagReader(folder / "rgbd.mcap") as reader, SequenceWriter(folder / "depth.mcap") as writer:
        for raw in reader.messages():
            if raw.topic != "/camera/color/image_raw":
                topic = raw.topic.replace("/camera/color/camera_info", "/camera/depth/camera_info")
                writer.bag.write(topic, raw.type, raw.stamp_ns, raw.data)
    return folder / "depth.mcap"


def sf(environment: dict[str, str], *args: str) -> str:
    command = [sys.executable, "-m", "sf_bringup.cli", *args]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=200)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_block_is_listed_and_enters_the_plan_where_asked(installed: dict[str, str], depth_only: Path) -> None:
    assert "relief" in {block["id"] for block in json.loads(sf(installed, "blocks", "--json"))}
    plain = json.loads(sf(installed, "plan", str(depth_only), "--goal", "tracking", "--json"))
    assert plain["line"] == ["flexion", "tracking"]
    asked = json.loads(sf(installed, "plan", str(depth_only), "--goal", "tracking", "--use", "relief", "--json"))
    assert asked["line"] == ["relief", "tracking"]


@pytest.mark.graph
@pytest.mark.parametrize("engine", ["inproc", "ros"])
def test_the_block_runs_in_both_engines(
    installed: dict[str, str], depth_only: Path, tmp_path: Path, engine: str
) -> None:
    args = ("--goal", "tracking", "--use", "relief", "--engine", engine, "--set", "relief.blur=2.0")
    sf(installed, "run", str(depth_only), "--out", str(tmp_path), *args)
    with BagReader(tmp_path / "result.mcap") as bag:
        assert bag.topics["/sf/flexion/image"].count == 5
