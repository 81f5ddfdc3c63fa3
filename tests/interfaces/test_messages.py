"""Messages and data convert into each other without loss, and malformed messages are refused in words."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from rosbags.typesys import Stores, get_typestore

from sf_interfaces.corrections import Correction, Corrections
from sf_interfaces.errors import CalibrationError, FormatError
from sf_interfaces.geometry import se3
from sf_interfaces.geometry.undistort import undistort_depth, undistort_image
from sf_interfaces.io.definitions import definition, typestore
from sf_interfaces.ros import messages as m
from sf_interfaces.types import Camera, DepthMap, PointCloud, Scale, Trajectory

STORE = get_typestore(Stores.ROS2_JAZZY)
STAMP = 1_700_000_000_123_456_789
CAMERA = Camera(64, 48, 50.0, 51.0, 32.5, 24.25, "cam")


def make(name: str) -> Any:
    return STORE.types[name]


def rclpy_make(name: str) -> Any:
    pytest.importorskip("rclpy")
    if name.startswith("tf2_msgs"):
        pytest.importorskip("tf2_msgs")
    return m.rclpy_factory(name)


@pytest.fixture(params=["rosbags", "rclpy"])
def factory(request: pytest.FixtureRequest) -> Any:
    return make if request.param == "rosbags" else rclpy_make


def through_wire(msg: Any, name: str) -> Any:
    """Serialise and read again, so that the message is proven to be well formed."""
    if not hasattr(type(msg), "__dataclass_fields__"):
        from rclpy.serialization import deserialize_message, serialize_message

        return deserialize_message(serialize_message(msg), type(msg))
    return STORE.deserialize_cdr(STORE.serialize_cdr(msg, name), name)


shapes = st.tuples(st.integers(1, 9), st.integers(1, 9))


@settings(max_examples=30, deadline=None)
@given(image=shapes.flatmap(lambda s: st.sampled_from([s, (*s, 3)])).flatmap(lambda s: hnp.arrays(np.uint8, s)))
def test_image_round_trip(image: np.ndarray) -> None:
    for factory in (make, rclpy_make):
        msg = through_wire(m.encode_image(factory, image, STAMP, "cam"), "sensor_msgs/msg/Image")
        assert m.to_ns(msg.header.stamp) == STAMP and msg.header.frame_id == "cam"
        np.testing.assert_array_equal(m.decode_image(msg), image)


@settings(max_examples=30, deadline=None)
@given(z=shapes.flatmap(lambda s: hnp.arrays(np.float32, s, elements=st.floats(-1, 65.5, width=32))))
def test_depth_round_trip(z: np.ndarray) -> None:
    depth = DepthMap(z)
    for factory in (make, rclpy_make):
        msg = through_wire(m.encode_depth(factory, depth, STAMP, "cam"), "sensor_msgs/msg/Image")
        np.testing.assert_array_equal(m.decode_depth(msg).z, np.where(z > 0, z, np.nan))
        msg = through_wire(m.encode_depth(factory, depth, STAMP, "cam", "16UC1"), "sensor_msgs/msg/Image")
        back = m.decode_depth(msg)
        seen = z > 0.00051
        np.testing.assert_allclose(back.z[seen], z[seen], atol=0.00051)
        assert np.isnan(back.z[z <= 0]).all()


def test_invalid_millimetres_are_nan(factory: Any) -> None:
    msg = m.encode_depth(factory, DepthMap(np.array([[1.0, 70.0, np.nan]])), STAMP, "cam", "16UC1")
    raw = np.frombuffer(msg.data, "<u2").copy()
    assert raw.tolist() == [1000, 0, 0]
    raw[1] = 65535
    msg.data = m.sequence(type(msg), raw.view(np.uint8))
    np.testing.assert_array_equal(m.decode_depth(msg).z, np.array([[1.0, np.nan, np.nan]], np.float32))


def raw_image(pixels: np.ndarray, encoding: str, pad: int = 0, big: bool = False) -> Any:
    """An Image message written by hand, with padded rows and either byte order."""
    stored = pixels.astype(pixels.dtype.newbyteorder(">" if big else "<"))
    rows = stored.reshape(len(stored), -1).view(np.uint8)
    rows = np.pad(rows, ((0, 0), (0, pad)), constant_values=7)
    msg = m.encode_image(make, np.zeros(pixels.shape[:2], np.uint8), STAMP, "cam")
    return dataclasses.replace(msg, encoding=encoding, is_bigendian=int(big), step=rows.shape[1], data=rows.reshape(-1))


@pytest.mark.parametrize("pad", [0, 5])
def test_encodings_come_out_as_rgb(pad: int) -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (4, 6, 3), dtype=np.uint8)
    alpha = np.full((4, 6, 1), 9, np.uint8)
    cases = {
        "rgb8": rgb,
        "bgr8": rgb[..., ::-1],
        "rgba8": np.concatenate([rgb, alpha], -1),
        "bgra8": np.concatenate([rgb[..., ::-1], alpha], -1),
    }
    for encoding, pixels in cases.items():
        np.testing.assert_array_equal(m.decode_image(raw_image(pixels, encoding, pad)), rgb)


@pytest.mark.parametrize("big", [False, True])
def test_byte_order_of_depth_and_mono16(big: bool) -> None:
    mm = np.array([[1000, 258], [0, 4000]], np.uint16)
    z = m.decode_depth(raw_image(mm, "16UC1", 3, big)).z
    np.testing.assert_allclose(z, [[1.0, 0.258], [np.nan, 4.0]], rtol=1e-6)
    np.testing.assert_array_equal(m.decode_image(raw_image(mm, "mono16", 0, big)), mm >> 8)
    metres = np.array([[1.5, np.inf], [-1.0, 2.0]], np.float32)
    z = m.decode_depth(raw_image(metres, "32FC1", 1, big)).z
    np.testing.assert_array_equal(z, np.array([[1.5, np.nan], [np.nan, 2.0]], np.float32))


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_bayer_patterns(pattern: str) -> None:
    color = np.array([200, 100, 50], np.uint8)  # a flat field shows a wrong pattern as a wrong colour
    mosaic = np.zeros((8, 8), np.uint8)
    for i, letter in enumerate(pattern):
        mosaic[i // 2 :: 2, i % 2 :: 2] = color["rgb".index(letter)]
    out = m.decode_image(raw_image(mosaic, f"bayer_{pattern}8"))
    np.testing.assert_array_equal(out[3, 3], color)


@pytest.mark.parametrize(
    "change, words",
    [
        ({"step": 5}, "step"),
        ({"data": np.zeros(10, np.uint8)}, "bytes"),
        ({"encoding": "h264"}, "h264"),
        ({"encoding": "32FC1"}, "depth"),
        ({"height": 0}, "size"),
        ({"width": 2**31}, "step"),
    ],
)
def test_malformed_images(change: dict[str, Any], words: str) -> None:
    msg = m.encode_image(make, np.zeros((4, 6, 3), np.uint8), STAMP, "cam")
    with pytest.raises(FormatError, match=words):
        m.decode_image(dataclasses.replace(msg, **change))


def test_colour_is_no_depth() -> None:
    with pytest.raises(FormatError, match="rgb8"):
        m.decode_depth(m.encode_image(make, np.zeros((4, 6, 3), np.uint8), STAMP, "cam"))


def test_camera_info_shifts_the_principal_point(factory: Any) -> None:
    msg = through_wire(m.encode_camera_info(factory, CAMERA, STAMP), "sensor_msgs/msg/CameraInfo")
    assert msg.k[2] == 32.0 and msg.k[5] == 23.75 and msg.p[2] == 32.0
    assert m.decode_camera_info(msg) == (CAMERA, None)
    lens = m.Distortion("plumb_bob", (0.1, -0.2, 0.001, 0.002, 0.0))
    msg = through_wire(m.encode_camera_info(factory, CAMERA, STAMP, lens), "sensor_msgs/msg/CameraInfo")
    assert m.decode_camera_info(msg) == (CAMERA, lens)
    assert m.decode_camera_info(msg, rectified=True) == (CAMERA, None)


def test_binning_and_region_of_interest() -> None:
    msg = m.encode_camera_info(make, CAMERA, STAMP)
    msg.binning_x = msg.binning_y = 2
    assert m.decode_camera_info(msg)[0] == CAMERA.scaled(0.5)
    msg.binning_x = msg.binning_y = 0
    msg.roi.x_offset, msg.roi.y_offset, msg.roi.width, msg.roi.height = 10, 4, 20, 30
    cropped = m.decode_camera_info(msg)[0]
    assert (cropped.width, cropped.height, cropped.cx, cropped.cy) == (20, 30, 22.5, 20.25)


def test_bad_calibrations() -> None:
    msg = m.encode_camera_info(make, CAMERA, STAMP)
    with pytest.raises(CalibrationError, match="uncalibrated"):
        m.decode_camera_info(dataclasses.replace(msg, k=np.zeros(9)))
    for model, d in (("fancy", [0.1]), ("plumb_bob", [0.1] * 3), ("plumb_bob", [np.nan] * 5)):
        with pytest.raises(CalibrationError, match=model):
            m.decode_camera_info(dataclasses.replace(msg, distortion_model=model, d=np.array(d)))
    assert m.decode_camera_info(dataclasses.replace(msg, distortion_model="", d=np.zeros(0)))[1] is None


@pytest.mark.parametrize(
    "lens",
    [
        m.Distortion("plumb_bob", (-0.2, 0.05, 0.001, -0.001, 0.0)),
        m.Distortion("rational_polynomial", (0.1, 0.02, 0.0, 0.0, 0.01, 0.2, 0.03, 0.0)),
        m.Distortion("equidistant", (-0.05, 0.01, 0.0, 0.0)),
    ],
)
def test_undistortion_straightens(lens: m.Distortion) -> None:
    """A distorted ramp, undistorted, gives at each pixel the distorted position the model prescribes."""
    camera = Camera(160, 120, 100.0, 100.0, 80.5, 60.5)
    ramp = np.broadcast_to(np.arange(160, dtype=np.float32) + 1, (120, 160))
    out = undistort_depth(DepthMap(ramp), camera, lens).z
    u, v = 110, 75
    x, y = (u + 0.5 - camera.cx) / camera.fx, (v + 0.5 - camera.cy) / camera.fy
    k, r2 = lens.coefficients, x * x + y * y
    if lens.model == "equidistant":
        r = np.sqrt(r2)
        theta = np.arctan(r)
        xd = theta * (1 + k[0] * theta**2 + k[1] * theta**4) / r * x
    else:
        radial = 1 + k[0] * r2 + k[1] * r2**2 + k[4] * r2**3
        if lens.model == "rational_polynomial":
            radial /= 1 + k[5] * r2 + k[6] * r2**2 + k[7] * r2**3
        xd = x * radial + 2 * k[2] * x * y + k[3] * (r2 + 2 * x * x)
    assert abs(out[v, u] - (camera.fx * xd + camera.cx - 0.5 + 1)) <= 0.51
    image = undistort_image(np.full((120, 160, 3), 77, np.uint8), camera, lens)
    assert image.shape == (120, 160, 3) and image[60, 80].tolist() == [77, 77, 77]
    with pytest.raises(CalibrationError, match="calibration"):
        undistort_image(np.zeros((10, 10), np.uint8), camera, lens)


def test_zero_distortion_is_identity() -> None:
    image = np.random.default_rng(1).integers(0, 256, (48, 64), dtype=np.uint8)
    zero = m.Distortion("plumb_bob", (0.0,) * 5)
    assert undistort_image(image, CAMERA, zero) is image and undistort_image(image, CAMERA, None) is image


@settings(max_examples=25, deadline=None)
@given(
    points=hnp.arrays(np.float32, st.tuples(st.integers(0, 20), st.just(3)), elements=st.floats(-1e3, 1e3, width=32)),
    colored=st.booleans(),
    timed=st.booleans(),
)
def test_cloud_round_trip(points: np.ndarray, colored: bool, timed: bool) -> None:
    n = len(points)
    colors = (np.arange(n * 3) % 256).astype(np.uint8).reshape(n, 3) if colored else None
    offsets = np.arange(n) * 1000 if timed else None
    cloud = PointCloud(points, colors, offsets, STAMP, "lidar")
    for factory in (make, rclpy_make):
        intensity = np.linspace(0, 1, n, dtype=np.float32)
        msg = through_wire(m.encode_cloud(factory, cloud, intensity), "sensor_msgs/msg/PointCloud2")
        back = m.decode_cloud(msg)
        assert (back.stamp_ns, back.frame_id) == (STAMP, "lidar")
        np.testing.assert_array_equal(back.points, points)
        np.testing.assert_array_equal(m.decode_field(msg, "intensity"), intensity)
        assert (back.colors is None) == (not colored) and (back.time_offset_ns is None) == (not timed)
        if colored:
            np.testing.assert_array_equal(back.colors, colors)
        if timed:
            np.testing.assert_allclose(back.time_offset_ns, offsets, atol=1)


def raw_cloud(table: np.ndarray, big: bool = False, rows: int = 1, pad: int = 0) -> Any:
    codes = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
    fields = [
        make("sensor_msgs/msg/PointField")(name=n, offset=f[1], datatype=codes[f[0].str[1:]], count=1)
        for n, f in table.dtype.fields.items()
    ]
    grid = table.reshape(rows, -1)
    data = np.pad(grid.view(np.uint8).reshape(rows, -1), ((0, 0), (0, pad)))
    empty = m.encode_cloud(make, PointCloud(np.zeros((0, 3)), stamp_ns=STAMP, frame_id="lidar"))
    return dataclasses.replace(
        empty, height=rows, width=grid.shape[1], fields=fields, is_bigendian=big, point_step=table.itemsize,
        row_step=data.shape[1], data=data.reshape(-1),
    )  # fmt: skip


@pytest.mark.parametrize(
    "name, dtype, values",
    [
        ("t", "u4", [0, 50_000_000]),
        ("time", "f4", [0.0, 0.05]),
        ("timestamp", "f8", [STAMP * 1e-9, STAMP * 1e-9 + 0.05]),
        ("timestamp", "f8", [float(STAMP), float(STAMP + 50_000_000)]),
        ("offset_time", "u4", [0, 50_000_000]),
        ("time", "f4", [0.0, -0.05]),
    ],
)
@pytest.mark.parametrize("big", [False, True])
def test_time_fields(name: str, dtype: str, values: list[float], big: bool) -> None:
    order = ">" if big else "<"
    table = np.zeros(2, dtype=[("x", order + "f4"), ("y", order + "f4"), ("pad", "u1"), ("z", order + "f8"),
                               (name, order + dtype)])  # fmt: skip
    table["x"], table["z"], table[name] = [1, 2], [3, 4], values
    cloud = m.decode_cloud(raw_cloud(table, big))
    np.testing.assert_array_equal(cloud.points, [[1, 0, 3], [2, 0, 4]])
    expected = [0, -50_000_000 if values[1] < 0 else 50_000_000]
    np.testing.assert_allclose(cloud.time_offset_ns, expected, atol=500)


def test_unbelievable_time_is_refused() -> None:
    table = np.zeros(2, dtype=[("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("t", "<u4")])
    table["t"] = 4_000_000_000
    msg = raw_cloud(table)
    msg.header.stamp.sec = 0
    table["t"] = [0, 2**32 - 1]
    assert m.decode_cloud(raw_cloud(table)).time_offset_ns is not None
    wide = np.zeros(2, dtype=[("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("time", "<f4")])
    wide["time"] = [0, 5e4]
    with pytest.raises(FormatError, match="'time'"):
        m.decode_cloud(raw_cloud(wide))


def test_organised_cloud_with_holes_and_padding() -> None:
    table = np.zeros(6, dtype=[("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<u4")])
    table["x"], table["rgb"] = [0, 1, np.nan, 3, 4, np.inf], 0x010203
    cloud = m.decode_cloud(raw_cloud(table, rows=2, pad=4))
    assert cloud.points[:, 0].tolist() == [0, 1, 3, 4]
    assert cloud.colors is not None and cloud.colors[0].tolist() == [1, 2, 3]


def test_malformed_clouds() -> None:
    good = m.encode_cloud(make, PointCloud(np.ones((5, 3)), stamp_ns=STAMP))
    for change, words in (
        ({"fields": good.fields[:2]}, "'z'"),
        ({"point_step": 8}, "point_step"),
        ({"width": 50}, "bytes"),
        ({"data": np.zeros(3, np.uint8)}, "bytes"),
        ({"fields": [dataclasses.replace(good.fields[0], datatype=99)]}, "datatype"),
    ):
        with pytest.raises(FormatError, match=words):
            m.decode_cloud(dataclasses.replace(good, **change))
    twice = [dataclasses.replace(field, count=2) if field.name == "x" else field for field in good.fields]
    with pytest.raises(FormatError, match="2 values a point"):
        m.decode_cloud(dataclasses.replace(good, fields=twice))
    with pytest.raises(FormatError, match="points of 3000000000 bytes"):
        m.decode_cloud(dataclasses.replace(good, point_step=3_000_000_000))


@settings(max_examples=25, deadline=None)
@given(xi=hnp.arrays(np.float64, 6, elements=st.floats(-3, 3)), ns=st.integers(0, 2**31 * 10**9 - 1))
def test_pose_round_trip(xi: np.ndarray, ns: int) -> None:
    T = se3.exp(xi)
    for factory in (make, rclpy_make):
        msg = through_wire(m.encode_pose(factory, T, ns, "/map"), "geometry_msgs/msg/PoseStamped")
        stamp, frame, back = m.decode_pose(msg)
        assert (stamp, frame) == (ns, "map")
        np.testing.assert_allclose(back, T, atol=1e-12)


def test_tf_and_path() -> None:
    T = se3.exp(np.array([1.0, 2, 3, 0.1, 0.2, 0.3]))
    msg = through_wire(
        m.encode_tf(make, [("map", "odom", 5, T), ("odom", "base", 6, se3.inverse(T))]),
        "tf2_msgs/msg/TFMessage",
    )
    (first, second) = m.decode_tf(msg)
    assert first[:3] == ("map", "odom", 5) and second[:3] == ("odom", "base", 6)
    np.testing.assert_allclose(first[3] @ second[3], np.eye(4), atol=1e-12)
    trajectory = Trajectory(np.array([1, 2]), np.stack([np.eye(4), T]))
    path = through_wire(m.encode_path(make, trajectory, 2), "nav_msgs/msg/Path")
    assert [m.to_ns(p.header.stamp) for p in path.poses] == [1, 2]
    np.testing.assert_allclose(m.decode_pose(path.poses[1])[2], T, atol=1e-12)


def test_bad_quaternions_and_stamps() -> None:
    msg = m.encode_pose(make, np.eye(4), 0, "map")
    msg.pose.orientation.w = 0.0
    with pytest.raises(FormatError, match="unit length"):
        m.decode_pose(msg)
    msg.pose.orientation.w = float("nan")
    with pytest.raises(FormatError, match="finite"):
        m.decode_pose(msg)
    for ns in (-1, 2**31 * 10**9):
        with pytest.raises(FormatError, match="stamp"):
            m.to_stamp(make, ns)


@pytest.mark.parametrize("scale", list(Scale))
def test_a_keyframe_says_its_scale_and_what_it_corrects(scale: Scale) -> None:
    name = "sf_interfaces/msg/KeyframeState"
    assert definition(name) is not None
    store = typestore()
    poses = Trajectory(np.array([5, 10**9, STAMP]), se3.exp(np.random.default_rng(0).normal(0, 1, (3, 6))), scale)
    correction = Correction(poses, np.array([1.0, 0.9, 1.1]))
    for sent in (None, correction):
        msg = m.encode_keyframe_state(lambda kind: store.types[kind], scale, STAMP, sent)
        got, back = m.decode_keyframe_state(store.deserialize_cdr(store.serialize_cdr(msg, name), name))
        assert got is scale and m.to_ns(msg.header.stamp) == STAMP
        assert (back is None) == (sent is None)
    assert back is not None and back.keyframes.scale is scale
    np.testing.assert_array_equal(back.keyframes.stamps_ns, poses.stamps_ns)
    np.testing.assert_allclose(back.keyframes.poses, poses.poses, atol=1e-12)
    np.testing.assert_array_equal(back.scales, correction.scales)
    with pytest.raises(FormatError, match="one positive scale"):
        m.decode_keyframe_state(dataclasses.replace(msg, corrected_scale=np.ones(2)))
    with pytest.raises(FormatError, match="scale 7"):
        m.decode_keyframe_state(dataclasses.replace(msg, scale=7))


def test_corrections_wait_for_their_keyframe() -> None:
    waiting = Corrections()
    first, second = (Correction(Trajectory(np.array([k]), np.eye(4)[None]), np.ones(1)) for k in (1, 2))
    waiting.push(20, first)
    assert waiting.due(19) is None and waiting.due(20) is first and waiting.due(20) is None
    waiting.push(30, first)
    waiting.push(40, second)
    assert waiting.due(50) is second, "the newest replaces older ones"
    waiting.push(60, first)
    assert waiting.due() is first
