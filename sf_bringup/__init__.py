"""What starts things: command line, planner, player, recorder, demos."""

# SPDX-License-Identifier: Apache-2.0
