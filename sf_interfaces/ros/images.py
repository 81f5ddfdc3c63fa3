"""sensor_msgs/Image <-> uint8 images and depth maps; CompressedImage is read wherever an Image is."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sf_interfaces.errors import FormatError
from sf_interfaces.ros.compressed import is_compressed, unpack
from sf_interfaces.ros.stamps import Factory, header, sequence
from sf_interfaces.types import DepthMap, UInt8

# encoding -> (dtype, channels, OpenCV conversion to RGB or None when only mono or RGB)
_IMAGE: dict[str, tuple[str, int, int | None]] = {
    "rgb8": ("u1", 3, None),
    "bgr8": ("u1", 3, cv2.COLOR_BGR2RGB),
    "8UC3": ("u1", 3, cv2.COLOR_BGR2RGB),
    "rgba8": ("u1", 4, cv2.COLOR_RGBA2RGB),
    "bgra8": ("u1", 4, cv2.COLOR_BGRA2RGB),
    "8UC4": ("u1", 4, cv2.COLOR_BGRA2RGB),
    "mono8": ("u1", 1, None),
    "8UC1": ("u1", 1, None),
    "mono16": ("u2", 1, None),
    # OpenCV names a Bayer pattern by its second row, ROS by its first.
    "bayer_rggb8": ("u1", 1, cv2.COLOR_BayerBG2RGB),
    "bayer_bggr8": ("u1", 1, cv2.COLOR_BayerRG2RGB),
    "bayer_gbrg8": ("u1", 1, cv2.COLOR_BayerGR2RGB),
    "bayer_grbg8": ("u1", 1, cv2.COLOR_BayerGB2RGB),
    "yuv422": ("u1", 2, cv2.COLOR_YUV2RGB_UYVY),
    "uyvy": ("u1", 2, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": ("u1", 2, cv2.COLOR_YUV2RGB_YUY2),
    "yuyv": ("u1", 2, cv2.COLOR_YUV2RGB_YUY2),
}
_DEPTH = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}
_MILLIMETRES_FULL = 65535  # what Kinect drivers write where they saw nothing


def _pixels(msg: Any, dtype: str, channels: int) -> NDArray[Any]:
    """The pixels [H, W] or [H, W, C] of an Image as a view of its data, padding of rows left out."""
    height, width, step = int(msg.height), int(msg.width), int(msg.step)
    kind = np.dtype(dtype).newbyteorder(">" if msg.is_bigendian else "<")
    row = width * channels * kind.itemsize
    data = np.frombuffer(msg.data, dtype=np.uint8)
    if height < 1 or width < 1:
        raise FormatError(f"image has size {width}x{height}; give images that hold pixels")
    if step < row:
        raise FormatError(f"{msg.encoding} image of width {width} has step {step}, needs {row}; mend its driver")
    needed = step * (height - 1) + row
    if data.size < needed:
        raise FormatError(
            f"{msg.encoding} image of {width}x{height} with step {step} holds {data.size} bytes, "
            f"needs {needed}; mend the driver that wrote it"
        )
    shape = (height, width, channels) if channels > 1 else (height, width)
    strides = (step, channels * kind.itemsize, kind.itemsize) if channels > 1 else (step, kind.itemsize)
    return np.ndarray(shape, kind, buffer=data.data, strides=strides)


def is_depth_encoding(encoding: str) -> bool:
    """Whether an image of this encoding is depth by REP-118 (mono16 is taken for a picture)."""
    return encoding in ("16UC1", "32FC1")


def decode_image(msg: Any) -> UInt8:
    """sensor_msgs/Image or CompressedImage -> RGB [H, W, 3] or mono [H, W] uint8.

    Colour comes out as RGB whatever the encoding; of mono16 the upper byte is kept.

    Raises:
        FormatError: an encoding that is no picture, a step or length that does not fit the size, or damaged data.
    """
    unpacked, encoding = unpack(msg) if is_compressed(msg) else (None, msg.encoding)
    if encoding not in _IMAGE:
        hint = "it is depth" if encoding in _DEPTH else f"known: {', '.join(_IMAGE)}"
        raise FormatError(f"cannot read encoding '{encoding}' as a picture ({hint}); choose another topic")
    dtype, channels, conversion = _IMAGE[encoding]
    if unpacked is not None:
        return np.right_shift(unpacked, 8).astype(np.uint8) if dtype == "u2" else unpacked
    pixels = _pixels(msg, dtype, channels)
    if dtype == "u2":
        return np.right_shift(pixels, 8).astype(np.uint8)
    if conversion is None:
        return np.ascontiguousarray(pixels)
    try:
        return np.asarray(cv2.cvtColor(np.ascontiguousarray(pixels), conversion), dtype=np.uint8)
    except cv2.error as error:
        raise FormatError(
            f"{msg.encoding} image of {msg.width}x{msg.height} cannot be converted to RGB; give an even size"
        ) from error


def decode_depth(msg: Any) -> DepthMap:
    """sensor_msgs/Image or CompressedImage -> depth in metres, by REP-118.

    16UC1 is millimetres with 0 (and 65535, saturated) invalid, 32FC1 is metres; whatever is not finite
    and positive becomes NaN.

    Raises:
        FormatError: an encoding that is no depth, a step or length that does not fit the size, or damaged data.
    """
    unpacked, encoding = unpack(msg) if is_compressed(msg) else (None, msg.encoding)
    if encoding not in _DEPTH:
        raise FormatError(f"cannot read encoding '{encoding}' as depth (16UC1 mm or 32FC1 m); choose another topic")
    pixels = _pixels(msg, _DEPTH[encoding], 1) if unpacked is None else unpacked
    if pixels.dtype.kind == "u":
        z = pixels.astype(np.float32) * np.float32(1e-3)
        z[(pixels == 0) | (pixels == _MILLIMETRES_FULL)] = np.nan
        return DepthMap(z)
    z = pixels.astype(np.float32)
    z[~(np.isfinite(z) & (z > 0))] = np.nan
    return DepthMap(z)


def _image(make: Factory, pixels: NDArray[Any], encoding: str, stamp_ns: int, frame_id: str) -> Any:
    pixels = np.ascontiguousarray(pixels)
    cls = make("sensor_msgs/msg/Image")
    return cls(
        header=header(make, stamp_ns, frame_id),
        height=pixels.shape[0],
        width=pixels.shape[1],
        encoding=encoding,
        is_bigendian=0,
        step=pixels.strides[0],
        data=sequence(cls, pixels.view(np.uint8)),
    )


def encode_image(make: Factory, image: UInt8 | NDArray[np.uint16], stamp_ns: int, frame_id: str) -> Any:
    """RGB [H, W, 3] uint8 -> rgb8, mono [H, W] -> mono8 (uint8) or mono16 (uint16).

    Raises:
        FormatError: another type or shape.
    """
    image = np.asarray(image)
    encoding = {("uint8", 3): "rgb8", ("uint8", 2): "mono8", ("uint16", 2): "mono16"}.get(
        (image.dtype.name, image.ndim)
    )
    if encoding is None or (image.ndim == 3 and image.shape[2] != 3):
        raise FormatError(f"image must be uint8 (H, W) or (H, W, 3), or uint16 (H, W), got {image.dtype} {image.shape}")
    return _image(make, image, encoding, stamp_ns, frame_id)


def encode_depth(make: Factory, depth: DepthMap, stamp_ns: int, frame_id: str, encoding: str = "32FC1") -> Any:
    """Depth -> Image of 32FC1 (m, NaN invalid) or 16UC1 (mm rounded, 0 invalid or beyond 65.534 m).

    Raises:
        FormatError: another encoding.
    """
    if encoding == "32FC1":
        return _image(make, np.where(depth.valid, depth.z, np.float32(np.nan)), encoding, stamp_ns, frame_id)
    if encoding != "16UC1":
        raise FormatError(f"depth cannot be written as '{encoding}'; use 32FC1 or 16UC1")
    mm = np.rint(np.where(depth.valid, depth.z, 0).astype(np.float64) * 1000)
    mm[mm >= _MILLIMETRES_FULL] = 0
    return _image(make, mm.astype("<u2"), encoding, stamp_ns, frame_id)


def encode_variance(make: Factory, depth: DepthMap, stamp_ns: int, frame_id: str) -> Any:
    """The variance of a depth map as a 32FC1 image in m^2, NaN where unknown."""
    variance = np.full_like(depth.z, np.nan) if depth.variance is None else depth.variance
    return _image(make, variance, "32FC1", stamp_ns, frame_id)


def decode_variance(msg: Any) -> NDArray[np.float32]:
    """A 32FC1 image of variances [H, W] in m^2.

    Raises:
        FormatError: another encoding, or a malformed image.
    """
    if msg.encoding != "32FC1":
        raise FormatError(f"depth variance must be 32FC1 in m^2, got '{msg.encoding}'; choose another topic")
    return _pixels(msg, "f4", 1).astype(np.float32)
