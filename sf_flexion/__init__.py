"""Completes the image: flexion images from depth, for sensors without colour."""

# SPDX-License-Identifier: Apache-2.0
