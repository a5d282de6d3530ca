# SPDX-License-Identifier: Apache-2.0
"""Simulated runs that are solved in half the time."""

from dataclasses import replace

from graphloc.config import TimelineConfig, VesselConfig
from graphloc.eval.simulate import SimulatedRun


def with_few_states(config: VesselConfig) -> VesselConfig:
    """Five states a second instead of ten, which is enough for anything but what states themselves are asked."""
    return config.model_copy(update={"timeline": TimelineConfig(rate_hz=5.0)})


def slowly(run: SimulatedRun) -> SimulatedRun:
    """A run `with_few_states`."""
    return replace(run, config=with_few_states(run.config))
