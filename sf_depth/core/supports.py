"""What gaps are filled from: the depth that is kept, without what is too wide at the borders of what stands in front.

Windows are compared where depth is found. At the border of a surface in front a window shows both surfaces, and takes
the depth of the nearer one as long as that has the texture. What is kept reaches over the border by half a window
then, onto what looks like the gap and would flood it. So depth well inside of what is kept counts as it is; nearer to
a gap it counts where it is what diffusion through what looks alike makes of the depth further inside.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import cv2
import numpy as np

from sf_depth.core.diffusion import CHANNELS, spread
from sf_interfaces.types import Float32, UInt8

_RIM = 1 / 80  # image widths: half a window
_ALONE = 2.0  # rims away from anything further inside, what is kept counts too: nothing else tells about it
_ALIKE = 0.1  # relative difference of inverse depth that the slope of one surface makes within a rim
_LEAST = 0.25  # share of what is kept that is left without its outermost pixels; less is no surface


def supports(image: UInt8, d: Float32, valid: np.ndarray) -> np.ndarray:
    """Pixels [H, W] bool whose inverse depth gaps are filled from.

    Args:
        image: RGB [H, W, 3] or mono [H, W].
        d: inverse depth [H, W], anything finite where not ``valid`` [H, W] bool.
    """
    inner = cv2.erode(valid.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    if inner.sum() <= _LEAST * valid.sum():
        return valid
    rim = _RIM * valid.shape[1]
    deep = _distance(valid) > rim
    trusted = deep | (inner & (_distance(~deep) > _ALONE * rim))
    expected = spread(image, np.repeat(d[..., None], CHANNELS, axis=2), trusted)[..., 0]
    return np.asarray(trusted | (inner & (np.abs(expected - d) < _ALIKE * expected)))


def _distance(mask: np.ndarray) -> Float32:
    """Distance of every pixel of a mask to the nearest one that is none, px [H, W]."""
    return np.asarray(cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 3))
