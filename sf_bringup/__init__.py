"""Starts things: planner, orchestrator, player, recorder and the command line."""

# SPDX-License-Identifier: Apache-2.0
