"""The median of a depth image over valid pixels only: holes neither count nor grow."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from sf_interfaces.types import Float32

_STRIP_ROWS = 64  # rows filtered at once where OpenCV has no filter: bounds memory
_RIM_BLOCK = 6000  # rim pixels ranked at once: windows stay in the cache, no power of two (rows would collide there)


def median(z: Float32, size: int) -> Float32:
    """Median of the valid pixels of each ``size`` x ``size`` window; a missing centre stays missing.

    Args:
        z: [H, W] m, NaN where nothing was measured.
        size: side of the window, px, odd; 1 gives ``z`` back.
    """
    if size == 1:
        return z
    missing = np.isnan(z)
    filled = np.where(missing, np.float32(np.inf), z)  # sorts last
    near_hole = cv2.dilate(missing.view(np.uint8), np.ones((size, size), np.uint8)).view(bool)
    out = _dense(filled, size)
    _rank_rim(filled, size, np.flatnonzero(near_hole & ~missing), out)
    out[missing] = np.nan
    return out


def _dense(z: Float32, size: int) -> Float32:
    """Plain median filter, edges replicated. float32 is filtered natively up to 5 x 5."""
    if size <= 5:
        return np.asarray(cv2.medianBlur(z, size))
    r = size // 2
    out = np.empty_like(z)
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(z, r, mode="edge"), (size, size))
    for top in range(0, z.shape[0], _STRIP_ROWS):
        strip = windows[top : top + _STRIP_ROWS]
        out[top : top + _STRIP_ROWS] = np.median(strip.reshape(*strip.shape[:2], -1), axis=2)
    return out


def _rank_rim(filled: Float32, size: int, rim: NDArray[np.intp], out: Float32) -> None:
    """Pixels whose window holds a hole: sort the window with holes last, take the middle of the rest."""
    r = size // 2
    padded = cv2.copyMakeBorder(filled, r, r, r, r, cv2.BORDER_CONSTANT, value=float("inf"))
    width, pixels = padded.shape[1], np.asarray(padded).ravel()
    centre = (rim // filled.shape[1] + r) * width + rim % filled.shape[1] + r
    offsets = [dv * width + du for dv in range(-r, r + 1) for du in range(-r, r + 1)]
    for start in range(0, len(rim), _RIM_BLOCK):
        block = slice(start, start + _RIM_BLOCK)
        ranked = np.stack([pixels.take(centre[block] + offset) for offset in offsets])  # [size^2, N]
        ranked.sort(axis=0)
        count = np.isfinite(ranked).sum(axis=0)
        column = np.arange(len(count))
        out.reshape(-1)[rim[block]] = 0.5 * (ranked[(count - 1) // 2, column] + ranked[count // 2, column])
