"""sensor_msgs/CompressedImage: JPEG, PNG, and image_transport's compressedDepth.

``format`` names the encoding before compression and the codec: ``jpeg``, ``rgb8; jpeg compressed bgr8``,
``16UC1; png compressed 16UC1``, ``32FC1; compressedDepth png``.
"""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import struct
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sf_interfaces.errors import FormatError

COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
_DEPTH_HEADER = struct.Struct("<iff")  # format, quantisation A and B: z = A / (q - B)
_ENCODINGS = ("mono8", "8UC1", "mono16", "16UC1", "32FC1", "rgb8", "bgr8", "rgba8", "bgra8", "8UC3")


def is_compressed(msg: Any) -> bool:
    """Whether a message is a CompressedImage (an Image has ``encoding`` in place of ``format``)."""
    return hasattr(msg, "format")


def encoding_of(msg: Any) -> str:
    """The encoding of an Image, or of a CompressedImage once unpacked.

    Raises:
        FormatError: the compressed image cannot be unpacked.
    """
    return unpack(msg)[1] if is_compressed(msg) else str(msg.encoding)


def unpack(msg: Any) -> tuple[NDArray[Any], str]:
    """The pixels of a CompressedImage and their encoding: rgb8, mono8, mono16, 16UC1 (mm) or 32FC1 (m).

    Raises:
        FormatError: damaged data, a codec that is not read, or depth that went through a lossy one.
    """
    declared, _, codec = (part.strip() for part in msg.format.partition(";"))
    data = np.frombuffer(msg.data, dtype=np.uint8)
    if "compressedDepth" in msg.format:
        return _unpack_depth(data, declared, msg.format)
    pixels = _image(data, msg.format)
    declared = declared if declared in _ENCODINGS else ""
    if pixels.dtype == np.uint16 and pixels.ndim == 2:
        return pixels, declared if declared in ("mono16", "16UC1") else "16UC1"
    if declared in ("16UC1", "32FC1"):
        raise FormatError(f"depth went through a lossy codec ('{msg.format}'); publish it as compressedDepth or png")
    if pixels.dtype == np.uint16:
        pixels = np.right_shift(pixels, 8).astype(np.uint8)
    if pixels.ndim == 2:
        return pixels, "mono8"
    pixels = pixels[..., :3]
    # Publishers that compressed RGB as if it were BGR say so; the file's red is then blue.
    return np.ascontiguousarray(pixels if "compressed rgb8" in codec else pixels[..., ::-1]), "rgb8"


def _image(data: NDArray[np.uint8], form: str) -> NDArray[Any]:
    if not data.size:
        raise FormatError(f"compressed image ('{form}') is empty; mend the node that wrote it")
    try:
        pixels = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    except cv2.error:  # sizes beyond OpenCV's limits
        pixels = None
    if pixels is None or pixels.dtype not in (np.uint8, np.uint16):
        raise FormatError(
            f"compressed image ('{form}') is damaged or no JPEG or PNG of 8 or 16 bits; check its publisher"
        )
    return np.asarray(pixels)


def _unpack_depth(data: NDArray[np.uint8], declared: str, form: str) -> tuple[NDArray[Any], str]:
    """image_transport's compressedDepth: a header of 12 bytes, then a 16-bit PNG of mm or of scaled inverse depth."""
    if "rvl" in form:
        raise FormatError("compressedDepth of codec rvl is not read; set the publisher's format to png")
    if data.size <= _DEPTH_HEADER.size:
        raise FormatError(
            f"compressedDepth holds {data.size} bytes, too few for its header; mend the node that wrote it"
        )
    _, a, b = _DEPTH_HEADER.unpack(data[: _DEPTH_HEADER.size].tobytes())
    q = _image(data[_DEPTH_HEADER.size :], form)
    if q.dtype != np.uint16 or q.ndim != 2:
        raise FormatError(f"compressedDepth ('{form}') must hold one channel of 16 bits, got {q.dtype} {q.shape}")
    if declared == "16UC1" or (declared != "32FC1" and a == 0):
        return q, "16UC1"
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        z = np.float32(a) / (q.astype(np.float32) - np.float32(b))
    z[q == 0] = np.nan
    return z, "32FC1"
