"""What the compiled plane sweep computes, in numpy; the tests hold one against the other."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import cv2
import numpy as np
from scipy.ndimage import map_coordinates

from sf_depth.core import pinhole
from sf_depth.core.plane_sweep import BEND, BREAK, EDGE, MIN_Z, NOISE, UNSEEN, WINDOW, Compared
from sf_interfaces.types import Float32


def dissimilarity(compared: Compared, d: float) -> Float32:
    """1 - correlation with the two sources most alike, if the scene were at inverse depth d, [h, w]."""
    geometry = zip(compared.others, compared.rotated, compared.t, strict=True)
    costs = np.sort([_against(compared, other, X + t[:, None] * d) for other, X, t in geometry], axis=0)
    return np.asarray(costs[:2].mean(axis=0))


def _against(compared: Compared, other: Float32, X: Float32) -> Float32:
    """1 - normalised correlation with one source, of whose points X [3, N] the reference would be made."""
    height, width = other.shape
    uv = pinhole.project(compared.theta, X[:2] / np.maximum(X[2], MIN_Z)) / compared.zoom[:, None] - 0.5
    u, v = uv.reshape(2, height, width)
    b = map_coordinates(other, [v, u], order=1, mode="nearest")
    mean = cv2.blur(b, WINDOW)
    variance = np.maximum(cv2.blur(b * b, WINDOW) - mean * mean, 0.0) + NOISE
    alike = (cv2.blur(compared.first * b, WINDOW) - compared.mean * mean) * compared.scale / np.sqrt(variance)
    outside = (u < -0.5) | (u > width - 0.5) | (v < -0.5) | (v > height - 0.5)
    outside |= X[2].reshape(other.shape) < MIN_Z
    return np.where(outside, UNSEEN, 1.0 - alike)


def best_paths(cost: Float32, image: Float32, upright: bool) -> Float32:
    """Cost [h, w, D] of the best paths along the columns or the rows that end in a pixel on a plane, both ways."""
    if not upright:
        return best_paths(cost.transpose(1, 0, 2), image.T, True).transpose(1, 0, 2)
    return _path(cost, image) + _path(cost[::-1], image[::-1])[::-1]


def _path(cost: Float32, image: Float32) -> Float32:
    """Cost [n, m, D] of the best path along the first axis that ends in a pixel on a plane."""
    total = np.empty_like(cost)
    total[0] = cost[0]
    padded = np.full((cost.shape[1], cost.shape[2] + 2), np.inf)
    for i in range(1, len(cost)):
        padded[:, 1:-1] = total[i - 1]
        least = total[i - 1].min(axis=1, keepdims=True)
        jump = np.maximum(BREAK / (1.0 + np.abs(image[i] - image[i - 1]) / EDGE), BEND)[:, None]
        near = np.minimum(padded[:, :-2], padded[:, 2:]) + BEND
        total[i] = cost[i] + np.minimum(np.minimum(near, total[i - 1]), least + jump) - least
    return total
