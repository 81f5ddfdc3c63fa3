"""Sparse LiDAR depth completion on real KITTI data, beside classical interpolation.

Two protocols: ``stereo2015`` scores at ground-truth pixels without a scan point; ``heldout`` drops half of
the scan points of an odometry sequence and predicts them. Prints a table and writes JSON.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator

from sf_depth.config import DepthConfig
from sf_depth.core.estimator import DepthCompleter
from sf_interfaces.geometry.lidar import project_sweep
from sf_interfaces.types import Camera, DepthMap, Float64, Keyframe, SparseDepth, UInt8

STEREO_BASE = 721.5377 * 0.5327  # focal length px times baseline m
Sample = tuple[Keyframe, Float64]  # sparse keyframe, truth [H, W] m (NaN = not scored)
Method = Callable[[Keyframe], tuple[Float64, Float64 | None]]


def _calibration(path: Path) -> dict[str, Float64]:
    rows = (line.split(":", 1) for line in path.read_text().splitlines() if ":" in line)
    return {key: np.array(value.split(), dtype=float) for key, value in rows if "time" not in key}


def _camera(P: Float64, image: UInt8) -> tuple[Camera, Float64]:
    """Camera of a 3x4 projection (pixel centres + 0.5) and the motion from camera 0 into it."""
    T = np.eye(4)
    T[:3, 3] = np.linalg.solve(P[:, :3], P[:, 3])
    camera = Camera(image.shape[1], image.shape[0], P[0, 0], P[1, 1], P[0, 2] + 0.5, P[1, 2] + 0.5)
    return camera, T


def _affine(rotation: Float64, translation: Float64 | None = None) -> Float64:
    T = np.eye(4)
    T[:3, :3] = rotation.reshape(3, 3)
    if translation is not None:
        T[:3, 3] = translation
    return T


def _image(path: Path) -> UInt8:
    return np.ascontiguousarray(cv2.imread(str(path))[..., ::-1])


def _sweep(path: Path) -> Float64:
    return np.fromfile(path, np.float32).reshape(-1, 4)[:, :3]


def stereo2015(root: Path) -> Iterator[Sample]:
    """Frames with a scan and denser ground truth; scored where the scan has no point."""
    cam, velo = _calibration(root / "calib_cam_to_cam.txt"), _calibration(root / "calib_velo_to_cam.txt")
    T_0_lidar = _affine(cam["R_rect_00"]) @ _affine(velo["R"], velo["T"])
    for path in sorted((root / "image_02").glob("*.png")):
        image = _image(path)
        camera, T = _camera(cam["P_rect_02"].reshape(3, 4), image)
        points = _sweep(root / "velodyne_points" / f"{path.stem}.bin")
        sparse = project_sweep(points, camera, T @ T_0_lidar).to_map(*image.shape[:2])
        truth_file = next((root / "gt" / "disp_occ_0").glob(f"{path.stem}*.png"))
        disparity = cv2.imread(str(truth_file), cv2.IMREAD_UNCHANGED) / 256.0
        scored = (disparity > 0) & ~sparse.valid
        truth = np.where(scored, STEREO_BASE / np.maximum(disparity, 1e-6), np.nan)
        yield Keyframe(0, camera, image, np.eye(4), sparse), truth


def heldout(root: Path, step: int = 4) -> Iterator[Sample]:
    """Every ``step``-th odometry frame; a seeded half of the scan pixels is hidden and scored."""
    folder = root / "sequences" / "04"
    calib = _calibration(folder / "calib.txt")
    T_0_lidar = np.vstack([calib["Tr"].reshape(3, 4), [0, 0, 0, 1]])
    for number, path in enumerate(sorted((folder / "image_2").glob("*.png"))[::step]):
        image = _image(path)
        camera, T = _camera(calib["P2"].reshape(3, 4), image)
        points = _sweep(folder / "velodyne" / f"{path.stem}.bin")
        full = project_sweep(points, camera, T @ T_0_lidar).to_map(*image.shape[:2])
        given = np.random.default_rng(number).random(full.z.shape) < 0.5
        sparse = DepthMap(np.where(given, full.z, np.nan))
        yield Keyframe(0, camera, image, np.eye(4), sparse), np.where(given, np.nan, full.z)


def nearest(keyframe: Keyframe) -> tuple[Float64, None]:
    """The depth of the nearest measured pixel."""
    points = SparseDepth.from_map(keyframe.depth)
    return NearestNDInterpolator(points.uv, points.z)(keyframe.camera.pixel_grid()), None


def linear(keyframe: Keyframe) -> tuple[Float64, None]:
    """Linear interpolation on the Delaunay triangulation, nearest outside its hull."""
    points = SparseDepth.from_map(keyframe.depth)
    z = LinearNDInterpolator(points.uv, points.z)(keyframe.camera.pixel_grid())
    return np.where(np.isfinite(z), z, nearest(keyframe)[0]), None


def dilation(keyframe: Keyframe) -> tuple[Float64, None]:
    """Morphology: near depth grows over gaps, in ever larger windows, then a light blur."""
    inverse = np.where(keyframe.depth.valid, 1.0 / keyframe.depth.z, 0.0).astype(np.float32)
    for size in (5, 7, 15, 31, 63, 127):
        grown = cv2.dilate(inverse, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)))
        inverse = np.where(inverse > 0, inverse, grown)
    inverse = cv2.GaussianBlur(cv2.medianBlur(inverse, 5), (5, 5), 0)
    z = np.where(inverse > 0, 1.0 / np.maximum(inverse, 1e-6), nearest(keyframe)[0])
    return np.where(keyframe.depth.valid, keyframe.depth.z, z), None


def gaussian_process(keyframe: Keyframe) -> tuple[Float64, Float64]:
    """The depth block."""
    depth = DepthCompleter(DepthConfig()).complete(keyframe).depth
    return depth.z, np.sqrt(depth.variance)


METHODS: dict[str, Method] = {
    "nearest": nearest,
    "linear": linear,
    "dilation": dilation,
    "gaussian process": gaussian_process,
}


def measure(samples: list[Sample], method: Method) -> dict[str, float]:
    """Errors pooled over all scored pixels, and the median time per frame."""
    errors, relative, ratios, normalised, seconds = [], [], [], [], []
    for keyframe, truth in samples:
        start = time.perf_counter()
        z, sigma = method(keyframe)
        seconds.append(time.perf_counter() - start)
        scored = np.isfinite(truth)
        z, truth = z[scored], truth[scored]
        errors.append(np.abs(z - truth))
        relative.append(errors[-1] / truth)
        ratios.append(np.maximum(z / truth, truth / z))
        if sigma is not None:
            normalised.append(errors[-1] / sigma[scored])
    e = np.concatenate(errors)
    out = {
        "mae_m": float(e.mean()),
        "rmse_m": float(np.sqrt((e**2).mean())),
        "absrel": float(np.concatenate(relative).mean()),
        "inlier_1.03": float((np.concatenate(ratios) < 1.03).mean()),
        "seconds": float(np.median(seconds)),
    }
    if normalised:
        n = np.concatenate(normalised)
        out |= {"within_1_sigma": float((n < 1).mean()), "within_2_sigma": float((n < 2).mean())}
    return out


def main() -> None:
    """Run both protocols on the recordings below ``--data``."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="folder that holds the recordings")
    parser.add_argument("--out", type=Path, default=Path("completion.json"))
    args = parser.parse_args()
    protocols = {
        "stereo2015": list(stereo2015(args.data / "lidarcompletion_kitti2015_a")),
        "heldout": list(heldout(args.data / "rgbl_kitti_odometry04_000_017")),
    }
    results: dict[str, dict[str, dict[str, float]]] = {}
    for protocol, samples in protocols.items():
        results[protocol] = {}
        for name, method in METHODS.items():
            results[protocol][name] = row = measure(samples, method)
            print(f"{protocol:11s} {name:17s} " + "  ".join(f"{k} {v:.4f}" for k, v in row.items()), flush=True)
    args.out.write_text(json.dumps(results, indent=2) + "\n")


if __name__ == "__main__":
    main()
