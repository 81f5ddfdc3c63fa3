"""Measures as pure functions of arrays: trajectories, depth maps, surfaces and images. Formulae: docs/evaluation.md."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from sf_bringup.evaluation.depth import DepthError, depth_error, mean_depth_error
from sf_bringup.evaluation.image import psnr, ssim
from sf_bringup.evaluation.mesh import Samples, SurfaceError, surface_error
from sf_bringup.evaluation.trajectory import (
    TrajectoryError,
    align_trajectories,
    interpolate_pose,
    match_stamps,
    trajectory_error,
)

__all__ = [
    "DepthError",
    "Samples",
    "SurfaceError",
    "TrajectoryError",
    "align_trajectories",
    "depth_error",
    "interpolate_pose",
    "match_stamps",
    "mean_depth_error",
    "psnr",
    "ssim",
    "surface_error",
    "trajectory_error",
]
