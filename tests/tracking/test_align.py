"""Alignment of patches: sub-pixel accuracy under warps and changes of light, and honest confidence."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import cv2
import numpy as np
import pytest

from sf_tracking.core.align import align, describe

SIDE = 11


def texture(seed: int) -> np.ndarray:
    """Smooth random image [240, 320] of several octaves, float32 grey levels."""
    rng = np.random.default_rng(seed)
    octaves = [cv2.resize(rng.normal(size=(s, s)), (320, 240), interpolation=cv2.INTER_CUBIC) for s in (20, 45, 90)]
    return (128 + 30 * sum(octaves)).astype(np.float32)


def places(seed: int, count: int = 60) -> np.ndarray:
    return np.random.default_rng(seed).integers(30, (290, 210), (count, 2)) + 0.5


def warped(image: np.ndarray, A: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """The image that shows ``image`` moved by x -> A (x - c) + c + shift, continuous px, c its middle."""
    c = np.array([160.0, 120.0])
    offset = c + shift - A @ c + (A @ np.full(2, 0.5) - 0.5)  # OpenCV counts centres from 0
    return cv2.warpAffine(image, np.column_stack([A, offset]), (320, 240), flags=cv2.INTER_CUBIC)


@pytest.mark.parametrize(("gain", "bias"), [(1.0, 0.0), (0.5, 20.0), (1.5, -30.0)])
def test_shifted_patches_are_found_to_hundredths_of_a_pixel(gain: float, bias: float) -> None:
    image, uv = texture(1), places(1)
    A, shift = np.array([[1.05, 0.06], [-0.04, 0.93]]), np.array([3.3, -1.8])
    target = gain * warped(image, A, shift) + bias
    truth = (uv - (160, 120)) @ A.T + (160, 120) + shift
    start = truth + np.random.default_rng(2).uniform(-1.0, 1.0, truth.shape)
    found = align(target.astype(np.float32), describe(image, uv, SIDE), start, np.broadcast_to(A, (60, 2, 2)), 15)
    error = np.linalg.norm(found.centre - truth, axis=1)
    assert np.median(error) < 0.04 and np.percentile(error, 90) < 0.1  # warpAffine rounds to 1/32 px
    assert np.median(found.gain) == pytest.approx(gain, rel=0.05)
    assert np.median(found.explained) > 0.98


def test_confidence_foretells_the_error_under_noise() -> None:
    image, uv = texture(3), places(3, 200)
    noisy = image + np.random.default_rng(4).normal(0, 4.0, image.shape).astype(np.float32)
    found = align(noisy, describe(image, uv, SIDE), uv, np.broadcast_to(np.eye(2), (200, 2, 2)), 15)
    error = found.centre - uv
    squared = np.einsum("ei,eij,ej->e", error, np.linalg.inv(found.covariance), error)
    assert 1.0 < np.mean(squared) < 4.0  # two degrees of freedom: 2 when the covariance is exact


def test_confidence_is_low_along_an_edge_of_the_image() -> None:
    step = np.zeros((240, 320), np.float32)
    step[:, 160:] = 200.0  # only horizontal gradients: vertical motion is unobservable
    step += np.random.default_rng(0).normal(0, 1.0, step.shape).astype(np.float32)
    uv = np.array([[160.5, 100.5]])
    found = align(step, describe(step, uv, SIDE), uv + np.array([0.3, 0.0]), np.eye(2)[None], 5)
    assert found.covariance[0, 1, 1] > 10 * found.covariance[0, 0, 0]


def test_another_texture_explains_nothing() -> None:
    uv = places(5)
    found = align(texture(6), describe(texture(5), uv, SIDE), uv, np.broadcast_to(np.eye(2), (60, 2, 2)), 5)
    assert np.median(found.explained) < 0.6
