"""Geometry used by every block: rigid motions, cameras, alignment and LiDAR projection."""

# SPDX-License-Identifier: Apache-2.0
