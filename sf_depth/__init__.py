"""The depth block."""

# SPDX-License-Identifier: Apache-2.0
