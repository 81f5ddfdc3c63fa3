"""Flexion is 1 on planes, dark at edges, honest about missing depth, and as noise-sensitive as published."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sf_flexion.config import FlexionConfig
from sf_flexion.core.flexion import flexion_image
from sf_interfaces.errors import CalibrationError, ConfigError
from sf_interfaces.types import Camera, DepthMap

CAMERA = Camera(96, 72, 80.0, 80.0, 48.0, 36.0)


def plane(camera: Camera, slope_x: float, slope_y: float, distance: float = 2.0) -> DepthMap:
    """A slanted plane; a steep one passes behind the camera, and rays that never meet it carry no depth."""
    rays = camera.unproject(camera.pixel_grid(), np.ones((camera.height, camera.width)))
    approach = rays @ np.array([slope_x, slope_y, 1.0])
    return DepthMap(np.divide(distance, approach, out=np.full_like(approach, np.nan), where=approach > 1e-2))


def inner(image: np.ndarray, border: int) -> np.ndarray:
    return image[border:-border, border:-border]


@pytest.mark.parametrize("variant", ["standard", "normalized", "angle"])
@pytest.mark.parametrize("step", [1, 2, 3])
def test_fronto_parallel_plane_is_white_with_a_black_border(variant: str, step: int) -> None:
    image = flexion_image(plane(CAMERA, 0, 0), CAMERA, FlexionConfig(variant=variant, step=step))
    assert image.dtype == np.uint8 and image.shape == (72, 96)
    assert (inner(image, step) >= 254).all()
    assert image.sum() == inner(image, step).sum()


@settings(max_examples=20, deadline=None)
@given(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))
def test_every_plane_is_white_in_the_normalized_form(slope_x: float, slope_y: float) -> None:
    depth = plane(CAMERA, slope_x, slope_y)
    image = inner(flexion_image(depth, CAMERA, FlexionConfig("normalized", step=2, median=1)), 2)
    seen = np.lib.stride_tricks.sliding_window_view(depth.valid, (5, 5))[..., ::2, ::2].all(axis=(2, 3))
    assert seen.mean() > 0.9
    assert (image[seen] >= 253).all() and not image[~seen].any()


def test_standard_form_darkens_with_slant() -> None:
    flat, mild, steep = (
        np.median(inner(flexion_image(plane(CAMERA, s, s), CAMERA, FlexionConfig(median=1)), 2)) / 255
        for s in (0.0, 0.3, 1.0)
    )
    assert flat > 0.99 and 0.95 < mild < 1.0 and steep < 0.85


@pytest.mark.parametrize(
    ("sigma_mm", "step", "expected", "tolerance"),
    [(1, 1, 0.94, 0.03), (1, 2, 0.98, 0.02), (5, 1, 0.48, 0.05), (5, 2, 0.73, 0.05), (5, 4, 0.91, 0.03)],
)
def test_noise_on_a_plane_at_two_metres(sigma_mm: float, step: int, expected: float, tolerance: float) -> None:
    camera = Camera(320, 240, 600.0, 600.0, 160.0, 120.0)
    noise = np.random.default_rng(7).normal(0, sigma_mm * 1e-3, (240, 320))
    image = flexion_image(DepthMap(2.0 + noise), camera, FlexionConfig(step=step, median=1))
    assert inner(image, step).mean() / 255 == pytest.approx(expected, abs=tolerance)


def test_the_median_filter_calms_noise() -> None:
    camera = Camera(320, 240, 600.0, 600.0, 160.0, 120.0)
    noise = np.random.default_rng(7).normal(0, 1e-3, (240, 320))
    image = flexion_image(DepthMap(2.0 + noise), camera, FlexionConfig())
    assert inner(image, 3).mean() / 255 > 0.97


def test_a_crease_and_a_step_are_dark() -> None:
    z = np.full((72, 96), 2.0)
    z[:, 48:] = 4.0
    image = flexion_image(DepthMap(z), CAMERA, FlexionConfig())
    assert inner(image, 2)[:, 45:47].max() < inner(image, 2)[:, :40].min()


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**31), st.sampled_from(["standard", "normalized", "angle"]))
def test_turning_the_camera_by_a_right_angle_turns_the_image(seed: int, variant: str) -> None:
    rng = np.random.default_rng(seed)
    z = 2.0 + 0.05 * rng.standard_normal((72, 96))
    z[rng.random((72, 96)) < 0.02] = np.nan
    turned = Camera(72, 96, 80.0, 80.0, 36.0, 48.0)
    config = FlexionConfig(variant)
    first = flexion_image(DepthMap(z), CAMERA, config).astype(int)
    second = flexion_image(DepthMap(np.rot90(z)), turned, config).astype(int)
    assert np.abs(np.rot90(first) - second).max() <= 1


def test_one_missing_neighbour_makes_a_pixel_unknown_and_nothing_else() -> None:
    z = np.full((72, 96), 2.0)
    z[30, 40] = np.nan
    image = flexion_image(DepthMap(z), CAMERA, FlexionConfig(step=2))
    dark = {(30 + dv, 40 + du) for dv in (-2, 0, 2) for du in (-2, 0, 2)} - {(30, 40)}
    assert {tuple(p) for p in np.argwhere(inner(image, 2) == 0) + 2} == dark


def test_zero_and_negative_depth_count_as_missing() -> None:
    z = np.full((72, 96), 2.0)
    z[10:20, 10:20] = 0.0
    image = flexion_image(DepthMap(z), CAMERA, FlexionConfig())
    assert (image[11:19, 11:19] == 0).all() and image[40, 60] == 255


@pytest.mark.parametrize("size", [3, 5, 7, 9])
def test_median_ranks_valid_pixels_only(size: int) -> None:
    z = np.full((72, 96), 2.0)
    z[:, 60:] = np.nan  # the edge of the data must not pull towards zero
    image = flexion_image(DepthMap(z), CAMERA, FlexionConfig(median=size))
    assert (image[2:-2, 2:58] == 255).all() and (image[:, 60:] == 0).all()


def test_bad_input_is_refused() -> None:
    with pytest.raises(CalibrationError, match="calibration of the depth image"):
        flexion_image(DepthMap(np.ones((10, 10))), CAMERA, FlexionConfig())
    with pytest.raises(ConfigError, match="variant"):
        FlexionConfig(variant="fancy")
    with pytest.raises(ConfigError, match="odd"):
        FlexionConfig(median=4)
    assert flexion_image(DepthMap(np.ones((2, 2))), Camera(2, 2, 1, 1, 1, 1), FlexionConfig()).sum() == 0
