"""Tiny samples of every data-set layout the importers know, with what must come out of them."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from sf_interfaces.geometry import se3

W, H, F = 48, 32, 40.0  # size and focal length of the samples that may choose them
K = np.array([[F, 0, 23.5], [0, F, 15.5], [0, 0, 1.0]])
DEPTH_M = 2.0


def pose(i: int) -> np.ndarray:
    """T_map_camera of frame i."""
    return se3.exp(np.array([0.1, 0.02, 0.3, 0.0, 0.03, 0.01]) * i)


def picture(path: Path, i: int, size: tuple[int, int] = (W, H)) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    image = np.full((size[1], size[0], 3), 40 + i, np.uint8)
    image[::4, ::3] = (10, 100, 200)  # BGR
    assert cv2.imwrite(str(path), image)


def depth(path: Path, per_metre: float, size: tuple[int, int] = (W, H)) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    raw = np.full((size[1], size[0]), round(DEPTH_M * per_metre), np.uint16)
    raw[:3], raw[3:5] = 0, 65535
    assert cv2.imwrite(str(path), raw)


def text(path: Path, content: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content)


def numbers(T: np.ndarray) -> str:
    return "\n".join(" ".join(f"{v:.9f}" for v in row) for row in np.atleast_2d(T)) + "\n"


def sweep(path: Path, i: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.random.default_rng(i).random((7, 4)).astype("<f4").tofile(path)


def tum_line(stamp: str, T: np.ndarray) -> str:
    t, q = se3.to_quaternion(T)
    return f"{stamp} " + " ".join(f"{v:.9f}" for v in (*t, *q)) + "\n"


def seven_scenes(root: Path, n: int) -> Path:
    for i in range(n):
        picture(root / f"frame-{i:06d}.color.jpg", i, (640, 480))
        depth(root / f"frame-{i:06d}.depth.png", 1000, (640, 480))
        text(root / f"frame-{i:06d}.pose.txt", numbers(pose(i) * 1.0001))
    return root


def replica(root: Path, n: int) -> Path:
    camera = {"w": W, "h": H, "fx": F, "fy": F, "cx": 23.5, "cy": 15.5, "scale": 6553.5}
    text(root / "cam_params.json", json.dumps({"camera": camera}))
    for i in range(n):
        picture(root / f"room0/results/frame{i:06d}.jpg", i)
        depth(root / f"room0/results/depth{i:06d}.png", 6553.5)
    text(root / "room0/traj.txt", "".join(" ".join(map(str, pose(i).ravel())) + "\n" for i in range(n)))
    return root / "room0"


def scannet(root: Path, n: int) -> Path:
    for i in range(n):
        picture(root / f"color/{10 * i}.jpg", i, (2 * W, 2 * H))
        depth(root / f"depth/{10 * i}.png", 1000)
        text(root / f"pose/{10 * i}.txt", numbers(pose(i)))
    color, near = np.eye(4), np.eye(4)
    color[:3, :3] = [[2 * F, 0, 47.5], [0, 2 * F, 31.5], [0, 0, 1]]
    near[:3, :3] = K
    text(root / "intrinsic/intrinsic_color.txt", numbers(color))
    text(root / "intrinsic/intrinsic_depth.txt", numbers(near))
    return root


def tum(root: Path, n: int) -> Path:
    root = root / "rgbd_dataset_freiburg3_test"
    rgb, depths, truth = ["# color\n"], ["# depth\n"], ["# truth\n"]
    for i in range(n):
        picture(root / f"rgb/{i}.png", i, (640, 480))
        depth(root / f"depth/{i}.png", 5000, (640, 480))
        rgb.append(f"{100 + i}.123456 rgb/{i}.png\n")
        depths.append(f"{100 + i}.133456 depth/{i}.png\n")
    for k in range(-1, 100 * (n - 1) + 3):
        truth.append(tum_line(f"{100 + (k * 10 + 123) / 1000:.4f}", pose(k / 100)))
    for name, lines in (("rgb", rgb), ("depth", depths), ("groundtruth", truth)):
        text(root / f"{name}.txt", "".join(lines))
    return root


def icl(root: Path, n: int) -> Path:
    mirror = np.diag([1.0, -1, 1, 1])
    for i in range(n):
        picture(root / f"rgb/{i}.png", i, (640, 480))
        depth(root / f"depth/{i}.png", 5000, (640, 480))
    text(root / "associations.txt", "".join(f"{i} depth/{i}.png {i} rgb/{i}.png\n" for i in range(n)))
    text(root / "traj0.gt.freiburg", "".join(tum_line(str(i), mirror @ pose(i) @ mirror) for i in range(n)))
    return root


def kitti_odometry(root: Path, n: int) -> Path:
    folder = root / "sequences" / "04"
    rows = []
    for i in range(n):
        picture(folder / f"image_2/{i:06d}.png", i)
        sweep(folder / f"velodyne/{i:06d}.bin", i)
        rows.append(" ".join(map(str, pose(i)[:3].ravel())))
    text(root / "poses/04.txt", "\n".join(rows))
    text(folder / "times.txt", "".join(f"{i / 10}\n" for i in range(n)))
    P0, P2 = "P0: 40 0 23.5 0 0 40 15.5 0 0 0 1 0\n", "P2: 40 0 23.5 4 0 40 15.5 0 0 0 1 0\n"
    text(folder / "calib.txt", P0 + P2 + "Tr: 0 -1 0 0.3 0 0 -1 0 1 0 0 0\n")
    return folder


def _kitti_day(folder: Path) -> None:
    eye = "1 0 0 0 1 0 0 0 1"
    P2, P3 = "P_rect_02: 40 0 23.5 4 0 40 15.5 0 0 0 1 0\n", "P_rect_03: 40 0 23.5 -16 0 40 15.5 0 0 0 1 0\n"
    text(folder / "calib_cam_to_cam.txt", f"calib_time: 09-Jan-2012 13:57:47\nR_rect_00: {eye}\n{P2}{P3}")
    text(folder / "calib_velo_to_cam.txt", "calib_time: 15-Mar\nR: 0 -1 0 0 0 -1 1 0 0\nT: 0 0 0\n")
    text(folder / "calib_imu_to_velo.txt", f"R: {eye}\nT: 0 0 0\n")


def kitti_raw(root: Path, n: int) -> Path:
    """The car drives east, 1 m per frame."""
    _kitti_day(root)
    folder = root / "2011_09_26_drive_0001_sync"
    times = "".join(f"2011-09-26 13:02:{25 + i / 10:012.9f}\n" for i in range(n))
    for i in range(n):
        picture(folder / f"image_02/data/{i:010d}.png", i)
        sweep(folder / f"velodyne_points/data/{i:010d}.bin", i)
        east = np.degrees(i / (6378137.0 * np.cos(np.radians(49.0))))
        text(folder / f"oxts/data/{i:010d}.txt", f"49.0 {8 + east:.12f} 110 0 0 0" + " 0" * 24)
    for sensor in ("image_02", "velodyne_points", "oxts"):
        text(folder / sensor / "timestamps.txt", times)
    return folder


def kitti_stereo(root: Path, n: int) -> Path:
    _kitti_day(root)
    for i in range(n):
        picture(root / f"image_02/{i:06d}.png", i)
        sweep(root / f"velodyne_points/{i:06d}.bin", i)
        depth(root / f"gt/disp_occ_0/{i:06d}.png", 256 * 20 / DEPTH_M**2)  # 20 px m / 2 m = 10 px
    return root


def colmap(root: Path, n: int, binary: bool = False) -> Path:
    for i in range(n):
        picture(root / f"images/view{i}.jpg", i)
    images, points = [], [(1, 0.5, -0.5, 3.0, 10, 20, 30), (2, 1.0, 0.25, 4.0, 40, 50, 60)]
    for i in range(n):
        t, q = se3.to_quaternion(se3.inverse(pose(i)))
        images.append((i + 1, q[3], *q[:3], *t, 7, f"view{i}.jpg"))
    folder = root / "sparse" / "0"
    lens = (F, 24.0, 16.0, -0.1)  # SIMPLE_RADIAL; pixel centres at + 0.5
    if not binary:
        text(folder / "cameras.txt", f"# c\n7 SIMPLE_RADIAL {W} {H} {' '.join(map(str, lens))}\n")
        text(folder / "images.txt", "# i\n" + "".join(" ".join(map(str, row)) + "\n\n" for row in images))
        text(folder / "points3D.txt", "".join(" ".join(map(str, row)) + " 0.1 1 2 3 4\n" for row in points))
        return root
    folder.mkdir(parents=True)
    cameras = struct.pack("<QiiQQ4d", 1, 7, 2, W, H, *lens)
    (folder / "cameras.bin").write_bytes(cameras)
    data = struct.pack("<Q", n)
    for number, *q_t, camera, name in images:
        data += struct.pack("<I7dI", number, *q_t, camera) + name.encode() + b"\0"
        data += struct.pack("<Qddq", 1, 1.5, 2.5, -1)
    (folder / "images.bin").write_bytes(data)
    data = struct.pack("<Q", len(points))
    for number, x, y, z, *rgb in points:
        data += struct.pack("<Q3d3BdQ2I", number, x, y, z, *rgb, 0.1, 1, 1, 1)
    (folder / "points3D.bin").write_bytes(data)
    return root


def colmap_binary(root: Path, n: int) -> Path:
    return colmap(root, n, binary=True)


def eth3d(root: Path, n: int) -> Path:
    folder, rows = root / "dslr_calibration_undistorted", []
    for i in range(n):
        picture(root / f"images/dslr_images_undistorted/D{i}.JPG", i)
        t, q = se3.to_quaternion(se3.inverse(pose(i)))
        values = " ".join(map(str, (q[3], *q[:3], *t)))
        rows.append(f"{i} {values} 0 dslr_images_undistorted/D{i}.JPG\n1 2 -1\n")
        (root / "ground_truth_depth/dslr_images").mkdir(parents=True, exist_ok=True)
        z = np.full((H, W), DEPTH_M, "<f4")
        z[:4] = np.inf
        z.tofile(root / f"ground_truth_depth/dslr_images/D{i}.JPG")
    text(folder / "cameras.txt", f"0 PINHOLE {W} {H} {F} {F} 24 16\n")
    text(folder / "images.txt", "".join(rows))
    return root


def mvsnet(root: Path, n: int) -> Path:
    for i in range(n):
        picture(root / f"images/{i:08d}.jpg", i)
        extrinsic, intrinsic = numbers(se3.inverse(pose(i))), numbers(K)
        text(root / f"cams/{i:08d}_cam.txt", f"extrinsic\n{extrinsic}\nintrinsic\n{intrinsic}\n425 2.5\n")
        z = np.full((H, W), DEPTH_M, "<f4")
        z[:4] = 0  # of the top rows, which PFM stores last
        (root / "depths").mkdir(exist_ok=True)
        (root / f"depths/{i:08d}.pfm").write_bytes(f"Pf\n{W} {H}\n-1.0\n".encode() + z[::-1].tobytes())
    return root


def strecha(root: Path, n: int) -> Path:
    for i in range(n):
        picture(root / f"images/{i:04d}.png", i)
        T = pose(i)
        rows = [*K, np.zeros(3), *T[:3, :3], T[:3, 3], np.array([W, H])]
        text(root / f"gt_dense_cameras/{i:04d}.png.camera", "".join(numbers(row) for row in rows))
    return root


def robustmvd(root: Path, n: int) -> Path:
    for i in range(n):
        view = root / ("key" if i == 0 else f"source/{i - 1}")
        picture(view / "image.png", i)
        np.save(view / "K.npy", K)
        np.save(view / "to_ref_transform.npy", np.round(se3.inverse(pose(i)), 3))
    return root


def photos(root: Path, n: int) -> Path:
    for i in range(n):
        picture(root / f"IMG_{i + 8}.jpg", i)  # 8, 9, 10: natural order
    return root


def video(root: Path, n: int) -> Path:
    root.mkdir(parents=True, exist_ok=True)
    path = root / "clip.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10.0, (W, H))
    for i in range(n):
        writer.write(np.full((H, W, 3), 40 + i, np.uint8))
    writer.release()
    return path


@dataclass(frozen=True)
class Layout:
    """A sample's generator and what must come out.

    Args:
        make: (empty folder, frames) -> the path to give to the importer.
        name: of the layout.
        depth: "" (none), "input" or "reference".
        poses: frames carry a pose.
        lidar: frames carry a sweep.
        calibrated: frames carry intrinsics.
        focal: their focal length.
        step_ns: time between frames.
        motion: T_0_1, the camera's motion from the first frame to the second.
        image: the second image's file below the given path, or above it.
    """

    make: Callable[[Path, int], Path]
    name: str
    image: str
    step_ns: int
    depth: str = ""
    poses: bool = True
    lidar: bool = False
    focal: float | None = F
    motion: Callable[[], np.ndarray] = lambda: pose(1)


def _east() -> np.ndarray:
    return se3.exp(np.array([0, 0, 1.0, 0, 0, 0]))


def _second_camera() -> np.ndarray:
    T = se3.exp(np.array([0.1, 0, 0, 0, 0, 0]))
    return T @ pose(1) @ se3.inverse(T)


def _color_camera() -> np.ndarray:
    from sf_interfaces.io.datasets import SevenScenes

    T = SevenScenes.T_COLOR_DEPTH
    return T @ pose(1) @ se3.inverse(T)


_30HZ, _1S = round(1e9 / 30), 10**9
LAYOUTS = (
    Layout(seven_scenes, "7-Scenes", "frame-000001.color.jpg", _30HZ, "input", focal=525.0, motion=_color_camera),
    Layout(replica, "Replica", "results/frame000001.jpg", _30HZ, "input"),
    Layout(scannet, "ScanNet", "color/10.jpg", round(1e10 / 30), "input"),
    Layout(tum, "TUM RGB-D", "rgb/1.png", _1S, "input", focal=535.4),
    Layout(icl, "ICL-NUIM", "rgb/1.png", _30HZ, "input", focal=481.2),
    Layout(kitti_odometry, "KITTI odometry", "image_2/000001.png", _1S // 10, lidar=True, motion=_second_camera),
    Layout(kitti_raw, "KITTI raw", "image_02/data/0000000001.png", _1S // 10, lidar=True, motion=_east),
    Layout(kitti_stereo, "KITTI completion frames", "image_02/000001.png", _1S, "reference", poses=False, lidar=True),
    Layout(colmap, "COLMAP", "images/view1.jpg", _1S),
    Layout(colmap_binary, "COLMAP", "images/view1.jpg", _1S),
    Layout(eth3d, "ETH3D", "images/dslr_images_undistorted/D1.JPG", _1S, "reference"),
    Layout(mvsnet, "DTU/MVSNet", "images/00000001.jpg", _1S, "reference"),
    Layout(strecha, "Strecha/OpenMVG cameras", "images/0001.png", _1S),
    Layout(robustmvd, "robustmvd sample", "source/0/image.png", _1S),
    Layout(photos, "photos", "IMG_9.jpg", _1S, poses=False, focal=None),
    Layout(video, "video", "", _1S // 10, poses=False, focal=None),
)
