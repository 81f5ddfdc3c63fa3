"""The data that blocks exchange: frozen, validated on construction, arrays read-only.

Time is integer nanoseconds. ``T_a_b`` maps points of b into a. Images are RGB uint8 [H, W, 3] or mono
uint8 [H, W]. Depth is z along the optical axis in metres, NaN where there is none. Pixel centres lie at
integer + 0.5. A quantity that is missing is ``None``: exactly the paper's trigger (Sec. III-E).
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sf_interfaces.errors import CalibrationError, FormatError

Float64 = NDArray[np.float64]
Float32 = NDArray[np.float32]
UInt8 = NDArray[np.uint8]


class Scale(Enum):
    """Whether one unit of length is a metre."""

    METRIC = "metric"
    ARBITRARY = "arbitrary"


def _frozen(array: Any, dtype: Any) -> NDArray[Any]:
    """A read-only, contiguous view (a copy only where dtype or layout demand it)."""
    out = np.ascontiguousarray(array, dtype=dtype).view()
    out.flags.writeable = False
    return out


def _set(instance: object, name: str, value: object) -> None:
    object.__setattr__(instance, name, value)


def check_pose(given: Any, name: str = "pose") -> Float64:
    """A read-only float64 [4, 4] rigid motion.

    Raises:
        FormatError: not 4x4, not finite, or its rotation is not orthonormal within 1e-3.
    """
    T: Float64 = _frozen(given, np.float64)  # [4, 4]
    if T.shape != (4, 4) or not np.isfinite(T).all():
        raise FormatError(f"{name} must be a finite 4x4 matrix, got shape {T.shape}")
    if np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() > 1e-3:
        raise FormatError(f"{name} has a rotation that is not orthonormal; re-orthonormalise it first")
    return T


@dataclass(frozen=True, slots=True)
class Camera:
    """A pinhole camera without distortion (images are undistorted once, on input).

    Args:
        width, height: image size, px.
        fx, fy: focal lengths, px.
        cx, cy: principal point, px, with pixel centres at integer + 0.5 (ROS and OpenCV values + 0.5).
        frame_id: the optical frame, REP-103 (x right, y down, z forward).
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    frame_id: str = "camera_optical_frame"

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise CalibrationError(f"camera size must be positive, got {self.width}x{self.height}")
        values = (self.fx, self.fy, self.cx, self.cy)
        if not np.isfinite(values).all() or self.fx <= 0 or self.fy <= 0:
            raise CalibrationError(f"camera intrinsics must be finite with fx, fy > 0, got {values}")

    @property
    def K(self) -> Float64:
        """Calibration matrix [3, 3] in the integer + 0.5 pixel convention."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], dtype=np.float64)

    def scaled(self, factor: float) -> Camera:
        """The camera of the image resized by ``factor`` (exact: centres are at + 0.5)."""
        w, h = max(1, round(self.width * factor)), max(1, round(self.height * factor))
        sx, sy = w / self.width, h / self.height
        return replace(self, width=w, height=h, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy)

    def project(self, points: Float64) -> tuple[Float64, Float64]:
        """Camera points [..., 3] m -> continuous pixels [..., 2] and depth z [...]. No z check is made."""
        points = np.asarray(points, dtype=np.float64)
        z = points[..., 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            u = self.fx * points[..., 0] / z + self.cx
            v = self.fy * points[..., 1] / z + self.cy
        return np.stack([u, v], axis=-1), z

    def sees(self, uv: Float64, z: Float64) -> NDArray[np.bool_]:
        """Which of the pixels [N, 2] and depths [N] of :meth:`project` lie in the image and before the camera, [N]."""
        with np.errstate(invalid="ignore"):
            return np.asarray((z > 0) & (uv >= 0).all(axis=1) & (uv < (self.width, self.height)).all(axis=1))

    def unproject(self, pixels: Float64, z: Float64) -> Float64:
        """Continuous pixels [..., 2] with depth z [...] m -> camera points [..., 3] m."""
        pixels = np.asarray(pixels, dtype=np.float64)
        x = (pixels[..., 0] - self.cx) / self.fx * z
        y = (pixels[..., 1] - self.cy) / self.fy * z
        return np.stack(np.broadcast_arrays(x, y, z), axis=-1)

    def pixel_grid(self) -> Float64:
        """Continuous coordinates of all pixel centres, [H, W, 2]."""
        v, u = np.mgrid[0 : self.height, 0 : self.width].astype(np.float64)
        return np.stack([u + 0.5, v + 0.5], axis=-1)


@dataclass(frozen=True, slots=True)
class DepthMap:
    """Depth z [H, W] float32 m (NaN = no data) with its variance [H, W] m^2 where known."""

    z: Float32
    variance: Float32 | None = None
    scale: Scale = Scale.METRIC

    def __post_init__(self) -> None:
        _set(self, "z", _frozen(self.z, np.float32))
        if self.z.ndim != 2:
            raise FormatError(f"depth must have shape (H, W), got {self.z.shape}")
        if self.variance is not None:
            _set(self, "variance", _frozen(self.variance, np.float32))
            if self.variance.shape != self.z.shape:
                raise FormatError(f"depth variance has shape {self.variance.shape}, depth {self.z.shape}")

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Pixels that carry a depth, [H, W]."""
        return np.isfinite(self.z) & (self.z > 0)

    @property
    def density(self) -> float:
        """Fraction of pixels that carry a depth."""
        return float(self.valid.mean())


@dataclass(frozen=True, slots=True)
class SparseDepth:
    """Depth at scattered points of an image, as a LiDAR sweep gives it.

    Args:
        uv: continuous pixel coordinates [N, 2].
        z: depth [N], m.
    """

    uv: Float64
    z: Float64

    def __post_init__(self) -> None:
        _set(self, "uv", _frozen(self.uv, np.float64))
        _set(self, "z", _frozen(self.z, np.float64))
        if self.uv.ndim != 2 or self.uv.shape[1] != 2 or self.z.shape != self.uv.shape[:1]:
            raise FormatError(f"sparse depth needs uv (N, 2) and z (N,), got {self.uv.shape}, {self.z.shape}")

    def __len__(self) -> int:
        return len(self.z)

    def to_map(self, height: int, width: int) -> DepthMap:
        """Rasterise to the pixel each point falls in; the nearest wins. Points outside are left out."""
        col, row = np.floor(self.uv).astype(np.int64).T
        inside = (col >= 0) & (col < width) & (row >= 0) & (row < height)
        order = np.argsort(-self.z[inside], kind="stable")
        z = np.full((height, width), np.nan, dtype=np.float32)
        z[row[inside][order], col[inside][order]] = self.z[inside][order]
        return DepthMap(z)

    @staticmethod
    def from_map(depth: DepthMap) -> SparseDepth:
        """The valid pixels of a depth map, at their centres, in row-major order."""
        row, col = np.nonzero(depth.valid)
        return SparseDepth(np.stack([col + 0.5, row + 0.5], axis=-1), depth.z[row, col].astype(np.float64))


@dataclass(frozen=True, slots=True)
class PointCloud:
    """Points [N, 3] float32 m with optional colour [N, 3] uint8 and per-point time [N] ns after the stamp.

    The cloud belongs to ``frame_id`` at ``stamp_ns`` (0 and "" where that has no meaning).
    """

    points: Float32
    colors: UInt8 | None = None
    time_offset_ns: NDArray[np.int64] | None = None
    stamp_ns: int = 0
    frame_id: str = ""

    def __post_init__(self) -> None:
        _set(self, "points", _frozen(self.points, np.float32))
        if self.points.ndim != 2 or self.points.shape[1] != 3:
            raise FormatError(f"points must have shape (N, 3), got {self.points.shape}")
        if self.colors is not None:
            _set(self, "colors", _frozen(self.colors, np.uint8))
            if self.colors.shape != self.points.shape:
                raise FormatError(f"colors have shape {self.colors.shape}, points {self.points.shape}")
        if self.time_offset_ns is not None:
            _set(self, "time_offset_ns", _frozen(self.time_offset_ns, np.int64))
            if self.time_offset_ns.shape != self.points.shape[:1]:
                raise FormatError("time_offset_ns must have one entry per point")

    def __len__(self) -> int:
        return len(self.points)


def _check_image(given: Any, camera: Camera | None) -> UInt8:
    image: UInt8 = _frozen(given, np.uint8)
    if image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] != 3):
        raise FormatError(f"image must have shape (H, W) or (H, W, 3), got {image.shape}")
    if camera is not None and image.shape[:2] != (camera.height, camera.width):
        size = f"{image.shape[1]}x{image.shape[0]}"
        raise CalibrationError(
            f"image is {size} but its camera_info says {camera.width}x{camera.height}; "
            "give the calibration that belongs to this stream"
        )
    return image


@dataclass(frozen=True, slots=True)
class Frame:
    """One instant of input, joined by the stamp of its image (the paper's I_rgb, I_d, G, theta).

    Args:
        stamp_ns: time of the image.
        camera: intrinsics, or None when unknown.
        image: RGB [H, W, 3] or mono [H, W] uint8, or None for depth-only input.
        depth: dense sensor depth registered to the image, or None.
        sparse_depth: LiDAR depth projected into the image (occlusions removed), or None.
        T_map_camera: pose given from outside, or None.
    """

    stamp_ns: int
    camera: Camera | None
    image: UInt8 | None = None
    depth: DepthMap | None = None
    sparse_depth: SparseDepth | None = None
    T_map_camera: Float64 | None = None

    def __post_init__(self) -> None:
        if self.image is not None:
            _set(self, "image", _check_image(self.image, self.camera))
        if self.depth is not None and self.camera is not None:
            if self.depth.z.shape != (self.camera.height, self.camera.width):
                raise CalibrationError(
                    f"depth is {self.depth.z.shape[1]}x{self.depth.z.shape[0]} but the camera is "
                    f"{self.camera.width}x{self.camera.height}; register depth to the image first"
                )
        if self.T_map_camera is not None:
            _set(self, "T_map_camera", check_pose(self.T_map_camera, "T_map_camera"))

    @property
    def measured(self) -> bool:
        """Whether it carries depth, dense or sparse."""
        return self.depth is not None or self.sparse_depth is not None


@dataclass(frozen=True, slots=True)
class Keyframe:
    """A frame whose pose is final: it has left the tracker's optimisation window (Sec. III-E).

    ``depth`` is sparse (LiDAR pixels), dense, or None until the depth block has completed it;
    ``landmarks`` are the tracker's patch centres in the optical frame. ``scale`` is that of the pose and the
    landmarks.
    """

    stamp_ns: int
    camera: Camera
    image: UInt8
    T_map_camera: Float64
    depth: DepthMap | None = None
    landmarks: PointCloud | None = None
    scale: Scale = Scale.METRIC

    def __post_init__(self) -> None:
        _set(self, "image", _check_image(self.image, self.camera))
        _set(self, "T_map_camera", check_pose(self.T_map_camera, "T_map_camera"))

    @staticmethod
    def of(frame: Frame) -> Keyframe:
        """A sensor frame whose pose is final because it was given; without one it stays in its own optical frame.

        Raises:
            FormatError: the frame has no image or no camera.
        """
        camera, sparse = frame.camera, frame.sparse_depth
        if frame.image is None or camera is None:
            raise FormatError(f"frame {frame.stamp_ns} has no image or no camera_info; a keyframe needs both")
        T = np.eye(4) if frame.T_map_camera is None else frame.T_map_camera
        depth = frame.depth if sparse is None else sparse.to_map(camera.height, camera.width)
        return Keyframe(frame.stamp_ns, camera, frame.image, T, depth)


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Stamped poses in increasing time. ``poses`` [N, 4, 4] are ``T_<frame>_<child>``."""

    stamps_ns: NDArray[np.int64]
    poses: Float64
    scale: Scale = Scale.METRIC
    frame: str = "map"
    child: str = "camera_optical_frame"

    def __post_init__(self) -> None:
        _set(self, "stamps_ns", _frozen(self.stamps_ns, np.int64))
        _set(self, "poses", _frozen(self.poses, np.float64))
        if self.poses.shape != (len(self.stamps_ns), 4, 4):
            raise FormatError(f"poses must have shape ({len(self.stamps_ns)}, 4, 4), got {self.poses.shape}")
        if len(self.stamps_ns) > 1 and (np.diff(self.stamps_ns) <= 0).any():
            raise FormatError("trajectory stamps must increase strictly; sort it and drop duplicates")

    @staticmethod
    def from_pairs(pairs: Sequence[tuple[int, Float64]], scale: Scale = Scale.METRIC) -> Trajectory:
        """From (stamp ns, pose) pairs in any order."""
        ordered = sorted(pairs, key=lambda pair: pair[0])
        stamps = np.array([s for s, _ in ordered], dtype=np.int64)
        poses = np.array([T for _, T in ordered], dtype=np.float64).reshape(-1, 4, 4)
        return Trajectory(stamps, poses, scale)

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def positions(self) -> Float64:
        """Origins of the child frame, [N, 3] m."""
        return self.poses[:, :3, 3]
