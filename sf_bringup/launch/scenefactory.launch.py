"""Bring up a production line on live topics: ``ros2 launch sf_bringup scenefactory.launch.py goal:=slam``.

These are the arguments likely to change and nothing else; everything further is in the YAML given as ``config``.
Only where a ROS distribution provides ``launch``; ``sf up`` does the same without it.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import sys
from pathlib import Path

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, OpaqueFunction
from launch.substitutions import LaunchConfiguration

# name -> (default, help)
ARGUMENTS = {
    "goal": ("auto", "auto, tracking, slam, recon or completion"),
    "rgb": ("", "colour image topic (empty: found by itself)"),
    "depth": ("", "depth image topic (empty: found by itself)"),
    "points": ("", "LiDAR topic (empty: found by itself)"),
    "pose": ("", "PoseStamped topic with T_map_camera (empty: tracked)"),
    "config": ("", "YAML of sections, such as config/rgbl.yaml of this package"),
    "out": ("out", "folder for logs, snapshots and results"),
    "viewer": ("none", "none or rviz"),
}
ROLES = {"rgb": "rgb", "depth": "depth", "points": "lidar", "pose": "pose"}


def command(values: dict[str, str]) -> list[str]:
    """The ``sf up`` that these arguments ask for."""
    words = [sys.executable, "-m", "sf_bringup.cli", "up", "--goal", values["goal"], "--out", values["out"]]
    for argument, role in ROLES.items():
        if values[argument]:
            words += ["--map", f"{role}={values[argument]}"]
    return words + (["--config", values["config"]] if values["config"] else [])


def start(context: LaunchContext) -> list[ExecuteProcess]:
    """The orchestrator, and RViz where asked."""
    values = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    actions = [ExecuteProcess(cmd=command(values), output="screen", sigterm_timeout="60")]
    if values["viewer"] == "rviz":
        rviz = Path(__file__).resolve().parents[1] / "rviz" / "scenefactory.rviz"
        actions.append(ExecuteProcess(cmd=["rviz2", "-d", str(rviz)]))
    return actions


def generate_launch_description() -> LaunchDescription:
    """Entry point of ``ros2 launch``."""
    declared = [DeclareLaunchArgument(n, default_value=d, description=h) for n, (d, h) in ARGUMENTS.items()]
    return LaunchDescription([*declared, OpaqueFunction(function=start)])
