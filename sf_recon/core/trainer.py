"""Online learning of the colour field (Sec. IV-B): jump start, least-trained keyframe first.

Work per keyframe is a fixed number of iterations, never a time limit, so the result depends only on the
input and the seed.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from sf_recon.config import ReconConfig
from sf_recon.core.color_field import ColorField, Neighbourhood
from sf_recon.core.keyframe_view import KeyframeView
from sf_recon.core.native import native

BETAS = (0.9, 0.99)
EPSILON = 1e-3  # about the gradient of one grey level: smaller ones are noise, which Adam must not blow up
JUMP_FACTOR = 10.0
MOST_STEPS = 4096  # counted; from then on the bias corrections are 1
_HALF_LEAST, _HALF_MOST = 1e-7, 6e4  # of a moment, so that half precision holds it
BLIND = 4  # every so many pixels learns the colour seen from no side, which the exported surface shows


class RowAdam:
    """Adam over the rows of a growing table, lazy: a row that no training pixel touched rests, its moments too.

    Each row counts its own steps, so a point placed late gets the same bias correction as an early one. Moments
    are half precision (the second one as its root): 4 bytes per feature instead of 8. Where every row is touched
    every time this is Adam, up to the rounding of the moments.
    """

    def __init__(self, columns: int, device: torch.device | None = None) -> None:
        self.mean = torch.zeros(0, columns, dtype=torch.float16, device=device)
        self.root = torch.zeros(0, columns, dtype=torch.float16, device=device)
        self.steps = torch.zeros(0, dtype=torch.int16, device=device)

    def grow(self, rows: int) -> None:
        """Extend to a table of ``rows``; the moments of the old rows stay."""
        new = rows - len(self.steps)
        if new > 0:
            self.mean = torch.nn.functional.pad(self.mean, (0, 0, 0, new))
            self.root = torch.nn.functional.pad(self.root, (0, 0, 0, new))
            self.steps = torch.nn.functional.pad(self.steps, (0, new))

    def keep(self, kept: np.ndarray) -> None:
        """Keep only the rows of a mask."""
        mask = torch.from_numpy(kept).to(self.steps.device)
        self.mean, self.root, self.steps = self.mean[mask], self.root[mask], self.steps[mask]

    @property
    def nbytes(self) -> int:
        """Memory of the moments."""
        return self.mean.nbytes + self.root.nbytes + self.steps.nbytes

    def step(self, table: Tensor, near: Neighbourhood, gradient: Tensor, rate: float, threads: int = 0) -> None:
        """Move the rows that were interpolated, given the loss gradient [N, C] of the interpolated values."""
        if table.is_cuda:
            return self.step_by_torch(table, near, gradient, rate)
        return native().adam_rows(
            near.ids.numpy(),
            near.weights.numpy(),
            gradient.contiguous().numpy(),
            table.numpy(),
            self.mean.numpy().view(np.uint16),
            self.root.numpy().view(np.uint16),
            self.steps.numpy(),
            rate,
            *BETAS,
            EPSILON,
            threads,
        )

    def step_by_torch(self, table: Tensor, near: Neighbourhood, gradient: Tensor, rate: float) -> None:
        """The same on any device. A GPU sums in an order of its own, so that last bits differ from run to run."""
        used = near.weights > 0
        rows, number = near.ids[used].long().unique(return_inverse=True)
        parts = (near.weights[..., None] * gradient[:, None])[used]  # [M, C]
        g = torch.zeros(len(rows), parts.shape[1], device=parts.device).index_add_(0, number, parts)
        steps = (self.steps[rows] + 1).clamp(max=MOST_STEPS)
        t, (beta1, beta2) = steps[:, None].float(), BETAS
        mean = beta1 * self.mean[rows].float() + (1 - beta1) * g
        square = beta2 * self.root[rows].float().square() + (1 - beta2) * g.square()
        table[rows] -= rate / (1 - beta1**t) * mean / ((square / (1 - beta2**t)).sqrt() + EPSILON)
        self.steps[rows] = steps
        self.mean[rows] = mean.clamp(-_HALF_MOST, _HALF_MOST).half()
        self.root[rows] = square.sqrt().clamp(_HALF_LEAST, _HALF_MOST).half()


class Trainer:
    """Optimises the field on all keyframes seen so far."""

    def __init__(self, field: ColorField, config: ReconConfig, rng: np.random.Generator) -> None:
        self.field, self.config, self._rng = field, config, rng
        self.views: list[KeyframeView] = []
        self.iteration = 0
        self.losses: list[float] = []
        self.rows = [RowAdam(f.shape[1], field.device) for f in field.features]
        self._network = torch.optim.Adam(field.network.parameters(), lr=config.network_rate, betas=BETAS, eps=EPSILON)

    def add(self, view: KeyframeView) -> None:
        """Take a new keyframe into the rotation."""
        if view.z.any():
            self.views.append(view)

    def run(self, iterations: int) -> list[float]:
        """Train; returns the loss of these iterations (mean squared error of RGB in 0..1)."""
        new = [self.iterate()[1] for _ in range(iterations if self.views else 0)]
        self.losses += new
        return new

    def iterate(self) -> tuple[KeyframeView, float]:
        """One iteration on the least trained keyframe (ties: the oldest); that keyframe and its loss."""
        for adam, features in zip(self.rows, self.field.features, strict=True):
            adam.grow(len(features))
        view = min(self.views, key=lambda v: v.turns)
        view.turns += 1
        factor = JUMP_FACTOR if self.iteration < self.config.jump_iterations else 1.0
        self.iteration += 1
        samples = view.sample(self.config.pixels, self._rng)
        samples.directions[::BLIND] = 0.0
        near = self.field.neighbourhoods(samples.points)
        encoded = self.field.encode(near).requires_grad_(True)
        error = self.field.decode(encoded, near, samples.directions) - self.field.sent(samples.colors)
        loss = (self.field.sent(samples.weights)[:, None] * error.square()).mean()
        self._network.zero_grad()
        # Adam does not see the scale of a loss; the sum keeps small gradients out of the denormal range.
        (loss * self.config.pixels).backward()  # type: ignore[no-untyped-call]
        for group in self._network.param_groups:
            group["lr"] = factor * self.config.network_rate
        self._network.step()
        assert encoded.grad is not None
        gradients = torch.split(encoded.grad, [f.shape[1] for f in self.field.features], dim=1)
        for adam, table, n, gradient in zip(self.rows, self.field.features, near, gradients, strict=True):
            adam.step(table, n, gradient, factor * self.config.feature_rate, self.field.threads)
        return view, float(loss.detach())
