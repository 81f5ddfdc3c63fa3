"""Gaps are not flooded with the depth of what stands in front, however wide that was kept."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from sf_depth.config import DepthConfig
from sf_depth.core.filling import Filler
from sf_depth.core.supports import supports
from sf_interfaces.types import Camera, DepthMap, Keyframe

HEIGHT, WIDTH = 240, 320  # rims are 4 px wide
CAMERA = Camera(WIDTH, HEIGHT, 300.0, 300.0, 160.0, 120.0)
FRONT = np.zeros((HEIGHT, WIDTH), bool)
FRONT[80:160, 120:220] = True


def in_front_of_a_plain_wall(too_wide: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Image, true depth, and what is kept: the front, too wide, and the wall at the border of the image."""
    image = np.full((HEIGHT, WIDTH, 3), (160, 40, 40), np.uint8)
    image[FRONT] = (90, 80, 60)
    z = np.where(FRONT, 1.5, 3.0).astype(np.float32)
    seen = np.where(FRONT, z, np.nan).astype(np.float32)
    seen[80 - too_wide : 160 + too_wide, 120 - too_wide : 220 + too_wide] = 1.5
    for border in (np.s_[:25], np.s_[-25:], np.s_[:, :25], np.s_[:, -25:]):
        seen[border] = 3.0
    return image, z, seen


@pytest.mark.parametrize("too_wide", [0, 2, 4])
def test_a_front_that_is_kept_too_wide_does_not_flood_the_wall_behind(too_wide: int) -> None:
    image, z, seen = in_front_of_a_plain_wall(too_wide)
    keyframe = Keyframe(0, CAMERA, image, np.eye(4), DepthMap(seen, (0.01 * seen) ** 2))
    full = Filler(DepthConfig()).fill(keyframe).depth
    assert full is not None
    gap = np.isnan(seen)
    assert np.abs(full.z[gap] / z[gap] - 1).mean() < 0.01
    np.testing.assert_array_equal(full.z[~gap], seen[~gap])  # what is kept stays as it is


def test_supports_lie_inside_of_what_is_kept_and_hold_all_that_is_well_inside() -> None:
    image, z, seen = in_front_of_a_plain_wall(4)
    valid = np.isfinite(seen)
    support = supports(image, 1.0 / np.where(valid, seen, 1.0).astype(np.float32), valid)
    assert not support[~valid].any()
    assert support[FRONT].mean() > 0.99
    assert not support[valid & (seen < z)].any()
    assert support[2:22, 2:-2].all()  # the wall: its rim looks like the gap and has its depth


def test_thin_surfaces_support_all_but_their_outermost_pixels() -> None:
    valid = np.zeros((HEIGHT, WIDTH), bool)
    valid[30:35], valid[100:105] = True, True  # narrower than two rims
    d = np.full(valid.shape, 0.5, np.float32)
    inner = np.zeros_like(valid)
    inner[31:34], inner[101:104] = True, True
    np.testing.assert_array_equal(supports(np.full((HEIGHT, WIDTH), 120, np.uint8), d, valid), inner)


@pytest.mark.parametrize("pixels", [1, 40])
def test_what_is_no_surface_supports_as_it_is(pixels: int) -> None:
    valid = np.zeros((HEIGHT, WIDTH), bool)
    valid.ravel()[:: HEIGHT * WIDTH // pixels] = True
    image = np.full((HEIGHT, WIDTH), 120, np.uint8)
    np.testing.assert_array_equal(supports(image, valid.astype(np.float32), valid), valid)
