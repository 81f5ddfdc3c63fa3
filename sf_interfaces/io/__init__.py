"""Files: bags, data sets and trajectories."""

# SPDX-License-Identifier: Apache-2.0
