"""The pose graph: keyframes that agree best with all relative poses measured between them.

scipy.sparse solves it: the normal equations are a band with a few loops, which its LU factors in
milliseconds, and SciPy is there already.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from sf_interfaces.types import Float64
from sf_tracking.core import sim3

_OUTLIER = 4.0  # deviations from which on a loop is taken for false
_GRADUATION = 3.0  # factor by which the robust kernel narrows per step
_STEPS = 40
_STILL = 1e-5  # of a step, beyond which nothing changes any more
_DAMPING = 1e-9


@dataclass(frozen=True, slots=True)
class Edges:
    """Measured relative poses Z = S_i^-1 S_j with their deviations (m, rad, log of scale).

    Args:
        i, j: [E] indices of keyframes; Z: [E, 4, 4] similarities; sigma: [E, 7] deviations.
        loop: [E] closes a loop, so that it may be false; the others are never doubted.
    """

    i: NDArray[np.int64]
    j: NDArray[np.int64]
    Z: Float64
    sigma: Float64
    loop: NDArray[np.bool_]

    def residuals(self, S: Float64) -> tuple[Float64, Float64, Float64]:
        """Weighted errors [E, 7] and their derivatives by S_i and S_j, [E, 7, 7] each."""
        between = sim3.inverse(S[self.i]) @ S[self.j]
        r, J_j = sim3.coordinates(sim3.inverse(self.Z) @ between)
        J_i = -J_j @ sim3.adjoint(sim3.inverse(between))
        return r / self.sigma, J_i / self.sigma[..., None], J_j / self.sigma[..., None]


def optimise(S: Float64, edges: Edges, *, with_scale: bool) -> tuple[Float64, Float64]:
    """Keyframes S [N, 4, 4] that fit the edges best; the first one stays where it is.

    Gauss-Newton with a Geman-McClure kernel on the loops that starts convex and narrows step by step
    (graduated non-convexity): a true loop that asks for metres is believed, a false one that contradicts
    the others is not.

    Returns:
        The keyframes and the weight of each edge, 1 where it is believed and 0 where it is not.
    """
    free = 7 if with_scale else 6
    width, weight = np.inf, np.ones(len(edges.i))
    for _ in range(_STEPS):
        r, J_i, J_j = edges.residuals(S)
        error = np.where(edges.loop, (r**2).sum(axis=1), 0.0) / _OUTLIER**2
        width = max(1.0, min(width / _GRADUATION, 2 * float(error.max(initial=0.0))))
        weight = (width / (error + width)) ** 2
        step = _solve(len(S), edges, r[:, :free], J_i[:, :free, :free], J_j[:, :free, :free], weight)
        S = sim3.moved(S, np.pad(step, ((0, 0), (0, 7 - free))))
        if width == 1.0 and np.abs(step).max() < _STILL:
            break
    return S, weight


def _solve(n: int, edges: Edges, r: Float64, J_i: Float64, J_j: Float64, weight: Float64) -> Float64:
    """The step [N, free] of weighted normal equations in which the first keyframe is held."""
    free = r.shape[1]
    rows, columns, blocks = [], [], []
    g = np.zeros((n, free))
    for a, J_a in ((edges.i, J_i), (edges.j, J_j)):
        weighted = np.swapaxes(J_a, 1, 2) * weight[:, None, None]
        np.add.at(g, a, (weighted @ r[..., None])[..., 0])
        for b, J_b in ((edges.i, J_i), (edges.j, J_j)):
            rows.append(np.broadcast_to((free * a)[:, None, None] + np.arange(free)[:, None], (len(a), free, free)))
            columns.append(np.broadcast_to((free * b)[:, None, None] + np.arange(free), (len(a), free, free)))
            blocks.append(weighted @ J_b)
    at = np.concatenate(rows).ravel(), np.concatenate(columns).ravel()
    H = sparse.csc_matrix((np.concatenate(blocks).ravel(), at), shape=(free * n, free * n))[free:, free:]
    H = H + sparse.diags(_DAMPING * H.diagonal(), format="csc")
    step = np.zeros((n, free))
    step[1:] = splu(H).solve(-g[1:].ravel()).reshape(-1, free)
    return step
