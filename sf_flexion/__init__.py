"""Flexion: an image made of depth alone, for tracking and colouring where no camera image exists."""

# SPDX-License-Identifier: Apache-2.0
