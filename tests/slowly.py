# SPDX-License-Identifier: Apache-2.0
"""Simulated runs that are solved in half the time or less."""

from dataclasses import replace

from graphloc.config import TimelineConfig, VesselConfig
from graphloc.eval.simulate import Scenario, SimulatedRun, simulate


def with_few_states(config: VesselConfig, rate_hz: float = 2.5) -> VesselConfig:
    """Two and a half states a second instead of ten: measurements between them are carried there by the IMU."""
    return config.model_copy(update={"timeline": TimelineConfig(rate_hz=rate_hz)})


def slowly(run: SimulatedRun, rate_hz: float = 2.5) -> SimulatedRun:
    """A run `with_few_states`."""
    return replace(run, config=with_few_states(run.config, rate_hz))


def simulate_slowly(scenario: Scenario, seed: int, rate_hz: float = 2.5) -> SimulatedRun:
    """Simulate a run `with_few_states`."""
    return slowly(simulate(scenario, seed), rate_hz)
