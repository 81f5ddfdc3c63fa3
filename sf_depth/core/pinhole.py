"""The camera of multi-view depth: a pinhole with one radial term, and its derivatives.

``theta`` is [fx, fy, cx, cy, k1]: normalised x is drawn to ``x (1 + k1 |x|^2)`` before fx, fy, cx, cy apply.
Arrays carry coordinates first, [2, N] or [3, N], so that every operation runs over contiguous memory.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np

from sf_interfaces.errors import ConfigError
from sf_interfaces.types import Camera, Float64

# Columns of d theta / d phi: the free parameters phi are logarithms of focal lengths, shifts of the principal
# point in focal lengths, and k1. All are of order one, whatever the image size.
_COLUMNS = {"none": (), "f": ("f",), "pinhole": ("fx", "fy", "cx", "cy"), "radial": ("f", "k1"), "lens": ("k1",)}
_NEWTON_STEPS = 3


def theta_of(camera: Camera) -> Float64:
    """Parameters [5] of an undistorted camera."""
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy, 0.0])


def camera_of(theta: Float64, width: int, height: int, frame_id: str = "camera_optical_frame") -> Camera:
    """The pinhole part of the parameters."""
    fx, fy, cx, cy = (float(v) for v in theta[:4])
    return Camera(width, height, fx, fy, cx, cy, frame_id)


def free_columns(theta: Float64, free: str) -> Float64:
    """d theta / d phi [5, K] for the intrinsics that ``free`` names: none, f, pinhole, radial.

    Raises:
        ConfigError: another name.
    """
    if free not in _COLUMNS:
        raise ConfigError(f"intrinsics '{free}' cannot be set free; choose one of {', '.join(_COLUMNS)}")
    fx, fy = theta[0], theta[1]
    columns = {
        "f": (fx, fy, 0, 0, 0),
        "fx": (fx, 0, 0, 0, 0),
        "fy": (0, fy, 0, 0, 0),
        "cx": (0, 0, fx, 0, 0),
        "cy": (0, 0, 0, fy, 0),
        "k1": (0, 0, 0, 0, 1),
    }
    return np.array([columns[name] for name in _COLUMNS[free]], dtype=np.float64).reshape(-1, 5).T


def moved(theta: Float64, columns: Float64, step: Float64) -> Float64:
    """The parameters after a step in phi; focal lengths stay positive."""
    change = columns @ step
    out = theta + change
    out[:2] = theta[:2] * np.exp(change[:2] / theta[:2])
    return out


def rays(theta: Float64, uv: Float64) -> Float64:
    """Undistorted normalised coordinates [2, N] of pixels [2, N], in their precision."""
    theta = theta.astype(uv.dtype, copy=False)
    x = (uv - theta[2:4, None]) / theta[:2, None]
    k1 = theta[4]
    if k1 == 0.0:
        return x
    r = np.sqrt((x * x).sum(axis=0))
    s = r.copy()  # undistorted radius: s (1 + k1 s^2) = r
    for _ in range(_NEWTON_STEPS):
        s -= (s + k1 * s**3 - r) / np.maximum(1.0 + 3.0 * k1 * s * s, 0.1)
    return x * (s / np.maximum(r, 1e-12))


def rays_jacobian(theta: Float64, x: Float64, columns: Float64) -> Float64:
    """d x / d phi [2, K, N] at fixed pixels, for undistorted coordinates x [2, N]."""
    theta, columns = theta.astype(x.dtype, copy=False), columns.astype(x.dtype, copy=False)
    r2 = (x * x).sum(axis=0)
    distorted = x * (1.0 + theta[4] * r2)
    # The distorted point moves by -(x_d * df/f + dc/f) and -x r^2 dk1; D carries it back to the undistorted one.
    shift = np.empty((2, columns.shape[1], x.shape[1]), x.dtype)
    for axis in range(2):
        f = theta[axis]
        shift[axis] = -(np.outer(columns[axis], distorted[axis]) + columns[2 + axis][:, None]) / f
        shift[axis] -= np.outer(columns[4], x[axis] * r2)
    if theta[4] == 0.0:
        return shift
    a, b = 1.0 + theta[4] * r2, 2.0 * theta[4]
    D = np.array([[a + b * x[0] ** 2, b * x[0] * x[1]], [b * x[0] * x[1], a + b * x[1] ** 2]])  # [2, 2, N]
    det = D[0, 0] * D[1, 1] - D[0, 1] ** 2
    return np.stack(
        [
            (D[1, 1] * shift[0] - D[0, 1] * shift[1]) / det,
            (D[0, 0] * shift[1] - D[0, 1] * shift[0]) / det,
        ]
    )


def project(theta: Float64, x: Float64) -> Float64:
    """Pixels [2, N] of normalised coordinates [2, N]."""
    return theta[:2, None] * x * (1.0 + theta[4] * (x * x).sum(axis=0)) + theta[2:4, None]


def project_jacobian(theta: Float64, x: Float64) -> tuple[Float64, Float64, Float64]:
    """d uv / d x of :func:`project` as (uu, uv, vv) [N] each, before fx and fy are applied to the rows."""
    k1 = theta[4]
    r2 = (x * x).sum(axis=0)
    a = 1.0 + k1 * r2
    return a + 2 * k1 * x[0] ** 2, 2 * k1 * x[0] * x[1], a + 2 * k1 * x[1] ** 2


def project_parameters(theta: Float64, x: Float64, columns: Float64) -> Float64:
    """d uv / d phi [2, K, N] at fixed normalised coordinates."""
    r2 = (x * x).sum(axis=0)
    distorted = x * (1.0 + theta[4] * r2)
    return np.stack(
        [
            np.outer(columns[axis], distorted[axis])
            + columns[2 + axis][:, None]
            + np.outer(columns[4], theta[axis] * x[axis] * r2)
            for axis in range(2)
        ]
    )
