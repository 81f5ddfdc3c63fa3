"""An unknown focal length: how sure it is said to be, and what stands in where the views do not tell it."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from views import adjust, exact

from sf_depth.core import dense_depth, focal
from sf_depth.core.dense_ba import Observations
from sf_depth.core.start import Size, start
from sf_interfaces.types import Float64

SIZE = Size(640, 480)


def smooth_errors(seen: Observations, rng: np.random.Generator, size: float) -> Float64:
    """What a source gets wrong all over its image, [S, 2, N] px: low polynomials and waves."""
    u, v = (seen.target[:, :1] - 320) / 480, (seen.target[:, 1:] - 240) / 480
    count = len(seen.target)

    def draw(spread: float) -> Float64:
        return rng.normal(0, spread, (count, 2, 1))

    out = draw(1.0) * v + draw(0.3) * u + draw(0.5) * v * v + draw(0.3) * u * v
    for _ in range(4):
        out += draw(0.4) * np.cos(draw(6.0)[:, :1] * u + draw(6.0)[:, :1] * v + draw(3.0)[:, :1])
    return size * out


@pytest.mark.parametrize("size", [0.0, 0.3, 0.8])  # px
def test_the_focal_length_is_as_sure_as_it_is_said_to_be(size: float) -> None:
    pulls = []
    for seed in range(16):
        rng = np.random.default_rng(seed)
        true = 520.0 * np.exp(rng.normal(0, 0.25))
        seen, _ = exact(1200, 2 + seed % 5, focal=true, noise=rng.uniform(0.1, 0.5), seed=seed)
        target = np.nan_to_num(seen.target + smooth_errors(seen, rng, size), nan=-1.0)
        inside = ((target > 0) & (target < [[640.0], [480.0]])).all(axis=1)
        seen = Observations(seen.uv, target, inside.astype(float))
        found = adjust(seen, start(seen, SIZE, None), intrinsics="f", turn=0.0007)
        pulls.append(np.log(found.estimate.theta[0] / true) / dense_depth.focal_deviation(found))
    assert (np.abs(pulls) < 1).mean() >= 0.5 and max(np.abs(pulls)) < 3


def test_a_focal_length_that_is_known_well_stays_and_another_becomes_usual() -> None:
    assert focal.drawn(300.0, 0.01, 640)[0] == pytest.approx(300.0, rel=2e-3)
    f, deviation = focal.drawn(3000.0, 3.0, 640)
    assert f == pytest.approx(576.0, rel=0.03) and 0.25 < deviation < 0.3
    halfway, _ = focal.drawn(288.0, 0.3, 640)  # both know as much: the middle of the logarithms
    assert halfway == pytest.approx((288.0 * 576.0) ** 0.5)


def test_the_prior_decides_between_focal_lengths_that_explain_alike() -> None:
    near, far = focal.implausibility(1.0, 500.0, 640), focal.implausibility(0.99, 1500.0, 640)
    assert near < far
    assert focal.implausibility(0.8, 1500.0, 640) < near  # a clear difference is stronger
