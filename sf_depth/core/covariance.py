"""The covariance function of depth completion (paper Sec. ScaleCov): a non-stationary Matern kernel.

A model gives every pixel a 2x2 covariance E, the shape of its neighbourhood, and a feature. The default needs
no training: correlation shortens across image edges, and colours that differ do not belong together.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
import torch

from sf_depth.config import DepthConfig
from sf_interfaces.types import UInt8

_JITTER = 1e-8  # under the root, so that the kernel is smooth at zero distance


@dataclass(frozen=True, slots=True)
class PixelCovariance:
    """Neighbourhood shapes E [H, W, 3] (xx, xy, yy) px^2 and features [H, W, C], unit scale."""

    shape: torch.Tensor
    feature: torch.Tensor


class CovarianceModel(Protocol):
    """Anything that reads the covariance of depth off an image, learned or not."""

    def __call__(self, image: UInt8, length_px: float) -> PixelCovariance:
        """Covariance of every pixel of an RGB or mono image, for a typical correlation length in px."""
        ...


@dataclass(frozen=True, slots=True)
class StructureCovariance:
    """Covariance from image structure alone: E^-1 = (I + edge_strength * structure tensor) / length^2."""

    color_scale: float
    edge_strength: float

    def __call__(self, image: UInt8, length_px: float) -> PixelCovariance:
        """Covariance of every pixel; the image is smoothed a little first, so that noise is no edge."""
        smooth = cv2.GaussianBlur(image.astype(np.float32) / 255.0, (0, 0), 1.0)
        feature = smooth.reshape(*image.shape[:2], -1)
        grey = feature.mean(axis=2)
        gx, gy = (
            cv2.Sobel(grey, cv2.CV_32F, 1, 0, scale=0.125),
            cv2.Sobel(grey, cv2.CV_32F, 0, 1, scale=0.125),
        )
        products = cv2.GaussianBlur(np.stack([gx * gx, gx * gy, gy * gy], axis=-1), (0, 0), 2.0)
        gain = self.edge_strength * (length_px / self.color_scale) ** 2
        xx, xy, yy = 1.0 + gain * products[..., 0], gain * products[..., 1], 1.0 + gain * products[..., 2]
        scale = length_px**2 / (xx * yy - xy * xy)
        shape = np.stack([yy * scale, -xy * scale, xx * scale], axis=-1)
        return PixelCovariance(
            torch.from_numpy(shape.astype(np.float32)), torch.from_numpy(feature / np.float32(self.color_scale))
        )


def kernel(
    x1: torch.Tensor, E1: torch.Tensor, c1: torch.Tensor, x2: torch.Tensor, E2: torch.Tensor, c2: torch.Tensor
) -> torch.Tensor:
    """Non-stationary Matern 3/2 times a Gaussian of the feature difference, [B, N, M], 1 for equal arguments.

    Args:
        x1, x2: positions [B, N, 2], [B, M, 2] px.
        E1, E2: neighbourhood shapes [B, N, 3], [B, M, 3] px^2 (xx, xy, yy).
        c1, c2: features [B, N, C], [B, M, C].
    """
    d = x1[:, :, None] - x2[:, None]
    s = E1[:, :, None] + E2[:, None]
    det = s[..., 0] * s[..., 2] - s[..., 1] ** 2
    dx, dy = d[..., 0], d[..., 1]
    q = 0.5 * (s[..., 2] * dx * dx - 2.0 * s[..., 1] * dx * dy + s[..., 0] * dy * dy) / det
    r = torch.sqrt(3.0 * q + _JITTER)
    det1 = (E1[..., 0] * E1[..., 2] - E1[..., 1] ** 2)[:, :, None]
    det2 = (E2[..., 0] * E2[..., 2] - E2[..., 1] ** 2)[:, None]
    norm = 2.0 * (det1 * det2) ** 0.25 / torch.sqrt(det)
    squares = (c1 * c1).sum(dim=2)[:, :, None] + (c2 * c2).sum(dim=2)[:, None]
    color = (squares - 2.0 * c1 @ c2.transpose(1, 2)).clamp_min(0.0)
    return norm * (1.0 + r) * torch.exp(-r - 0.5 * color)


def make_covariance(config: DepthConfig) -> CovarianceModel:
    """The covariance that the configuration names."""
    return StructureCovariance(config.covariance_color_scale, config.edge_strength)
