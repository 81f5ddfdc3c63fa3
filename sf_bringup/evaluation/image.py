"""Errors of images: PSNR and SSIM."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
from scipy.ndimage import convolve1d

from sf_interfaces.errors import FormatError
from sf_interfaces.types import Float64, UInt8

_WINDOW, _SIGMA = 11, 1.5
_C1, _C2 = 0.01**2, 0.03**2  # for values in [0, 1]


def _unit(image: UInt8) -> Float64:
    values = image.astype(np.float64) / 255.0
    return values if values.ndim == 3 else np.repeat(values[..., None], 3, axis=2)


def unit_pair(image: UInt8, reference: UInt8) -> tuple[Float64, Float64]:
    """Both images [H, W, 3] on [0, 1]; grey is repeated.

    Raises:
        FormatError: sizes differ.
    """
    if image.shape[:2] != reference.shape[:2]:
        raise FormatError(f"images differ in size: {image.shape[:2]} and {reference.shape[:2]}")
    return _unit(image), _unit(reference)


def psnr(image: UInt8, reference: UInt8, mask: np.ndarray | None = None) -> float:
    """Peak signal-to-noise ratio in dB on [0, 1] values, over the mask [H, W] where given."""
    a, b = unit_pair(image, reference)
    difference = a - b if mask is None else (a - b)[mask]
    mse = float((difference**2).mean()) if difference.size else float("nan")
    return float("inf") if mse == 0 else -10.0 * float(np.log10(mse))


def ssim(image: UInt8, reference: UInt8) -> float:
    """Structural similarity (Wang 2004): 11x11 Gaussian window, sigma 1.5, mean over channels.

    Only windows that lie inside the image count.

    Raises:
        FormatError: sizes differ, or the image is smaller than the window.
    """
    x, y = unit_pair(image, reference)
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
