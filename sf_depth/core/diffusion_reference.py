"""What the compiled kernel of diffusion computes, in NumPy and SciPy: the definition of ``settle``."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.linalg import spsolve_triangular

from sf_interfaces.types import Float32, Float64


def system(right: Float32, down: Float32, ground: Float32) -> csr_array:
    """A [H W, H W]: the sum of the conductances of a pixel, less that of the link to each neighbour."""
    height, width = ground.shape
    at = np.arange(height * width).reshape(height, width)
    first = np.concatenate([at[:, :-1].ravel(), at[:-1].ravel()])
    second = np.concatenate([at[:, 1:].ravel(), at[1:].ravel()])
    w = np.concatenate([right[:, :-1].ravel(), down[:-1].ravel()]).astype(np.float64)
    total = ground.ravel() + np.bincount(first, w, at.size) + np.bincount(second, w, at.size)
    rows, columns = np.concatenate([first, second, at.ravel()]), np.concatenate([second, first, at.ravel()])
    return coo_array((np.concatenate([-w, -w, total]), (rows, columns)), shape=(at.size, at.size)).tocsr()


def settle(values: Float32, inflow: Float32, right: Float32, down: Float32, ground: Float32, steps: int) -> Float64:
    """Values [H, W, C] after so many steps of conjugate gradients; see ``diffusion.hpp``."""
    whole = system(right, down, ground)
    linked = np.flatnonzero(whole.diagonal() > 0)
    A = whole[linked][:, linked]
    lower, pivot = _factors(A)
    out = values.reshape(-1, values.shape[2]).astype(np.float64)
    for channel in range(values.shape[2]):
        x, b = out[linked, channel], inflow.reshape(-1, values.shape[2])[linked, channel].astype(np.float64)
        r = b - A @ x
        z = _preconditioned(lower, pivot, r)
        p, rz = z, r @ z
        for _ in range(steps):
            Ap = A @ p
            alpha = rz / (p @ Ap) if p @ Ap > 0 else 0.0
            x, r = x + alpha * p, r - alpha * Ap
            z = _preconditioned(lower, pivot, r)
            p, rz = z + (r @ z / rz if rz > 0 else 0.0) * p, r @ z
        out[linked, channel] = x
    return out.reshape(values.shape)


def _factors(A: csr_array) -> tuple[csr_array, Float64]:
    """Incomplete Cholesky factors (lower, diagonal pivots): M = lower diag(1 / pivot) lower^T."""
    pivot = A.diagonal().astype(np.float64)
    dense = A.tolil()
    for k in range(len(pivot)):
        for j in dense.rows[k]:
            if j < k:
                pivot[k] -= dense[k, j] ** 2 / pivot[j]
    lower = A.copy()
    lower.setdiag(pivot)
    keep = coo_array(lower)
    below = keep.coords[0] >= keep.coords[1]
    data = (keep.data[below], (keep.coords[0][below], keep.coords[1][below]))
    return csr_array(data, shape=A.shape), pivot


def _preconditioned(lower: csr_array, pivot: Float64, r: Float64) -> Float64:
    return np.asarray(spsolve_triangular(lower.T.tocsr(), pivot * spsolve_triangular(lower, r), lower=False))
