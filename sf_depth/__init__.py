"""Depth: completes what the sensor left out, with the variance of every pixel."""

# SPDX-License-Identifier: Apache-2.0
