"""The step follows the noise, 16 bits carry more than 8, and holes stay holes whatever surrounds them."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from sf_flexion.block import make
from sf_flexion.config import FlexionConfig
from sf_flexion.core.flexion import Flexion, flexion_image
from sf_flexion.core.median import median
from sf_flexion.core.noise import TOLERANCE, choose_step, direction_error
from sf_interfaces.config import ConfigFile
from sf_interfaces.types import Camera, DepthMap

CAMERA = Camera(320, 240, 600.0, 600.0, 160.0, 120.0)


def noisy_plane(sigma: float, slope: float = 0.5) -> np.ndarray:
    rays = CAMERA.unproject(CAMERA.pixel_grid(), np.ones((240, 320)))
    z = 2.0 / (1.0 + slope * rays[..., 0])
    return (z + np.random.default_rng(3).normal(0, sigma, z.shape)).astype(np.float32)


@pytest.mark.parametrize("sigma", [1e-3, 5e-3])
def test_the_direction_error_is_that_of_the_noise_whatever_the_slant(sigma: float) -> None:
    expected = sigma * CAMERA.fx / (np.sqrt(2) * 2.0)
    for slope in (0.0, 0.5):
        assert direction_error(noisy_plane(sigma, slope), CAMERA) == pytest.approx(expected, rel=0.1)


def test_more_noise_asks_for_a_larger_step_and_none_for_the_smallest() -> None:
    steps = [choose_step(noisy_plane(sigma), CAMERA) for sigma in (0.0, 1e-3, 2e-3, 5e-3)]
    assert steps[0] == 1 and steps == sorted(steps) and steps[-1] > 4
    for step, sigma in zip(steps, (0.0, 1e-3, 2e-3), strict=False):
        assert direction_error(noisy_plane(sigma), CAMERA) / step <= TOLERANCE


def test_the_step_stays_while_it_nearly_fits() -> None:
    z = noisy_plane(2e-3)
    step = choose_step(z, CAMERA)
    assert choose_step(z, CAMERA, step + 1) == step + 1, "a step that also does is kept: no flicker"
    assert choose_step(z, CAMERA, 4 * step) == step


def test_planes_stay_bright_under_noise_with_the_automatic_step() -> None:
    flexion = Flexion(FlexionConfig("normalized", median=1))
    image = flexion(DepthMap(noisy_plane(3e-3)), CAMERA)
    assert flexion.step is not None and flexion.step > 1
    assert image[flexion.step : -flexion.step, flexion.step : -flexion.step].mean() / 255 > 0.95


def test_sixteen_bits_round_the_same_value_finer() -> None:
    depth = DepthMap(noisy_plane(1e-3))
    value = Flexion(FlexionConfig()).value(depth, CAMERA)
    for bits, full, kind in ((8, 255, np.uint8), (16, 65535, np.uint16)):
        image = flexion_image(depth, CAMERA, FlexionConfig(bits=bits))
        assert image.dtype == kind
        np.testing.assert_allclose(image / full, np.nan_to_num(value), atol=0.5 / full + 1e-7)
    in_line = make(ConfigFile({"flexion": {"bits": 16}}))(depth, CAMERA)
    wide = flexion_image(depth, CAMERA, FlexionConfig(bits=16))
    assert in_line.dtype == np.uint8 and np.array_equal(in_line, wide >> 8)


@pytest.mark.parametrize("size", [3, 5, 7])
def test_the_median_equals_ranking_each_window_by_hand(size: int) -> None:
    rng = np.random.default_rng(size)
    z = rng.uniform(1, 3, (40, 50)).astype(np.float32)
    z[rng.random(z.shape) < 0.3] = np.nan
    expected = np.full_like(z, np.nan)
    r = size // 2
    for v, u in np.argwhere(np.isfinite(z)):
        window = z[max(0, v - r) : v + r + 1, max(0, u - r) : u + r + 1]
        expected[v, u] = np.nanmedian(window)
    inside = np.s_[r:-r, r:-r]  # at the border OpenCV repeats the edge, which a full window does not
    np.testing.assert_allclose(median(z, size)[inside], expected[inside], rtol=1e-6)


def test_real_structured_light_asks_for_a_large_step(shared_data: Callable[[str], Path]) -> None:
    path = shared_data("rgbd_7scenes_redkitchen_000_199") / "frame-000000.depth.png"
    mm = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    depth = DepthMap(np.where((mm == 0) | (mm == 65535), np.nan, mm.astype(np.float32) / 1000))
    camera = Camera(640, 480, 585.0, 585.0, 320.0, 240.0)
    bent = {}
    for step in (1, 0):
        flexion = Flexion(FlexionConfig("normalized", step=step))
        value = flexion.value(depth, camera)
        bent[step] = float((value[np.isfinite(value)] < 0.95).mean())
    assert flexion.step is not None and flexion.step >= 4
    assert bent[0] < 0.5 * bent[1], "walls become flat, which at step 1 quantisation hides"
