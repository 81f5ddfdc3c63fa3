"""Similarities as 4x4 matrices [[s R, t], [0, 1]]; with scale 1 they are the rigid motions of ``se3``.

Tangents are ordered (translation, rotation, log of the scale). Every function takes leading batch axes.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from sf_interfaces.geometry import se3
from sf_interfaces.types import Float64

_RIGID = 1e-12  # deviation of a scale from 1 that is rounding


def similarity(T: Float64, scale: float | Float64) -> Float64:
    """The similarity that scales, then moves by T: x -> scale R x + t. [..., 4, 4], [...] -> [..., 4, 4]."""
    S = np.array(T, dtype=np.float64)
    S[..., :3, :3] *= np.asarray(scale, dtype=np.float64)[..., None, None]
    return S


def scale_of(S: Float64) -> Float64:
    """Scale [...] of similarities [..., 4, 4]."""
    return np.asarray(np.cbrt(np.linalg.det(S[..., :3, :3])))


def rigid(S: Float64) -> Float64:
    """The pose of a similarity: its rotation and translation, without the scale; what is rigid stays as it is."""
    scale = scale_of(S)
    unscaled = se3.orthonormalise(similarity(S, 1.0 / scale))
    return np.where(np.abs(scale - 1.0)[..., None, None] < _RIGID, S, unscaled)


def inverse(S: Float64) -> Float64:
    """Inverse of a similarity. [..., 4, 4] -> [..., 4, 4]."""
    s2 = scale_of(S)[..., None, None] ** 2
    out = np.zeros_like(S)
    out[..., :3, :3] = np.swapaxes(S[..., :3, :3], -1, -2) / s2
    out[..., :3, 3] = -(out[..., :3, :3] @ S[..., :3, 3:])[..., 0]
    out[..., 3, 3] = 1.0
    return out


def adjoint(S: Float64) -> Float64:
    """7x7 adjoint: a small motion xi before S is the small motion ``adjoint(S) xi`` after it."""
    s = scale_of(S)
    R, t = S[..., :3, :3] / s[..., None, None], S[..., :3, 3]
    out = np.zeros((*S.shape[:-2], 7, 7))
    out[..., :3, :3], out[..., 3:6, 3:6] = S[..., :3, :3], R
    out[..., :3, 3:6] = se3.hat(t) @ R
    out[..., :3, 6] = -t
    out[..., 6, 6] = 1.0
    return out


def moved(S: Float64, xi: Float64) -> Float64:
    """S followed, in its own frame, by the small motion xi [..., 7]; equal to ``S exp(xi)`` to first order."""
    out = S.copy()
    out[..., :3, 3] += (S[..., :3, :3] @ xi[..., :3, None])[..., 0]
    turn = Rotation.from_rotvec(xi[..., 3:6].reshape(-1, 3)).as_matrix().reshape(*xi.shape[:-1], 3, 3)
    out[..., :3, :3] = S[..., :3, :3] @ turn * np.exp(xi[..., 6])[..., None, None]
    return out


def coordinates(E: Float64) -> tuple[Float64, Float64]:
    """How far E is from identity, [..., 7], and its derivative by a small motion of E in its own frame [..., 7, 7]."""
    s = scale_of(E)
    R = E[..., :3, :3] / s[..., None, None]
    w = Rotation.from_matrix(R.reshape(-1, 3, 3)).as_rotvec().reshape(*E.shape[:-2], 3)
    J = np.zeros((*E.shape[:-2], 7, 7))
    J[..., :3, :3], J[..., 3:6, 3:6], J[..., 6, 6] = E[..., :3, :3], _inverse_right_jacobian(w), 1.0
    return np.concatenate([E[..., :3, 3], w, np.log(s)[..., None]], axis=-1), J


def _inverse_right_jacobian(w: Float64) -> Float64:
    """d log(R exp(d)) / d d at d = 0, where w = log(R). [..., 3] -> [..., 3, 3]."""
    angle = np.linalg.norm(w, axis=-1)[..., None, None]
    W = se3.hat(w)
    safe = np.maximum(angle, 1e-4)
    factor = np.where(angle < 1e-4, 1 / 12, (1 - 0.5 * safe / np.tan(0.5 * safe)) / safe**2)
    return np.eye(3) + 0.5 * W + factor * (W @ W)
