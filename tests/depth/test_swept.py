"""Depth of SLAM's keyframes: a sweep at their poses, what others confirm of it, and how sure that is."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sf_depth.core.agreement import Swept, confirmed
from sf_depth.core.swept import Consensus, swept
from sf_interfaces.errors import InsufficientParallax
from sf_interfaces.geometry import se3
from sf_interfaces.types import Keyframe, PointCloud
from tests.depth.views import room


def keyframes(count: int = 4) -> list[Keyframe]:
    views = room(count)
    grid = views.camera.pixel_grid()[5::20, 5::20]
    clouds = [views.camera.unproject(grid, z[5::20, 5::20].astype(np.float64)).reshape(-1, 3) for z in views.z]
    parts = zip(views.images, views.poses, clouds, strict=True)
    return [
        Keyframe(k + 1, views.camera, image, T, None, PointCloud(cloud)) for k, (image, T, cloud) in enumerate(parts)
    ]


def exact(count: int = 4) -> list[Swept]:
    """Keyframes as a perfect sweep would leave them."""
    return [
        Swept(frame, 1 / z, np.ones(z.shape, bool), 0.5)
        for frame, z in zip(keyframes(count), room(count).z, strict=True)
    ]


def test_what_is_wrong_in_one_keyframe_alone_is_left_out_and_what_is_right_stays() -> None:
    own, *others = exact()
    wrong = np.zeros(own.d.shape, bool)
    wrong[60:120, 80:160] = True
    found = confirmed(replace(own, d=np.where(wrong, np.float32(1.2) * own.d, own.d)), others)
    assert found.valid[wrong].mean() < 0.1 and found.valid[~wrong].mean() > 0.85
    error = np.abs(found.z * own.d - 1)[~wrong & found.valid]
    assert np.quantile(error, 0.95) < 0.01


def test_the_variance_follows_what_keyframes_disagree_by() -> None:
    rng = np.random.default_rng(0)
    sigma = []
    for noise in (0.002, 0.012):
        own, *others = [
            replace(one, d=(one.d * np.exp(noise * rng.standard_normal(one.d.shape))).astype(np.float32))
            for one in exact()
        ]
        found = confirmed(own, others)
        assert found.variance is not None
        relative = np.sqrt(found.variance[found.valid]) / found.z[found.valid]
        error = np.abs(found.z * exact()[0].d - 1)[found.valid]
        assert (error < relative).mean() > 0.68
        sigma.append(float(np.median(relative)))
    assert 3 < sigma[1] / sigma[0] < 9


def test_a_reduced_sweep_is_enlarged_within_surfaces() -> None:
    own, *others = [replace(one, d=one.d[1::2, 1::2].copy(), known=one.known[1::2, 1::2]) for one in exact()]
    found = confirmed(own, others)
    assert found.z.shape == (240, 320)
    assert np.nanmedian(np.abs(found.z / room(4).z[0] - 1)) < 0.01


def test_depth_in_front_of_all_landmarks_counts_only_where_the_images_are_alike() -> None:
    frame, *sources = keyframes()
    image = frame.image.copy()
    image[80:160, 120:200] = 128  # nothing there that a source could show
    bare = np.zeros(image.shape[:2], bool)
    bare[84:156, 124:196] = True
    found = swept(replace(frame, image=image), sources)
    assert frame.landmarks is not None
    in_front = found.d > 1.5 * np.quantile(1 / frame.landmarks.points[:, 2], 0.99)
    assert not (found.known & in_front & bare).any()
    assert found.known[~bare].mean() > 0.98


def test_what_is_not_known_is_neither_confirmed_nor_confirms() -> None:
    own, *others = exact()
    unknown = np.zeros(own.d.shape, bool)
    unknown[60:120, 80:160] = True
    found = confirmed(replace(own, known=~unknown), others)
    assert not found.valid[unknown].any() and found.valid[~unknown].mean() > 0.9
    assert not confirmed(own, [replace(other, known=np.zeros_like(unknown)) for other in others]).valid.any()


def test_a_source_whose_pose_is_wrong_does_not_count() -> None:
    frame, *sources = keyframes()
    turned = sources[0].T_map_camera @ se3.exp(np.array([0.0, 0, 0, 0, 0.12, 0]))
    alone = swept(frame, sources[1:])
    assert np.array_equal(swept(frame, [replace(sources[0], T_map_camera=turned), *sources[1:]]).d, alone.d)
    with pytest.raises(InsufficientParallax, match="where its pose says"):
        swept(frame, [replace(sources[0], T_map_camera=turned)])
    with pytest.raises(InsufficientParallax, match="landmarks"):
        swept(replace(frame, landmarks=None), sources)


def test_keyframes_wait_for_later_ones_and_come_in_order() -> None:
    one = exact()[0]
    many = [replace(one, keyframe=replace(one.keyframe, stamp_ns=k)) for k in range(12)]
    consensus = Consensus()
    came = [[k.stamp_ns for k in consensus.add(s)] for s in many]
    assert came[:4] == [[], [], [], [0]] and came[11] == [8]
    assert [k.stamp_ns for k in consensus.finish()] == [9, 10, 11] and consensus.finish() == []
