"""What ``sf doctor`` hears on live topics: rates, quality of service, calibration, extrinsic, and the line."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import time
from collections import Counter, defaultdict
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.serialization import deserialize_message

from sf_bringup import discovery
from sf_bringup.discovery import InputMapping, Probe
from sf_bringup.doctor import Check
from sf_bringup.launcher_env import node_environment
from sf_bringup.planner import plan
from sf_interfaces import topics
from sf_interfaces.blocks import Quantity, load_blocks
from sf_interfaces.errors import SceneFactoryError
from sf_interfaces.ros.frames import FrameTree
from sf_interfaces.ros.messages import decode_camera_info, decode_tf, rclpy_factory
from sf_interfaces.ros.qos import qos_profile
from sf_interfaces.ros.stamps import stamp_of

_LOST = 0.05  # share of lost images that is worth a word
_STEPS = 10  # between images, before anything is said of losses


@dataclass(slots=True)
class Heard:
    """What a short while of listening gave."""

    types: dict[str, str] = field(default_factory=dict)
    counts: Counter[str] = field(default_factory=Counter)
    bytes: Counter[str] = field(default_factory=Counter)
    stamps: defaultdict[str, list[int]] = field(default_factory=lambda: defaultdict(list))  # ns, of images
    quality: dict[str, str] = field(default_factory=dict)
    probes: dict[str, Probe] = field(default_factory=dict)
    infos: dict[str, Any] = field(default_factory=dict)
    static: FrameTree = field(default_factory=FrameTree)


def listen(seconds: float) -> Heard:
    """Subscribe to every input topic, best effort, and count."""
    heard, context = Heard(), rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node("sf_doctor", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)

    def subscribe(name: str, kind: str) -> None:
        cls = rclpy_factory(kind)

        def take(raw: bytes) -> None:
            heard.counts[name] += 1
            heard.bytes[name] += len(raw)
            if discovery.is_image(kind):
                heard.stamps[name].append(stamp_of(raw))
            if heard.counts[name] == 1:
                _first(heard, name, deserialize_message(raw, cls))

        node.create_subscription(cls, name, take, qos_profile(topics.RGB_IMAGE.qos), raw=True)
        heard.types[name] = kind

    def static(msg: Any) -> None:
        for parent, child, stamp, T in decode_tf(msg):
            heard.static.add(parent, child, T, stamp, static=True)

    tf = topics.TF_STATIC
    node.create_subscription(rclpy_factory(tf.type), tf.name, static, qos_profile(tf.qos))
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        for name, kinds in node.get_topic_names_and_types():
            offered = node.get_publishers_info_by_topic(name)
            if offered and name not in heard.types and discovery.is_input(name) and discovery.is_wanted(kinds[0]):
                subscribe(name, kinds[0])
                heard.quality[name] = ", ".join(sorted({_quality(p.qos_profile) for p in offered}))
        executor.spin_once(timeout_sec=0.05)
    node.destroy_node()
    rclpy.try_shutdown(context=context)
    return heard


def _quality(profile: Any) -> str:
    return f"{profile.reliability.name.lower()} {profile.durability.name.lower()}"


def _first(heard: Heard, name: str, msg: Any) -> None:
    if heard.types[name] == discovery.INFO:
        heard.infos[name] = msg
    else:
        heard.probes[name] = discovery.probe(msg)


def topic_checks(seconds: float) -> list[Check]:
    """One finding per input topic, then calibration, extrinsic and line."""
    heard = listen(seconds)
    if not heard.types:
        mend = (
            "start the camera's driver, and use the same ROS_DOMAIN_ID and ROS_AUTOMATIC_DISCOVERY_RANGE on both sides"
        )
        return [Check("topics", True, f"no camera, LiDAR or pose topic within {seconds:g} s", mend)]
    return [*(_topic(heard, name, seconds) for name in sorted(heard.types)), *_together(heard)]


def _topic(heard: Heard, name: str, seconds: float) -> Check:
    about = f"{heard.types[name]}, {heard.quality[name]}"
    if not heard.counts[name]:
        mend = "check that the driver runs, that the network lets its packets through, and its domain"
        return Check(name, False, f"{about}: a publisher, but no message within {seconds:g} s", mend)
    rate, load = heard.counts[name] / seconds, heard.bytes[name] / seconds / 1e6
    about += f", {rate:.1f} Hz, {load:.2f} MB/s"
    found = heard.probes.get(name, Probe())
    if found.problem:
        return Check(name, False, f"{about}: {found.problem}", "choose another topic with --map")
    about += f", {found.encoding}" if found.encoding else ""
    lost = _share_lost(heard.stamps[name])
    if lost > _LOST:
        size = heard.bytes[name] / heard.counts[name] / 1e6
        profile = node_environment()["FASTRTPS_DEFAULT_PROFILES_FILE"]
        mend = f"start the driver with FASTRTPS_DEFAULT_PROFILES_FILE={profile}, or let it publish compressed images"
        detail = f"{about}: by its stamps {lost:.0%} of the messages of {size:.2f} MB are lost on the way"
        return Check(name, False, detail, mend)
    return Check(name, True, about)


def _share_lost(stamps: list[int]) -> float:
    """Share of the messages that are missing between others; short steps, if many are, tell the period."""
    steps = np.diff(np.sort(stamps))
    if len(steps) < _STEPS:
        return 0.0
    period = max(float(np.median(steps[steps <= 1.5 * np.quantile(steps, 0.25)])), 1.0)
    missing = float(np.sum(np.round(steps / period) - 1))
    return missing / (missing + len(stamps))


def _together(heard: Heard) -> list[Check]:
    try:
        mapping = discovery.discover(heard.types, heard.probes)
        made = plan(mapping.available, "auto", load_blocks())
        line = Check("line", True, f"sf up would start {' -> '.join(made.ids)}")
    except SceneFactoryError as error:
        return [Check("line", False, str(error), "add the missing topic, or choose with --goal and --map")]
    return [*_calibration(heard, mapping), *_extrinsic(heard, mapping), line]


def _calibration(heard: Heard, mapping: InputMapping) -> list[Check]:
    name = mapping.roles.get("camera_info", "")
    if name not in heard.infos:
        return []
    try:
        camera, lens = decode_camera_info(heard.infos[name])
    except SceneFactoryError as error:
        return [Check("calibration", False, str(error), "calibrate the camera, or give --calibration")]
    leader = mapping.roles.get("rgb", mapping.roles.get("depth", ""))
    frame = heard.probes[leader].frame_id if leader in heard.probes else camera.frame_id
    if frame != camera.frame_id.lstrip("/"):
        detail = f"camera_info is for frame '{camera.frame_id}', {leader} comes in '{frame}'"
        return [Check("calibration", False, detail, "let the driver use one frame_id for both")]
    about = f"{camera.width}x{camera.height}, f {camera.fx:.1f} px, {lens.model if lens else 'no distortion'}"
    return [Check("calibration", True, about)]


def _extrinsic(heard: Heard, mapping: InputMapping) -> list[Check]:
    lidar, leader = mapping.roles.get("lidar", ""), mapping.roles.get("rgb", "")
    if Quantity.SPARSE_DEPTH not in mapping.available or lidar not in heard.probes or leader not in heard.probes:
        return []
    camera_frame, lidar_frame = heard.probes[leader].frame_id, heard.probes[lidar].frame_id
    if heard.static.lookup(camera_frame, lidar_frame, static_only=True) is None:
        mend = f"publish it: ros2 run tf2_ros static_transform_publisher ... {camera_frame} {lidar_frame}"
        return [Check("extrinsic", False, f"/tf_static does not connect '{lidar_frame}' to '{camera_frame}'", mend)]
    return [Check("extrinsic", True, f"/tf_static connects '{lidar_frame}' to '{camera_frame}'")]
