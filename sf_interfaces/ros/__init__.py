"""Everything that meets ROS messages. Only modules here may be handed rclpy or rosbags objects."""

# SPDX-License-Identifier: Apache-2.0
