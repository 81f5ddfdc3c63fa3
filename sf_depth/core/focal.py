"""An unknown focal length that the views hardly tell is drawn to what cameras usually have.

Views with little parallax, of a plane, or whose errors are alike all over the image leave the focal length open: one
that is far off fits as well. The posterior of dense bundle adjustment says so (``posterior.with_covariance``). With a
prior on its logarithm, both count by what they know; a focal length that is well determined is left as it is.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import math

_USUAL = 0.9  # focal length over the longer side of the image: 58 degrees of view, between phones and lenses of 50 mm
_SPREAD = 0.3  # deviation of its logarithm: two thirds of all cameras have 44 to 74 degrees
UNSURE = 0.1  # relative deviation from which the prior counts; at this one it has a weight of 10 %
_INDEPENDENT = 100  # correspondences of a set of views that err on their own, as neighbours err alike
USUAL = (
    "the views hardly tell the focal length: it was drawn to that of usual cameras, and the variance tells how unsure"
)


def implausibility(cost: float, focal: float, side: int) -> float:
    """What tells starts from different focal lengths apart: the logarithm of the cost and, little, the prior."""
    return math.log(max(cost, 1e-12)) + (math.log(focal / (_USUAL * side)) / _SPREAD) ** 2 / _INDEPENDENT


def drawn(focal: float, deviation: float, side: int) -> tuple[float, float]:
    """A focal length, px, and its relative deviation, with the prior of an image whose longer side has ``side`` px."""
    own, usual = deviation**-2, _SPREAD**-2
    log = (own * math.log(focal) + usual * math.log(_USUAL * side)) / (own + usual)
    return math.exp(log), (own + usual) ** -0.5
