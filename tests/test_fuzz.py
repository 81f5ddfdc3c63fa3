"""Damaged input of every kind: what comes out is a result or one sentence, never a crash or a hang.

SF_FUZZ=N multiplies the number of examples and draws new ones; without it they are the same every time.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os
import struct
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_typestore

from sf_bringup.discovery import probe
from sf_interfaces.config import ConfigFile
from sf_interfaces.errors import SceneFactoryError
from sf_interfaces.geometry.undistort import Distortion
from sf_interfaces.io.bag import BagReader
from sf_interfaces.io.datasets import ReadOptions, recognise, write
from sf_interfaces.io.sequence_writer import SequenceWriter
from sf_interfaces.io.trajectory import read_tum, write_tum
from sf_interfaces.ros import messages as m
from sf_interfaces.types import Camera, DepthMap, Keyframe, PointCloud, Trajectory
from sf_recon.config import ReconConfig
from sf_recon.core.reconstruction import Reconstruction
from tests.interfaces.layouts import LAYOUTS, Layout

STORE = get_typestore(Stores.ROS2_JAZZY)
RNG = np.random.default_rng(0)
CAMERA = Camera(8, 6, 7.0, 7.0, 4.0, 3.0, "cam")
TIMES = int(os.environ.get("SF_FUZZ", "1"))
SLOW_IS_FINE = [HealthCheck.too_slow, HealthCheck.function_scoped_fixture, HealthCheck.data_too_large]


def fuzz(examples: int) -> settings:
    return settings(
        max_examples=examples * TIMES,
        deadline=60_000,
        suppress_health_check=SLOW_IS_FINE,
        derandomize="SF_FUZZ" not in os.environ,
    )


@st.composite
def damaged(draw: st.DrawFn, whole: bytes) -> bytes:
    """Bytes with a few places overwritten, cut out, doubled or cut off."""
    data = bytearray(whole)
    for _ in range(draw(st.integers(1, 6))):
        if not data:
            break
        at = draw(st.integers(0, len(data) - 1))
        kind = draw(st.sampled_from(("byte", "word", "cut", "double", "end")))
        if kind == "byte":
            data[at] = draw(st.integers(0, 255))
        elif kind == "word":
            word = draw(st.sampled_from((0, 1, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 0x7FC00000, 0x7F800000)))
            data[at : at + 4] = struct.pack("<I", word)
        elif kind == "cut":
            del data[at : at + draw(st.integers(1, 64))]
        elif kind == "double":
            data[at:at] = data[at : at + draw(st.integers(1, 64))]
        else:
            del data[at:]
    return bytes(data)


def only_sentences(action: Callable[[], Any]) -> None:
    """Run; an error that input may cause is fine as long as it says something."""
    try:
        action()
    except SceneFactoryError as error:
        assert str(error).strip()


def make(name: str) -> Any:
    return STORE.types[name]


def samples() -> dict[str, tuple[str, Any, Callable[[Any], Any]]]:
    image = RNG.integers(0, 256, (6, 8, 3), dtype=np.uint8)
    depth = DepthMap(RNG.uniform(1, 3, (6, 8)))
    cloud = PointCloud(RNG.uniform(-1, 1, (9, 3)), image.reshape(-1, 3)[:9], np.arange(9) * 10**6, 10**9, "lidar")
    lens = Distortion("plumb_bob", (0.1, -0.05, 0.001, 0.001, 0.0))
    T = np.eye(4)
    path = Trajectory.from_pairs([(1, T), (2, T)])
    png = cv2.imencode(".png", RNG.integers(0, 5000, (6, 8)).astype(np.uint16))[1].tobytes()
    jpeg = cv2.imencode(".jpg", image)[1].tobytes()

    def compressed(form: str, data: bytes) -> Any:
        cls = make("sensor_msgs/msg/CompressedImage")
        return cls(header=m.header(make, 5, "cam"), format=form, data=np.frombuffer(data, np.uint8))

    info = "sensor_msgs/msg/CameraInfo"
    return {
        "rgb": ("sensor_msgs/msg/Image", m.encode_image(make, image, 5, "cam"), m.decode_image),
        "depth": ("sensor_msgs/msg/Image", m.encode_depth(make, depth, 5, "cam"), m.decode_depth),
        "depth mm": ("sensor_msgs/msg/Image", m.encode_depth(make, depth, 5, "cam", "16UC1"), m.decode_depth),
        "variance": ("sensor_msgs/msg/Image", m.encode_variance(make, depth, 5, "cam"), m.decode_variance),
        "jpeg": (m.COMPRESSED_IMAGE, compressed("jpeg", jpeg), m.decode_image),
        "png": (m.COMPRESSED_IMAGE, compressed("16UC1; compressedDepth png", bytes(12) + png), m.decode_depth),
        "camera_info": (info, m.encode_camera_info(make, CAMERA, 5, lens), m.decode_camera_info),
        "cloud": ("sensor_msgs/msg/PointCloud2", m.encode_cloud(make, cloud), m.decode_cloud),
        "pose": ("geometry_msgs/msg/PoseStamped", m.encode_pose(make, T, 5, "map"), m.decode_pose),
        "tf": ("tf2_msgs/msg/TFMessage", m.encode_tf(make, [("a", "b", 5, T)]), m.decode_tf),
        "path": ("nav_msgs/msg/Path", m.encode_path(make, path, 5), lambda msg: [m.decode_pose(p) for p in msg.poses]),
    }


SAMPLES = samples()


@pytest.mark.parametrize("name", SAMPLES)
def test_damaged_messages(name: str) -> None:
    kind, message, decode = SAMPLES[name]
    whole = bytes(STORE.serialize_cdr(message, kind))

    @fuzz(120)
    @given(damaged(whole))
    def run(data: bytes) -> None:
        try:
            found = STORE.deserialize_cdr(data, kind)
        except Exception:  # bytes that are no message never reach the conversion: BagReader.decode says so
            return
        only_sentences(lambda: decode(found))
        if hasattr(found, "header"):
            probe(found)

    run()


numbers = st.one_of(st.integers(-3, 70), st.sampled_from((2**31 - 1, 2**32 - 1)))


@fuzz(200)
@given(
    st.sampled_from(("rgb8", "mono8", "mono16", "16UC1", "32FC1", "bayer_rggb8", "uyvy", "rgba8", "64FC1")),
    st.integers(0, 40), st.integers(0, 40), st.integers(0, 200), st.booleans(), st.binary(max_size=4000),
)  # fmt: skip
def test_images_whose_fields_do_not_fit(
    encoding: str, height: int, width: int, step: int, big: bool, data: bytes
) -> None:
    stamp = SimpleNamespace(sec=1, nanosec=0)
    image = SimpleNamespace(
        header=SimpleNamespace(stamp=stamp, frame_id="c"), encoding=encoding, height=height, width=width, step=step,
        is_bigendian=big, data=data,
    )  # fmt: skip
    for decode in (m.decode_image, m.decode_depth, m.decode_variance):
        only_sentences(lambda decode=decode: decode(image))  # type: ignore[misc]


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("fuzz") / "bag.mcap"
    with SequenceWriter(path) as writer:
        for i in range(4):
            writer.image("/cam/image_raw", 10**9 + i, RNG.integers(0, 256, (6, 8, 3), dtype=np.uint8), "cam")
            writer.camera_info("/cam/camera_info", 10**9 + i, CAMERA)
            writer.pose("/pose", 10**9 + i, np.eye(4), "map")
    return path.read_bytes()


def read_damaged(whole: bytes, path: Path) -> None:
    """Read every message of a bag after damage, under the name ``path``."""

    def read() -> None:
        with BagReader(path) as reader:
            for raw in reader.messages():
                only_sentences(lambda raw=raw: reader.decode(raw))  # type: ignore[misc]

    @fuzz(40)
    @given(damaged(whole))
    def run(data: bytes) -> None:
        path.write_bytes(data)
        only_sentences(read)

    run()


@pytest.mark.parametrize("cut_end", [False, True])
def test_damaged_bags(bag: bytes, tmp_path: Path, cut_end: bool) -> None:
    read_damaged(bag[:-30] if cut_end else bag, tmp_path / "b.mcap")


@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: layout.make.__name__)
def test_damaged_data_sets(layout: Layout, tmp_path: Path) -> None:
    """One file of the set after the other: lists, calibrations, poses, images, depth, sweeps, video."""
    given_path = layout.make(tmp_path / "set", 2)
    files = sorted(path for path in (tmp_path / "set").rglob("*") if path.is_file())
    whole = {path: path.read_bytes() for path in files}

    def read() -> None:
        with SequenceWriter(tmp_path / "out.mcap") as writer:
            write(recognise(given_path), writer, ReadOptions())

    @fuzz(12)
    @given(st.data())
    def run(data: st.DataObject) -> None:
        path = data.draw(st.sampled_from(files))
        path.write_bytes(data.draw(damaged(whole[path])))
        try:
            only_sentences(read)
        finally:
            path.write_bytes(whole[path])

    run()


@pytest.mark.parametrize("kind", ["db3", "bag"])
def test_damaged_bags_of_other_writers(kind: str, tmp_path: Path) -> None:
    store = STORE if kind == "db3" else get_typestore(Stores.ROS1_NOETIC)
    text = store.types["std_msgs/msg/String"](data="hello")
    if kind == "db3":
        with Writer(tmp_path / "whole", version=9) as writer:
            topic = writer.add_connection("/text", text.__msgtype__, typestore=store)
            for i in range(4):
                writer.write(topic, i + 1, store.serialize_cdr(text, text.__msgtype__))
        path = next((tmp_path / "whole").glob("*.db3"))
    else:
        path = tmp_path / "whole.bag"
        with Writer1(path) as old:
            topic = old.add_connection("/text", text.__msgtype__, typestore=store)
            for i in range(4):
                old.write(topic, i + 1, store.serialize_ros1(text, text.__msgtype__))
    read_damaged(path.read_bytes(), path)


def test_damaged_trajectories(tmp_path: Path) -> None:
    path = tmp_path / "t.tum"
    write_tum(path, Trajectory.from_pairs([(10**9 * i, np.eye(4)) for i in range(1, 5)]))

    @fuzz(150)
    @given(damaged(path.read_bytes()))
    def run(data: bytes) -> None:
        (tmp_path / "d.tum").write_bytes(data)
        only_sentences(lambda: read_tum(tmp_path / "d.tum"))

    run()


def test_damaged_configurations(tmp_path: Path) -> None:
    path = tmp_path / "c.yaml"

    @fuzz(200)
    @given(damaged(b"recon: {iterations: 8, multiplier: [1, 2], merge_gap: 0.5}\nsync:\n  depth: true\n"))
    def run(data: bytes) -> None:
        path.write_bytes(data)
        only_sentences(lambda: ConfigFile.load(path).build("recon", ReconConfig))

    run()


def test_damaged_maps(tmp_path: Path) -> None:
    small = ReconConfig(iterations=1, final_iterations=1, threads=1)
    reconstruction = Reconstruction(small)
    image = RNG.integers(0, 256, (24, 32, 3), dtype=np.uint8)
    camera = Camera(32, 24, 30.0, 30.0, 16.0, 12.0)
    reconstruction.add(Keyframe(1, camera, image, np.eye(4), DepthMap(RNG.uniform(1.9, 2.1, (24, 32)))))
    reconstruction.save(tmp_path / "m.sfmap")

    @fuzz(25)
    @given(damaged((tmp_path / "m.sfmap").read_bytes()))
    def run(data: bytes) -> None:
        (tmp_path / "d.sfmap").write_bytes(data)
        only_sentences(lambda: Reconstruction.load(tmp_path / "d.sfmap"))

    run()
