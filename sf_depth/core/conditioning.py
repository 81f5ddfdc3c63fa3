"""Which observations a tile of pixels is conditioned on, and the plane every observation lies on.

Observations are kept at several densities. A tile takes the nearest of every density and prefers those that no
nearer one screens off: behind a near observation, another in the same direction says little more.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from scipy.spatial import cKDTree

from sf_depth.core.parallel import each
from sf_interfaces.types import Float32, Float64

_CELLS = (1, 4, 16, 64)  # px; the densest kept observation per cell of each density
_SPARSER = 3  # a density is kept if it holds this many times fewer than the one before
_BORDER = 3  # px; of dense depth, only what lies this near a gap is kept at the highest density
_NEIGHBOURS = 12  # observations a plane is fitted to
_CANDIDATES = 16  # nearest observations of each density that a tile chooses from
_SECTORS = 16
_PLANE_TOLERANCE = 0.005  # relative deviation at which an observation counts a quarter for its neighbour's plane
_PLANE_ROUNDS = 6
_CHUNK = 8192  # observations a plane is fitted to at once
_RIDGE = 0.1  # px^2; keeps a slope that its neighbours do not determine at zero


@dataclass(frozen=True, slots=True)
class Observations:
    """Measured pixels at all densities, [N] each; a pixel may occur once per density.

    ``ratio`` is base / z: with a constant base it is linear in the pixel coordinates of a plane.
    """

    index: np.ndarray  # [N, 2] (row, col)
    x: torch.Tensor  # [N, 2] px (col, row)
    ratio: torch.Tensor  # [N] base / z
    noise: torch.Tensor  # [N] variance of log z from the sensor
    slope: torch.Tensor  # [N, 2] ratio per px
    spacing: torch.Tensor  # [N] px, distance of the neighbours the slope comes from
    near: torch.Tensor  # [N, M] its neighbours of the same density
    trees: tuple[cKDTree, ...]  # one per density
    first: tuple[int, ...]  # where each density begins

    @property
    def densest(self) -> int:
        """How many observations the highest density holds; they come first."""
        return self.first[1] if len(self.first) > 1 else len(self.ratio)


def observe(ratio: Float32, noise: Float32, measured: np.ndarray) -> Observations:
    """The observations of an image: ratio [H, W], noise [H, W] (variance of log z), measured [H, W] bool."""
    gap = cv2.dilate((~measured).astype(np.uint8), np.ones((2 * _BORDER + 1,) * 2, np.uint8)) > 0
    everywhere = np.argwhere(measured)
    indices, trees, nears, spacings, first = [], [], [], [], []
    for cell in _CELLS:
        index = np.argwhere(measured & gap) if cell == 1 else _thinned(measured, cell)
        if indices and len(index) <= _NEIGHBOURS:
            break
        if indices and _SPARSER * len(index) > len(indices[-1]) and cell > 1:
            continue
        if len(index) < 2:
            index = everywhere
        tree, near, spacing = _neighbours(index)
        first.append(sum(map(len, indices)))
        spacings.append(spacing)
        nears.append(np.pad(near, ((0, 0), (0, _NEIGHBOURS - near.shape[1])), mode="edge") + first[-1])
        indices.append(index)
        trees.append(tree)
    index = np.concatenate(indices)
    row, col = index.T
    x = torch.from_numpy(index[:, ::-1].astype(np.float32))
    near = torch.from_numpy(np.concatenate(nears))
    value = torch.from_numpy(np.ascontiguousarray(ratio[row, col]))
    apart = torch.from_numpy(np.concatenate(spacings))
    variance = torch.from_numpy(np.ascontiguousarray(noise[row, col]))
    slope = _slopes(x, value, near, apart)
    return Observations(index, x, value, variance, slope, apart, near, tuple(trees), tuple(first))


def _neighbours(index: np.ndarray) -> tuple[cKDTree, np.ndarray, Float32]:
    """Of pixels [N, 2] their tree, which others are nearest to each [N, M], and how far apart these lie [N] px."""
    tree, count = cKDTree(index), min(_NEIGHBOURS, len(index) - 1)
    distance, near = tree.query(index, k=count + 1, workers=-1)
    return tree, near[:, 1:], distance[:, min(6, count)].astype(np.float32)


def _thinned(measured: np.ndarray, cell: int) -> np.ndarray:
    """The measured pixel nearest to the centre of each cell, [M, 2] in the order of the image."""
    (height, width), side = measured.shape, np.arange(cell) - 0.5 * (cell - 1)
    rows, cols = -(-height // cell), -(-width // cell)
    padded = np.pad(measured, ((0, rows * cell - height), (0, cols * cell - width)))
    inside = padded.reshape(rows, cell, cols, cell).swapaxes(1, 2).reshape(rows, cols, cell * cell)
    off = (side[:, None] ** 2 + side**2).reshape(-1).astype(np.float32)
    row, col = np.nonzero(inside.any(axis=2))
    nearest = np.where(inside[row, col], off, np.float32(np.inf)).argmin(axis=1)
    row, col = row * cell + nearest // cell, col * cell + nearest % cell
    order = np.lexsort((col, row))
    return np.stack([row[order], col[order]], axis=1)


def _slopes(x: torch.Tensor, ratio: torch.Tensor, near: torch.Tensor, spacing: torch.Tensor) -> torch.Tensor:
    """Slopes of robust planes through all observations, [N, 2]."""
    parts = torch.arange(len(x)).split(_CHUNK)
    return torch.cat(each(lambda part: _slopes_at(x, ratio, near, spacing, part), parts))


def _slopes_at(
    x: torch.Tensor, ratio: torch.Tensor, near: torch.Tensor, spacing: torch.Tensor, part: torch.Tensor
) -> torch.Tensor:
    """Robust plane through some observations, [B, 2]: other surfaces among their neighbours are left out."""
    own, near, spacing = ratio[part, None], near[part], spacing[part]
    d = x[near] - x[part, None]  # [B, M, 2]
    rise = ratio[near] - own  # [B, M]
    dx, dy = d.unbind(dim=2)
    prior = 1.0 / (1.0 + (dx * dx + dy * dy) / spacing[:, None].clamp_min(1.0) ** 2)
    weight, tolerance = prior, _PLANE_TOLERANCE * own
    slope = torch.zeros_like(x[part])
    for _ in range(_PLANE_ROUNDS):
        wx, wy = weight * dx, weight * dy
        xx, xy, yy = (wx * dx).sum(1) + _RIDGE, (wx * dy).sum(1), (wy * dy).sum(1) + _RIDGE
        bx, by = (wx * rise).sum(1), (wy * rise).sum(1)
        det = xx * yy - xy * xy
        slope = torch.stack([yy * bx - xy * by, xx * by - xy * bx], dim=1) / det[:, None]
        off = (rise - slope[:, :1] * dx - slope[:, 1:] * dy) / tolerance
        weight = prior / (1.0 + off * off) ** 2
    return slope


def coarse_slopes(ratio: Float32, measured: np.ndarray, cell: int) -> tuple[np.ndarray, Float32]:
    """Slopes of ratio [H, W] at one measured pixel a cell: (row, col) [N, 2] and ratio per px [N, 2] (right, down)."""
    index = _thinned(measured, cell)
    if len(index) < 2:
        return index, np.zeros((len(index), 2), np.float32)
    _, near, spacing = _neighbours(index)
    x, value = torch.from_numpy(index[:, ::-1].astype(np.float32)), torch.from_numpy(ratio[tuple(index.T)])
    return index, _slopes(x, value, torch.from_numpy(near), torch.from_numpy(spacing)).numpy()


def choose(observed: Observations, center: Float64, count: int, excluded: Float64 | None = None) -> torch.Tensor:
    """The observations each tile is conditioned on, [B, count], the least screened first.

    Args:
        center: tile centres [B, 2] (row, col).
        excluded: [B] px; observations at most this far from the centre are left out (for held-out tests).
    """
    distances, chosen = [], []
    for tree, first in zip(observed.trees, observed.first, strict=True):
        wanted = min(_CANDIDATES if excluded is None else 3 * _CANDIDATES, tree.n)
        distance, near = tree.query(center, k=wanted, workers=-1)
        distances.append(distance.reshape(len(center), wanted))
        chosen.append(near.reshape(len(center), wanted) + first)
    d = torch.from_numpy(np.concatenate(distances, axis=1).astype(np.float32))
    ids = torch.from_numpy(np.concatenate(chosen, axis=1))
    d, order = torch.sort(d, dim=1, stable=True)
    ids = ids.gather(1, order)
    x = observed.x[ids]
    offset = x - torch.from_numpy(center[:, None, ::-1].astype(np.float32))
    same = torch.zeros_like(d, dtype=torch.bool)
    for step in range(1, len(observed.first) + 1):  # the same pixel at a lower density
        same[:, step:] |= (x[:, step:] == x[:, :-step]).all(dim=2)
    if excluded is not None:
        same |= d <= torch.from_numpy(excluded.astype(np.float32))[:, None]
    angle = torch.atan2(offset[..., 1], offset[..., 0]) / (2 * np.pi) + 0.5
    sector = (angle * _SECTORS + 0.5).long() % _SECTORS
    rank = torch.zeros_like(d)
    for s in range(_SECTORS):
        inside = (sector == s) & ~same
        rank += torch.where(inside, inside.cumsum(dim=1).to(d.dtype), 0.0)
    key = torch.where(same, torch.inf, (d + 0.5) * rank)
    best = torch.topk(key, min(count, d.shape[1]), dim=1, largest=False, sorted=True).indices
    return ids.gather(1, best)
