"""The algorithm of the reconstruction block, without ROS."""
# SPDX-License-Identifier: Apache-2.0
