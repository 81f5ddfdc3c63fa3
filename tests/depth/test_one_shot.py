"""One image's depth from a few others, alone and through the service of the node."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from views import room, rotation_error_deg

from sf_depth.config import DepthConfig
from sf_depth.core.one_shot import OneShot
from sf_interfaces.errors import FormatError
from sf_interfaces.geometry import se3
from sf_interfaces.types import Frame

DOMAIN = 152


def frames(camera: bool, poses: bool) -> list[Frame]:
    views = room(3)
    known = views.camera if camera else None
    stamped = zip(views.images, views.poses, strict=True)
    return [Frame(10**9 * (k + 1), known, i, None, None, T if poses else None) for k, (i, T) in enumerate(stamped)]


def test_depth_and_poses_come_in_the_frame_of_the_given_poses() -> None:
    made = OneShot(DepthConfig()).estimate(frames(True, True))
    error = np.abs(made.keyframe.depth.z / room(3).z[0] - 1)
    assert made.keyframe.depth.density == 1.0 and np.median(error) < 0.01
    np.testing.assert_array_equal(np.stack(made.poses), np.stack(room(3).poses))


def test_what_is_known_of_some_images_only_is_refused() -> None:
    given = frames(True, True)
    with pytest.raises(FormatError, match="poses need intrinsics"):
        OneShot(DepthConfig()).estimate([given[0], given[1], frames(True, False)[2]])
    with pytest.raises(FormatError, match="at least 2 images"):
        OneShot(DepthConfig()).estimate(given[:1])
    with pytest.raises(FormatError, match="different cameras"):
        OneShot(DepthConfig()).estimate([given[0], frames(False, False)[1]])


def call(request: Any) -> Any:
    """The answer of a node process to one call."""
    import rclpy
    from rclpy.context import Context
    from rclpy.executors import SingleThreadedExecutor

    from sf_interfaces.srv import EstimateDepth

    environment = {**os.environ, "ROS_DOMAIN_ID": str(DOMAIN), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    flags = ["--ros-args", "-p", "mode:=mvd", "-p", "autostart:=true"]
    node = subprocess.Popen([sys.executable, "-m", "sf_depth.node", *flags], env=environment)
    context = Context()
    rclpy.init(context=context, domain_id=DOMAIN)
    caller = rclpy.create_node("caller", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(caller)
    try:
        client = caller.create_client(EstimateDepth, "/sf/depth/estimate_depth")
        assert client.wait_for_service(timeout_sec=40)
        future = client.call_async(request)
        executor.spin_until_future_complete(future, timeout_sec=60)
        assert future.done()
        return future.result()
    finally:
        node.kill()
        node.wait()
        executor.remove_node(caller)
        caller.destroy_node()
        rclpy.shutdown(context=context)


@pytest.mark.graph
@pytest.mark.timeout(120)
def test_the_service_gives_what_the_core_gives() -> None:
    pytest.importorskip("rclpy", reason="rclpy is not installed")
    srv = pytest.importorskip("sf_interfaces.srv", reason="the generated message packages are not installed")
    from sf_interfaces.ros import messages

    given, make = frames(False, False), messages.rclpy_factory
    request = srv.EstimateDepth.Request()
    request.images = [messages.encode_image(make, f.image, f.stamp_ns, "camera_optical_frame") for f in given]
    response = call(request)
    assert response.success and response.message == ""
    made = OneShot(DepthConfig()).estimate(given)
    np.testing.assert_array_equal(messages.decode_depth(response.depth).z, made.keyframe.depth.z)
    np.testing.assert_array_equal(messages.decode_variance(response.variance), made.keyframe.depth.variance)
    camera, _ = messages.decode_camera_info(response.info)
    np.testing.assert_allclose((camera.fx, camera.cx), (made.keyframe.camera.fx, made.keyframe.camera.cx))
    poses = np.stack([messages.decode_pose(pose)[2] for pose in response.poses])
    assert {pose.header.frame_id for pose in response.poses} == {"map"}
    np.testing.assert_allclose(poses, np.stack(made.poses), atol=1e-9)
    assert rotation_error_deg(se3.inverse(poses[1:]) @ poses[0], room(3).T_source_reference) < 0.3
