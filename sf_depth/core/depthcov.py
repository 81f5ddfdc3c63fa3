"""DepthCov: the covariance of depth learned by a network (paper Sec. ScaleCov), from a checkpoint given by path.

A UNet predicts a 2x2 covariance per pixel at its four finest levels; completion takes the finest.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import torch
from torch import nn
from torch.nn import functional

from sf_depth.config import DepthConfig
from sf_depth.core.covariance import PixelCovariance
from sf_interfaces.errors import ConfigError
from sf_interfaces.types import UInt8

_WIDTHS = (16, 32, 64, 128, 256, 512)  # channels at 1/1 .. 1/32
_GROUPS = 16
_LEVELS = 4
_SIZE = 192  # px; height of the images the network is trained on
_MULTIPLE = 32  # its coarsest level
_MEAN, _STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
_LOG_RANGE = (float(np.log(1e-3)), float(np.log(1e4)))  # variances, in normalised image coordinates


class ResidualBlock(nn.Module):
    """Two 3x3 convolutions that share their normalisation, beside a 1x1 shortcut."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, outputs, 3, padding=1)
        self.conv2 = nn.Conv2d(outputs, outputs, 3, padding=1)
        self.shortcut = nn.Conv2d(inputs, outputs, 1)
        self.norm = nn.GroupNorm(_GROUPS, outputs)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """[B, inputs, H, W] -> [B, outputs, H, W]."""
        y = functional.leaky_relu(self.norm(self.conv1(x)), 0.01)
        return functional.leaky_relu(self.norm(self.conv2(y)) + self.shortcut(x), 0.01)


class UpBlock(nn.Module):
    """Doubles the resolution, joins the encoder's features of that size, and mixes them."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.reduce = nn.Conv2d(inputs, outputs, 3, padding=1)
        self.mix = ResidualBlock(2 * outputs, outputs)

    def forward(self, x: torch.Tensor, skip: torch.Tensor) -> torch.Tensor:
        """[B, inputs, H, W] and [B, outputs, 2H, 2W] -> [B, outputs, 2H, 2W]."""
        x = functional.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)
        return self.mix(torch.cat([self.reduce(x), skip], dim=1))


class DepthCovNet(nn.Module):
    """UNet of five levels, 9.0 M parameters; prior and noise variance of each level are learned too."""

    def __init__(self) -> None:
        super().__init__()
        self.encoder = nn.ModuleList(ResidualBlock(i, o) for i, o in zip((3, *_WIDTHS), _WIDTHS, strict=False))
        self.decoder = nn.ModuleList(UpBlock(2 * w, w) for w in reversed(_WIDTHS[:-1]))
        self.heads = nn.ModuleList(nn.Conv2d(w, 3, 1) for w in reversed(_WIDTHS[:_LEVELS]))
        self.log_scale = nn.Parameter(torch.zeros(_LEVELS))
        self.log_noise = nn.Parameter(torch.zeros(_LEVELS))

    def forward(self, image: torch.Tensor) -> list[torch.Tensor]:
        """Covariances [B, 3, h, w] (yy, xy, xx) in normalised coordinates, of levels 1/8, 1/4, 1/2, 1/1.

        Args:
            image: RGB [B, 3, H, W] in 0..1; H and W multiples of 32.
        """
        mean, std = (image.new_tensor(v)[:, None, None] for v in (_MEAN, _STD))
        x, skips = (image - mean) / std, []
        for number, block in enumerate(self.encoder):
            x = block(x if number == 0 else functional.max_pool2d(x, 2))
            skips.append(x)
        levels = []
        for number, block in enumerate(self.decoder):
            x = block(x, skips[-2 - number])
            head = number - (len(self.decoder) - _LEVELS)
            if head >= 0:
                levels.append(_covariance(self.heads[head](x)))
        return levels


def _covariance(raw: torch.Tensor) -> torch.Tensor:
    """Three channels [B, 3, h, w] of a head as positive definite matrices (yy, xy, xx)."""
    yy, xx = raw[:, 0].clamp(*_LOG_RANGE).exp(), raw[:, 1].clamp(*_LOG_RANGE).exp()
    xy = 0.99 * torch.tanh(raw[:, 2]) * torch.sqrt(yy * xx - 1e-8)
    return torch.stack([yy, xy, xx], dim=1)


class DepthCov:
    """The network as a covariance of completion.

    Args:
        net: the network, with its weights.
    """

    def __init__(self, net: DepthCovNet) -> None:
        self._net = net.eval()

    @staticmethod
    def load(path: str | Path) -> DepthCov:
        """Read a checkpoint: a state dict of :class:`DepthCovNet`, or a training checkpoint with one inside.

        Raises:
            ConfigError: no such file, not a checkpoint, or one of another network.
        """
        path = Path(path)
        if not path.is_file():
            raise ConfigError(f"no DepthCov checkpoint at '{path}'; set depth.covariance_weights to its path")
        try:
            state = torch.load(path, map_location="cpu", weights_only=True)
        except Exception as error:
            raise ConfigError(f"'{path}' is no checkpoint that torch can read safely: {error}") from error
        state = state.get("state_dict", state) if isinstance(state, dict) else {}
        net = DepthCovNet()
        try:
            net.load_state_dict(state)
        except (RuntimeError, AttributeError, TypeError) as error:
            reason = str(error).splitlines()[0]
            raise ConfigError(f"'{path}' does not hold the weights of DepthCov's UNet: {reason}") from error
        return DepthCov(net)

    def __call__(self, image: UInt8, length_px: float) -> PixelCovariance:
        """Covariance of every pixel, in px^2; the network knows lengths by itself, ``length_px`` is not used."""
        height, width = image.shape[:2]
        factor = _SIZE / height
        size = [max(_MULTIPLE, round(n * factor / _MULTIPLE) * _MULTIPLE) for n in (width, height)]
        rgb = image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2)
        small = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA).astype(np.float32) / 255.0
        with torch.no_grad():
            finest = self._net(torch.from_numpy(small).permute(2, 0, 1)[None])[-1]
            full = functional.interpolate(finest, (height, width), mode="bilinear", align_corners=False)[0]
        yy, xy, xx = full
        half_h, half_w = 0.5 * height, 0.5 * width  # normalised coordinates run from -1 to 1
        shape = torch.stack([xx * half_w**2, xy * half_w * half_h, yy * half_h**2], dim=-1)
        return PixelCovariance(shape.contiguous(), torch.zeros(height, width, 0))


def make(config: DepthConfig) -> DepthCov:
    """The network with the weights at ``covariance_weights``."""
    if not config.covariance_weights:
        raise ConfigError("covariance 'depthcov' needs weights; set depth.covariance_weights to a checkpoint")
    return DepthCov.load(config.covariance_weights)
