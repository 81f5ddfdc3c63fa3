"""Rigid motions as 4x4 matrices. ``T_a_b`` maps points of frame b into frame a.

Tangent vectors are ordered (translation, rotation), as in the tracker's normal equations, and every
function takes any number of leading batch axes.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_SERIES = 0.05  # rad; below it the series is more exact than the closed form
_NEAR_PI = 3.0  # rad
_TINY = 1e-30
_UNIT = np.eye(3)


def _rotation() -> Any:
    """SciPy's rotations, imported on first use: that takes longer than all else a small process does."""
    from scipy.spatial.transform import Rotation

    return Rotation


# hat(e_i) of the unit vectors, row after row.
_GENERATORS = np.array(
    [[0, 0, 0, 0, 0, -1, 0, 1, 0], [0, 0, 1, 0, 0, 0, -1, 0, 0], [0, -1, 0, 1, 0, 0, 0, 0, 0]], dtype=np.float64
)


def hat(w: Array) -> Array:
    """Skew-symmetric matrix of a 3-vector: ``hat(a) @ b == cross(a, b)``. [..., 3] -> [..., 3, 3]."""
    w = np.asarray(w, dtype=np.float64)
    return np.asarray((w @ _GENERATORS).reshape(*w.shape, 3))


def exp(xi: Array) -> Array:
    """Exponential map of SE(3). xi [..., 6] (translation m, rotation rad) -> [..., 4, 4]."""
    xi = np.asarray(xi, dtype=np.float64)
    w = xi[..., 3:]
    t2 = (w * w).sum(axis=-1)[..., None, None]
    t = np.sqrt(t2)
    a, half = np.sinc(t / np.pi), np.sinc(t / (2 * np.pi))  # sin(t)/t, and of half of it: b = (1 - cos t)/t^2
    b = 0.5 * half * half
    c = np.where(t < _SERIES, 1 / 6 - t2 / 120 + t2 * t2 / 5040, (1 - a) / np.maximum(t2, _SERIES**2))
    W = hat(w)
    W2 = W @ W
    T = np.zeros((*xi.shape[:-1], 4, 4))
    T[..., :3, :3] = _UNIT + a * W + b * W2
    T[..., :3, 3:] = (_UNIT + b * W + c * W2) @ xi[..., :3, None]
    T[..., 3, 3] = 1.0
    return T


def log(T: Array) -> Array:
    """Logarithm of SE(3), inverse of :func:`exp` for angles below pi. [..., 4, 4] -> [..., 6]."""
    T = np.asarray(T, dtype=np.float64)
    w = _rotation_vector(T[..., :3, :3])
    t2 = (w * w).sum(axis=-1)[..., None, None]
    half = np.maximum(0.5 * np.sqrt(t2), 0.5 * _SERIES)
    k = np.where(t2 < _SERIES**2, 1 / 12 + t2 / 720 + t2 * t2 / 30240, (0.25 - 0.25 * half / np.tan(half)) / half**2)
    W = hat(w)
    turned = W @ T[..., :3, 3:]
    rho = T[..., :3, 3:] - 0.5 * turned + k * (W @ turned)
    return np.concatenate([rho[..., 0], w], axis=-1)


def _rotation_vector(R: Array) -> Array:
    """Axis times angle of rotations [..., 3, 3] -> [..., 3]."""
    v = 0.5 * (R[..., (2, 0, 1), (1, 2, 0)] - R[..., (1, 2, 0), (2, 0, 1)])
    sine = np.sqrt((v * v).sum(axis=-1))
    cosine = 0.5 * (R[..., 0, 0] + R[..., 1, 1] + R[..., 2, 2] - 1.0)
    angle = np.arctan2(sine, cosine)
    w = v * (np.maximum(angle, _TINY) / np.maximum(sine, _TINY))[..., None]
    turned = angle > _NEAR_PI  # where the sine tells the axis badly
    if turned.any():
        w[turned] = _rotation().from_matrix(R[turned]).as_rotvec()
    return np.asarray(w)


def inverse(T: Array) -> Array:
    """Inverse of a rigid motion, by transposition. [..., 4, 4] -> [..., 4, 4]."""
    T = np.asarray(T, dtype=np.float64)
    Rt = np.swapaxes(T[..., :3, :3], -1, -2)
    out = np.zeros_like(T)
    out[..., :3, :3] = Rt
    out[..., :3, 3:] = -(Rt @ T[..., :3, 3:])
    out[..., 3, 3] = 1.0
    return out


def adjoint(T: Array) -> Array:
    """6x6 adjoint: ``T exp(xi) T^-1 == exp(adjoint(T) xi)``. [..., 4, 4] -> [..., 6, 6]."""
    T = np.asarray(T, dtype=np.float64)
    R = T[..., :3, :3]
    out = np.zeros((*T.shape[:-2], 6, 6))
    out[..., :3, :3] = R
    out[..., 3:, 3:] = R
    out[..., :3, 3:] = hat(T[..., :3, 3]) @ R
    return out


def transform(T: Array, points: Array) -> Array:
    """Apply one motion to points. T [4, 4], points [..., 3] -> [..., 3]."""
    return np.asarray(points) @ T[:3, :3].T + T[:3, 3]


def from_quaternion(translation: Array, xyzw: Array) -> Array:
    """Pose from a translation [..., 3] m and a quaternion xyzw [..., 4] (normalised here)."""
    translation = np.asarray(translation, dtype=np.float64)
    q = np.asarray(xyzw, dtype=np.float64)
    T = np.zeros((*translation.shape[:-1], 4, 4))
    T[..., :3, :3] = _rotation().from_quat(q.reshape(-1, 4)).as_matrix().reshape(*q.shape[:-1], 3, 3)
    T[..., :3, 3] = translation
    T[..., 3, 3] = 1.0
    return T


def to_quaternion(T: Array) -> tuple[Array, Array]:
    """Translation [..., 3] and unit quaternion xyzw [..., 4] with w >= 0."""
    T = np.asarray(T, dtype=np.float64)
    q = _rotation().from_matrix(T[..., :3, :3].reshape(-1, 3, 3)).as_quat(canonical=True)
    return T[..., :3, 3].copy(), q.reshape(*T.shape[:-2], 4)


def orthonormalise(T: Array) -> Array:
    """Nearest rigid motion to a 4x4 whose rotation has drifted (SVD projection onto SO(3))."""
    T = np.array(T, dtype=np.float64)
    U, _, Vt = np.linalg.svd(T[..., :3, :3])
    sign = np.ones((*T.shape[:-2], 3))
    sign[..., 2] = np.sign(np.linalg.det(U @ Vt))
    T[..., :3, :3] = (U * sign[..., None, :]) @ Vt
    T[..., 3, :] = (0.0, 0.0, 0.0, 1.0)
    return T


def interpolate(T_0: Array, T_1: Array, alpha: float | Array) -> Array:
    """Motion on the screw between two poses: alpha 0 gives T_0, 1 gives T_1; alpha scalar or [N]."""
    step = log(inverse(T_0) @ T_1)
    a = np.asarray(alpha, dtype=np.float64)[..., None]
    return T_0 @ exp(a * step)


def twist_between(t0_ns: int, T0: Array, t1_ns: int, T1: Array) -> Array:
    """Constant twist [6] (m/s, rad/s) in the moving frame that carries T0 at t0 into T1 at t1."""
    return log(inverse(T0) @ T1) / ((t1_ns - t0_ns) / 1_000_000_000)
