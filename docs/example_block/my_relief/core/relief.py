"""Shaded relief: the slope of the inverse depth, lit from one side."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import cv2
import numpy as np

from my_relief.config import ReliefConfig
from sf_interfaces.types import Camera, DepthMap, UInt8


def relief_image(depth: DepthMap, camera: Camera, config: ReliefConfig) -> UInt8:
    """Relief of a depth map, uint8 [H, W]: 128 where flat, 0 where there is no depth."""
    w = np.where(depth.valid, 1.0 / np.where(depth.valid, depth.z, 1.0), 0.0)
    weight = cv2.GaussianBlur(depth.valid.astype(np.float64), (0, 0), config.blur)
    smooth = cv2.GaussianBlur(w, (0, 0), config.blur) / np.maximum(weight, 1e-6)
    down, right = np.gradient(smooth)
    light = np.deg2rad(config.azimuth_deg)
    slope = (right * np.cos(light) - down * np.sin(light)) * camera.fx
    shade = np.clip(128 + 127 * np.tanh(slope / 4), 1, 255)
    return np.where(depth.valid, shade, 0).astype(np.uint8)
