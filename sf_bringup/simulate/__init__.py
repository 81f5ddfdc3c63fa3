"""Simulated recordings with exact ground truth: ``simulate(PRESETS["demo"], Path("demo.mcap"))``."""

# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from sf_bringup.simulate.simulator import SimulationSummary, Simulator, simulate
from sf_bringup.simulate.spec import PRESETS, SimulationSpec

__all__ = ["PRESETS", "SimulationSpec", "SimulationSummary", "Simulator", "simulate"]
