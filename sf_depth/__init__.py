"""Completes the depth: multi-view estimation and completion of sparse depth, with variance."""

# SPDX-License-Identifier: Apache-2.0
