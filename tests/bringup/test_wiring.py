"""From plans to processes, and from topics to inputs: pure decisions."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import pytest

from sf_bringup.discovery import Probe, discover
from sf_bringup.planner import plan
from sf_bringup.wiring import NodeLaunch, launches
from sf_interfaces import topics
from sf_interfaces.blocks import Quantity, load_blocks
from sf_interfaces.config import ConfigFile
from sf_interfaces.errors import ConfigError

Q = Quantity
ROLES = {"rgb": "/cam/image_raw", "camera_info": "/cam/camera_info"}
EMPTY = ConfigFile({})
COMPRESSED = "sensor_msgs/msg/CompressedImage"
IMAGE, INFO, CLOUD = topics.RGB_IMAGE.type, topics.RGB_INFO.type, topics.LIDAR_POINTS.type


def line(given: set[Quantity], roles: dict[str, str], goal: str = "recon") -> dict[str, NodeLaunch]:
    made = launches(plan(given, goal, load_blocks()), {**ROLES, **roles}, EMPTY, lossless=True, out="/o")
    return {launch.name: launch for launch in made}


def test_rgbl_line_is_wired_from_sensors_to_surface() -> None:
    nodes = line({Q.IMAGE, Q.INTRINSICS, Q.SPARSE_DEPTH}, {"lidar": "/points"})
    assert list(nodes) == ["tracking", "depth", "recon"]
    tracking = nodes["tracking"]
    assert tracking.head and tracking.remaps[topics.LIDAR_POINTS.name] == "/points"
    assert tracking.parameters["sync.lidar"] and not tracking.parameters["sync.depth"]
    assert nodes["depth"].parameters["source"] == "tracking" and not nodes["depth"].head
    assert nodes["recon"].parameters["source"] == "depth"


def test_rgbd_line_has_no_depth_node() -> None:
    nodes = line({Q.IMAGE, Q.INTRINSICS, Q.DEPTH}, {"depth": "/d"})
    assert list(nodes) == ["tracking", "recon"]
    assert nodes["tracking"].parameters["sync.depth"] and nodes["recon"].parameters["source"] == "tracking"


def test_depth_only_line_tracks_the_flexion_image() -> None:
    nodes = line({Q.INTRINSICS, Q.DEPTH}, {"depth": "/d"})
    assert list(nodes) == ["flexion", "tracking", "recon"]
    assert nodes["tracking"].remaps[topics.RGB_IMAGE.name] == topics.FLEXION_IMAGE.name
    assert nodes["tracking"].parameters["upstream"] == "flexion"


def test_given_poses_make_the_next_block_the_head() -> None:
    nodes = line({Q.IMAGE, Q.INTRINSICS, Q.SPARSE_DEPTH, Q.GIVEN_POSE}, {"lidar": "/points", "pose": "/p"})
    assert list(nodes) == ["depth", "recon"]
    assert nodes["depth"].head and nodes["depth"].parameters["sync.pose"]
    assert nodes["recon"].parameters["source"] == "depth"


def test_configuration_sections_become_parameters() -> None:
    made = plan({Q.IMAGE, Q.INTRINSICS, Q.DEPTH}, "tracking", load_blocks())
    config = ConfigFile({"tracking": {"patches": 99}, "sync": {"depth_slop_s": 0.1}})
    (tracking,) = launches(made, {**ROLES, "depth": "/d"}, config, lossless=False)
    assert tracking.parameters["patches"] == 99 and tracking.parameters["sync.depth_slop_s"] == 0.1


@pytest.mark.parametrize("known", [set(), {Q.INTRINSICS}, {Q.INTRINSICS, Q.GIVEN_POSE}])
def test_an_image_set_is_one_node_that_takes_what_is_known(known: set[Quantity]) -> None:
    nodes = line({Q.IMAGE, *known}, {"pose": "/p"}, "mvd")
    assert list(nodes) == ["depth"] and nodes["depth"].head and nodes["depth"].parameters["mode"] == "mvd"
    assert nodes["depth"].parameters["sync.camera"] == (Q.INTRINSICS in known)
    assert nodes["depth"].parameters["sync.pose"] == (Q.GIVEN_POSE in known)


def test_single_frames_are_completed_without_a_pose() -> None:
    nodes = line({Q.IMAGE, Q.INTRINSICS, Q.SPARSE_DEPTH}, {"lidar": "/points"}, "completion")
    assert list(nodes) == ["depth"] and nodes["depth"].head
    assert nodes["depth"].parameters["sync.lidar"] and not nodes["depth"].parameters["sync.pose"]


def test_colour_depth_and_lidar_find_their_roles() -> None:
    types = {
        "/cam/color/image_raw": IMAGE,
        "/cam/color/camera_info": INFO,
        "/cam/depth/image_raw": IMAGE,
        "/points": CLOUD,
        "/imu": "sensor_msgs/msg/Imu",
        "/sf/tracking/keyframe/image": IMAGE,
        "/ground_truth/depth/image": IMAGE,
    }
    probes = {"/cam/color/image_raw": Probe("rgb8"), "/cam/depth/image_raw": Probe("16UC1", "", 0.9)}
    found = discover(types, probes)
    assert found.roles == {
        "rgb": "/cam/color/image_raw",
        "depth": "/cam/depth/image_raw",
        "lidar": "/points",
        "camera_info": "/cam/color/camera_info",
    }
    assert found.available == {Q.IMAGE, Q.INTRINSICS, Q.DEPTH}
    assert any("/imu ignored" in reason for reason in found.reasons)


def test_sparse_depth_images_count_as_sparse() -> None:
    types = {"/c/image_raw": IMAGE, "/c/camera_info": INFO, "/c/depth": IMAGE}
    found = discover(types, {"/c/image_raw": Probe("bgr8"), "/c/depth": Probe("32FC1", "", 0.05)})
    assert Q.SPARSE_DEPTH in found.available and Q.DEPTH not in found.available


def test_the_rectified_camera_with_calibration_wins_and_the_user_wins_over_it() -> None:
    types = {"/a/image_raw": IMAGE, "/b/image_rect": IMAGE, "/a/camera_info": INFO, "/b/camera_info": INFO}
    probes = {"/a/image_raw": Probe("rgb8"), "/b/image_rect": Probe("rgb8")}
    assert discover(types, probes).roles["rgb"] == "/b/image_rect"
    chosen = discover(types, probes, {"rgb": "/a/image_raw"})
    assert chosen.roles["camera_info"] == "/a/camera_info"


def test_wrong_choices_of_the_user_are_explained() -> None:
    types = {"/a/image_raw": IMAGE}
    with pytest.raises(ConfigError, match="no such topic"):
        discover(types, {}, {"rgb": "/b"})
    with pytest.raises(ConfigError, match="unknown role"):
        discover(types, {}, {"colour": "/a/image_raw"})
    with pytest.raises(ConfigError, match="lidar needs"):
        discover(types, {}, {"lidar": "/a/image_raw"})


def test_compressed_topics_play_the_roles_of_images_and_nodes_are_told() -> None:
    color, depth = "/robot/cam/color/image_raw/compressed", "/robot/cam/depth/image_raw/compressedDepth"
    types = {color: COMPRESSED, depth: COMPRESSED, "/robot/cam/color/camera_info": INFO}
    found = discover(types, {color: Probe("rgb8"), depth: Probe("16UC1", "", 0.9)})
    assert found.roles == {"rgb": color, "depth": depth, "camera_info": "/robot/cam/color/camera_info"}
    assert found.compressed == {"rgb", "depth"}
    assert any("a colour image, compressed" in reason for reason in found.reasons)
    made = plan(found.available, "recon", load_blocks())
    tracking, _ = launches(made, found.roles, EMPTY, lossless=False, compressed=found.compressed)
    assert tracking.parameters["sync.compressed"] == ["image", "depth"]


def test_the_flexion_image_is_never_compressed() -> None:
    made = plan({Q.INTRINSICS, Q.DEPTH}, "tracking", load_blocks())
    flexion, tracking = launches(
        made, {"depth": "/d/compressedDepth", "camera_info": "/i"}, EMPTY, lossless=False, compressed={"depth"}
    )
    assert flexion.parameters["sync.compressed"] == tracking.parameters["sync.compressed"] == ["depth"]


def test_a_raw_image_wins_over_the_same_one_compressed() -> None:
    types = {"/c/image_raw/compressed": COMPRESSED, "/c/image_raw": IMAGE, "/c/camera_info": INFO}
    found = discover(types, {name: Probe("rgb8") for name in types if name != "/c/camera_info"})
    assert found.roles["rgb"] == "/c/image_raw" and not found.compressed
    assert any("/c/image_raw/compressed left out" in reason for reason in found.reasons)


def test_of_several_cameras_the_one_with_depth_is_taken_and_its_own_depth() -> None:
    names = ("/a_back/color/image_raw", "/front/color/image_raw", "/zed/depth/image", "/front/depth/image_raw")
    types = dict.fromkeys(names, IMAGE) | {f"{n.rsplit('/', 1)[0]}/camera_info": INFO for n in names}
    probes = {n: Probe("16UC1" if "depth" in n else "bgr8", n.split("/")[1], 0.9) for n in names}
    found = discover(types, probes)
    assert found.roles["rgb"] == "/front/color/image_raw" and found.roles["depth"] == "/front/depth/image_raw"
    text = "\n".join(found.reasons)
    assert "/a_back/color/image_raw left out" in text and "/zed/depth/image left out" in text


def test_an_image_that_cannot_be_read_is_left_out_with_its_reason() -> None:
    types = {"/c/image_raw": IMAGE, "/c/camera_info": INFO, "/c/depth/compressed": COMPRESSED}
    probes = {"/c/image_raw": Probe("rgb8"), "/c/depth/compressed": Probe(problem="depth went through a lossy codec")}
    found = discover(types, probes)
    assert "depth" not in found.roles
    assert any("lossy codec" in reason for reason in found.reasons)
