"""The algorithm; importable without ROS."""

# SPDX-License-Identifier: Apache-2.0
