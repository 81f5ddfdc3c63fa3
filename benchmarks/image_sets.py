"""Sets of images with the truth about them: simulated ones with exact depth, real ones with what reference they bring.

Of 7-Scenes, options of the depth block were chosen on frames 0-99 only; the sets here use frames 100-199. The sets of
``simulated`` were looked at for those choices too: their rows show what the block can do. How it fares elsewhere the
sets of ``unseen`` show, which nothing was chosen on (the place in the Ames room is the same, its other views are not).
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from sf_bringup.simulate import PRESETS, SimulationSpec, Simulator
from sf_bringup.simulate.ames import EYE
from sf_bringup.simulate.render import Renderer
from sf_interfaces.geometry import se3
from sf_interfaces.geometry.registration import register_depth
from sf_interfaces.geometry.undistort import undistort_depth, undistort_image
from sf_interfaces.io.datasets.files import read_depth, read_pose
from sf_interfaces.io.datasets.indoor import SevenScenes
from sf_interfaces.types import Camera, DepthMap, Float64, UInt8

CAMERA = Camera(640, 480, 520.0, 520.0, 320.0, 240.0)
# Scene, seconds along its path, views, baseline over depth, largest roll deg. The first few serve a quick run; "ames"
# is an Ames room seen from the place where it looks like an ordinary one.
SIMULATED = (
    ("room", 12.0, 5, 0.15, 3.0),
    ("campus", 10.0, 6, 0.15, 3.0),
    ("room0", 20.0, 5, 0.15, 25.0),
    ("ames", 0.0, 5, 0.12, 3.0),
    ("demo", 1.0, 5, 0.12, 3.0),
    ("room", 40.0, 8, 0.12, 3.0),
    ("hall", 20.0, 6, 0.12, 3.0),
)
# The reference first. Every tenth frame around it, and for comparison with earlier results sets of five.
SEVEN_SCENES = (
    (130, 100, 110, 120, 140, 150, 160),
    (150, 110, 130, 170, 190),
    (160, 130, 140, 150, 170, 180, 190),
    (140, 110, 120, 130, 150, 160, 170),
    (120, 100, 110, 130, 140),
    (180, 140, 160, 170, 199),
)
UNSEEN = (
    ("room1", 14.0, 5, 0.14, 3.0),
    ("office0", 9.0, 6, 0.15, 10.0),
    ("campus", 33.0, 6, 0.15, 3.0),
    ("ames", 0.0, 5, 0.13, 4.0),
    ("hall", 5.0, 5, 0.13, 5.0),
)
QUICK_SIMULATED, QUICK_UNSEEN, QUICK_SEVEN_SCENES = 2, 4, 2
# Depth and colour of 7-Scenes are not taken at once: a depth image lags by a quarter of a frame, and one was lost, so
# that from there on it belongs to the colour image after it (`benchmarks/registration.py` finds both by the edges).
DEPTH_LAG, DEPTH_LOST = 0.26, 179
FOUNTAIN = (5, 3, 4, 6, 7)


@dataclass(frozen=True)
class ImageSet:
    """Images of one camera, the first is the reference; ``truth`` is its depth, None where there is none."""

    name: str
    camera: Camera
    images: list[UInt8]
    poses: list[Float64]  # T_map_camera
    truth: DepthMap | None

    @property
    def T_source_reference(self) -> Float64:
        """Motion from the reference into every other view, [S, 4, 4]."""
        return np.stack([se3.inverse(T) @ self.poses[0] for T in self.poses[1:]])

    def only(self, sources: list[int]) -> ImageSet:
        """The reference with some of the other views, counted from 1."""
        keep = [0, *sources]
        return ImageSet(
            self.name, self.camera, [self.images[k] for k in keep], [self.poses[k] for k in keep], self.truth
        )


def simulated(everything: bool = True) -> Iterator[ImageSet]:
    """Views from around a place of a scene's path, turned to nearly the same point, with sensor noise."""
    yield from _rendered(SIMULATED if everything else SIMULATED[:QUICK_SIMULATED], 0)


def unseen(everything: bool = True) -> Iterator[ImageSet]:
    """The same of places and with baselines on which nothing was chosen."""
    yield from _rendered(UNSEEN if everything else UNSEEN[:QUICK_UNSEEN], 100)


def _rendered(chosen: tuple[tuple[str, float, int, float, float], ...], first_seed: int) -> Iterator[ImageSet]:
    for seed, (preset, seconds, count, baseline, roll) in enumerate(chosen, first_seed):
        simulator = Simulator(PRESETS.get(preset) or SimulationSpec(preset))
        renderer, rng = simulator.renderer, np.random.default_rng(seed)
        name, first = f"{preset} {seconds:.0f} s", simulator.path.pose(seconds)
        if preset == "ames":
            name, first = preset, _toward(np.array(EYE), np.add(EYE, (1.0, 0.0, 0.0)), 0.0)
        yield _around(name, renderer, first, count, baseline, roll, rng)


def _around(
    name: str, renderer: Renderer, first: Float64, count: int, baseline: float, roll: float, rng: np.random.Generator
) -> ImageSet:
    """The view ``first`` and others that look at what it sees."""
    image, z = renderer.render(CAMERA, first)
    poses, images, depth, angle = [first], [image], float(np.nanmedian(z)), 0.0
    while len(poses) < count:
        angle += 2 * np.pi / (count - 1) + rng.uniform(-0.3, 0.3)
        step = baseline * depth * np.array([np.cos(angle), 0.6 * np.sin(angle), rng.uniform(-0.5, 0.5)])
        eye = first[:3, 3] + first[:3, :3] @ step
        if renderer.clearance(eye[None])[0] < 0.15 * min(depth, 3.0):
            continue
        target = first[:3, 3] + first[:3, 2] * depth + rng.normal(0, 0.06 * depth, 3)
        poses.append(_toward(eye, target, rng.uniform(-roll, roll)))
        images.append(renderer.render(CAMERA, poses[-1])[0])
    noisy = [np.clip(i + rng.standard_normal(i.shape) + 0.5, 0, 255).astype(np.uint8) for i in images]
    return ImageSet(name, CAMERA, noisy, poses, DepthMap(z))


def _toward(eye: Float64, target: Float64, roll: float) -> Float64:
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    T[:3, 3] = eye
    return T @ se3.exp(np.array([0, 0, 0, 0, 0, np.radians(roll)]))


def real(data: Path, everything: bool = True) -> Iterator[ImageSet]:
    """The image sets of a folder of recordings."""
    chosen = SEVEN_SCENES if everything else SEVEN_SCENES[:QUICK_SEVEN_SCENES]
    yield from seven_scenes(data / "rgbd_7scenes_redkitchen_000_199", chosen)
    yield fountain(data / "mvs_strecha_fountain_P11")
    yield robustmvd(data / "mvd_robustmvd_sample")


def seven_scenes(folder: Path, sets: tuple[tuple[int, ...], ...]) -> Iterator[ImageSet]:
    """A hand-held Kinect; its depth is registered to colour, its poses are good to a degree or two."""
    camera, lens = SevenScenes.COLOR_CAMERA, SevenScenes.LENS
    for frames in sets:
        images = [undistort_image(_rgb(folder / f"frame-{k:06d}.color.jpg"), camera, lens) for k in frames]
        poses = [color_pose(folder, k) for k in frames]
        truth = undistort_depth(registered_depth(folder, frames[0]), camera, lens)
        yield ImageSet(f"7-Scenes {frames[0]}, {len(frames)} views", camera, images, poses, truth)


def registered_depth(folder: Path, frame: int) -> DepthMap:
    """Depth as a colour image of 7-Scenes saw it, lens and all."""
    depth, T = _depth_to_color(folder, frame)
    measured = read_depth(folder / f"frame-{depth:06d}.depth.png", SevenScenes.depth_units or 1000.0)
    return register_depth(measured, SevenScenes.DEPTH_CAMERA, SevenScenes.COLOR_CAMERA, T)


def color_pose(folder: Path, frame: int) -> Float64:
    """T_map_camera of a colour image of 7-Scenes; the poses in the files are those of the depth camera."""
    depth, T = _depth_to_color(folder, frame)
    return _depth_pose(folder, depth) @ se3.inverse(T)


def _depth_to_color(folder: Path, frame: int) -> tuple[int, Float64]:
    """The depth image taken with a colour image, and where its camera then was as seen from the colour camera."""
    depth = frame if frame < DEPTH_LOST else frame - 1
    first, last = max(depth - 1, 0), depth + 1
    before, after = _depth_pose(folder, first), _depth_pose(folder, last)
    motion = se3.log((se3.inverse(after) @ before)[None]) / (last - first)
    return depth, SevenScenes.T_COLOR_DEPTH @ se3.exp(DEPTH_LAG * motion)[0]


def _depth_pose(folder: Path, frame: int) -> Float64:
    return read_pose(folder / f"frame-{frame:06d}.pose.txt")


def fountain(folder: Path, factor: float = 0.5) -> ImageSet:
    """Five neighbouring photos; reference cameras, no depth."""
    images, poses = [], []
    for k in FOUNTAIN:
        numbers = np.array((folder / "gt_dense_cameras" / f"{k:04d}.jpg.camera").read_text().split(), dtype=float)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = numbers[12:21].reshape(3, 3), numbers[21:24]
        poses.append(T)
        images.append(_rgb(folder / "images" / f"{k:04d}.jpg", factor))
    return ImageSet("fountain-P11", _reduced(numbers[:9].reshape(3, 3), factor, images[0]), images, poses, None)


def robustmvd(folder: Path, factor: float = 0.5) -> ImageSet:
    """One key view and six sources; reference poses, no depth."""
    parts = [folder / "key", *(folder / "source" / str(k) for k in range(6))]
    images = [_rgb(part / "image.png", factor) for part in parts]
    camera = _reduced(np.load(folder / "key" / "K.npy").astype(float), factor, images[0])
    motions = [np.load(part / "to_ref_transform.npy").astype(float) for part in parts[1:]]
    poses = [np.eye(4), *(se3.inverse(se3.orthonormalise(T)) for T in motions)]
    return ImageSet("robustmvd", camera, images, poses, None)


def _rgb(path: Path, factor: float = 1.0) -> UInt8:
    image = cv2.imread(str(path))[..., ::-1]
    return np.ascontiguousarray(cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA))


def _reduced(K: Float64, factor: float, image: UInt8) -> Camera:
    """The camera of an image reduced by ``factor``, pixel centres at + 0.5."""
    height, width = image.shape[:2]
    fx, fy, cx, cy = (float(v) for v in (K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5))
    return Camera(width, height, fx * factor, fy * factor, cx * factor, cy * factor)
