# SPDX-License-Identifier: Apache-2.0
"""A simulator of trajectory, IMU, GNSS, compass and pose measurements, so that truth exists."""

from graphloc.eval.simulate._scenario import (
    Scenario,
    SimulatedRun,
    bl_scenario,
    find_scenario,
    harbour_scenarios,
    simulate,
)

__all__ = ["Scenario", "SimulatedRun", "bl_scenario", "find_scenario", "harbour_scenarios", "simulate"]
