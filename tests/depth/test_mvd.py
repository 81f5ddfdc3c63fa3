"""U2-MVD on simulated views: depth, poses and focal length in all settings, honest refusals."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from threadpoolctl import threadpool_limits
from views import Views, room, rotation_error_deg

from sf_depth.config import DepthConfig
from sf_depth.core import matching, pinhole
from sf_depth.core.calibrate import Calibrator
from sf_depth.core.matching import FlowMatcher, load_matcher, pixel_grid
from sf_depth.core.mvd import MultiViewDepth, Recovered
from sf_depth.core.photoset import PhotoSetDepth
from sf_depth.core.sequence import PosedSetting, SequenceDepth, SlamSetting
from sf_interfaces.errors import ConfigError, FormatError, InsufficientParallax, SceneFactoryError
from sf_interfaces.geometry import se3
from sf_interfaces.types import DepthMap, Frame, Keyframe, PointCloud

MVD = MultiViewDepth(DepthConfig(), lens=True)


def relative_error(depth: DepthMap, truth: np.ndarray, *, absolute: bool) -> np.ndarray:
    both = depth.valid & np.isfinite(truth)
    factor = 1.0 if absolute else np.median(truth[both] / depth.z[both])
    return np.abs(depth.z[both] * factor / truth[both] - 1)


def recovered(views: Views, mode: str) -> Recovered:
    camera = None if mode == "unknown" else views.camera
    T = views.T_source_reference if mode == "posed" else None
    return MVD.recover(views.images[0], views.images[1:], camera, T)


@pytest.mark.parametrize("mode", ["unknown", "intrinsics", "posed"])
def test_depth_is_right_in_all_three_settings(mode: str) -> None:
    views = room()
    found = recovered(views, mode)
    error = relative_error(found.depth, views.z[0], absolute=mode == "posed")
    assert found.depth.density > 0.6 and found.registered.all()
    assert error.mean() < 0.019 and np.mean(error < 0.03) > 0.8
    assert rotation_error_deg(found.T_source_reference, views.T_source_reference) < 0.3
    assert abs(found.camera.fx / views.camera.fx - 1) < 0.01
    assert (found.focal_sigma > 0) == (mode == "unknown")
    assert found.distortion == 0.0


def through_a_lens(views: Views, k1: float) -> list[np.ndarray]:
    """The images with a radial term."""
    theta = pinhole.theta_of(views.camera)
    x = pinhole.rays(np.append(theta[:4], k1), pixel_grid(views.images[0].shape).reshape(-1, 2).T.astype(np.float64))
    at = pinhole.project(theta, x).T.reshape(*views.images[0].shape[:2], 2).astype(np.float32)
    return [matching.sample(image, at) for image in views.images]


@pytest.mark.parametrize("known", [True, False])
def test_a_lens_that_the_images_show_is_found_and_taken_out(known: bool) -> None:
    views, k1 = room(), -0.08
    bent, camera = through_a_lens(views, k1), views.camera if known else None
    found = MVD.recover(bent[0], bent[1:], camera)
    assert abs(found.distortion / k1 - 1) < 0.15 and abs(found.camera.fx / views.camera.fx - 1) < 0.01
    frames = [Frame(i, camera, image) for i, image in enumerate(bent)]
    made = PhotoSetDepth(DepthConfig()).estimate(frames)
    assert any("a lens" in reason for reason in made.reasons)
    first = next(k for k in made.observed if k.stamp_ns == 0)
    inside = (slice(20, -20), slice(20, -20))
    assert np.mean(np.abs(first.image[inside].astype(float) - views.images[0][inside])) < 0.6 * np.mean(
        np.abs(bent[0][inside].astype(float) - views.images[0][inside])
    )
    assert relative_error(first.depth, views.z[0], absolute=False).mean() < 0.02


def test_the_number_of_threads_changes_nothing() -> None:
    views, found = room(), []
    for threads in (1, 2):
        with threadpool_limits(threads):
            found.append(MVD.recover(views.images[0], views.images[1:]))
    np.testing.assert_array_equal(found[0].depth.z, found[1].depth.z)
    assert found[0].camera == found[1].camera


def test_variance_grows_where_parallax_is_poor() -> None:
    views = room()
    near_by = room(3, baseline=0.1)
    far, near = recovered(views, "posed").depth, recovered(near_by, "posed").depth
    assert far.variance is not None and near.variance is not None
    assert np.nanmedian(near.variance) > 4 * np.nanmedian(far.variance)


def test_seeded_flow_beats_plain_flow_under_rotation_and_large_motion() -> None:
    views = room(3, roll_deg=35.0)
    truth = views.camera.unproject(views.camera.pixel_grid(), views.z[0].astype(np.float64))
    uv, _ = views.camera.project(se3.transform(views.T_source_reference[0], truth))
    inside = (uv > 0).all(axis=2) & (uv < (320, 240)).all(axis=2)
    plain = pixel_grid(views.z[0].shape) + matching.flow(*(matching.grey(i) for i in views.images[:2]))
    ours = FlowMatcher()(views.images[0], views.images[1]).target
    good = [np.mean(np.linalg.norm(flow - uv, axis=2)[inside] < 3) for flow in (plain, ours)]
    assert good[1] > 0.6 and good[1] > good[0] + 0.2


def test_no_result_without_parallax() -> None:
    image = room().images[0]
    with pytest.raises(InsufficientParallax, match="no parallax"):
        MVD.recover(image, [image, image])


def test_bad_sets_of_images_are_refused() -> None:
    image = room().images[0]
    with pytest.raises(FormatError, match="at least 2 images"):
        MVD.recover(image, [])
    with pytest.raises(FormatError, match="differ in size"):
        MVD.recover(image, [image[:200]])
    with pytest.raises(FormatError, match="image 1 is blank"):
        MVD.recover(image, [np.zeros_like(image)])
    noise = [np.random.default_rng(k).integers(0, 255, image.shape, dtype=np.uint8) for k in range(3)]
    with pytest.raises(InsufficientParallax):
        MVD.recover(noise[0], noise[1:])


def test_unknown_matchers_are_named() -> None:
    with pytest.raises(ConfigError, match="no matcher 'telepathy' is installed"):
        load_matcher("telepathy")


def test_every_image_of_a_set_gets_depth_and_pose() -> None:
    views = room(4)
    frames = [Frame(10**9 * (k + 1), None, image) for k, image in enumerate(views.images)]
    made = PhotoSetDepth(DepthConfig()).estimate(frames)
    assert len(made.keyframes) == len(made.trajectory) == 4 and not made.reasons
    relative = se3.inverse(made.trajectory.poses[1:]) @ made.trajectory.poses[0]
    assert rotation_error_deg(relative, views.T_source_reference) < 0.3
    length = np.linalg.norm(relative[:, :3, 3], axis=1) / np.linalg.norm(views.T_source_reference[:, :3, 3], axis=1)
    assert np.ptp(length) < 0.04 * length.mean()
    for keyframe, z in zip(made.observed, views.z, strict=True):
        assert relative_error(keyframe.depth, z * np.float32(length.mean()), absolute=True).mean() < 0.03
    assert all(keyframe.depth.density == 1.0 for keyframe in made.keyframes)


def keyframes(views: Views) -> list[Keyframe]:
    out = []
    for k, (image, z, T) in enumerate(zip(views.images, views.z, views.poses, strict=True)):
        points = views.camera.unproject(views.camera.pixel_grid()[5::20, 5::20], z[5::20, 5::20].astype(np.float64))
        landmarks = PointCloud(points.reshape(-1, 3))
        out.append(Keyframe(10**9 * (k + 1), views.camera, image, T, None, landmarks))
    return out


@pytest.mark.parametrize("setting", [SlamSetting(), PosedSetting(0.0)])
def test_keyframes_of_a_sequence_get_depth_at_its_scale(setting: SlamSetting | PosedSetting) -> None:
    views = room(4)
    part = SequenceDepth(DepthConfig(min_baseline=0.01), setting)
    done = [dense for keyframe in keyframes(views) for dense in part.add(keyframe)] + part.finish()
    assert [dense.stamp_ns for dense in done] == [10**9 * (k + 1) for k in range(4)], part.reasons
    for dense, z in zip(done, views.z, strict=True):
        error = np.abs(dense.depth.z / z - 1)
        assert np.nanmedian(error) < 0.02


def test_a_still_camera_is_reported_not_guessed() -> None:
    frame = keyframes(room(4))[0]
    part = SequenceDepth(DepthConfig(), SlamSetting())
    for k in range(9):
        part.add(Keyframe(k + 1, frame.camera, frame.image, frame.T_map_camera, None, frame.landmarks))
    assert part.finish() == [] and any("too few good neighbours" in reason for reason in part.reasons)


def test_calibration_from_the_first_images() -> None:
    views = room()
    calibrator = Calibrator(DepthConfig())
    cameras = [calibrator.add(image) for image in views.images]
    camera = next((c for c in cameras if c is not None), None) or calibrator.finish()
    assert abs(camera.fx / views.camera.fx - 1) < 0.01
    with pytest.raises(SceneFactoryError, match="calibrate the camera from"):
        Calibrator(DepthConfig()).finish()
