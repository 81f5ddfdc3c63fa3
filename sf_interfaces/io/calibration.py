"""Calibration files: intrinsics in the YAML of ROS camera_calibration, extrinsics as 4x4 numbers."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from pathlib import Path

import numpy as np
import yaml

from sf_interfaces.errors import CalibrationError, FormatError
from sf_interfaces.geometry.undistort import Distortion
from sf_interfaces.types import Camera, Float64, check_pose


def read_camera(path: Path) -> tuple[Camera, Distortion | None]:
    """Intrinsics and lens distortion (plumb_bob, rational_polynomial, equidistant; None where all are zero).

    The frame is the file's camera_name.

    Raises:
        CalibrationError: unreadable, a key is missing, skew, or a distortion model that is not known.
    """
    try:
        values = yaml.safe_load(path.read_text())
        k = [float(v) for v in values["camera_matrix"]["data"]]
        size = int(values["image_width"]), int(values["image_height"])
        lens = [float(v) for v in (values.get("distortion_coefficients") or {}).get("data") or []]
        model = str(values.get("distortion_model") or "plumb_bob")
        name = str(values.get("camera_name") or "camera_optical_frame")
        if len(k) != 9 or abs(k[1]) > 1e-9 * k[0]:
            raise CalibrationError(f"camera_matrix in {path} must be 3x3 without skew; rectify the images first")
        camera = Camera(*size, k[0], k[4], k[2] + 0.5, k[5] + 0.5, name)
        return camera, Distortion(model, tuple(lens)) if any(lens) else None
    except CalibrationError as error:
        raise CalibrationError(f"calibration {path}: {error}") from error
    except (OSError, UnicodeDecodeError, yaml.YAMLError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise CalibrationError(
            f"cannot read calibration {path} ({error!r}); it needs image_width, image_height, camera_matrix.data and, "
            "for a lens, distortion_model and distortion_coefficients.data"
        ) from error


def read_extrinsic(path: Path) -> Float64:
    """T_camera_lidar [4, 4] from a text file of 4x4 numbers.

    Raises:
        CalibrationError: unreadable or not a rigid motion.
    """
    try:
        return check_pose(np.loadtxt(path), f"extrinsic {path}")
    except (OSError, ValueError, FormatError) as error:
        raise CalibrationError(f"cannot read T_camera_lidar from {path}: {error}; give 4 rows of 4 numbers") from error
