"""The whole block on a room whose colour and depth are known exactly."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from sf_interfaces.corrections import Correction
from sf_interfaces.errors import FormatError
from sf_interfaces.geometry import se3
from sf_interfaces.types import DepthMap, Keyframe, Scale, Trajectory
from sf_recon.config import ReconConfig
from sf_recon.core.color_field import Neighbourhood, gaussian_weights
from sf_recon.core.detail import Sums, blend_reference, detail, nearest_views, weight_of
from sf_recon.core.keyframe_view import KeyframeView
from sf_recon.core.reconstruction import Reconstruction
from sf_recon.core.silhouette import sharpen
from sf_recon.core.trainer import EPSILON, RowAdam
from tests.recon.scene import CAMERA, HALF, psnr, view

CONFIG = ReconConfig(pixels=2048, final_iterations=100)


@pytest.fixture(scope="module")
def room() -> Reconstruction:
    out = Reconstruction(CONFIG)
    for i in range(0, 12, 2):
        out.add(view(i))
    out.finish()
    return out


def test_held_out_view(room: Reconstruction) -> None:
    for i in (3, 7):
        truth = view(i)
        drawn = room.render(CAMERA, truth.T_map_camera)
        hit = drawn.depth.valid
        assert drawn.hole_fraction < 0.03
        assert psnr(drawn.image[hit], truth.image[hit]) > 30
        assert np.median(np.abs(drawn.depth.z - truth.depth.z)[hit]) < 0.2 * room.resolution
        assert not np.isfinite(drawn.depth.z[~hit]).any()


def test_surface_lies_on_the_walls(room: Reconstruction) -> None:
    cloud = room.surface()
    off = np.abs(np.abs(cloud.points) - HALF).min(axis=1)
    assert len(cloud) > 5000 and np.percentile(off, 99) < 0.5 * room.resolution
    assert cloud.colors is not None and cloud.frame_id == "map"


def test_training_lowers_the_error(room: Reconstruction) -> None:
    """Points start at the observed colour: what is left to learn is what averaging lost."""
    assert np.mean(room.losses[-20:]) < 0.5 * np.mean(room.losses[:3])


def test_first_view_shows_its_colours_before_any_training() -> None:
    out, key = Reconstruction(replace(CONFIG, detail=0)), view(0)
    out.place(key)
    drawn = out.render(CAMERA, key.T_map_camera)
    hit = drawn.depth.valid
    assert psnr(drawn.image[hit], key.image[hit]) > 25


def test_keyframe_images_sharpen_a_view_between_them() -> None:
    truth, scores = view(1), {}
    for count in (0, 4):
        out = Reconstruction(replace(CONFIG, iterations=10, detail=count))
        for i in (0, 2):
            out.add(view(i))
        drawn = out.render(CAMERA, truth.T_map_camera)
        hit = drawn.depth.valid
        scores[count] = psnr(drawn.image[hit], truth.image[hit])
    assert scores[4] > scores[0] + 6


def test_a_keyframe_says_nothing_about_what_it_did_not_see(room: Reconstruction) -> None:
    key = view(1)
    z = np.array(key.depth.z)
    blank = KeyframeView.make(0, CAMERA, key.T_map_camera, np.zeros((120, 160, 3), np.uint8), z, None)
    surface = np.ones(z.shape, bool)
    far = nearest_views([blank], view(9).T_map_camera, 2.0, 1)
    seen = detail([(blank, 0.0)], CAMERA, key.T_map_camera, z, surface, reach=0.5)
    behind = detail([(blank, 0.0)], CAMERA, key.T_map_camera, 2.0 * z, surface, reach=0.5)
    away = detail(far, CAMERA, view(9).T_map_camera, z, surface, reach=0.5)
    assert seen.confidence[20:-20, 20:-20].min() == 1 and not behind.known.any() and not away.known.any()


def test_colour_depends_on_the_side_it_is_seen_from() -> None:
    """One wall, two cameras beside each other that see different greys on it: a highlight, in the extreme."""
    T = np.stack([np.eye(4)] * 2)
    T[:, 0, 3] = -1, 1
    greys = [np.full((120, 160, 3), value, np.uint8) for value in (60, 200)]
    z = np.full((2, 120, 160), np.nan)
    z[0, :, 120:], z[1, :, :40] = 2.0, 2.0  # the part of the wall that both see
    differences = {}
    for sided in (True, False):
        rates = {"feature_rate": 0.0, "network_rate": 3e-3}  # only the network can tell the sides apart
        config = replace(
            CONFIG, detail=0, view_directions=sided, pixels=256, iterations=0, final_iterations=150, **rates
        )
        out = Reconstruction(config)
        for i in (0, 1):
            out.add(Keyframe(i, CAMERA, greys[i], T[i], DepthMap(z[i])))
        out.finish()
        left, right = (out.render(CAMERA, pose) for pose in T)
        differences[sided] = np.median(right.image[right.depth.valid]) - np.median(left.image[left.depth.valid])
    assert differences[True] > 25 > abs(differences[False]) + 20


def test_a_uniform_wall_stays_as_it_is() -> None:
    """Where nothing is left to learn, gradients are rounding errors: they must not move anything."""
    out, key = Reconstruction(replace(CONFIG, detail=0, pixels=256)), view(0)
    out.add(replace(key, image=np.full((120, 160, 3), 90, np.uint8)))
    drawn = out.render(CAMERA, key.T_map_camera)
    assert np.abs(drawn.image[drawn.depth.valid].astype(int) - 90).max() <= 2


def test_points_and_views_follow_their_keyframe() -> None:
    """Half of the keyframes are off by a rigid motion; the correction gives the map that was right at once."""
    shift = se3.exp(np.array([0.2, -0.1, 0.15, 0.02, 0.1, -0.05]))
    right, wrong = (Reconstruction(replace(CONFIG, iterations=5)) for _ in range(2))
    for i in (0, 9, 10):
        right.add(view(i))
        off = replace(view(i), T_map_camera=shift @ view(i).T_map_camera) if i > 5 else view(i)
        wrong.add(off)
    keyframes = Trajectory.from_pairs([(i, view(i).T_map_camera) for i in (9, 10, 77)])
    wrong.correct(Correction(keyframes, np.ones(3)))
    for i in (0, 9):
        a, b = (r.render(CAMERA, view(i).T_map_camera) for r in (right, wrong))
        both = a.depth.valid & b.depth.valid
        assert both.mean() > 0.97
        assert np.median(np.abs(a.depth.z - b.depth.z)[both]) < 0.1 * right.resolution
        assert psnr(a.image[both], b.image[both]) > 35
    wrong.add(view(11))  # it grows on


def test_a_changed_unit_scales_what_a_keyframe_placed_about_its_camera(tmp_path: Path) -> None:
    """Without a metric scale a loop finds how much the unit has shrunk: twice told, it is applied once."""
    shift, shrunk = se3.exp(np.array([0.2, -0.1, 0.15, 0.02, 0.1, -0.05])), 0.8
    right, wrong = (Reconstruction(replace(CONFIG, iterations=5)) for _ in range(2))
    for i in (0, 9):
        key = view(i)
        assert key.depth is not None
        right.add(key)
        off = replace(key, T_map_camera=shift @ key.T_map_camera, depth=DepthMap(shrunk * key.depth.z)) if i else key
        wrong.add(off)
    correction = Correction(Trajectory.from_pairs([(9, view(9).T_map_camera)]), np.array([1 / shrunk]))
    assert wrong.points is not None
    level = wrong.points.levels[0]
    mine, before = level.owners == 9, level.sigmas
    wrong.correct(correction)
    np.testing.assert_allclose(level.sigmas[mine], before[mine] / shrunk, rtol=2e-3)
    np.testing.assert_array_equal(level.sigmas[~mine], before[~mine])
    wrong.save(tmp_path / "map.sfmap")
    wrong = Reconstruction.load(tmp_path / "map.sfmap")
    wrong.correct(correction)
    np.testing.assert_allclose(wrong.views[-1].depth, right.views[-1].depth, rtol=1e-3)
    a, b = (r.render(CAMERA, view(9).T_map_camera) for r in (right, wrong))
    both = a.depth.valid & b.depth.valid  # points placed in the smaller unit lie farther apart now
    assert both.mean() > 0.9
    assert np.median(np.abs(a.depth.z - b.depth.z)[both]) < 0.2 * right.resolution


def test_memory_budget_forgets_the_far_and_old() -> None:
    free = Reconstruction(replace(CONFIG, iterations=1))
    for i in range(0, 20, 2):
        free.add(view(i))
    held = Reconstruction(replace(CONFIG, iterations=1, memory_mb=0.5 * free.nbytes / 1e6))
    for i in range(0, 20, 2):
        held.add(view(i))
        assert held.nbytes <= 0.5 * free.nbytes
    drawn = held.render(CAMERA, view(18).T_map_camera)
    assert drawn.hole_fraction < 0.1
    assert held.views[-1].stamp_ns == 18 and held.views[0].stamp_ns > 0


def test_resolution_follows_the_viewing_distance() -> None:
    """A wall ten times as far gets coarse points only, and is drawn from them without holes."""
    far, near = view(0), view(0)
    T = np.array(far.T_map_camera)
    T[:3, 3] = 10 * T[:3, 3] + [50, 0, 0]
    far = replace(far, stamp_ns=1, T_map_camera=T, depth=DepthMap(10 * far.depth.z))
    out = Reconstruction(replace(CONFIG, iterations=1))
    out.add(near)
    fine = len(out.points.levels[0])
    out.add(far)
    assert len(out.points.levels[0]) < 1.05 * fine
    drawn = out.render(CAMERA, T, full=True)
    assert drawn.hole_fraction < 0.03
    assert np.nanmedian(np.abs(drawn.depth.z / far.depth.z - 1)) < 0.01
    assert np.nanmedian(drawn.depth.variance) > 25 * np.nanmedian(
        out.render(CAMERA, near.T_map_camera, full=True).depth.variance
    )


def test_normals_face_the_camera_and_stand_on_the_walls(room: Reconstruction) -> None:
    drawn = room.render(CAMERA, view(3).T_map_camera, full=True)
    normal = drawn.normal[np.isfinite(drawn.normal[..., 0])] @ view(3).T_map_camera[:3, :3].T
    assert len(normal) > 0.8 * CAMERA.width * CAMERA.height
    assert np.median(np.abs(normal).max(axis=1)) > 0.99  # the room is a box: one axis each


def test_two_runs_are_equal() -> None:
    runs = []
    for _ in range(2):
        out = Reconstruction(replace(CONFIG, final_iterations=10))
        clouds = [out.add(view(i)) for i in (0, 2)]
        out.finish()
        runs.append((out, clouds))
    (a, clouds_a), (b, clouds_b) = runs
    assert a.losses == b.losses
    for x, y in zip(clouds_a, clouds_b, strict=True):
        assert x.points.tobytes() == y.points.tobytes() and x.colors.tobytes() == y.colors.tobytes()
    assert a.surface().colors.tobytes() == b.surface().colors.tobytes()


def test_save_and_load(room: Reconstruction, tmp_path: Path) -> None:
    path = tmp_path / "map.sfmap"
    room.save(path)
    again = Reconstruction.load(path)
    before, after = (r.render(CAMERA, view(3).T_map_camera) for r in (room, again))
    np.testing.assert_array_equal(before.image, after.image)
    np.testing.assert_array_equal(before.depth.z, after.depth.z)
    added = again.add(view(14))  # a loaded map grows on
    assert 0 < len(added) < len(again.surface())


def test_bad_map_files(tmp_path: Path, room: Reconstruction) -> None:
    path = tmp_path / "broken.sfmap"
    path.write_bytes(b"PK nothing")
    with pytest.raises(FormatError, match="not a SceneFactory map"):
        Reconstruction.load(path)
    with pytest.raises(FormatError, match="not a SceneFactory map"):
        Reconstruction.load(tmp_path / "absent.sfmap")
    room.save(path)
    path.write_bytes(path.read_bytes()[:-2000])
    with pytest.raises(FormatError, match="not a SceneFactory map"):
        Reconstruction.load(path)


def test_mono_image_gives_grey() -> None:
    out = Reconstruction(replace(CONFIG, iterations=60))
    key = view(0)
    out.add(replace(key, image=key.image[:, :, 0].copy()))
    drawn = out.render(CAMERA, key.T_map_camera)
    hit = drawn.depth.valid
    assert np.abs(np.diff(drawn.image[hit].astype(int), axis=1)).mean() < 8


def test_uncertain_depth_is_left_out() -> None:
    key = view(0)
    variance = np.full(key.depth.z.shape, 1e-6, np.float32)
    variance[:, :80] = 1.0
    out = Reconstruction(replace(CONFIG, iterations=1))
    out.add(replace(key, depth=DepthMap(key.depth.z, variance)))
    drawn = out.render(CAMERA, key.T_map_camera)
    assert drawn.depth.valid[:, :75].mean() < 0.01 and drawn.depth.valid[:, 85:].mean() > 0.97


def test_resolution_follows_the_scene() -> None:
    key = view(0)
    T = key.T_map_camera.copy()
    T[:3, 3] *= 0.01
    small = replace(key, T_map_camera=T, depth=DepthMap(key.depth.z * 0.01, scale=Scale.ARBITRARY))
    a, b = Reconstruction(replace(CONFIG, iterations=1)), Reconstruction(replace(CONFIG, iterations=1))
    a.add(key)
    b.add(small)
    assert b.resolution == pytest.approx(0.01 * a.resolution)
    assert len(b.surface()) == pytest.approx(len(a.surface()), rel=0.02)


def test_input_that_cannot_be_used() -> None:
    key = view(0)
    with pytest.raises(FormatError, match="no depth"):
        Reconstruction(CONFIG).add(replace(key, depth=None))
    with pytest.raises(FormatError, match="register depth"):
        Reconstruction(CONFIG).add(replace(key, depth=DepthMap(np.ones((4, 4)))))
    with pytest.raises(FormatError, match="no valid depth"):
        Reconstruction(CONFIG).add(replace(key, depth=DepthMap(np.full((120, 160), np.nan))))


def test_empty_map_draws_holes() -> None:
    empty = Reconstruction(CONFIG)
    drawn = empty.render(CAMERA, np.eye(4))
    assert drawn.hole_fraction == 1.0 and not drawn.image.any() and len(empty.surface()) == 0


def test_gaussian_weights() -> None:
    d2 = np.array([[0.0, 1.0], [400.0, 401.0], [5.0, np.inf], [np.inf, np.inf]], np.float32)
    w = gaussian_weights(torch.from_numpy(d2), 1.0)
    e = np.exp(-1.0)
    np.testing.assert_allclose(w, [[1 / (1 + e), e / (1 + e)]] * 2 + [[1, 0], [0, 0]], rtol=1e-6)


def test_row_adam_equals_adam_and_keeps_moments_when_it_grows() -> None:
    rng = np.random.default_rng(0)
    table = torch.zeros(4, 3)
    parameter = torch.zeros(4, 3, requires_grad=True)
    adam = torch.optim.Adam([parameter], lr=0.1, betas=(0.9, 0.99), eps=EPSILON)
    rows = RowAdam(3)
    rows.grow(4)
    near = Neighbourhood(torch.arange(4, dtype=torch.int32)[:, None], torch.ones(4, 1))
    for step in range(6):
        gradient = torch.from_numpy(rng.normal(size=(4, 3)).astype(np.float32))
        rows.step(table, near, gradient, 0.1)
        parameter.grad = gradient
        adam.step()
        if step == 2:  # new rows must not disturb the old ones
            rows.grow(7)
            table = torch.cat([table, torch.zeros(3, 3)])
    torch.testing.assert_close(table[:4], parameter.detach(), rtol=2e-3, atol=3e-4)  # moments are half precision
    assert not table[4:].any() and rows.steps.tolist() == [6] * 4 + [0] * 3


def test_the_compiled_blend_equals_its_definition(room: Reconstruction) -> None:
    rng = np.random.default_rng(0)
    key = view(0)
    z = np.array(key.depth.z) * rng.uniform(0.9, 1.2, key.depth.z.shape).astype(np.float32)
    surface = rng.random(z.shape) < 0.8
    z[5, 5] = 1e-9  # behind or at the camera of some keyframe
    chosen = nearest_views(room.views, key.T_map_camera, 2.0, 4)
    sums = Sums.zeros(z.shape)
    for kept, distance in chosen:
        trust = float(np.clip(1.5 - distance, 0, 1))
        blend_reference(kept, CAMERA, key.T_map_camera, z, surface, trust, weight_of(distance), sums)
    one, two = (detail(chosen, CAMERA, key.T_map_camera, z, surface, reach=1.0, threads=n) for n in (1, 2))
    assert np.array_equal(one.color, two.color) and np.array_equal(one.confidence, two.confidence)
    expected = sums.color / np.maximum(sums.total, 1e-12)[..., None]
    same = np.isclose(one.confidence, sums.confidence, atol=1e-4)
    assert same.mean() > 0.999 and (one.known == (sums.total > 0)).mean() > 0.999
    difference = np.abs(one.color - expected)[same].max(axis=1)
    assert np.quantile(difference, 0.995) < 1.0 and difference.mean() < 0.1  # grey levels; OpenCV's grid of 1/32 px


def test_keyframes_cut_a_near_surface_back_to_its_border() -> None:
    """A near square drawn 4 px too wide before a wall; a keyframe saw how wide it is."""
    truth = np.full((120, 160), 3.0, np.float32)
    truth[40:80, 60:100] = 1.0
    key = KeyframeView.make(0, CAMERA, np.eye(4), np.zeros((120, 160, 3), np.uint8), truth, None)
    drawn = np.full_like(truth, 3.0)
    drawn[36:84, 56:104] = 1.0
    drawn[0, :5] = np.nan
    half = np.where(drawn == 1.0, 4.0, 0.5).astype(np.float32)
    here = np.eye(4)
    out = sharpen(drawn, half, 0.02, [key], CAMERA, here)
    assert np.isnan(out[0, :5]).all()
    np.testing.assert_allclose(out[1:], truth[1:], rtol=1e-4)
    assert np.array_equal(sharpen(drawn, half, 0.02, [], CAMERA, here), drawn, equal_nan=True)
    blind = KeyframeView.make(0, CAMERA, np.eye(4), key.image, np.full_like(truth, np.nan), None)
    assert np.array_equal(sharpen(drawn, half, 0.02, [blind], CAMERA, here), drawn, equal_nan=True)
    short = np.full_like(half, 2.0)  # the windows explain only two of the four pixels
    assert (sharpen(drawn, short, 0.02, [key], CAMERA, here)[38:82, 58:102] != 1.0).sum() == 0
