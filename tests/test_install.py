"""What the installed wheel promises: messages that travel, the extension, the package index, the blocks."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os
import subprocess
import sys
import sysconfig
from importlib import import_module
from importlib.metadata import distribution, entry_points
from pathlib import Path

import pytest

PACKAGES = ("sf_interfaces", "sf_tracking", "sf_flexion", "sf_depth", "sf_recon", "sf_bringup")

SUBSCRIBER = """
import sys, time, rclpy
from rclpy.qos import DurabilityPolicy, QoSProfile
from sf_interfaces.msg import StreamState
from tf2_msgs.msg import TFMessage
rclpy.init()
node = rclpy.create_node("listener")
latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
got = {}
node.create_subscription(StreamState, "state", lambda m: got.update(state=m), latched)
node.create_subscription(TFMessage, "tf", lambda m: got.update(tf=m), latched)
deadline = time.monotonic() + 20
while len(got) < 2 and time.monotonic() < deadline:
    rclpy.spin_once(node, timeout_sec=0.1)
state, tf = got["state"], got["tf"]
assert (state.state, state.count, state.stamp.sec) == (StreamState.FINISHED, 7, 3), state
assert [t.child_frame_id for t in tf.transforms] == ["lidar"], tf
"""

PUBLISHER = """
import sys, rclpy
from builtin_interfaces.msg import Time
from geometry_msgs.msg import TransformStamped
from rclpy.qos import DurabilityPolicy, QoSProfile
from sf_interfaces.msg import StreamState
from tf2_msgs.msg import TFMessage
rclpy.init()
node = rclpy.create_node("talker")
latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
state = node.create_publisher(StreamState, "state", latched)
tf = node.create_publisher(TFMessage, "tf", latched)
state.publish(StreamState(stamp=Time(sec=3), state=StreamState.FINISHED, count=7))
tf.publish(TFMessage(transforms=[TransformStamped(child_frame_id="lidar")]))
sys.stdin.read()
"""

needs_install = pytest.mark.skipif(
    not list(entry_points(group="scenefactory.blocks")), reason="scenefactory is not installed (make setup)"
)


@needs_install
def test_every_block_and_the_command_are_registered() -> None:
    names = {point.name for point in entry_points(group="scenefactory.blocks")}
    assert {"tracking", "flexion", "depth", "recon"} <= names
    assert any(p.name == "sf" and p.value == "sf_bringup.cli:main" for p in entry_points(group="console_scripts"))


@needs_install
def test_the_exact_torch_is_required() -> None:
    assert "torch==2.13.0" in (distribution("scenefactory").requires or [])


@needs_install
@pytest.mark.parametrize("package", PACKAGES)
def test_ros_tools_find_the_package(package: str) -> None:
    share = Path(sysconfig.get_path("data"), "share")
    assert (share / "ament_index/resource_index/packages" / package).is_file()
    assert f"<name>{package}</name>" in (share / package / "package.xml").read_text(encoding="utf-8")


@needs_install
def test_generated_modules_sit_beside_the_vocabulary() -> None:
    import sf_interfaces.msg
    import sf_interfaces.srv
    import sf_interfaces.types

    assert sf_interfaces.types.Frame is not None
    assert sf_interfaces.msg.StreamState.FINISHED == 1
    fields = sf_interfaces.srv.EstimateDepth.Request.get_fields_and_field_types()
    assert list(fields) == ["images", "infos", "poses"]


@needs_install
@pytest.mark.parametrize("block", ["sf_recon", "sf_tracking", "sf_depth"])
def test_the_extension_is_compiled(block: str) -> None:
    native = import_module(f"{block}._native")
    assert native.__file__ is not None and native.__file__.endswith(".so")


@needs_install
@pytest.mark.graph
@pytest.mark.timeout(60)
def test_messages_travel_between_processes() -> None:
    env = {**os.environ, "ROS_DOMAIN_ID": "87", "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    talker = subprocess.Popen([sys.executable, "-c", PUBLISHER], env=env, stdin=subprocess.PIPE)
    try:
        listener = subprocess.run(
            [sys.executable, "-c", SUBSCRIBER], env=env, capture_output=True, text=True, check=False
        )
    finally:
        talker.communicate(timeout=15)
    assert listener.returncode == 0, listener.stderr
    assert talker.returncode == 0
