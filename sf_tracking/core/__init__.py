"""The tracking algorithm, free of ROS."""

# SPDX-License-Identifier: Apache-2.0
