"""The covariance function of depth completion (paper Sec. ScaleCov): a non-stationary Matern kernel.

A model gives every pixel a 2x2 covariance E, the shape of its neighbourhood, and a feature. The default needs
no training: correlation shortens across image edges, and colours that differ do not belong together.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import entry_points
from typing import Protocol

import cv2
import numpy as np
import torch

from sf_depth.config import DepthConfig
from sf_interfaces.errors import ConfigError
from sf_interfaces.types import UInt8

ENTRY_POINT_GROUP = "scenefactory.covariance"
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
    (px, py), (qx, qy) = (x.unbind(dim=2) for x in (x1, x2))
    (pxx, pxy, pyy), (qxx, qxy, qyy) = (E.unbind(dim=2) for E in (E1, E2))
    dx, dy = px[..., None] - qx[:, None], py[..., None] - qy[:, None]
    xx, xy, yy = pxx[..., None] + qxx[:, None], pxy[..., None] + qxy[:, None], pyy[..., None] + qyy[:, None]
    det = xx * yy - xy * xy
    Q = 0.5 * (yy * dx * dx - 2.0 * xy * dx * dy + xx * dy * dy) / det
    r = torch.sqrt(3.0 * Q + _JITTER)
    root = (pxx * pyy - pxy * pxy)[..., None] ** 0.25 * (qxx * qyy - qxy * qxy)[:, None] ** 0.25
    squares = (c1 * c1).sum(dim=2)[..., None] + (c2 * c2).sum(dim=2)[:, None]
    color = (squares - 2.0 * c1 @ c2.transpose(1, 2)).clamp_min_(0.0)
    return 2.0 * root * torch.rsqrt(det) * (1.0 + r) * torch.exp(-r - 0.5 * color)


def make_structure(config: DepthConfig) -> CovarianceModel:
    """Covariance from image structure, which needs no weights."""
    return StructureCovariance(config.covariance_color_scale, config.edge_strength)


def make_covariance(config: DepthConfig) -> CovarianceModel:
    """The covariance that the configuration names, one of entry-point group ``scenefactory.covariance``.

    Raises:
        ConfigError: no installed package provides it, or its weights are missing.
    """
    found = {point.name: point for point in entry_points(group=ENTRY_POINT_GROUP)}
    if config.covariance not in found:
        raise ConfigError(f"no covariance '{config.covariance}' is installed; choose one of {', '.join(sorted(found))}")
    make: Callable[[DepthConfig], CovarianceModel] = found[config.covariance].load()
    return make(config)
