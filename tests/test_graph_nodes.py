"""The parts of a node without ROS, and real node processes fed over DDS."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator

import numpy as np
import pytest

from sf_interfaces.ros.diagnostics import Health, Level
from sf_interfaces.ros.inbox import Inbox, KeyframeJoiner
from sf_interfaces.types import Camera, DepthMap


def test_a_bounded_kind_keeps_the_latest_and_names_the_drop() -> None:
    drops: list[tuple[str, int, str]] = []
    inbox = Inbox(lambda kind, data, reason: drops.append((kind, data, reason)))
    for i in range(4):
        inbox.put("image", i, keep=2)
    inbox.put("tf", 9)
    inbox.end()
    assert [inbox.get() for _ in range(4)] == [("image", 2), ("image", 3), ("tf", 9), (Inbox.END, None)]
    assert [(kind, data) for kind, data, _ in drops] == [("image", 0), ("image", 1)]
    assert "latest wins" in drops[0][2]
    assert inbox.get(timeout_s=0.01) is None


def test_bundles_are_joined_by_stamp_and_incomplete_ones_are_named() -> None:
    joiner = KeyframeJoiner(("image", "pose"))
    assert joiner.push("image", 1, "a") is None
    assert joiner.push("image", 2, "b") is None
    assert joiner.push("pose", 2, "c") == {"image": "b", "pose": "c"}
    assert joiner.reasons == {"keyframe dropped: no pose with its stamp": 1}
    joiner.push("pose", 3, "d")
    joiner.end()
    assert joiner.reasons["keyframe dropped: no image with its stamp"] == 1


def test_health_warns_of_new_drops_once_and_keeps_failures() -> None:
    health = Health(clock=iter(range(10)).__next__)
    health.count("frames", 4)
    health.drop("too slow", 3)
    report = health.report()
    assert report.level is Level.WARN and report.message == "3x too slow"
    assert report.values["frames per s"] == "4.0"
    assert health.report().level is Level.OK
    health.error("broken message")
    assert health.report().level is Level.ERROR
    assert health.report().level is Level.OK
    health.fail("cannot go on")
    health.report()
    assert health.report().message == "cannot go on"


ENV = {**os.environ, "ROS_DOMAIN_ID": "87", "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
CAMERA = Camera(64, 48, 60.0, 60.0, 32.0, 24.0, "cam")


def _spawn(*parameters: str) -> subprocess.Popen[str]:
    flags = [part for p in parameters for part in ("-p", p)]
    command = [sys.executable, "-m", "sf_flexion.node", "--ros-args", *flags]
    return subprocess.Popen(command, env=ENV, stderr=subprocess.PIPE, text=True)


@pytest.fixture
def interfaces() -> None:
    pytest.importorskip("rclpy", reason="rclpy is not installed")
    pytest.importorskip("tf2_msgs.msg", reason="the generated message packages are not installed")
    pytest.importorskip("sf_interfaces.msg", reason="the generated message packages are not installed")


@pytest.fixture
def node(interfaces: None) -> Iterator[subprocess.Popen[str]]:
    process = _spawn("autostart:=true", "lossless:=true")
    yield process
    process.kill()
    process.communicate()


def test_an_unknown_parameter_ends_the_node_with_one_sentence(interfaces: None) -> None:
    process = _spawn("autostar:=true")
    _, stderr = process.communicate(timeout=20)
    assert process.returncode == 2
    assert "did you mean 'autostart'?" in stderr and "Traceback" not in stderr


def test_a_lossless_node_gives_the_same_images_as_its_core(node: subprocess.Popen[str]) -> None:
    import rclpy
    from rclpy.context import Context
    from rclpy.executors import SingleThreadedExecutor

    from sf_flexion.config import FlexionConfig
    from sf_flexion.core.flexion import flexion_image
    from sf_interfaces import topics
    from sf_interfaces.ros import messages
    from sf_interfaces.ros.qos import qos_profile

    make = messages.rclpy_factory
    context = Context()
    rclpy.init(context=context, domain_id=87)
    driver = rclpy.create_node("driver", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(driver)

    def publisher(topic: topics.Topic):  # type: ignore[no-untyped-def]
        return driver.create_publisher(make(topic.type), topic.name, qos_profile(topic.qos, lossless=True))

    images: dict[int, np.ndarray] = {}
    credits: list[int] = []
    ends: list[int] = []

    def on_image(msg: object) -> None:
        images[messages.to_ns(msg.header.stamp)] = messages.decode_image(msg)  # type: ignore[attr-defined]

    def on_state(msg: object) -> None:
        if msg.state == 1:  # type: ignore[attr-defined]
            ends.append(msg.count)  # type: ignore[attr-defined]

    for topic, callback in (
        (topics.FLEXION_IMAGE, on_image),
        (topics.consumed("flexion"), lambda msg: credits.append(messages.to_ns(msg))),
        (topics.stream("flexion"), on_state),
    ):
        qos = qos_profile(topic.qos, lossless=True)
        driver.create_subscription(make(topic.type), topic.name, callback, qos)
    depth_out, info_out = publisher(topics.DEPTH_IMAGE), publisher(topics.RGB_INFO)
    stream_out = publisher(topics.stream("player"))

    def spin_until(condition) -> None:  # type: ignore[no-untyped-def]
        limit = time.monotonic() + 15
        while not condition() and time.monotonic() < limit:
            executor.spin_once(timeout_sec=0.05)
        assert condition()

    try:
        spin_until(lambda: depth_out.get_subscription_count() and info_out.get_subscription_count())
        rng = np.random.default_rng(0)
        depths = {(i + 1) * 10**8: DepthMap(rng.uniform(1, 3, (48, 64))) for i in range(12)}
        for stamp_ns, depth in depths.items():
            depth_out.publish(messages.encode_depth(make, depth, stamp_ns, "cam"))
        info_out.publish(messages.encode_camera_info(make, CAMERA, 10**8))
        end = make(topics.stream("player").type)(state=1, count=len(depths))
        stream_out.publish(end)
        spin_until(lambda: ends and len(images) == len(depths) and len(credits) == len(depths))
        assert ends == [len(depths)] and credits == list(depths)
        for stamp_ns, depth in depths.items():
            assert np.array_equal(images[stamp_ns], flexion_image(depth, CAMERA, FlexionConfig()))
        node.send_signal(signal.SIGTERM)
        start = time.monotonic()
        assert node.wait(timeout=30) == 0
        assert time.monotonic() - start < 10.0  # a moment, on a machine that does other things too
    finally:
        driver.destroy_node()
        rclpy.shutdown(context=context)
