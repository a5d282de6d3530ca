# SPDX-License-Identifier: Apache-2.0
"""Simulator of a harbour, a vessel in it, its sensors and recordings, with known truth."""

from graphloc.eval.simulate._run import SimulatedRun, simulate
from graphloc.eval.simulate._scenario import Scenario, bl_scenario, find_scenario, harbour_scenarios

__all__ = ["Scenario", "SimulatedRun", "bl_scenario", "find_scenario", "harbour_scenarios", "simulate"]
