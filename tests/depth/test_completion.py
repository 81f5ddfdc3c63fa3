"""Completion is exact on planes, honest about its error, sharper at image edges, deterministic."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from sf_depth.config import DepthConfig
from sf_depth.core.covariance import StructureCovariance, kernel
from sf_depth.core.estimator import DepthCompleter
from sf_interfaces.errors import FormatError, SceneFactoryError
from sf_interfaces.types import Camera, DepthMap, Keyframe

CAMERA = Camera(160, 120, 150.0, 150.0, 80.0, 60.0)


def keyframe(truth: np.ndarray, image: np.ndarray, fraction: float = 0.05, seed: int = 0) -> Keyframe:
    kept = np.random.default_rng(seed).random(truth.shape) < fraction
    return Keyframe(0, CAMERA, image, np.eye(4), DepthMap(np.where(kept, truth, np.nan)))


def slanted() -> np.ndarray:
    rays = CAMERA.unproject(CAMERA.pixel_grid(), np.ones((120, 160)))
    return 5.0 / (rays @ np.array([0.5, 0.8, 1.0]))


def completed(given: Keyframe, **options: float) -> DepthMap:
    depth = DepthCompleter(DepthConfig(**options)).complete(given).depth
    assert depth is not None and depth.variance is not None
    return depth


GREY = np.full((120, 160), 128, np.uint8)


def test_a_plane_is_recovered_at_any_slant() -> None:
    truth = slanted()
    error = np.abs(completed(keyframe(truth, GREY)).z / truth - 1)
    assert np.median(error) < 1e-3 and error.max() < 0.02


def test_measurements_stay_and_carry_the_sensor_variance() -> None:
    given = keyframe(slanted(), GREY)
    depth = completed(given, depth_sigma=0.05)
    seen = given.depth.valid
    np.testing.assert_array_equal(depth.z[seen], given.depth.z[seen])
    np.testing.assert_allclose(depth.variance[seen], 0.05**2, rtol=1e-5)
    assert depth.density == 1.0 and (depth.variance[~seen] >= 0.05**2 * 0.999).all()


def test_image_edges_halve_the_bleeding_of_foreground() -> None:
    truth, image = np.full((120, 160), 10.0), np.full((120, 160, 3), 40, np.uint8)
    truth[30:90, 50:110], image[30:90, 50:110] = 4.0, 200
    given = keyframe(truth, image)
    with_edges = np.abs(completed(given).z - truth)
    without = np.abs(completed(replace(given, image=np.full_like(image, 90))).z - truth)
    assert with_edges.mean() < 0.5 * without.mean()


def test_variance_grows_away_from_support_and_can_be_cut() -> None:
    given = keyframe(slanted() + 0.02 * np.random.default_rng(1).standard_normal((120, 160)), GREY)
    z = given.depth.z.copy()
    z[:60] = np.nan
    given = replace(given, depth=DepthMap(z))
    depth = completed(given)
    assert np.median(depth.variance[:20]) > 5 * np.median(depth.variance[70:])
    cut = completed(given, max_sigma=float(np.sqrt(np.median(depth.variance[50]))))
    assert np.isnan(cut.z[:10]).mean() > 0.9 and np.isfinite(cut.z[70:]).mean() > 0.9


def test_what_the_image_shows_elsewhere_is_less_certain_where_depth_changes() -> None:
    given = keyframe(slanted(), GREY)
    aligned, apart = completed(given), completed(given, registration_sigma=2.0)
    np.testing.assert_allclose(apart.z, aligned.z, rtol=0.01)
    gap = ~given.depth.valid
    gy, gx = np.gradient(slanted())
    added = (apart.variance - aligned.variance)[gap]
    np.testing.assert_allclose(np.median(added / (4.0 * (gx**2 + gy**2))[gap]), 1.0, rtol=0.05)


def test_background_that_lies_on_the_image_of_what_is_in_front_does_not_show_there() -> None:
    truth, image = np.full((120, 160), 10.0), np.full((120, 160, 3), 40, np.uint8)
    truth[30:90, 50:110], image[30:90, 50:110] = 4.0, 200
    given = keyframe(truth, image)
    z = given.depth.z.copy()
    past = np.random.default_rng(5).random(z.shape) < 0.3  # seen past the edge, from a little to the left
    z[30:90, 50:58] = np.where(past[30:90, 50:58] & given.depth.valid[30:90, 50:58], 10.0, z[30:90, 50:58])
    given = replace(given, depth=DepthMap(z))
    front = np.s_[30:90, 50:110]
    aligned, apart = (np.abs(completed(given, registration_sigma=s).z - truth)[front].mean() for s in (0.0, 1.0))
    assert apart < 0.9 * aligned


def test_variance_is_calibrated_on_a_rough_surface() -> None:
    row, col = np.mgrid[:120, :160]
    truth = 5 + 0.5 * np.sin(row / 9.0) * np.cos(col / 11.0)
    given = keyframe(truth + 0.02 * np.random.default_rng(2).standard_normal(truth.shape), GREY)
    depth = completed(given, depth_sigma=0.02)
    hidden = ~given.depth.valid
    normalised = np.abs(depth.z - truth)[hidden] / np.sqrt(depth.variance[hidden])
    assert (normalised < 1).mean() > 0.6 and (normalised < 2).mean() > 0.9


def test_completion_is_deterministic() -> None:
    given = keyframe(slanted(), GREY)
    first, second = completed(given), completed(given)
    np.testing.assert_array_equal(first.z, second.z)
    np.testing.assert_array_equal(first.variance, second.variance)


def test_the_kernel_is_a_correlation() -> None:
    rng = np.random.default_rng(3)
    pixels = StructureCovariance(0.1, 1.0)(rng.integers(0, 255, (40, 40, 3), dtype=np.uint8), 6.0)
    row, col = rng.integers(0, 40, (2, 30))
    x = torch.tensor(np.stack([col, row], -1), dtype=torch.float32)[None]
    E, c = pixels.shape[row, col][None], pixels.feature[row, col][None]
    K = kernel(x, E, c, x, E, c)[0]
    assert torch.allclose(K, K.T, atol=1e-5) and torch.allclose(K.diagonal(), torch.ones(30), atol=1e-3)
    assert torch.linalg.eigvalsh(K.double()).min() > -1e-4


def test_too_little_depth_is_refused() -> None:
    given = keyframe(slanted(), GREY)
    for depth in (None, DepthMap(np.full((120, 160), np.nan)), DepthMap(np.ones((5, 5)))):
        with pytest.raises(FormatError) as error:
            DepthCompleter(DepthConfig()).complete(replace(given, depth=depth))
        assert isinstance(error.value, SceneFactoryError)
