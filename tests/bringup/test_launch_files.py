"""The launch file, the YAML of each mode and the layouts of RViz and Foxglove fit the program as it is."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import ast
import json
import re
import sys
import types
from importlib import import_module
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import pytest
import yaml

import sf_bringup
from sf_bringup.orchestrator import parse
from sf_interfaces import topics
from sf_interfaces.blocks import load_blocks
from sf_interfaces.config import ConfigFile
from sf_interfaces.sync import SyncConfig

HERE = Path(sf_bringup.__file__).parent
LAUNCH = HERE / "launch" / "scenefactory.launch.py"


@pytest.fixture
def launch_file(monkeypatch: pytest.MonkeyPatch) -> types.ModuleType:
    """The launch file as a module; a stand-in takes the place of ``launch`` where that is not installed."""
    pytest.importorskip("rclpy")
    try:
        import_module("launch")
    except ImportError:
        for name in ("launch", "launch.actions", "launch.substitutions"):
            stand_in = types.ModuleType(name)
            stand_in.__getattr__ = lambda _: object  # type: ignore[method-assign]
            monkeypatch.setitem(sys.modules, name, stand_in)
    spec = spec_from_file_location("scenefactory_launch", LAUNCH)
    assert spec is not None and spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_launch_file_has_few_arguments_and_starts_what_sf_up_understands(launch_file: types.ModuleType) -> None:
    ast.parse(LAUNCH.read_text())
    assert len(launch_file.ARGUMENTS) <= 8 and callable(launch_file.generate_launch_description)
    values = {name: default for name, (default, _) in launch_file.ARGUMENTS.items()}
    given = parse(launch_file.command(values)[4:])
    assert given.goal == "auto" and given.map == []
    values |= {"goal": "slam", "points": "/velodyne_points", "config": str(HERE / "config" / "rgbl.yaml")}
    given = parse(launch_file.command(values)[4:])
    assert given.goal == "slam" and given.map == ["lidar=/velodyne_points"] and given.config.is_file()
    assert parse([]).view is None and parse(["--view"]).view == 8080 and parse(["--view", "9000"]).view == 9000


@pytest.mark.parametrize("path", sorted((HERE / "config").glob("*.yaml")), ids=lambda path: path.stem)
def test_each_mode_is_a_valid_configuration(path: Path) -> None:
    config = ConfigFile.load(path)
    config.check_sections({spec.name for spec in load_blocks()} | {"sync", "hosts"})
    config.build("sync", SyncConfig)
    for section in set(config.sections) - {"sync", "hosts"}:
        module = import_module(f"sf_{section}.config")
        config.build(section, getattr(module, f"{section.capitalize()}Config"))


def test_rviz_shows_topics_that_exist_with_the_quality_they_have() -> None:
    layout = yaml.safe_load((HERE / "rviz" / "scenefactory.rviz").read_text())
    shown = {d["Topic"]["Value"]: d["Topic"] for d in layout["Visualization Manager"]["Displays"] if "Topic" in d}
    table = {topic.name: topic for topic in topics.TABLE}
    assert set(shown) <= set(table)
    for name, display in shown.items():
        if display["Durability Policy"] == "Transient Local":
            assert table[name].qos in (topics.Qos.LATCHED, topics.Qos.MAP, topics.Qos.KEYFRAME)


def test_foxglove_shows_topics_that_the_nodes_publish() -> None:
    layout = json.loads((HERE / "foxglove" / "scenefactory.json").read_text())
    panels: dict[str, dict[str, Any]] = layout["configById"]
    assert sorted(_leaves(layout["layout"])) == sorted(panels), "a panel without a place, or a place without a panel"
    shown = set(panels["3D!map"]["topics"]) | set(re.findall(r'": "(/[a-z_/]+)', json.dumps(panels)))
    published = {topic.name: topic for topic in topics.TABLE if topic not in (*topics.INPUTS, topics.VIEW_POSE)}
    assert len(shown) > 8 and shown <= set(published)
    fields = [path["value"].removeprefix(topics.TRACKING_POSE.name) for path in panels["Plot!position"]["paths"]]
    message = topics.TRACKING_POSE.type.replace("/msg/", "/")
    assert message == "geometry_msgs/PoseStamped" and fields == [f".pose.position.{axis}" for axis in "xyz"]
    clouds = {name for name, given in panels["3D!map"]["topics"].items() if given.get("colorMode") == "rgb"}
    assert clouds == {topics.SURFACE.name, topics.DENSE_POINTS.name}


def _leaves(place: str | dict[str, Any]) -> list[str]:
    """The panels of a layout."""
    return [place] if isinstance(place, str) else _leaves(place["first"]) + _leaves(place["second"])
