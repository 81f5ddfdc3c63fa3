"""Multi-view depth with nothing known, intrinsics known, and poses known: simulated scenes and real image sets.

Simulated sets have exact depth; 7-Scenes has sensor depth registered to colour; fountain-P11 and the robustmvd
sample have reference cameras. Prints a row a set and mode and writes JSON.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from sf_bringup.simulate import PRESETS, Simulator
from sf_depth.config import DepthConfig
from sf_depth.core.mvd import MultiViewDepth
from sf_interfaces.errors import SceneFactoryError
from sf_interfaces.geometry import se3
from sf_interfaces.geometry.registration import register_depth
from sf_interfaces.io.datasets.indoor import SevenScenes
from sf_interfaces.types import Camera, DepthMap, Float32, Float64, UInt8

# preset, frame, views, baseline over depth, largest roll deg
SIMULATED = (
    ("demo", 10, 5, 0.12, 3.0),
    ("room", 120, 5, 0.15, 3.0),
    ("room", 400, 8, 0.12, 3.0),
    ("hall", 200, 6, 0.12, 3.0),
    ("campus", 100, 6, 0.15, 3.0),
    ("room0", 200, 5, 0.15, 25.0),
)
SEVEN_SCENES = ((60, 20, 40, 80, 100), (120, 80, 100, 140, 160), (150, 110, 130, 170, 190))


@dataclass(frozen=True)
class ImageSet:
    """Images of one camera, the first is the reference; its depth is NaN where there is no truth."""

    name: str
    camera: Camera
    images: list[UInt8]
    poses: list[Float64]  # T_map_camera
    z: Float32


def _toward(eye: Float64, target: Float64, roll: float) -> Float64:
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    T[:3, 3] = eye
    return T @ se3.exp(np.array([0, 0, 0, 0, 0, np.radians(roll)]))


def simulated() -> Iterator[ImageSet]:
    """Views from around a place of a scene's path, turned to nearly the same point, with sensor noise."""
    for seed, (preset, frame, count, baseline, roll) in enumerate(SIMULATED):
        simulator = Simulator(PRESETS[preset])
        renderer, rng = simulator.renderer, np.random.default_rng(seed)
        camera = Camera(640, 480, 520.0, 520.0, 320.0, 240.0)
        poses = [simulator.path.pose(frame / 10)]
        image, z = renderer.render(camera, poses[0])
        images, depth = [image], float(np.nanmedian(z))
        angle = 0.0
        while len(poses) < count:
            angle += 2 * np.pi / (count - 1) + rng.uniform(-0.3, 0.3)
            step = baseline * depth * np.array([np.cos(angle), 0.6 * np.sin(angle), rng.uniform(-0.5, 0.5)])
            eye = poses[0][:3, 3] + poses[0][:3, :3] @ step
            if renderer.clearance(eye[None])[0] < 0.15 * min(depth, 3.0):
                continue
            target = poses[0][:3, 3] + poses[0][:3, 2] * depth + rng.normal(0, 0.06 * depth, 3)
            poses.append(_toward(eye, target, rng.uniform(-roll, roll)))
            images.append(renderer.render(camera, poses[-1])[0])
        noisy = [np.clip(i + rng.standard_normal(i.shape) + 0.5, 0, 255).astype(np.uint8) for i in images]
        yield ImageSet(f"{preset}-{frame}", camera, noisy, poses, z)


def _rgb(path: Path, factor: float = 1.0) -> UInt8:
    image = cv2.imread(str(path))[..., ::-1]
    return np.ascontiguousarray(cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA))


def seven_scenes(folder: Path) -> Iterator[ImageSet]:
    """Frames far enough apart; depth is registered to colour."""
    for frames in SEVEN_SCENES:
        stems = [folder / f"frame-{k:06d}" for k in frames]
        raw = cv2.imread(f"{stems[0]}.depth.png", cv2.IMREAD_UNCHANGED)
        measured = DepthMap(np.where((raw == 0) | (raw == 65535), np.nan, raw * 1e-3))
        T = SevenScenes.T_COLOR_DEPTH
        z = register_depth(measured, SevenScenes.DEPTH_CAMERA, SevenScenes.COLOR_CAMERA, T).z
        poses = [se3.orthonormalise(np.loadtxt(f"{stem}.pose.txt")) @ se3.inverse(T) for stem in stems]
        images = [_rgb(Path(f"{stem}.color.jpg")) for stem in stems]
        yield ImageSet(f"7scenes-{frames[0]}", SevenScenes.COLOR_CAMERA, images, poses, z)


def fountain(folder: Path, factor: float = 0.5) -> Iterator[ImageSet]:
    """Five neighbouring views."""
    images, poses = [], []
    for k in (5, 3, 4, 6, 7):
        numbers = np.array((folder / "gt_dense_cameras" / f"{k:04d}.jpg.camera").read_text().split(), dtype=float)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = numbers[12:21].reshape(3, 3), numbers[21:24]
        poses.append(T)
        images.append(_rgb(folder / "images" / f"{k:04d}.jpg", factor))
    height, width = images[0].shape[:2]
    K = numbers[:9].reshape(3, 3) * factor
    camera = Camera(width, height, K[0, 0], K[1, 1], K[0, 2] + 0.25, K[1, 2] + 0.25)
    yield ImageSet("fountain-P11", camera, images, poses, np.full((height, width), np.nan, np.float32))


def robustmvd(folder: Path, factor: float = 0.5) -> Iterator[ImageSet]:
    """One key view and six sources."""
    parts = [folder / "key", *(folder / "source" / str(k) for k in range(6))]
    images = [_rgb(part / "image.png", factor) for part in parts]
    K = np.load(folder / "key" / "K.npy").astype(float) * factor
    height, width = images[0].shape[:2]
    camera = Camera(width, height, K[0, 0], K[1, 1], K[0, 2] + 0.25, K[1, 2] + 0.25)
    motions = [np.load(part / "to_ref_transform.npy").astype(float) for part in parts[1:]]
    poses = [np.eye(4), *(se3.inverse(se3.orthonormalise(T)) for T in motions)]
    yield ImageSet("robustmvd", camera, images, poses, np.full((height, width), np.nan, np.float32))


def measure(images: ImageSet, mode: str) -> dict[str, float]:
    """One set in one mode: ``unknown``, ``intrinsics`` or ``posed``."""
    truth = np.stack([se3.inverse(T) @ images.poses[0] for T in images.poses[1:]])
    camera, T = (None if mode == "unknown" else images.camera), (truth if mode == "posed" else None)
    begun = time.perf_counter()
    found = MultiViewDepth(DepthConfig()).recover(images.images[0], images.images[1:], camera, T)
    off = se3.log(found.T_source_reference @ se3.inverse(truth))[:, 3:]
    out = {
        "focal_percent": 100 * (found.camera.fx / images.camera.fx - 1),
        "rotation_deg": float(np.degrees(np.linalg.norm(off, axis=1)).max()),
        "registered": float(found.registered.mean()),
        "density": found.depth.density,
        "seconds": time.perf_counter() - begun,
    }
    both = found.depth.valid & np.isfinite(images.z)
    if both.any():
        z, true = found.depth.z[both], images.z[both]
        z = z * (1.0 if mode == "posed" else np.median(true / z))
        error = np.abs(z / true - 1)
        assert found.depth.variance is not None
        sigma = np.sqrt(found.depth.variance[both]) / found.depth.z[both]
        out |= {"rel_percent": 100 * float(error.mean()), "median_percent": 100 * float(np.median(error))}
        out |= {"inlier_1.03": float((error < 0.03).mean()), "within_1_sigma": float((error < sigma).mean())}
    return out


def main() -> None:
    """Run every set in every mode."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, help="folder that holds the recordings; without it only simulated sets")
    parser.add_argument("--real-only", action="store_true", help="leave the simulated sets out")
    parser.add_argument("--out", type=Path, default=Path("multi_view_depth.json"))
    args = parser.parse_args()
    sets: list[Iterator[ImageSet]] = [] if args.real_only else [simulated()]
    if args.data is not None:
        sets.append(seven_scenes(args.data / "rgbd_7scenes_redkitchen_000_199"))
        sets.append(fountain(args.data / "mvs_strecha_fountain_P11"))
        sets.append(robustmvd(args.data / "mvd_robustmvd_sample"))
    results: dict[str, dict[str, float | str]] = {}
    for images in (image_set for group in sets for image_set in group):
        for mode in ("unknown", "intrinsics", "posed"):
            try:
                row: dict[str, float | str] = dict(measure(images, mode))
            except SceneFactoryError as error:
                row = {"failed": str(error)}
            results[f"{images.name} {mode}"] = row
            values = "  ".join(f"{k} {v:.3f}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items())
            print(f"{images.name:14s} {mode:10s} {values}", flush=True)
    args.out.write_text(json.dumps(results, indent=2) + "\n")


if __name__ == "__main__":
    main()
