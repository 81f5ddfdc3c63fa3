"""A textured box seen from inside, with exact depth and poses: small enough for every test run."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from sf_bringup.simulate.sensors import LIDARS, ray_pattern
from sf_interfaces.geometry import se3
from sf_interfaces.types import Camera, DepthMap, Float64, Frame, SparseDepth

HALF = np.array([3.0, 2.0, 3.0])  # m, half extents of the room; the camera starts in its middle
CAMERA = Camera(320, 240, 260.0, 255.0, 160.0, 120.0)
STEP_NS = 50_000_000


def _textures(seed: int) -> Float64:
    """Six smooth random textures with detail over several octaves, [6, 512, 512] grey levels."""
    rng = np.random.default_rng(seed)
    out = np.zeros((6, 512, 512))
    for size, weight in ((16, 1.0), (48, 0.8), (128, 0.5)):
        for face in range(6):
            out[face] += weight * cv2.resize(rng.normal(size=(size, size)), (512, 512), interpolation=cv2.INTER_CUBIC)
    return np.clip(128 + 45 * out, 0, 255)


def barred(seed: int) -> Float64:
    """Plain walls with dark marks, and bars before a part of each: much of what there is to see repeats itself."""
    rng = np.random.default_rng(seed)
    out = np.full((6, 512, 512), 205.0)
    for face in out:
        for u, v, a, b in zip(*rng.integers(0, 490, (2, 240)), *rng.integers(6, 22, (2, 240)), strict=True):
            face[v : v + b, u : u + a] = rng.uniform(90, 180)
        bars = np.broadcast_to((np.arange(110) % 34 < 8) | (np.arange(512) % 90 < 3)[:, None], (512, 110))
        face[:, 290:400] = np.where(bars, 45.0, 215.0)
    return out


class BoxRoom:
    """Renders frames by intersecting rays with the six walls."""

    def __init__(self, seed: int = 0, textures: Float64 | None = None) -> None:
        self._textures = (_textures(seed) if textures is None else textures).astype(np.float32)
        self._rng = np.random.default_rng(seed)

    def view(self, T_wc: Float64) -> tuple[np.ndarray, np.ndarray]:
        """Grey image uint8 [H, W] and depth z [H, W] m."""
        rays = CAMERA.unproject(CAMERA.pixel_grid(), np.ones((CAMERA.height, CAMERA.width)))
        direction = rays @ T_wc[:3, :3].T
        with np.errstate(divide="ignore"):
            distance = (np.sign(direction) * HALF - T_wc[:3, 3]) / direction
        axis = np.argmin(distance, axis=-1)
        z = np.take_along_axis(distance, axis[..., None], axis=-1)[..., 0]
        hit = T_wc[:3, 3] + z[..., None] * direction
        side = np.take_along_axis(direction, axis[..., None], axis=-1)[..., 0] > 0
        image = np.zeros(z.shape, np.float32)
        for face in range(6):
            mask = (axis == face // 2) & (side == bool(face % 2))
            a, b = [i for i in range(3) if i != face // 2]
            u = ((hit[..., a] / HALF[a] + 1) * 255.5).astype(np.float32)
            v = ((hit[..., b] / HALF[b] + 1) * 255.5).astype(np.float32)
            image[mask] = cv2.remap(self._textures[face], u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)[mask]
        return image.round().astype(np.uint8), z

    def frame(self, index: int, T_wc: Float64, kind: str = "sparse", gain: float = 1.0) -> Frame:
        """The frame of one pose; ``kind`` is dense, sparse, rosette or none."""
        gray, z = self.view(T_wc)
        image = np.repeat(np.clip(gray * gain, 0, 255).astype(np.uint8)[..., None], 3, axis=2)
        stamp = 1_000_000_000 + index * STEP_NS
        if kind == "dense":
            return Frame(stamp, CAMERA, image, DepthMap(z))
        if kind == "none":
            return Frame(stamp, CAMERA, image)
        uv = self._rng.uniform((1, 1), (CAMERA.width - 1, CAMERA.height - 1), (4000, 2))
        if kind == "rosette":
            uv = _rosette(index)
        col, row = np.floor(uv).astype(int).T
        centres = np.stack([col, row], axis=-1) + 0.5
        noise = self._rng.normal(0, 0.015, len(uv)) if kind == "rosette" else 0.0  # m
        return Frame(stamp, CAMERA, image, sparse_depth=SparseDepth(centres, z[row, col] + noise))


def _rosette(sweep: int) -> Float64:
    """Where a sweep of a scanner that draws a rosette, mounted in the camera, meets the image, [N, 2] px."""
    forward, left, up = ray_pattern(LIDARS["rosette"], sweep, STEP_NS * 1e-9, 360.0)[0].T
    uv = np.stack([CAMERA.cx - CAMERA.fx * left / forward, CAMERA.cy - CAMERA.fy * up / forward], axis=-1)
    return uv[((uv > 0) & (uv < (CAMERA.width, CAMERA.height))).all(axis=1)]


def path(count: int, step: float = 0.03) -> Float64:
    """A smooth walk with turns, [count, 4, 4]; starts at identity."""
    t = np.arange(count) * step
    xi = np.stack([np.sin(t), 0.3 * np.sin(2 * t), 0.8 * (1 - np.cos(t)), 0.1 * t, 0.5 * np.sin(t), 0.05 * t], axis=-1)
    return np.array([se3.exp(x) for x in xi])


def circle(count: int, lap: int, radius: float) -> Float64:
    """A camera that walks a circle and looks outwards, once round in ``lap`` poses, [count, 4, 4]."""
    poses = []
    for a in 2 * np.pi * np.arange(count) / lap:
        T = se3.exp(np.array([0, 0, 0, 0, a, 0]))
        T[:3, 3] = radius * np.array([np.sin(a), 0, np.cos(a) - 1])
        poses.append(T)
    return np.array(poses)


def warming_up(frames: list[Frame], first: int, last: int, share: float = 0.06) -> list[Frame]:
    """The same frames with dense depth that is too far from one to another, by ``share`` half way between them."""
    out = list(frames)
    for k in range(first, last):
        depth = frames[k].depth
        assert depth is not None
        factor = 1 + share * np.sin(np.pi * (k - first) / (last - first))
        out[k] = replace(frames[k], depth=DepthMap(depth.z * np.float32(factor)))
    return out
