"""Completes the pose: visual odometry and SLAM on colour, depth or flexion images."""

# SPDX-License-Identifier: Apache-2.0
