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

_SMALL_ANGLE = 1e-4  # rad; below it the series is more exact than the closed form


def _rotation() -> Any:
    """SciPy's rotations, imported on first use: that takes longer than all else a small process does."""
    from scipy.spatial.transform import Rotation

    return Rotation


def hat(w: Array) -> Array:
    """Skew-symmetric matrix of a 3-vector: ``hat(a) @ b == cross(a, b)``. [..., 3] -> [..., 3, 3]."""
    w = np.asarray(w, dtype=np.float64)
    zero = np.zeros_like(w[..., 0])
    x, y, z = w[..., 0], w[..., 1], w[..., 2]
    rows = (np.stack([zero, -z, y], -1), np.stack([z, zero, -x], -1), np.stack([-y, x, zero], -1))
    return np.stack(rows, -2)


def _series(w: Array) -> tuple[Array, Array, Array]:
    """sin(t)/t, (1-cos t)/t^2 and (t-sin t)/t^3 of the rotation vector's length t, each [..., 1, 1]."""
    t2 = np.sum(w * w, axis=-1)[..., None, None]
    t = np.sqrt(t2)
    small = t < _SMALL_ANGLE
    safe = np.where(small, 1.0, t)
    a = np.where(small, 1 - t2 / 6, np.sin(safe) / safe)
    b = np.where(small, 0.5 - t2 / 24, (1 - np.cos(safe)) / safe**2)
    c = np.where(small, 1 / 6 - t2 / 120, (safe - np.sin(safe)) / safe**3)
    return a, b, c


def exp(xi: Array) -> Array:
    """Exponential map of SE(3). xi [..., 6] (translation m, rotation rad) -> [..., 4, 4]."""
    xi = np.asarray(xi, dtype=np.float64)
    rho, w = xi[..., :3], xi[..., 3:]
    a, b, c = _series(w)
    W = hat(w)
    W2 = W @ W
    T = np.zeros((*xi.shape[:-1], 4, 4))
    T[..., :3, :3] = np.eye(3) + a * W + b * W2
    T[..., :3, 3] = ((np.eye(3) + b * W + c * W2) @ rho[..., None])[..., 0]
    T[..., 3, 3] = 1.0
    return T


def log(T: Array) -> Array:
    """Logarithm of SE(3), inverse of :func:`exp` for angles below pi. [..., 4, 4] -> [..., 6]."""
    T = np.asarray(T, dtype=np.float64)
    batch = T.shape[:-2]
    w = _rotation().from_matrix(T[..., :3, :3].reshape(-1, 3, 3)).as_rotvec().reshape(*batch, 3)
    _, b, c = _series(w)
    W = hat(w)
    V = np.eye(3) + b * W + c * (W @ W)
    rho = np.linalg.solve(V, T[..., :3, 3][..., None])[..., 0]
    return np.concatenate([rho, w], axis=-1)


def log_near_identity(T: Array) -> Array:
    """:func:`log` for angles below a radian, to 1e-5 of the translation there; faster for a few motions."""
    T = np.asarray(T, dtype=np.float64)
    R, t = T[..., :3, :3], T[..., :3, 3]
    v = 0.5 * np.stack([R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], axis=-1)
    sine = np.sqrt((v * v).sum(axis=-1, keepdims=True))
    angle = np.arctan2(sine, 0.5 * (np.trace(R, axis1=-2, axis2=-1)[..., None] - 1.0))
    w = v * np.where(sine > _SMALL_ANGLE, angle / np.where(sine > _SMALL_ANGLE, sine, 1.0), 1.0)
    turned = np.cross(w, t)
    rho = t - 0.5 * turned + (1 / 12 + angle**2 / 720 + angle**4 / 30240) * np.cross(w, turned)
    return np.concatenate([rho, w], axis=-1)


def inverse(T: Array) -> Array:
    """Inverse of a rigid motion, by transposition. [..., 4, 4] -> [..., 4, 4]."""
    T = np.asarray(T, dtype=np.float64)
    Rt = np.swapaxes(T[..., :3, :3], -1, -2)
    out = np.zeros_like(T)
    out[..., :3, :3] = Rt
    out[..., :3, 3] = -(Rt @ T[..., :3, 3:])[..., 0]
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
