"""Errors of images: PSNR, SSIM and, where its weights are on this machine, LPIPS."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import torch
from scipy.ndimage import convolve1d
from torch.nn import functional

from sf_interfaces.errors import FormatError
from sf_interfaces.types import Float64, UInt8

_WINDOW, _SIGMA = 11, 1.5
_C1, _C2 = 0.01**2, 0.03**2  # for values in [0, 1]
LPIPS_VARIABLE = "SF_LPIPS"  # environment variable: folder with the two weight files below
_ALEX, _LINEAR = "alexnet-owt-7be5be79.pth", "alex.pth"


def _unit(image: UInt8) -> Float64:
    values = image.astype(np.float64) / 255.0
    return values if values.ndim == 3 else np.repeat(values[..., None], 3, axis=2)


def _check(image: UInt8, reference: UInt8) -> tuple[Float64, Float64]:
    if image.shape[:2] != reference.shape[:2]:
        raise FormatError(f"images differ in size: {image.shape[:2]} and {reference.shape[:2]}")
    return _unit(image), _unit(reference)


def psnr(image: UInt8, reference: UInt8, mask: np.ndarray | None = None) -> float:
    """Peak signal-to-noise ratio in dB on [0, 1] values, over the mask [H, W] where given."""
    a, b = _check(image, reference)
    difference = a - b if mask is None else (a - b)[mask]
    mse = float((difference**2).mean()) if difference.size else float("nan")
    return float("inf") if mse == 0 else -10.0 * float(np.log10(mse))


def ssim(image: UInt8, reference: UInt8) -> float:
    """Structural similarity (Wang 2004): 11x11 Gaussian window, sigma 1.5, mean over channels.

    Only windows that lie inside the image count.

    Raises:
        FormatError: sizes differ, or the image is smaller than the window.
    """
    x, y = _check(image, reference)
    if min(x.shape[:2]) < _WINDOW:
        raise FormatError(f"SSIM needs images of at least {_WINDOW}x{_WINDOW} px, got {x.shape[1]}x{x.shape[0]}")
    mx, my = _blur(x), _blur(y)
    vx, vy, cov = _blur(x * x) - mx**2, _blur(y * y) - my**2, _blur(x * y) - mx * my
    value = ((2 * mx * my + _C1) * (2 * cov + _C2)) / ((mx**2 + my**2 + _C1) * (vx + vy + _C2))
    return float(value.mean())


def _blur(values: Float64) -> Float64:
    """Gaussian means of the windows inside the image, [H - 10, W - 10, C]."""
    t = np.arange(_WINDOW) - _WINDOW // 2
    weights = np.exp(-0.5 * (t / _SIGMA) ** 2)
    weights /= weights.sum()
    r = _WINDOW // 2
    return convolve1d(convolve1d(values, weights, axis=0), weights, axis=1)[r:-r, r:-r]


class Lpips:
    """Learned perceptual distance of AlexNet features (Zhang 2018, version 0.1), from weights found on this machine."""

    _STRIDES, _PADDING = (4, 1, 1, 1, 1), (2, 2, 1, 1, 1)
    _INDEX = (0, 3, 6, 8, 10)  # of the convolutions in torchvision's AlexNet.features
    _SHIFT, _SPREAD = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)

    def __init__(self, alexnet: dict[str, torch.Tensor], linear: dict[str, torch.Tensor]) -> None:
        self._convolutions = [(alexnet[f"features.{k}.weight"], alexnet[f"features.{k}.bias"]) for k in self._INDEX]
        self._linear = [linear[f"lin{k}.model.1.weight"] for k in range(5)]

    @staticmethod
    def find() -> Lpips:
        """From ``$SF_LPIPS`` or the cache of torch hub.

        Raises:
            FormatError: a weight file is missing; says where it was looked for.
        """
        folders = [Path(torch.hub.get_dir()) / "checkpoints"]
        if LPIPS_VARIABLE in os.environ:
            folders.insert(0, Path(os.environ[LPIPS_VARIABLE]))
        found = [next((f / name for f in folders if (f / name).is_file()), None) for name in (_ALEX, _LINEAR)]
        if None in found:
            missing = [n for n, path in zip((_ALEX, _LINEAR), found, strict=True) if path is None]
            raise FormatError(
                f"LPIPS needs {' and '.join(missing)} in {' or '.join(map(str, folders))}; "
                f"set {LPIPS_VARIABLE} to a folder that has them"
            )
        return Lpips(*(torch.load(path, map_location="cpu", weights_only=True) for path in found if path))

    def __call__(self, image: UInt8, reference: UInt8) -> float:
        """Distance of two images [H, W, 3]; 0 = alike."""
        with torch.no_grad():
            pairs = zip(*(self._features(i) for i in _check(image, reference)), self._linear, strict=True)
            return float(sum(functional.conv2d((a - b) ** 2, w).mean() for a, b, w in pairs))

    def _features(self, image: Float64) -> list[torch.Tensor]:
        """Unit-length features after each rectified convolution."""
        x = torch.from_numpy(2 * image - 1).float().permute(2, 0, 1)[None]
        x = (x - torch.tensor(self._SHIFT).view(1, 3, 1, 1)) / torch.tensor(self._SPREAD).view(1, 3, 1, 1)
        out = []
        for k, (weight, bias) in enumerate(self._convolutions):
            if k in (1, 2):
                x = functional.max_pool2d(x, 3, 2)
            x = functional.relu(functional.conv2d(x, weight, bias, self._STRIDES[k], self._PADDING[k]))
            out.append(x / (x.norm(dim=1, keepdim=True) + 1e-10))
        return out
