"""Scenes that deceive: an Ames room, and an object that moves while the camera does."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from views import CAMERA, room

from sf_bringup.simulate.ames import EYE
from sf_bringup.simulate.render import Renderer
from sf_bringup.simulate.scenes import ROOMS, SCENES, furnished_room
from sf_depth.config import DepthConfig
from sf_depth.core.mvd import MultiViewDepth
from sf_interfaces.geometry import se3

MVD = MultiViewDepth(DepthConfig())
STEPS = ((0.35, 0.1, 0.0, -4), (-0.35, -0.1, 0.0, 4), (0.1, 0.3, 0.1, -1), (-0.15, -0.25, 0.2, 2))


def relative(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    both = np.isfinite(found) & np.isfinite(truth)
    ratio = found[both] / truth[both]
    return np.abs(ratio / np.median(ratio) - 1)


def test_an_ames_room_is_seen_as_it_is() -> None:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]]), EYE
    poses = [T, *(T @ se3.exp(np.array([x, y, z, 0, np.radians(yaw), 0])) for x, y, z, yaw in STEPS)]
    renderer = Renderer(SCENES["ames"](0))
    views = [renderer.render(CAMERA, pose) for pose in poses]
    rng = np.random.default_rng(0)
    images = [np.clip(image + rng.standard_normal(image.shape) + 0.5, 0, 255).astype(np.uint8) for image, _ in views]
    found = MVD.recover(images[0], images[1:])
    ordinary = Renderer(furnished_room(ROOMS["room2"], 0)).render(CAMERA, T)[1]
    assert relative(found.depth.z, views[0][1]).mean() < 0.03
    assert relative(found.depth.z, ordinary).mean() > 0.15  # what the one image looks like


@pytest.mark.parametrize("motion", [(9, 5), (-14, 0)])
def test_what_moves_gets_no_depth_or_an_unsure_one(motion: tuple[int, int]) -> None:
    views = room()
    patch = np.random.default_rng(5).integers(0, 255, (10, 12, 3), dtype=np.uint8).repeat(7, 0).repeat(7, 1)
    images = []
    for k, image in enumerate(views.images):
        row, col = 80 + k * motion[1], 120 + k * motion[0]
        images.append(image.copy())
        images[-1][row : row + 70, col : col + 84] = patch
    depth = MVD.recover(images[0], images[1:], views.camera).depth
    inside = np.zeros(depth.z.shape, bool)
    inside[84:146, 124:200] = True
    scale = np.nanmedian((depth.z / views.z[0])[~inside])
    error = np.abs(depth.z / scale - views.z[0])[inside & depth.valid]
    sure = np.sqrt(depth.variance)[inside & depth.valid] / scale < error / 3
    assert sure.sum() < 0.1 * inside.sum(), "garbage with a small variance"
    assert relative(np.where(inside, np.nan, depth.z), views.z[0]).mean() < 0.03


def test_given_poses_that_contradict_the_images_only_give_the_scale() -> None:
    views, rng = room(), np.random.default_rng(4)
    T = views.T_source_reference
    length = np.linalg.norm(T[:, :3, 3], axis=1).mean()
    noise = rng.normal(size=(len(T), 6)) * np.repeat([0.1 * length, np.radians(2.0)], 3)
    assert not MVD.recover(views.images[0], views.images[1:], views.camera, T).contradicted
    found = MVD.recover(views.images[0], views.images[1:], views.camera, se3.exp(noise) @ T)
    assert found.contradicted and relative(found.depth.z, views.z[0]).mean() < 0.03
    scale = np.nanmedian(found.depth.z / views.z[0])
    assert found.depth.variance is not None
    sigma = np.nanmedian(np.sqrt(found.depth.variance) / found.depth.z)
    assert 0.01 < sigma < 0.3 and abs(scale - 1) < 2 * sigma
