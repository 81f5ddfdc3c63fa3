"""Sub-pixel alignment of patches with gain and bias: inverse compositional, warped as the geometry predicts.

A patch seen in another image is ``I(c + A x) = g T(x + s) + b`` with the affine warp A known from depth and
pose. Linearised in the shift s this is a regression of the warped pixels on ``J = (T_u, T_v, T, 1)``, whose
normal matrix belongs to the patch alone and is inverted once. Each iteration samples the image, solves for
(g s, g, b) and moves the centre by ``-A s``. Compiled; :mod:`.align_reference` is the same in numpy.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sf_interfaces.types import Float32, Float64
from sf_tracking.core.native import dense, native


@dataclass(frozen=True, slots=True)
class Templates:
    """What alignment keeps of M patches of P pixels, and which E of them are meant."""

    J: Float32  # [M, 4, P] gradients, grey levels less 128, and ones
    inverse: Float64  # [M, 4, 4] inverse of J J^T
    rows: NDArray[np.int64]  # [E]

    def __len__(self) -> int:
        return len(self.rows)

    def take(self, index: NDArray[np.int64]) -> Templates:
        """The templates at ``index``; nothing is copied."""
        return Templates(self.J, self.inverse, self.rows[index])


@dataclass(frozen=True, slots=True)
class Alignment:
    """Where the templates were found; NaN, gain 0 and nothing explained where start or warp were not finite."""

    centre: Float64  # [E, 2] continuous px
    covariance: Float64  # [E, 2, 2] px^2, from the structure tensor and the residual
    gain: Float64  # [E] contrast relative to the template
    residual: Float64  # [E] root mean square, grey levels
    explained: Float64  # [E] share of the variance of the pixels that the template explains, 0 to 1


class Limits(NamedTuple):
    """What an alignment must keep to be believed."""

    border: float  # px from the edge of the image
    reach: float  # px from its start
    explained: float  # share of the variance that the template must explain, where
    noise: float  # the residual is larger than this, grey levels
    residual: float  # grey levels, at most
    gain: float  # change of contrast at most, up or down
    own: float  # px, deviation that every position has beside what its residual shows


def describe(image: Float32, uv: Float64, side: int) -> Templates:
    """Templates of patches at ``uv`` [M, 2] continuous px of an image [H, W]."""
    return Templates(*native().describe(image, dense(uv), side), np.arange(len(uv)))


def align(image: Float32, templates: Templates, start: Float64, warp: Float64, iterations: int) -> Alignment:
    """Find templates in ``image`` [H, W] near ``start`` [E, 2] px, warped by ``warp`` [E, 2, 2]."""
    t = templates
    return Alignment(*native().align(image, t.J, t.inverse, t.rows, dense(start), dense(warp), iterations))


def judge(
    found: Alignment, start: Float64, shape: tuple[int, ...], limits: Limits
) -> tuple[Float64, NDArray[np.bool_]]:
    """Information [E, 2, 2] of aligned centres in an image of ``shape`` [H, W], and which [E] are to be believed."""
    arrays = (dense(start), found.centre, found.covariance, found.gain, found.residual, found.explained)
    information, valid = native().judge(*arrays, shape[1], shape[0], np.array(limits))
    return information, valid
