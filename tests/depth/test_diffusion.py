"""Gaps are filled along the image and its planes, surely where one surface bounds them, and as the reference says."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import cv2
import numpy as np
import pytest

from sf_bringup.simulate.simulator import Simulator
from sf_bringup.simulate.spec import SimulationSpec
from sf_depth.config import DepthConfig
from sf_depth.core import diffusion_reference as reference
from sf_depth.core.diffusion import Diffusion, spread
from sf_depth.core.filling import Filler
from sf_interfaces.errors import FormatError
from sf_interfaces.native import kernels
from sf_interfaces.types import Camera, DepthMap, Keyframe

GREY = np.full((120, 160, 3), 120, np.uint8)
CAMERA = Camera(160, 120, 150.0, 150.0, 80.0, 60.0)


def filled(image: np.ndarray, z: np.ndarray, camera: Camera = CAMERA) -> DepthMap:
    seen = DepthMap(z, (0.003 * z) ** 2)
    depth = Filler(DepthConfig()).fill(Keyframe(0, camera, image, np.eye(4), seen)).depth
    assert depth is not None and depth.variance is not None
    return depth


def test_on_a_large_image_what_is_smooth_spreads_alike_at_half_the_size() -> None:
    known = np.ones((480, 650), bool)
    known[160:320, 200:440] = False
    row, col = np.mgrid[:480, :650].astype(np.float32)
    values = np.stack([row, col, row + col, np.full_like(row, 100)], axis=2) / 400
    values[~known] = 0.0
    image = np.full(known.shape, 120, np.uint8)
    got, full = spread(image, values, known, 192.0), Diffusion(image, known).fill(values, 192.0)
    np.testing.assert_allclose(got, full, atol=0.02)
    assert np.isfinite(spread(image, values, np.zeros_like(known), 192.0)).all()


def disc(col: int, row: int, radius: int) -> np.ndarray:
    return cv2.circle(np.zeros((120, 160), np.uint8), (col, row), radius, 1, -1) > 0


@pytest.mark.parametrize("steps", [0, 1, 7])
def test_the_kernel_settles_as_the_reference_does(steps: int) -> None:
    rng = np.random.default_rng(steps)
    right, down, ground = rng.uniform(1e-3, 1.0, (3, 11, 14)).astype(np.float32) ** 2
    right[:, -1], down[-1] = 0.0, 0.0
    ground *= rng.random(ground.shape) < 0.2
    right[4, 5:7], down[3:5, 6], ground[4, 6] = 0.0, 0.0, 0.0  # a pixel without links
    values, inflow = rng.normal(size=(2, 11, 14, 4)).astype(np.float32)
    got = kernels("sf_depth").settle(values, inflow, right, down, ground, steps)
    np.testing.assert_allclose(got, reference.settle(values, inflow, right, down, ground, steps), rtol=2e-3, atol=2e-3)
    np.testing.assert_array_equal(got[4, 6], values[4, 6])


def test_diffusion_solves_the_equations_of_all_its_links() -> None:
    rng = np.random.default_rng(3)
    image = cv2.GaussianBlur(rng.integers(0, 255, (60, 90, 3), dtype=np.uint8), (0, 0), 6.0)
    known, values = rng.random((60, 90)) < 0.05, rng.uniform(1, 2, (60, 90, 4)).astype(np.float32)
    got = Diffusion(image, known).fill(values)
    np.testing.assert_array_equal(got[known], values[known])
    links = Diffusion(image, np.zeros_like(known)).links[0]
    A = reference.system(links.right[:60, :90], links.down[:60, :90], np.zeros((60, 90), np.float32))
    left = (A @ got[..., 0].ravel()).reshape(60, 90)[~known] / A.diagonal().reshape(60, 90)[~known]
    assert np.abs(left).max() < 0.01 and np.sqrt((left**2).mean()) < 1e-3
    assert got.min() >= values[known].min() - 0.01 and got.max() <= values[known].max() + 0.01


def test_a_plane_goes_on_beyond_what_was_seen() -> None:
    rays = CAMERA.unproject(CAMERA.pixel_grid(), np.ones((120, 160)))
    truth = 5.0 / (rays @ np.array([0.1, 0.5, 1.0]))
    z = truth.copy()
    z[:16], z[disc(80, 70, 20)] = np.nan, np.nan
    error = np.abs(filled(GREY, z).z / truth - 1)
    ahead = np.abs(truth[16] / truth[:16] - 1)
    assert error[disc(80, 70, 20)].max() < 0.01 and error[:16].mean() < 0.25 * ahead.mean()


def test_depth_does_not_cross_the_edges_of_the_image() -> None:
    image, truth = GREY.copy(), np.full((120, 160), 4.0)
    image[:, 80:], truth[:, 80:] = (40, 160, 60), 2.0
    z = truth.copy()
    z[40:80, 50:110] = np.nan
    assert np.abs(filled(image, z).z / truth - 1)[:, np.r_[0:78, 82:160]].max() < 0.02


def test_a_gap_that_may_show_either_surface_is_unsure() -> None:
    truth = np.where(np.arange(160) < 80, 4.0, 2.0) * np.ones((120, 1))
    between, within = disc(80, 60, 12), disc(30, 60, 12)
    depth = filled(GREY, np.where(between | within, np.nan, truth))
    sigma = np.sqrt(depth.variance) / depth.z
    assert sigma[within].max() < 0.2 < sigma[disc(80, 60, 6)].min()
    assert (np.abs(depth.z - truth) < 2 * sigma * depth.z)[between].mean() > 0.9


def test_gaps_at_the_edges_of_a_room_are_as_sure_as_they_are_right() -> None:
    simulator = Simulator(SimulationSpec("room1", width=320, height=240, focal=240.0, supersampling=1, seed=3))
    image, truth = simulator.frame(45)[:2]
    steep = np.abs(cv2.Laplacian(np.log(truth.astype(np.float64)), cv2.CV_64F)) > 0.02
    gap = cv2.dilate(steep.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    gap[:, 280:] = True
    noise = 0.003 * np.random.default_rng(0).standard_normal(truth.shape)
    z = np.where(gap, np.nan, truth * (1 + noise))
    depth = filled(image, z, simulator.spec.camera)
    error = np.abs(depth.z - truth)[gap]
    sigma = np.sqrt(depth.variance[gap])
    assert 0.6 < (error < sigma).mean() < 0.9 and (error < 2 * sigma).mean() > 0.88
    nearest = cv2.distanceTransformWithLabels(gap.astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL)[1]
    value = np.zeros(nearest.max() + 1)
    value[nearest[~gap]] = z[~gap]
    assert error.mean() < 0.9 * np.abs(value[nearest] - truth)[gap].mean()
    again = filled(image, z, simulator.spec.camera)
    np.testing.assert_array_equal(again.z, depth.z)
    np.testing.assert_array_equal(again.variance, depth.variance)


def test_no_variance_is_negative_where_few_steps_do_not_arrive() -> None:
    rng, (height, width) = np.random.default_rng(1), (188, 620)
    image = rng.integers(0, 3, (height, width, 3)).astype(np.uint8)
    image[:, ::9] = 250  # bars that heat hardly passes
    keep = np.zeros((height, width), bool)
    keep[height // 2 :] = rng.random((height - height // 2, width)) < 0.9
    keep[:, 200:260] = False
    z = np.where(keep, rng.uniform(1, 9, keep.shape), np.nan).astype(np.float32)
    variance = (z * z * 10 ** rng.uniform(-10, 0, z.shape)).astype(np.float32)
    camera = Camera(width, height, 500.0, 500.0, width / 2, height / 2)
    full = Filler(DepthConfig()).fill(Keyframe(1, camera, image, np.eye(4), DepthMap(z, variance))).depth
    assert full is not None and full.variance is not None
    assert (full.variance > 0).all() and np.isfinite(full.z).all()


def test_four_pixels_beside_each_other_are_enough() -> None:
    z = np.full((120, 160), np.nan)
    z[60:62, 80:82] = 2.0
    np.testing.assert_allclose(filled(GREY, z).z, 2.0, rtol=1e-3)


def test_too_little_depth_is_refused() -> None:
    z = np.full((120, 160), np.nan)
    z[3, :3] = 2.0
    with pytest.raises(FormatError, match="fewer than 4"):
        filled(GREY, z)
