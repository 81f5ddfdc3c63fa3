"""Bags written here open everywhere, and damaged bags are refused in one sentence."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from mcap_ros2.reader import read_ros2_messages
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer as Writer1
from rosbags.typesys import Stores, get_typestore

from sf_interfaces.errors import FormatError
from sf_interfaces.io.bag import BagReader
from sf_interfaces.io.mcap_writer import McapWriter
from sf_interfaces.io.sequence_writer import SequenceWriter
from sf_interfaces.ros import messages
from sf_interfaces.types import Camera, DepthMap, PointCloud

CAMERA = Camera(16, 12, 10.0, 10.0, 8.0, 6.0)
START = 1_700_000_000_000_000_000


def write_sample(path: Path, n: int = 20, **options: int) -> None:
    rng = np.random.default_rng(0)
    with SequenceWriter(path, **options) as writer:
        writer.tf_static("camera_optical_frame", "lidar", np.eye(4), START)
        for i in range(n):
            stamp = START + i * 100_000_000
            writer.image("/image", stamp, rng.integers(0, 256, (12, 16, 3), dtype=np.uint8), "cam")
            writer.depth("/depth", stamp, DepthMap(np.full((12, 16), 1 + 0.001 * i)), "cam")
            writer.camera_info("/info", stamp, CAMERA)
            writer.cloud("/points", PointCloud(rng.random((9, 3)), stamp_ns=stamp, frame_id="lidar"))
            writer.pose("/pose", stamp, np.eye(4), "map")
            writer.tf(stamp, "map", "base", np.eye(4))
        writer.bag.metadata("scenefactory", {"version": "1"})
        writer.bag.attachment("a.txt", b"hello", "text/plain")


def test_every_reader_opens_it(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write_sample(path, chunk_bytes=3000)
    with BagReader(path) as bag:
        assert not bag.torn
        assert bag.topics["/image"].count == 20 and bag.topics["/tf_static"].count == 1
        assert (bag.start_ns, bag.end_ns) == (START, START + 19 * 100_000_000)
        assert "durability: 1" in bag.topics["/tf_static"].qos
        raws = list(bag.messages())
        assert [r.stamp_ns for r in raws] == sorted(r.stamp_ns for r in raws) and len(raws) == 121
        depth = [messages.decode_depth(bag.decode(r)) for r in bag.messages(["/depth"])]
        np.testing.assert_allclose([d.z[0, 0] for d in depth], 1 + 0.001 * np.arange(20), atol=1e-6)
        assert bag.metadata() == {"scenefactory": {"version": "1"}}
    with AnyReader([path]) as reader:
        assert reader.message_count == 121
    foreign = {m.channel.topic: m.ros_msg for m in read_ros2_messages(str(path))}
    assert foreign["/info"].width == 16 and foreign["/tf_static"].transforms[0].child_frame_id == "lidar"


@pytest.mark.parametrize("compression", ["zstd", ""])
def test_a_torn_file_is_read_up_to_its_last_chunk(tmp_path: Path, compression: str) -> None:
    whole, torn = tmp_path / "whole.mcap", tmp_path / "torn.mcap"
    write_sample(whole, chunk_bytes=3000, compression=compression)  # type: ignore[arg-type]
    with BagReader(whole) as bag:
        expected = list(bag.messages())
    for fraction in (0.2, 0.35, 0.5):
        data = whole.read_bytes()
        torn.write_bytes(data[: int(len(data) * fraction)])
        with BagReader(torn) as bag:
            got = list(bag.messages())
            assert bag.torn and 0 < len(got) < len(expected)
            assert got == [r for r in expected if r in got]
            messages.decode_image(bag.decode(next(bag.messages(["/image"]))))


def test_backward_log_times_come_out_sorted(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    cdr = b"\x00\x01\x00\x00" + b"\x01\x00\x00\x00\x02\x00\x00\x00"
    with McapWriter(path, chunk_bytes=100) as writer:
        for stamp in (50, 10, 40, 20, 30):
            writer.write("/t", "builtin_interfaces/msg/Time", stamp, cdr)
    with BagReader(path) as bag:
        assert [m.stamp_ns for m in bag.messages()] == [10, 20, 30, 40, 50]


def test_ros1_bag_comes_out_as_ros2(tmp_path: Path) -> None:
    store = get_typestore(Stores.ROS1_NOETIC)
    time = store.types["builtin_interfaces/msg/Time"](sec=5, nanosec=7)
    head = store.types["std_msgs/msg/Header"](seq=3, stamp=time, frame_id="cam")
    roi = store.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    K = np.array([10.0, 0, 7.5, 0, 10, 5.5, 0, 0, 1])
    info = store.types["sensor_msgs/msg/CameraInfo"](
        head, 12, 16, "plumb_bob", np.zeros(5), K, np.eye(3).reshape(-1), np.zeros(12), 0, 0, roi
    )
    path = tmp_path / "old.bag"
    with Writer1(path) as writer:
        connection = writer.add_connection("/info", "sensor_msgs/msg/CameraInfo", typestore=store)
        writer.write(connection, 99, store.serialize_ros1(info, "sensor_msgs/msg/CameraInfo"))
    with BagReader(path) as bag:
        (raw,) = bag.messages()
        msg = bag.decode(raw)
        assert messages.to_ns(msg.header.stamp) == 5_000_000_007
        assert messages.decode_camera_info(msg)[0].cx == 8.0


def test_bad_bags_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="does not exist"):
        BagReader(tmp_path / "none.mcap")
    for name, data, words in (
        ("empty.mcap", b"", "empty"),
        ("noise.mcap", b"nothing of the kind" * 9, "cannot be read"),
        ("noise.db3", b"nothing of the kind" * 9, "cannot be read"),
        ("noise.bag", b"nothing of the kind" * 9, "cannot be read"),
        ("notes.txt", b"x", "no bag"),
    ):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(FormatError, match=words) as caught:
            BagReader(tmp_path / name)
        assert "\n" not in str(caught.value)
    McapWriter(tmp_path / "void.mcap").close()
    with pytest.raises(FormatError, match="no message"):
        BagReader(tmp_path / "void.mcap")
    write_sample(tmp_path / "a.mcap", 2)
    with BagReader(tmp_path / "a.mcap") as bag, pytest.raises(FormatError, match=r"/nope.*/image"):
        list(bag.messages(["/nope"]))


def test_damage_inside_a_chunk_is_named(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write_sample(path)
    data = bytearray(path.read_bytes())
    data[2000:2100] = bytes(100)
    path.write_bytes(data)
    with pytest.raises(FormatError, match=r"a\.mcap"), BagReader(path) as bag:
        list(bag.messages())


@pytest.mark.parametrize("name, topic", [("nav2_turtlebot.mcap", None), ("tf_example", "/tf")])
def test_real_bags(shared_data: Callable[[str], Path], name: str, topic: str | None) -> None:
    with BagReader(shared_data("trajectories_evo") / name) as bag:
        counts = dict.fromkeys(bag.topics, 0)
        for raw in bag.messages():
            counts[raw.topic] += 1
        assert counts == {name: info.count for name, info in bag.topics.items()} and sum(counts.values()) > 10
        if topic:
            raw = next(bag.messages([topic]))
            assert messages.decode_tf(bag.decode(raw))
