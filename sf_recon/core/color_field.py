"""The colour of a surface point: interpolated features of all levels, decoded by a small network.

Sec. IV-A-2 (encoding) and IV-A-3 (colour prediction). Features live outside the network because only
the rows near the training pixels are touched in an iteration.

The first three features of a point are a colour (as logit) to which the network adds: they start at the colour
observed where the point was placed, and the network's last layer starts at zero. A new keyframe therefore shows
its colours before any training; this is the jump start taken to its end.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from sf_interfaces.types import Float32, Float64
from sf_recon.config import ReconConfig
from sf_recon.core.device import DeviceGrid, torch_device
from sf_recon.core.kernels import ColorNetwork, FieldLevel, decode_colors
from sf_recon.core.neural_points import SEARCH_RADIUS, Added, NeuralPoints

INITIAL_FEATURE = 0.5
HARMONICS = 8  # real spherical harmonics of degrees 1 and 2, up to constants
_BATCH = 1 << 19  # queries that a GPU decodes at once
_MARGIN = 0.02  # keeps the logit of a black or white colour finite


@dataclass(frozen=True, slots=True)
class Neighbourhood:
    """Interpolation of one level: rows ids [N, K] with weights [N, K] that sum to 1 (or all 0: none near)."""

    ids: Tensor
    weights: Tensor


def gaussian_weights(distance2: Tensor, sigma: float) -> Tensor:
    """Normalised exp(-d2 / sigma) along the last axis; rows without any neighbour (all inf) give zeros.

    The nearest distance is subtracted first: it cancels in the quotient and prevents 0 / 0.
    """
    nearest = distance2[..., :1].nan_to_num(posinf=0.0)
    w = torch.exp((nearest - distance2) / sigma)
    return w / w.sum(dim=-1, keepdim=True).clamp(min=1e-12)


def harmonics(directions: Tensor) -> Tensor:
    """The view code [N, 8] of unit directions [N, 3]; the zero vector gives zeros: the colour from no side."""
    x, y, z = directions.unbind(dim=1)
    return torch.stack([x, y, z, x * y, y * z, x * z, x * x - y * y, 2 * z * z - x * x - y * y], dim=1)


class ColorField(torch.nn.Module):
    """Features of every neural point and the network that turns them into RGB in 0..1."""

    def __init__(self, points: NeuralPoints, config: ReconConfig) -> None:
        super().__init__()
        self.points, self.device = points, torch_device(config.device)
        self._grids = [DeviceGrid(level, self.device) for level in points.levels] if self.device.type == "cuda" else []
        self.neighbours, self.sigma, self.threads = config.neighbours, config.sigma, config.threads
        self.view_directions = config.view_directions
        self.features = [torch.zeros(0, config.features, device=self.device) for _ in points.levels]
        inputs = config.features * len(points.levels) + HARMONICS * config.view_directions
        sizes, generator = [inputs, config.hidden, config.hidden, 3], torch.Generator().manual_seed(config.seed)
        layers: list[torch.nn.Module] = []
        for size, outputs in pairwise(sizes):
            linear = torch.nn.Linear(size, outputs)
            torch.nn.init.xavier_uniform_(linear.weight, generator=generator)
            torch.nn.init.zeros_(linear.bias)
            layers += [linear, torch.nn.ReLU()]
        self.network = torch.nn.Sequential(*layers[:-1])
        torch.nn.init.zeros_(layers[-2].weight)  # type: ignore[arg-type]
        self.network.to(self.device)

    def grow(self, added: list[Added]) -> None:
        """New points start with their observed colour; the rest is their nearest older point's, or the initial one."""
        for level, new in enumerate(added):
            old = self.features[level]
            rows = torch.full((len(new.points), old.shape[1]), INITIAL_FEATURE, device=self.device)
            parents = self.sent(new.parents).long()
            copied = parents >= 0
            rows[copied] = old[parents[copied]]
            rows[:, :3] = torch.logit(self.sent(new.colors), eps=_MARGIN)
            self.features[level] = torch.cat([old, rows])

    def keep(self, kept: list[np.ndarray]) -> None:
        """Keep only the rows of a mask for each level."""
        self.features = [f[self.sent(m)] for f, m in zip(self.features, kept, strict=True)]

    def sent(self, array: np.ndarray) -> Tensor:
        """The array on the device of the field; on the CPU it shares the memory."""
        return torch.from_numpy(array).to(self.device)

    def neighbourhoods(self, queries: Float32) -> list[Neighbourhood]:
        """Nearest points and their weights on each level for queries [N, 3] m, map frame."""
        found = []
        places = self.sent(queries) if self._grids else None
        for index, level in enumerate(self.points.levels):
            if places is not None:
                ids, d2 = self._grids[index].nearest(places, self.neighbours)
            else:
                ids, d2 = map(torch.from_numpy, level.nearest(queries, self.neighbours, self.threads))
            weights = gaussian_weights(d2, self.sigma * level.spacing**2)
            found.append(Neighbourhood(ids.clamp(min=0), weights))
        return found

    def encode(self, near: list[Neighbourhood]) -> Tensor:
        """Interpolated features of all levels, [N, levels * features]."""
        parts = []
        for features, n in zip(self.features, near, strict=True):
            if len(features) == 0:
                parts.append(torch.zeros(len(n.ids), features.shape[1], device=self.device))
            else:
                parts.append(_interpolate(features, n))
        return torch.cat(parts, dim=1)

    def decode(
        self, encoded: Tensor, near: list[Neighbourhood], directions: Float32 | None = None, level: int | None = None
    ) -> Tensor:
        """RGB [N, 3] in 0..1 of encoded points [N, levels * features] seen along unit directions [N, 3].

        The network adds to the colour features of ``level``; None: of the finest level that has a point near.
        """
        inputs = encoded
        if self.view_directions:
            code = torch.zeros(len(encoded), HARMONICS, device=self.device)
            if directions is not None:
                code = harmonics(self.sent(directions))
            inputs = torch.cat([encoded, code], dim=1)
        width = self.features[0].shape[1]
        colors = [encoded[:, at * width : at * width + 3] for at in range(len(near))]
        base = self._base(colors, near) if level is None else colors[level]
        return torch.sigmoid(self.network(inputs) + base)

    def _base(self, colors: list[Tensor], near: list[Neighbourhood]) -> Tensor:
        """Of the colour features [N, 3] of all levels those of the finest one that has a point near."""
        base = torch.zeros_like(colors[0])
        for color, n in zip(reversed(colors), reversed(near), strict=True):
            base = base + (n.weights[:, :1] > 0).to(base.dtype) * (color - base)
        return base

    def color(self, queries: Float32, eye: Float64 | None = None, level: int = 0) -> Float32:
        """RGB [N, 3] in 0..1 of surface points [N, 3] m, map frame: by the compiled decoder, or by torch on a GPU.

        Args:
            queries: points, best in an order in which neighbours follow one another.
            eye: camera centre [3] m they are seen from; None: from no side.
            level: the finest level that has points near the queries.
        """
        if len(queries) == 0:
            return np.zeros((0, 3), np.float32)
        if self._grids:
            return np.concatenate(
                [self.color_by_torch(q, eye, level) for q in np.array_split(queries, _parts(queries))]
            )
        levels = [
            FieldLevel(near.grid, table.numpy(), SEARCH_RADIUS * near.spacing, self.sigma * near.spacing**2)
            for near, table in zip(self.points.levels, self.features, strict=True)
        ]
        degree = 2 if self.view_directions and eye is not None else 0
        network = ColorNetwork(self._layers(level, degree > 0), self.neighbours, degree)
        return decode_colors(queries, levels, network, eye if degree else None, threads=self.threads)

    @torch.no_grad()
    def color_by_torch(self, queries: Float32, eye: Float64 | None, level: int) -> Float32:
        """:meth:`color` in the operations of training."""
        directions = None
        if eye is not None:
            rays = queries - eye.astype(np.float32)
            directions = rays / np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
        near = self.neighbourhoods(queries)
        colors: Float32 = self.decode(self.encode(near), near, directions, level).cpu().numpy()
        return colors

    def _layers(self, level: int, sided: bool) -> list[tuple[Float32, Float32]]:
        """The network with the colour features led past it: x = relu(x) - relu(-x), through two more units each."""
        linear = [(m.weight.detach().numpy(), m.bias.detach().numpy()) for m in self.network[::2]]  # type: ignore[union-attr]
        columns = self.features[0].shape[1] * len(self.features)
        first = linear[0][0] if sided or not self.view_directions else linear[0][0][:, :columns]
        both = np.concatenate([np.eye(3), -np.eye(3)]).astype(np.float32)  # [6, 3]
        led = np.zeros((6, first.shape[1]), np.float32)
        start = level * self.features[0].shape[1]
        led[:, start : start + 3] = both
        out = [(np.concatenate([first, led]), np.concatenate([linear[0][1], np.zeros(6, np.float32)]))]
        for weight, bias in linear[1:-1]:
            wide = np.zeros((len(weight) + 6, weight.shape[1] + 6), np.float32)
            wide[: len(weight), : weight.shape[1]] = weight
            wide[len(weight) :, weight.shape[1] :] = np.eye(6)
            out.append((wide, np.concatenate([bias, np.zeros(6, np.float32)])))
        out.append((np.concatenate([linear[-1][0], both.T], axis=1), linear[-1][1]))
        return [(np.ascontiguousarray(w), np.ascontiguousarray(b)) for w, b in out]


def _parts(queries: Float32) -> int:
    """Into how many parts queries are cut, so that what lies between the layers stays small."""
    return -(-len(queries) // _BATCH)


def _interpolate(rows: Tensor, near: Neighbourhood) -> Tensor:
    """Weighted sum of the neighbours' rows, [N, C]."""
    return torch.nn.functional.embedding_bag(near.ids, rows, per_sample_weights=near.weights, mode="sum")
