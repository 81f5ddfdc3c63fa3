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
from sf_recon.core.kernels import ColorNetwork, FieldLevel, decode_colors
from sf_recon.core.neural_points import SEARCH_RADIUS, Added, NeuralPoints

INITIAL_FEATURE = 0.5
HARMONICS = 8  # real spherical harmonics of degrees 1 and 2, up to constants
_MARGIN = 0.02  # keeps the logit of a black or white colour finite


@dataclass(frozen=True, slots=True)
class Neighbourhood:
    """Interpolation of one level: rows ids [N, K] with weights [N, K] that sum to 1 (or all 0: none near)."""

    ids: Tensor
    weights: Tensor


def gaussian_weights(distance2: Float32, sigma: float) -> Float32:
    """Normalised exp(-d2 / sigma) along the last axis; rows without any neighbour (all inf) give zeros.

    The nearest distance is subtracted first: it cancels in the quotient and prevents 0 / 0.
    """
    nearest = distance2[..., :1]
    shifted = np.where(np.isfinite(distance2), distance2 - np.where(np.isfinite(nearest), nearest, 0), np.inf)
    w = np.exp(-shifted / np.float32(sigma))
    normalised: Float32 = (w / np.maximum(w.sum(axis=-1, keepdims=True), 1e-12)).astype(np.float32)
    return normalised


def harmonics(directions: Float32) -> Tensor:
    """The view code [N, 8] of unit directions [N, 3]; the zero vector gives zeros: the colour from no side."""
    x, y, z = torch.from_numpy(np.ascontiguousarray(directions.T, dtype=np.float32))
    return torch.stack([x, y, z, x * y, y * z, x * z, x * x - y * y, 2 * z * z - x * x - y * y], dim=1)


class ColorField(torch.nn.Module):
    """Features of every neural point and the network that turns them into RGB in 0..1."""

    def __init__(
        self,
        points: NeuralPoints,
        *,
        features: int,
        hidden: int,
        neighbours: int,
        sigma: float,
        view_directions: bool,
        threads: int,
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        self.points = points
        self.neighbours, self.sigma, self.threads = neighbours, sigma, threads
        self.view_directions = view_directions
        self.features = [torch.zeros(0, features) for _ in points.levels]
        sizes = [features * len(points.levels) + HARMONICS * view_directions, hidden, hidden, 3]
        layers: list[torch.nn.Module] = []
        for inputs, outputs in pairwise(sizes):
            linear = torch.nn.Linear(inputs, outputs)
            torch.nn.init.xavier_uniform_(linear.weight, generator=generator)
            torch.nn.init.zeros_(linear.bias)
            layers += [linear, torch.nn.ReLU()]
        self.network = torch.nn.Sequential(*layers[:-1])
        torch.nn.init.zeros_(layers[-2].weight)  # type: ignore[arg-type]

    def grow(self, added: list[Added]) -> None:
        """New points start with their observed colour; the rest is their nearest older point's, or the initial one."""
        for level, new in enumerate(added):
            old = self.features[level]
            rows = torch.full((len(new.points), old.shape[1]), INITIAL_FEATURE)
            copied = torch.from_numpy(new.parents >= 0)
            rows[copied] = old[torch.from_numpy(new.parents).long()[copied]]
            rows[:, :3] = torch.logit(torch.from_numpy(new.colors), eps=_MARGIN)
            self.features[level] = torch.cat([old, rows])

    def keep(self, kept: list[np.ndarray]) -> None:
        """Keep only the rows of a mask for each level."""
        self.features = [f[torch.from_numpy(m)] for f, m in zip(self.features, kept, strict=True)]

    def neighbourhoods(self, queries: Float32) -> list[Neighbourhood]:
        """Nearest points and their weights on each level for queries [N, 3] m, map frame."""
        found = []
        for level in self.points.levels:
            ids, d2 = level.nearest(queries, self.neighbours, self.threads)
            weights = gaussian_weights(d2, self.sigma * level.spacing**2)
            found.append(Neighbourhood(torch.from_numpy(np.maximum(ids, 0)), torch.from_numpy(weights)))
        return found

    def encode(self, near: list[Neighbourhood]) -> Tensor:
        """Interpolated features of all levels, [N, levels * features]."""
        parts = []
        for features, n in zip(self.features, near, strict=True):
            if len(features) == 0:
                parts.append(torch.zeros(len(n.ids), features.shape[1]))
            else:
                parts.append(_interpolate(features, n))
        return torch.cat(parts, dim=1)

    def decode(self, encoded: Tensor, near: list[Neighbourhood], directions: Float32 | None = None) -> Tensor:
        """RGB [N, 3] in 0..1 of encoded points [N, levels * features] seen along unit directions [N, 3]."""
        inputs = encoded
        if self.view_directions:
            code = torch.zeros(len(encoded), HARMONICS) if directions is None else harmonics(directions)
            inputs = torch.cat([encoded, code], dim=1)
        return torch.sigmoid(self.network(inputs) + self._base(encoded, near))

    def _base(self, encoded: Tensor, near: list[Neighbourhood]) -> Tensor:
        """The colour features [N, 3] of the finest level that has a point near."""
        width = self.features[0].shape[1]
        base = torch.zeros(len(encoded), 3)
        for level in reversed(range(len(near))):
            has = (near[level].weights[:, :1] > 0).to(base.dtype)
            base = base + has * (encoded[:, level * width : level * width + 3] - base)
        return base

    def color(self, queries: Float32, eye: Float64 | None = None, level: int = 0) -> Float32:
        """RGB [N, 3] in 0..1 of surface points [N, 3] m, map frame, by the compiled decoder.

        Args:
            queries: points, best in an order in which neighbours follow one another.
            eye: camera centre [3] m they are seen from; None: from no side.
            level: the finest level that has points near the queries.
        """
        if len(queries) == 0:
            return np.zeros((0, 3), np.float32)
        levels = [
            FieldLevel(near.grid, table.numpy(), SEARCH_RADIUS * near.spacing, self.sigma * near.spacing**2)
            for near, table in zip(self.points.levels, self.features, strict=True)
        ]
        degree = 2 if self.view_directions and eye is not None else 0
        network = ColorNetwork(self._layers(level, degree > 0), self.neighbours, degree)
        return decode_colors(queries, levels, network, eye if degree else None, threads=self.threads)

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


def _interpolate(rows: Tensor, near: Neighbourhood) -> Tensor:
    """Weighted sum of the neighbours' rows, [N, C]."""
    return torch.nn.functional.embedding_bag(near.ids, rows, per_sample_weights=near.weights, mode="sum")
