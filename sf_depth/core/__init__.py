"""The depth algorithms; importable without ROS."""

# SPDX-License-Identifier: Apache-2.0
