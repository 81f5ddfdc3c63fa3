"""Data sets become bags: a tiny generated sample of each layout, broken files, streaming, and the real ones."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from sf_interfaces.errors import ConfigError, FormatError, SceneFactoryError
from sf_interfaces.geometry import se3
from sf_interfaces.geometry.registration import register_depth
from sf_interfaces.io.bag import BagReader
from sf_interfaces.io.datasets import DATASETS, ReadOptions, Written, recognise, write
from sf_interfaces.io.sequence_writer import SequenceWriter
from sf_interfaces.ros import messages as m
from sf_interfaces.types import Camera, DepthMap
from tests.interfaces import layouts
from tests.interfaces.layouts import LAYOUTS, Layout

COLOR, INFO, DEPTH = "/camera/color/image_raw", "/camera/color/camera_info", "/camera/depth/image_raw"
POINTS, TRUTH, TRUE_DEPTH, GIVEN = "/lidar/points", "/ground_truth/pose", "/ground_truth/depth/image", "/sf/pose"


def convert(path: Path, out: Path, **options: object) -> tuple[BagReader, Written]:
    reading = ReadOptions(**options)  # type: ignore[arg-type]
    with SequenceWriter(out) as writer:
        written = write(recognise(path, reading.depth_scale), writer, reading)
    return BagReader(out), written


def decoded(bag: BagReader, topic: str, decode: Callable[[object], object]) -> list:
    return [decode(bag.decode(raw)) for raw in bag.messages([topic])]


def stamps(bag: BagReader, topic: str) -> list[int]:
    return decoded(bag, topic, lambda msg: m.to_ns(msg.header.stamp))


def by_make(layout: Layout) -> str:
    return layout.make.__name__


every_layout = pytest.mark.parametrize("layout", LAYOUTS, ids=by_make)


@every_layout
def test_a_layout_becomes_what_it_holds(layout: Layout, tmp_path: Path) -> None:
    path = layout.make(tmp_path / "set", 3)
    assert recognise(path).name == layout.name
    bag, written = convert(path, tmp_path / "out.mcap")
    assert (written.frames, written.skipped) == (3, 0)
    counts = {name: info.count for name, info in bag.topics.items()}
    expected = {COLOR: 3, INFO: 3 * (layout.focal is not None), TRUTH: 3 * layout.poses, POINTS: 3 * layout.lidar}
    expected |= {DEPTH: 3 * (layout.depth == "input"), TRUE_DEPTH: 3 * (layout.depth == "reference")}
    assert {name: counts.get(name, 0) for name in expected} == expected
    assert GIVEN not in counts and ("/tf_static" in counts) == layout.lidar
    times = stamps(bag, COLOR)
    np.testing.assert_allclose(np.diff(times), layout.step_ns, atol=1)
    image = decoded(bag, COLOR, m.decode_image)[1]
    assert abs(int(image[17, 16].mean()) - 41) < 8
    if layout.focal is not None:
        camera, _ = decoded(bag, INFO, m.decode_camera_info)[0]
        assert (camera.fx, camera.cx) == (pytest.approx(layout.focal), pytest.approx(camera.width / 2, abs=1.0))
        assert image.shape[:2] == (camera.height, camera.width)
    if layout.depth:
        topic = DEPTH if layout.depth == "input" else TRUE_DEPTH
        z = decoded(bag, topic, m.decode_depth)[1].z
        assert z[3 * len(z) // 4, z.shape[1] // 2] == pytest.approx(layouts.DEPTH_M, abs=0.02)
        assert np.isnan(z[1, z.shape[1] // 2])
    if layout.poses:
        first, second = decoded(bag, TRUTH, lambda msg: m.decode_pose(msg)[2])[:2]
        np.testing.assert_allclose(se3.inverse(first) @ second, layout.motion(), atol=2e-3)
        assert stamps(bag, TRUTH) == times


@pytest.mark.parametrize("layout", [one for one in LAYOUTS if one.poses], ids=by_make)
def test_poses_are_an_input_only_on_request(layout: Layout, tmp_path: Path) -> None:
    bag, _ = convert(layout.make(tmp_path / "set", 2), tmp_path / "out.mcap", use_poses=True, limit=1)
    assert bag.topics[GIVEN].count == bag.topics[TRUTH].count == 1


@pytest.mark.parametrize("layout", [one for one in LAYOUTS if one.image], ids=by_make)
@pytest.mark.parametrize("damage", ["truncated", "missing"])
def test_a_bad_image_is_named_or_left_out(layout: Layout, damage: str, tmp_path: Path) -> None:
    path = layout.make(tmp_path / "set", 3)
    file = path / layout.image
    # A file that is gone leaves no trace where images alone are listed; a link to nowhere does.
    _truncate(file) if damage == "truncated" else _unlink(file)
    with pytest.raises(FormatError, match=rf"{file.name}.*--skip-bad"):
        convert(path, tmp_path / "out.mcap")
    bag, written = convert(path, tmp_path / "out.mcap", skip_bad=True)
    assert (written.frames, written.skipped) == (2, 1) and bag.topics[COLOR].count == 2
    assert file.name in written.sentences()[-1] and "1 bad of 3 frames" in written.sentences()[-1]


def _truncate(file: Path) -> None:
    file.write_bytes(file.read_bytes()[: file.stat().st_size * 2 // 3])


def _unlink(file: Path) -> None:
    file.unlink()
    file.symlink_to(file.with_name("nowhere"))


def _write_depth(scale: float, dtype: type = np.uint16) -> Callable[[Path], None]:
    def spoil(file: Path) -> None:
        raw = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(file), np.clip(raw * scale, 0, np.iinfo(dtype).max).astype(dtype))

    return spoil


def _write_text(change: Callable[[str], str]) -> Callable[[Path], None]:
    return lambda file: file.write_text(change(file.read_text())) and None


def _scaled(text: str) -> str:
    values = np.array(text.split(), dtype=float).reshape(4, 4)
    values[:3, :3] *= 1.1
    return layouts.numbers(values)


def _nan_row(text: str) -> str:
    rows = text.splitlines()
    return "\n".join([rows[0], "nan " + rows[1].partition(" ")[2], *rows[2:]])


@pytest.mark.parametrize(
    ("make", "file", "spoil", "says"),
    [
        (layouts.scannet, "depth/10.png", _write_depth(0.1, np.uint8), "8 bit"),
        (layouts.scannet, "depth/10.png", _write_depth(1e-3), "unit looks wrong"),
        (layouts.replica, "results/depth000001.png", Path.unlink, "missing"),
        (layouts.tum, "depth/1.png", _truncate, "truncated"),
        (layouts.scannet, "pose/10.txt", lambda f: f.write_text("-inf " * 16), "not finite"),
        (layouts.scannet, "pose/10.txt", _write_text(_scaled), "no rigid motion"),
        (layouts.seven_scenes, "frame-000001.pose.txt", lambda f: f.write_text("1 0 0"), "must hold 4x4"),
        (layouts.seven_scenes, "frame-000001.color.jpg", Path.unlink, "missing"),
        (layouts.kitti_odometry, "velodyne/000001.bin", Path.unlink, "missing"),
        (layouts.kitti_odometry, "../../poses/04.txt", _write_text(_nan_row), "not finite"),
        (layouts.kitti_odometry, "velodyne/000001.bin", lambda f: f.write_bytes(b"12345"), "four floats"),
        (layouts.kitti_raw, "oxts/data/0000000001.txt", lambda f: f.write_text("49 8 nan 0 0 0"), "lat, lon"),
        (layouts.kitti_stereo, "gt/disp_occ_0/000001.png", _write_depth(0.1, np.uint8), "16 bit"),
        (layouts.mvsnet, "cams/00000001_cam.txt", lambda f: f.write_text("extrinsic 1 2"), "must hold 'extrinsic'"),
        (layouts.mvsnet, "depths/00000001.pfm", _truncate, "no whole PFM"),
        (layouts.strecha, "gt_dense_cameras/0001.png.camera", Path.unlink, "must hold 26"),
        (layouts.robustmvd, "source/0/K.npy", _truncate, "must hold 3x3"),
        (layouts.photos, "IMG_9.jpg", lambda f: layouts.picture(f, 0, (160, 120)), "160x120"),
    ],
)
def test_other_bad_files_are_named_or_left_out(
    make: Callable[[Path, int], Path], file: str, spoil: Callable[[Path], object], says: str, tmp_path: Path
) -> None:
    path = make(tmp_path / "set", 3)
    spoil(path / file)
    name = Path(file).name
    with pytest.raises(SceneFactoryError, match=rf"{name}.*{says}|{says}.*{name}"):
        convert(path, tmp_path / "out.mcap")
    _, written = convert(path, tmp_path / "out.mcap", skip_bad=True)
    assert (written.frames, written.skipped) == (2, 1)


@pytest.mark.parametrize(
    ("make", "file", "content", "says"),
    [
        (layouts.replica, "../cam_params.json", "{}", "cam_params.json"),
        (layouts.replica, "traj.txt", "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1", "1 poses for 3 frames"),
        (layouts.scannet, "intrinsic/intrinsic_depth.txt", "1 2", "intrinsic_depth.txt"),
        (layouts.tum, "depth.txt", "1.0", "depth.txt must hold"),
        (layouts.kitti_odometry, "calib.txt", "P2: 1 2 3", "P2 of 12 numbers"),
        (layouts.kitti_odometry, "times.txt", "0", "3 images but 1 times"),
        (layouts.kitti_raw, "../calib_velo_to_cam.txt", "", "calib_velo_to_cam.txt"),
        (layouts.colmap, "sparse/0/images.txt", "1 2 3", "images.txt"),
        (layouts.colmap_binary, "sparse/0/images.bin", "xx", "images.bin"),
        (layouts.colmap, "sparse/0/cameras.txt", "7 FOV 48 32 40 40 24 16 0.9", "image_undistorter"),
        (layouts.video, "", "no video", "cannot be opened"),
    ],
)
def test_what_all_frames_need_is_named_and_never_skipped(
    make: Callable[[Path, int], Path], file: str, content: str, says: str, tmp_path: Path
) -> None:
    path = make(tmp_path / "set", 3)
    (path / file).write_text(content)
    with pytest.raises(SceneFactoryError, match=says):
        convert(path, tmp_path / "out.mcap", skip_bad=True)


def test_depth_of_another_size_is_named_by_its_image(tmp_path: Path) -> None:
    path = layouts.replica(tmp_path / "set", 2)
    layouts.depth(path / "results/depth000001.png", 6553.5, (24, 16))
    with pytest.raises(FormatError, match=r"depth of image .*frame000001\.jpg is 24x16, the image 48x32"):
        convert(path, tmp_path / "out.mcap")


def test_depth_scale_replaces_the_layouts_own(tmp_path: Path) -> None:
    path = layouts.tum(tmp_path / "set", 1)
    bag, _ = convert(path, tmp_path / "out.mcap", depth_scale=1000.0)
    assert np.nanmedian(decoded(bag, DEPTH, m.decode_depth)[0].z) == pytest.approx(10.0)
    with pytest.raises(ConfigError, match="no depth"):
        convert(layouts.photos(tmp_path / "photos", 1), tmp_path / "x.mcap", depth_scale=1000.0)


def test_tum_depth_keeps_its_stamp_and_lens_its_distortion(tmp_path: Path) -> None:
    path = layouts.tum(tmp_path / "set", 2)
    bag, _ = convert(path, tmp_path / "out.mcap")
    assert stamps(bag, COLOR)[0] == 100_123_456_000 and stamps(bag, DEPTH)[0] == 100_133_456_000
    (path / "associations.txt").write_text("101.1 depth/1.png 101.2 rgb/1.png\n")
    bag, _ = convert(path, tmp_path / "out.mcap")
    assert stamps(bag, COLOR) == [101_200_000_000] and stamps(bag, DEPTH) == [101_100_000_000]
    other = path.with_name("rgbd_dataset_freiburg1_test")
    path.rename(other)
    bag, _ = convert(other, tmp_path / "out.mcap")
    assert decoded(bag, INFO, m.decode_camera_info)[0][1].coefficients[0] == pytest.approx(0.262383)
    unknown = other.with_name("office")
    other.rename(unknown)
    bag, written = convert(unknown, tmp_path / "out.mcap")
    assert INFO not in bag.topics and "--calibration" in written.sentences()[0]


def test_colmap_points_and_lens(tmp_path: Path) -> None:
    for make in (layouts.colmap, layouts.colmap_binary):
        bag, _ = convert(make(tmp_path / make.__name__, 2), tmp_path / "out.mcap")
        camera, lens = decoded(bag, INFO, m.decode_camera_info)[0]
        assert (camera.cx, camera.cy, lens.model) == (24.0, 16.0, "plumb_bob") and lens.coefficients[0] == -0.1
        cloud = decoded(bag, "/ground_truth/points", m.decode_cloud)[0]
        np.testing.assert_allclose(cloud.points, [[0.5, -0.5, 3], [1, 0.25, 4]])
        np.testing.assert_array_equal(cloud.colors, [[10, 20, 30], [40, 50, 60]])


def test_a_focal_length_comes_from_exif_of_every_photo_or_not_at_all(tmp_path: Path) -> None:
    for name in ("a.jpg", "b.jpg"):
        exif = Image.Exif()
        exif.get_ifd(0x8769)[0xA405] = 28  # FocalLengthIn35mmFilm
        Image.new("RGB", (360, 240), (9, 9, 9)).save(tmp_path / name, exif=exif)
    bag, written = convert(tmp_path, tmp_path / "out.mcap")
    camera, _ = decoded(bag, INFO, m.decode_camera_info)[0]
    assert camera.fx == camera.fy == pytest.approx(280.0, rel=1e-4)  # 28 mm of 36 mm, 360 px
    assert "EXIF of a.jpg says a focal length of 280 px" in written.sentences()[0]
    Image.new("RGB", (360, 240)).save(tmp_path / "c.jpg")
    bag, written = convert(tmp_path, tmp_path / "out.mcap")
    assert INFO not in bag.topics and "no calibration" in written.sentences()[0]


def _long_sequence(root: Path, n: int) -> Path:
    """Frames that are links to one: long on disk only."""
    layouts.scannet(root, 1)
    for i in range(1, n):
        for folder, suffix in (("color", "jpg"), ("depth", "png"), ("pose", "txt")):
            os.link(root / folder / f"0.{suffix}", root / folder / f"{i}.{suffix}")
    return root


def _peak(path: Path, out: Path) -> int:
    tracemalloc.start()
    try:
        convert(path, out)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_memory_does_not_grow_with_the_length(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(layouts, "W", 480)
    monkeypatch.setattr(layouts, "H", 320)
    monkeypatch.setattr(layouts, "K", np.array([[400.0, 0, 240], [0, 400.0, 160], [0, 0, 1]]))
    for name in ("picture", "depth"):
        function = getattr(layouts, name)
        monkeypatch.setattr(function, "__defaults__", ((480, 320),))
    convert(_long_sequence(tmp_path / "warm", 2), tmp_path / "out.mcap")
    short = _peak(_long_sequence(tmp_path / "short", 20), tmp_path / "out.mcap")
    long = _peak(_long_sequence(tmp_path / "long", 120), tmp_path / "out.mcap")
    assert os.path.getsize(tmp_path / "out.mcap") > 0
    assert long < 1.05 * short + 1e6  # 100 more frames would be 60 MB


def test_registration_keeps_the_nearest_surface() -> None:
    camera = Camera(40, 30, 30.0, 30.0, 20.0, 15.0)
    z = np.full((30, 40), 4.0, np.float32)
    z[10:20, 10:20] = 1.0
    T = np.eye(4)
    same = register_depth(DepthMap(z), camera, camera, T, splat=1)
    np.testing.assert_allclose(same.z, z)
    T[0, 3] = 0.2  # the near square moves 6 px, the far wall 1.5 px
    moved = register_depth(DepthMap(z), camera, camera, T).z
    assert (moved[11:19, 17:25] == 1.0).all() and moved[15, 35] == 4.0


def test_what_is_no_data_set_is_told_what_it_is(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="no known data set"):
        recognise(tmp_path)
    with pytest.raises(FormatError, match="does not exist"):
        recognise(tmp_path / "none")
    (tmp_path / "truth.txt").write_text("0 0 0 0 0 0 0 1\n")
    with pytest.raises(FormatError, match="--poses"):
        recognise(tmp_path / "truth.txt")
    layouts.seven_scenes(tmp_path / "scene" / "seq-01", 1)
    with pytest.raises(FormatError, match="seq-01"):
        recognise(tmp_path / "scene")
    (tmp_path / "scene" / "run.mcap").touch()
    layouts.picture(tmp_path / "scene" / "plot.png", 0)
    with pytest.raises(FormatError, match=r"bags.*run\.mcap"):
        recognise(tmp_path / "scene")


def test_every_layout_is_documented() -> None:
    table = (Path(__file__).resolve().parents[2] / "docs" / "datasets.md").read_text()
    assert [kind.name for kind in DATASETS if f"| {kind.name} |" not in table] == []


@pytest.mark.parametrize(
    ("folder", "name", "frames"),
    [
        ("lidarcompletion_kitti2015_a", "KITTI completion frames", 4),
        ("mvd_robustmvd_sample", "robustmvd sample", 7),
        ("mvs_strecha_fountain_P11", "Strecha/OpenMVG cameras", 11),
        ("rgbl_kitti_odometry04_000_017", "KITTI odometry", 18),
    ],
)
def test_real_recordings(
    folder: str, name: str, frames: int, shared_data: Callable[[str], Path], tmp_path: Path
) -> None:
    path = shared_data(folder)
    assert recognise(path).name == name
    bag, written = convert(path, tmp_path / "out.mcap")
    assert (written.frames, written.skipped) == (frames, 0) and bag.topics[INFO].count == frames


def test_real_sweeps_fall_into_the_image(shared_data: Callable[[str], Path], tmp_path: Path) -> None:
    """Projected points cover the lower part of the image, and agree with the disparity where there is one."""
    for folder in ("rgbl_kitti_odometry04_000_017", "lidarcompletion_kitti2015_a"):
        bag, _ = convert(shared_data(folder), tmp_path / "k.mcap", limit=1)
        camera, _ = decoded(bag, INFO, m.decode_camera_info)[0]
        T = decoded(bag, "/tf_static", m.decode_tf)[0][0][3]
        points = decoded(bag, POINTS, m.decode_cloud)[0].points
        uv, z = camera.project(se3.transform(T, points))
        inside = (z > 0.5) & (uv >= 0).all(1) & (uv[:, 0] < camera.width) & (uv[:, 1] < camera.height)
        assert 10_000 < inside.sum() < 30_000 and np.median(uv[inside, 1]) > camera.height / 2
    truth = decoded(bag, TRUE_DEPTH, m.decode_depth)[0].z
    column, row = np.floor(uv[inside]).astype(int).T
    both = np.isfinite(truth[row, column])
    relative = truth[row, column][both] / z[inside][both] - 1
    assert both.sum() > 5000 and abs(np.median(relative)) < 0.005 and np.median(np.abs(relative)) < 0.01


def test_real_seven_scenes(shared_data: Callable[[str], Path], tmp_path: Path) -> None:
    bag, _ = convert(shared_data("rgbd_7scenes_redkitchen_000_199"), tmp_path / "s.mcap", limit=4)
    depths = decoded(bag, DEPTH, m.decode_depth)
    assert len(depths) == 4 and min(d.density for d in depths) > 0.6


def test_real_cameras_agree_with_the_images(shared_data: Callable[[str], Path], tmp_path: Path) -> None:
    """Sampson distance of SIFT matches under the imported cameras: a wrong convention gives tens of pixels."""
    for folder in ("mvs_strecha_fountain_P11", "mvd_robustmvd_sample"):
        bag, _ = convert(shared_data(folder), tmp_path / "p.mcap", limit=2)
        a, b = decoded(bag, COLOR, m.decode_image)
        poses = decoded(bag, TRUTH, lambda msg: m.decode_pose(msg)[2])
        cameras = [camera for camera, _ in decoded(bag, INFO, m.decode_camera_info)]
        assert np.median(_sampson(a, b, cameras, se3.inverse(poses[1]) @ poses[0])) < 0.6


def _sampson(a: np.ndarray, b: np.ndarray, cameras: list[Camera], T_b_a: np.ndarray) -> np.ndarray:
    sift = cv2.SIFT_create(1500)
    (points_a, da), (points_b, db) = (sift.detectAndCompute(cv2.cvtColor(x, cv2.COLOR_RGB2GRAY), None) for x in (a, b))
    pairs = [p[0] for p in cv2.BFMatcher().knnMatch(da, db, k=2) if p[0].distance < 0.75 * p[1].distance]
    x = np.array([np.add(points_a[p.queryIdx].pt, 0.5) for p in pairs])
    y = np.array([np.add(points_b[p.trainIdx].pt, 0.5) for p in pairs])
    x, y = (np.hstack([points, np.ones((len(points), 1))]) for points in (x, y))
    E = se3.hat(T_b_a[:3, 3]) @ T_b_a[:3, :3]
    fundamental = np.linalg.inv(cameras[1].K).T @ E @ np.linalg.inv(cameras[0].K)
    lines_b, lines_a = x @ fundamental.T, y @ fundamental
    error = np.abs((y * lines_b).sum(1))
    return error / np.sqrt((lines_b[:, :2] ** 2).sum(1) + (lines_a[:, :2] ** 2).sum(1))
