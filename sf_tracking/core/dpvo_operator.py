"""The DPVO network as update operator: learned corrections and confidences instead of patch alignment."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from sf_interfaces.types import Float64, UInt8
from sf_tracking.config import TrackingConfig
from sf_tracking.core.dpvo import DIM, PATCH, DPVONetwork, correlate
from sf_tracking.core.update import PatchAlignment, Update, View

_QUARTER = 4.0  # px of the image per px of the features
_FEATURE_SCALE = 4.0  # by which both feature maps are divided
_ROUNDS = 3  # recurrent steps per call
_SIGMA_PX = 0.5  # of a correction with weight 1
_MIN_WEIGHT = 0.05


@dataclass(frozen=True, slots=True)
class LearnedView(View):
    """An image with its features at quarter resolution."""

    features: Tensor  # [1, 128, h, w] for matching
    context: Tensor  # [1, 384, h, w]


@dataclass(frozen=True, slots=True)
class LearnedPatches:
    """What the network keeps of M patches."""

    features: Tensor  # [M, 128, 3, 3]
    context: Tensor  # [M, 384]

    def take(self, index: NDArray[np.int64]) -> LearnedPatches:
        """The patches at ``index``."""
        return LearnedPatches(self.features[index], self.context[index])


class DPVOOperator:
    """Recurrent corrections of one keyframe's patches in one image.

    The hidden state begins at zero with each call and lives for its rounds: bundle adjustment sees settled
    corrections, as with patch alignment, and the result does not depend on what was asked before.
    """

    def __init__(self, config: TrackingConfig, network: DPVONetwork | None = None) -> None:
        self._network = network or DPVONetwork.load(Path(config.checkpoint))
        self._aligner = PatchAlignment(config)

    @torch.no_grad()
    def view(self, image: UInt8) -> LearnedView:
        """Features of an RGB [H, W, 3] or mono image; the network was trained on BGR in -0.5..1.5."""
        plain = self._aligner.view(image)
        bgr = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR if image.ndim == 2 else cv2.COLOR_RGB2BGR)
        x = 2 * (torch.from_numpy(np.ascontiguousarray(bgr)).permute(2, 0, 1)[None].float() / 255) - 0.5
        patchify = self._network.patchify
        features, context = patchify.fnet(x) / _FEATURE_SCALE, patchify.inet(x) / _FEATURE_SCALE
        return LearnedView(plain.gray, plain.fine, features, context)

    @torch.no_grad()
    def describe(self, view: LearnedView, uv: Float64) -> LearnedPatches:
        """Features of the patches at ``uv`` [M, 2] px."""
        centre = torch.from_numpy(uv / _QUARTER - 0.5).float()
        features = _sample(view.features, centre[:, None] + _grid())
        return LearnedPatches(
            features.reshape(*features.shape[:2], PATCH, PATCH), _sample(view.context, centre[:, None])[..., 0]
        )

    @torch.no_grad()
    def __call__(self, patches: LearnedPatches, target: LearnedView, start: Float64, warp: Float64) -> Update:
        """See :class:`UpdateOperator`."""
        count = len(start)
        if count == 0:
            return Update(np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0, dtype=bool))
        centre = torch.from_numpy(start / _QUARTER - 0.5).float()
        spread = _grid() @ torch.from_numpy(warp).float().transpose(1, 2)  # [E, 9, 2]
        hidden, weight = torch.zeros(count, DIM), torch.zeros(count, 2)
        patch, frame = torch.arange(count), torch.zeros(count, dtype=torch.int64)
        for _ in range(_ROUNDS):
            corr = correlate(patches.features, target.features, (centre[:, None] + spread).reshape(-1, PATCH, PATCH, 2))
            hidden, correction, weight = self._network.update(hidden, patches.context, corr, patch, frame, frame + 1)
            centre = centre + correction
        found = (centre.double().numpy() + 0.5) * _QUARTER
        height, width = target.gray.shape
        ok = (found >= 0).all(axis=1) & (found < (width, height)).all(axis=1)
        sure = weight.double().numpy()
        information = sure[:, :, None] * np.eye(2) / _SIGMA_PX**2 + 1e-9 * np.eye(2)
        return Update(found, information, ok & (sure.max(axis=1) > _MIN_WEIGHT))


def _grid() -> Tensor:
    """Offsets of the patch pixels, [9, 2] as (x, y), rows first."""
    span = torch.arange(PATCH, dtype=torch.float32) - PATCH // 2
    rows, columns = torch.meshgrid(span, span, indexing="ij")
    return torch.stack([columns.flatten(), rows.flatten()], dim=-1)


def _sample(features: Tensor, at: Tensor) -> Tensor:
    """Bilinear samples [M, C, K] of features [1, C, h, w] at (x, y) [M, K, 2], pixel centres at integers."""
    size = torch.tensor([features.shape[3], features.shape[2]], dtype=torch.float32)
    grid = ((2 * at + 1) / size - 1)[None]
    return functional.grid_sample(features, grid, align_corners=False, padding_mode="border")[0].permute(1, 0, 2)
