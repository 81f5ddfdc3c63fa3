"""Online learning of the colour field (Sec. IV-B): jump start, least-trained keyframe first.

Work per keyframe is a fixed number of iterations, never a time limit, so the result depends only on the
input and the seed.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sf_interfaces.types import Float32, UInt8
from sf_recon.core.color_field import ColorField, Neighbourhood
from sf_recon.core.native import native

BETAS = (0.9, 0.99)
EPSILON = 1e-15
JUMP_FACTOR = 10.0


class RowAdam:
    """Adam over the rows of a growing table, which steps only the rows that were touched.

    Each row counts its own steps, so a point placed late gets the same bias correction as an early one.
    """

    def __init__(self, columns: int) -> None:
        self.mean = torch.zeros(0, columns)
        self.square = torch.zeros(0, columns)
        self.steps = torch.zeros(0)
        self._gradient = torch.zeros(0, columns)
        self._marks = torch.zeros(0, dtype=torch.uint8)

    def grow(self, rows: int) -> None:
        """Extend to a table of ``rows``; the moments of the old rows stay."""
        new = rows - len(self.steps)
        self.mean = torch.nn.functional.pad(self.mean, (0, 0, 0, new))
        self.square = torch.nn.functional.pad(self.square, (0, 0, 0, new))
        self.steps = torch.nn.functional.pad(self.steps, (0, new))
        self._gradient = torch.zeros_like(self.mean)
        self._marks = torch.zeros(rows, dtype=torch.uint8)

    def step(self, table: Tensor, near: Neighbourhood, gradient: Tensor, rate: float) -> None:
        """Move the rows that were interpolated, given the loss gradient [N, C] of the interpolated values."""
        touched = native().accumulate_rows(
            near.ids.numpy(),
            near.weights.numpy(),
            gradient.contiguous().numpy(),
            self._gradient.numpy(),
            self._marks.numpy(),
        )
        rows = torch.from_numpy(touched)
        g = self._gradient[rows]
        self._gradient[rows] = 0.0
        mean = torch.lerp(g, self.mean[rows], BETAS[0])
        square = torch.lerp(g * g, self.square[rows], BETAS[1])
        steps = self.steps[rows] + 1
        self.mean[rows], self.square[rows], self.steps[rows] = mean, square, steps
        correct_mean = (1 - BETAS[0] ** steps)[:, None]
        correct_square = (1 - BETAS[1] ** steps)[:, None]
        table[rows] -= rate * (mean / correct_mean) / ((square / correct_square).sqrt() + EPSILON)


@dataclass(slots=True)
class TrainingView:
    """The pixels of one keyframe that are kept for training, 17 bytes each."""

    points: Float32  # [M, 3] m, map frame
    colors: UInt8  # [M, 3]
    weights: NDArray[np.float16]  # [M] confidence, mean 1
    turns: int = 0


class Trainer:
    """Optimises the field on all keyframes seen so far."""

    def __init__(
        self,
        field: ColorField,
        *,
        pixels: int,
        feature_rate: float,
        network_rate: float,
        jump_iterations: int,
        rng: np.random.Generator,
    ) -> None:
        self.field, self.pixels, self._rng = field, pixels, rng
        self.feature_rate, self.jump_iterations = feature_rate, jump_iterations
        self.network_rate = network_rate
        self.views: list[TrainingView] = []
        self.iteration = 0
        self.losses: list[float] = []
        self._rows = [RowAdam(f.shape[1]) for f in field.features]
        self._network = torch.optim.Adam(field.network.parameters(), lr=network_rate, betas=BETAS, eps=EPSILON)

    def add(self, view: TrainingView) -> None:
        """Take a new keyframe into the rotation."""
        if len(view.points):
            self.views.append(view)

    def run(self, iterations: int) -> list[float]:
        """Train; returns the loss of these iterations (mean squared error of RGB in 0..1)."""
        for adam, features in zip(self._rows, self.field.features, strict=True):
            adam.grow(len(features))
        new = [self._iterate() for _ in range(iterations if self.views else 0)]
        self.losses += new
        return new

    def _iterate(self) -> float:
        view = min(self.views, key=lambda v: v.turns)  # least trained first; ties: the oldest
        view.turns += 1
        factor = JUMP_FACTOR if self.iteration < self.jump_iterations else 1.0
        self.iteration += 1
        # Sorted: neighbouring pixels ask for the same grid cells one after another.
        pick = np.sort(self._rng.integers(0, len(view.points), self.pixels))
        near = self.field.neighbourhoods(view.points[pick])
        encoded = self.field.encode(near).requires_grad_(True)
        error = self.field.decode(encoded, near) - torch.from_numpy(view.colors[pick]) / 255
        loss = (torch.from_numpy(view.weights[pick]).float()[:, None] * error.square()).mean()
        self._network.zero_grad()
        # Adam does not see the scale of a loss; the sum keeps small gradients out of the denormal range.
        (loss * self.pixels).backward()  # type: ignore[no-untyped-call]
        for group in self._network.param_groups:
            group["lr"] = factor * self.network_rate
        self._network.step()
        assert encoded.grad is not None
        gradients = torch.split(encoded.grad, [f.shape[1] for f in self.field.features], dim=1)
        for adam, table, n, gradient in zip(self._rows, self.field.features, near, gradients, strict=True):
            adam.step(table, n, gradient, factor * self.feature_rate)
        return float(loss.detach())
