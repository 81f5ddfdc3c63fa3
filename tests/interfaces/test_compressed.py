"""CompressedImage is read wherever an Image is: JPEG, PNG, compressedDepth, and what is wrong with others."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import struct
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from sf_interfaces.errors import FormatError
from sf_interfaces.ros.compressed import encoding_of
from sf_interfaces.ros.messages import decode_depth, decode_image

RNG = np.random.default_rng(0)
SMOOTH = np.stack([*np.meshgrid(np.linspace(20, 200, 64), np.linspace(60, 220, 48)), np.full((48, 64), 90.0)], axis=-1)
RGB = SMOOTH.astype(np.uint8)
MM = RNG.integers(400, 5000, (48, 64)).astype(np.uint16)
MM[RNG.random(MM.shape) < 0.1] = 0


def compressed(form: str, data: Any) -> SimpleNamespace:
    return SimpleNamespace(format=form, data=np.frombuffer(bytes(data), np.uint8))


def encoded(suffix: str, pixels: np.ndarray) -> bytes:
    return cv2.imencode(suffix, pixels)[1].tobytes()


@pytest.mark.parametrize("form", ["jpeg", "rgb8; jpeg compressed bgr8", "bgr8; jpeg compressed bgr8"])
def test_jpeg_comes_out_as_rgb(form: str) -> None:
    image = decode_image(compressed(form, encoded(".jpg", RGB[..., ::-1])))
    assert image.shape == RGB.shape and np.abs(image.astype(int) - RGB).mean() < 3


def test_png_is_exact_in_colour_grey_and_with_alpha() -> None:
    np.testing.assert_array_equal(decode_image(compressed("png", encoded(".png", RGB[..., ::-1]))), RGB)
    grey = compressed("mono8; png compressed mono8", encoded(".png", RGB[..., 0]))
    np.testing.assert_array_equal(decode_image(grey), RGB[..., 0])
    alpha = np.dstack([RGB[..., ::-1], np.full(RGB.shape[:2], 7, np.uint8)])
    np.testing.assert_array_equal(decode_image(compressed("bgra8; png compressed bgra8", encoded(".png", alpha))), RGB)


def test_colours_that_were_compressed_as_if_bgr_are_put_right() -> None:
    message = compressed("rgb8; png compressed rgb8", encoded(".png", RGB))
    np.testing.assert_array_equal(decode_image(message), RGB)


def test_sixteen_bit_grey_keeps_its_upper_byte() -> None:
    message = compressed("mono16; png compressed mono16", encoded(".png", MM * 13))
    np.testing.assert_array_equal(decode_image(message), ((MM * 13) >> 8).astype(np.uint8))


@pytest.mark.parametrize("form", ["png", "16UC1; png compressed 16UC1"])
def test_depth_in_png_is_millimetres(form: str) -> None:
    message = compressed(form, encoded(".png", MM))
    assert encoding_of(message) == "16UC1"
    np.testing.assert_allclose(decode_depth(message).z, np.where(MM == 0, np.nan, MM / 1000), rtol=1e-6)


def test_compressed_depth_in_millimetres() -> None:
    message = compressed("16UC1; compressedDepth png", struct.pack("<iff", 0, 0, 0) + encoded(".png", MM))
    np.testing.assert_allclose(decode_depth(message).z, np.where(MM == 0, np.nan, MM / 1000), rtol=1e-6)


@pytest.mark.parametrize("form", ["32FC1; compressedDepth png", "32FC1; compressedDepth", "compressedDepth png"])
def test_compressed_depth_of_floats_is_quantised_inverse_depth(form: str) -> None:
    z = np.where(MM == 0, np.nan, MM / 1000)
    quantisation, far = 100.0, 10.0  # the publisher's defaults: z = A / (q - B)
    a = quantisation * (quantisation + 1)
    b = 1 - a / far
    q = np.where(np.isnan(z), 0, np.rint(a / z + b)).astype(np.uint16)
    found = decode_depth(compressed(form, struct.pack("<iff", 1, a, b) + encoded(".png", q))).z
    assert np.array_equal(np.isnan(found), np.isnan(z))
    np.testing.assert_allclose(found[MM > 0], z[MM > 0], rtol=0.01)


@pytest.mark.parametrize(
    ("form", "data", "says"),
    [
        ("jpeg", b"", "empty"),
        ("jpeg", b"not an image at all", "damaged"),
        ("png", encoded(".png", RGB)[:40], "damaged"),
        ("16UC1; jpeg compressed mono8", encoded(".jpg", RGB[..., 0]), "lossy"),
        ("16UC1; compressedDepth rvl", b"0" * 40, "rvl"),
        ("16UC1; compressedDepth png", b"0" * 12, "too few"),
        ("16UC1; compressedDepth png", b"0" * 12 + encoded(".png", RGB), "one channel"),
    ],
)
def test_what_cannot_be_read_is_said_in_words(form: str, data: bytes, says: str) -> None:
    with pytest.raises(FormatError, match=says):
        decode_depth(compressed(form, data))
    with pytest.raises(FormatError):
        decode_image(compressed(form, data))


def test_depth_is_no_picture_and_a_picture_no_depth() -> None:
    with pytest.raises(FormatError, match="it is depth"):
        decode_image(compressed("16UC1; png compressed 16UC1", encoded(".png", MM)))
    with pytest.raises(FormatError, match="as depth"):
        decode_depth(compressed("jpeg", encoded(".jpg", RGB)))
