"""The compiled kernels against their definition in numpy, on random and on hostile input."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sf_interfaces.geometry import se3
from sf_interfaces.types import Camera, Frame
from sf_tracking.core import (
    align,
    align_reference,
    bundle,
    bundle_reference,
    pose,
    pose_reference,
    reproject_reference,
    shape_reference,
)
from sf_tracking.core.keyframes import TrackedKeyframe, reproject
from sf_tracking.core.native import intrinsics, native
from sf_tracking.core.patches import Patches
from tests.tracking.test_align import places, texture
from tests.tracking.test_bundle import CAMERA, scene

SMALL = Camera(160, 120, 130.0, 125.0, 80.0, 60.0)


def assert_alike(found: align.Alignment, wanted: align.Alignment) -> None:
    """NaN where the other is NaN, equal up to the rounding of float32 elsewhere."""
    np.testing.assert_allclose(found.centre, wanted.centre, atol=2e-3)
    np.testing.assert_allclose(found.gain, wanted.gain, rtol=2e-3, atol=2e-3)
    np.testing.assert_allclose(found.explained, wanted.explained, atol=2e-3)
    np.testing.assert_allclose(found.residual, wanted.residual, rtol=1e-2, atol=0.05)
    np.testing.assert_allclose(found.covariance, wanted.covariance, rtol=5e-2, atol=1e-5)


@pytest.mark.parametrize("side", [5, 8, 11])
def test_patches_are_described_and_aligned_as_defined(side: int) -> None:
    image, uv, rng = texture(1), places(1, 80) + 0.21, np.random.default_rng(side)
    templates, wanted = align.describe(image, uv, side), align_reference.describe(image, uv, side)
    np.testing.assert_allclose(templates.J, wanted.J, atol=4e-3)
    np.testing.assert_allclose(templates.inverse, wanted.inverse, rtol=1e-3, atol=1e-7)
    some = rng.permutation(80)[:50]
    start, warp = uv[some] + rng.uniform(-0.8, 0.8, (50, 2)), np.eye(2) + rng.normal(0, 0.05, (50, 2, 2))
    target = 0.8 * np.roll(image, 1, axis=1) + 12 + rng.normal(0, 2, image.shape).astype(np.float32)
    target = target.astype(np.float32)
    for count in (1, 6):
        found = align.align(target, templates.take(some), start, warp, count)
        assert_alike(found, align_reference.align(target, wanted.take(some), start, warp, count))


def test_alignment_of_hostile_input_is_as_defined() -> None:
    """Not finite, outside, on the border, far away, without any gradient, in tiny images."""
    image = texture(2)
    image[100:140, 100:140] = 77.0
    uv = np.array([[0.0, 0.0], [319.9, 239.9], [-50.0, 10.0], [120.0, 120.0], [1e30, -1e30], [60.5, 70.5]])
    templates = align.describe(image, uv, 11)
    np.testing.assert_allclose(templates.J, align_reference.describe(image, uv, 11).J, atol=4e-3)
    rows = templates.take(np.repeat(np.arange(6), 6))
    start = np.tile(np.array([[np.nan, 5], [5, np.inf], [0, 0], [319.5, 239.5], [120.2, 120.4], [-1e9, 1e9]]), (6, 1))
    warp = np.tile(np.eye(2), (36, 1, 1))
    warp[7], warp[14], warp[20] = np.nan, 0.0, 40.0
    for picture in (image, image[:1], image[:, :1], image[:2, :3]):
        picture = np.ascontiguousarray(picture)
        found = align.align(picture, rows, start, warp, 4)
        wanted = align_reference.align(picture, rows, start, warp, 4)
        np.testing.assert_array_equal(np.isnan(found.centre), np.isnan(wanted.centre))
        assert np.isnan(found.centre[0]).all() and found.explained[0] == 0 and np.isinf(found.residual[0])
        known = np.isfinite(found.centre).all(axis=1)
        np.testing.assert_allclose(found.gain[known], wanted.gain[known], atol=0.02)


def test_alignments_are_judged_as_defined() -> None:
    rng = np.random.default_rng(3)
    start, half = rng.uniform(-10, 170, (400, 2)), rng.normal(0, 0.5, (400, 2, 2))
    found = align.Alignment(
        start + rng.normal(0, 3, (400, 2)),
        half @ half.transpose(0, 2, 1),
        *rng.uniform(0, 5, (2, 400)),
        rng.random(400),
    )
    found.centre[::9], found.residual[::13] = np.nan, np.inf
    limits = align.Limits(5.5, 4.0, 0.5, 2.0, 4.5, 4.0, 0.05)
    information, valid = align.judge(found, start, (120, 160), limits)
    wanted = align_reference.judge(found, start, (120, 160), limits)
    np.testing.assert_array_equal(valid, wanted[1])
    np.testing.assert_allclose(information, wanted[0], rtol=1e-6)
    assert 20 < valid.sum() < 300


def test_patches_are_reprojected_as_defined() -> None:
    rng, count = np.random.default_rng(4), 300
    uv, w = rng.uniform(0, (160, 120), (count, 2)), rng.uniform(-0.2, 1.5, count)
    w[:4] = np.nan, np.inf, 0.0, 1e300
    patches = Patches(uv, rng.normal(0, 0.01, (count, 2)), w, w, w, w, w > 0)
    frame = Frame(0, SMALL, np.zeros((120, 160), np.uint8))
    for T in (se3.exp(rng.normal(0, 0.3, 6)), se3.exp(np.array([0, 0, -1.0, 0, 1.2, 0])), np.eye(4)):
        keyframe = TrackedKeyframe(frame, None, patches, None, se3.exp(rng.normal(0, 0.2, 6)))
        with np.errstate(all="ignore"):
            wanted = reproject_reference.reproject(keyframe, T)
        found = reproject(keyframe, T)
        np.testing.assert_array_equal(found.visible, wanted.visible)
        for name in ("uv", "warp", "J_w", "w"):
            np.testing.assert_allclose(getattr(found, name)[4:], getattr(wanted, name)[4:], rtol=1e-9, atol=1e-9)


def test_arrays_that_do_not_fit_are_refused() -> None:
    image, t = texture(1), align.describe(texture(1), places(1, 3), 11)
    with pytest.raises(ValueError, match="no template"):
        align.align(image, replace(t, rows=np.array([3])), np.zeros((1, 2)), np.eye(2)[None], 3)
    with pytest.raises(ValueError, match="one start"):
        align.align(image, t, np.zeros((2, 2)), np.zeros((3, 2, 2)), 3)
    with pytest.raises(ValueError, match="1 to 41"):
        align.describe(image, places(1, 3), 43)


@pytest.mark.parametrize("seed", range(4))
def test_the_pose_is_that_of_the_definition(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth, count = se3.exp(rng.normal(0, 0.2, 6)), 120
    points, w = rng.uniform((-2, -2, 2), (2, 2, 8), (count, 3)), rng.uniform(0.1, 1.0, count)
    uv = CAMERA.project(se3.transform(truth, points))[0] + rng.normal(0, 0.4, (count, 2))
    uv[:20] += rng.uniform(-60, 60, (20, 2))
    half = rng.normal(0, 1, (count, 2, 2))
    information = half @ half.transpose(0, 2, 1) + np.eye(2)
    X = points * w[:, None]
    X[20:25], uv[25:28], information[28] = -X[20:25], np.nan, np.nan
    start = se3.exp(rng.normal(0, 0.02, 6)) @ truth
    found = pose.solve_pose(CAMERA, start, X, w, uv, information, (9.0, 3.0, 3.0))
    wanted = pose_reference.solve_pose(CAMERA, start, X, w, uv, information, (9.0, 3.0, 3.0))
    np.testing.assert_allclose(found.T_cw, wanted.T_cw, atol=1e-7)
    np.testing.assert_allclose(found.error, wanted.error, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(found.information, wanted.information, rtol=1e-4, atol=1e-2)
    assert found.support == pytest.approx(wanted.support, rel=1e-4)
    assert found.excess == pytest.approx(wanted.excess, rel=1e-4)
    assert np.isinf(found.error[20:29]).all() and np.linalg.norm((found.T_cw @ se3.inverse(truth))[:3, 3]) < 0.02


def test_a_pose_without_any_sight_stays_where_it_is() -> None:
    nothing = np.zeros((0, 3)), np.zeros(0), np.zeros((0, 2)), np.zeros((0, 2, 2))
    found = pose.solve_pose(CAMERA, np.eye(4), *nothing, (3.0,))
    np.testing.assert_array_equal(found.T_cw, np.eye(4))
    assert found.excess == 1.0 and found.support == 0.0


@pytest.mark.parametrize("seed", range(3))
def test_normal_equations_are_those_of_the_definition(seed: int) -> None:
    _, p = scene(seed, n=4, m=30, noise=0.5, outliers=3)
    rng = np.random.default_rng(seed)
    p.T_cw[3] = se3.exp(np.array([0, 0, -4.0, 0, 0.5, 0])) @ p.T_cw[3]  # much lies behind this one
    p.root[0, 1, :5], p.uv[1, 2, :4], p.w[:, 7] = 0.0, np.nan, 0.0
    sure = np.zeros((4, 4, 6, 6))
    sure[2, 1] = np.diag(rng.uniform(10, 1000, 6))
    motion = np.tile(se3.exp(rng.normal(0, 0.1, 6)), (4, 4, 1, 1))
    p = replace(p, prior_weight=rng.uniform(0, 100, p.w.shape), motion=motion, motion_information=sure)
    assert bundle.cost(CAMERA, p, 3.0) == pytest.approx(bundle_reference.cost(CAMERA, p, 3.0), rel=1e-10)
    found, wanted = bundle.linearise(CAMERA, p, 3.0), bundle_reference.linearise(CAMERA, p, 3.0)
    for name in ("H", "b", "C", "c", "E"):
        a, b = getattr(found, name), getattr(wanted, name)
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9 * np.abs(b).max(), err_msg=name)
    reduced = found.E, found.C.reshape(-1) + 1.0, found.c.reshape(-1), found.H, found.b
    for a, b in zip(native().eliminate(*reduced), bundle_reference.eliminate(*reduced), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-9 * np.abs(b).max())


@pytest.mark.parametrize("step", [1, 4, 7])
def test_depth_is_thinned_as_defined(step: int) -> None:
    rng = np.random.default_rng(step)
    z = rng.uniform(0.5, 5.0, (61, 80)).astype(np.float32)
    z[rng.random(z.shape) < 0.4] = np.nan
    z[:14, :14], z[20, 20], z[21, 30] = 0.0, np.inf, -1.0
    (count, centre, rough), wanted = native().thin(z, step), shape_reference.thin(z, step)
    np.testing.assert_array_equal(count, wanted[0])
    enough = count > 0.5 * step * step  # fewer pixels may lie in a line, through which many planes go
    np.testing.assert_allclose(centre[enough], wanted[1][enough], rtol=1e-6)
    np.testing.assert_allclose(rough[enough], wanted[2][enough], rtol=1e-6, atol=1e-4)
    assert np.isfinite(centre).all() and np.isfinite(rough).all() and (centre[count == 0] == 0).all()


def test_a_plane_is_smooth_and_borders_are_not() -> None:
    v, u = np.mgrid[0:120, 0:160] + 0.5
    z = (1.0 / (0.4 + 0.001 * u - 0.0005 * v)).astype(np.float32)
    _, centre, rough = native().thin(z, 8)
    middle = np.mgrid[0:15, 0:20] * 8 + 4.0
    np.testing.assert_allclose(centre, 1.0 / (0.4 + 0.001 * middle[1] - 0.0005 * middle[0]), rtol=1e-5)
    assert rough.max() < 1e-5
    z[:, 100:] += 0.1  # 10 cm behind
    assert (native().thin(z, 8)[2][:, 12] > 0.01).all()


def test_planes_are_met_as_defined() -> None:
    rng = np.random.default_rng(0)
    moved, points = rng.uniform((-2, -1.5, -0.5), (2, 1.5, 4), (900, 3)), rng.uniform((-2, -2, 1), (2, 2, 4), (300, 3))
    moved[:3], moved[3] = np.nan, 0.0
    T = se3.exp(rng.normal(0, 0.1, 6))
    source = se3.transform(se3.inverse(T), moved)
    grid = rng.integers(-1, 300, (12, 16))
    partner = native().partners(intrinsics(SMALL), T, source, grid, 16 / SMALL.width, 12 / SMALL.height)
    np.testing.assert_array_equal(partner, shape_reference.partners(SMALL, T, source, grid))
    normals = points / np.linalg.norm(points, axis=1, keepdims=True)
    normals[::7] = np.nan
    sigma = rng.uniform(0.001, 0.1, 900)
    sigma[::11] = 0.0
    for reach, least in ((0.8, 0.03), (0.8, 1e3), (1e-9, 0.03)):
        arguments = T, source, sigma, partner, points, normals, reach, 2.0, least, 0.5
        (H, g, *counts), wanted = native().plane_system(*arguments), shape_reference.plane_system(*arguments)
        used = counts[0]
        assert tuple(counts) == wanted[2:] and (used > 50 or reach < 1e-6)
        np.testing.assert_allclose(H, wanted[0], rtol=1e-9, atol=1e-6)
        np.testing.assert_allclose(g, wanted[1], rtol=1e-9, atol=1e-6)
