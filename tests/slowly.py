# SPDX-License-Identifier: Apache-2.0
"""Simulated runs that are solved in half the time or less."""

from collections import Counter
from dataclasses import replace

import pytest

from graphloc import app
from graphloc.app import _estimate
from graphloc.config import TimelineConfig, VesselConfig
from graphloc.eval.simulate import Scenario, SimulatedRun, simulate
from graphloc.measurements import CompassHeading, GnssPosition


def with_few_states(config: VesselConfig, rate_hz: float = 2.5) -> VesselConfig:
    """Two and a half states a second instead of ten: measurements between them are carried there by the IMU."""
    return config.model_copy(update={"timeline": TimelineConfig(rate_hz=rate_hz)})


def slowly(run: SimulatedRun, rate_hz: float = 2.5) -> SimulatedRun:
    """A run `with_few_states`."""
    return replace(run, config=with_few_states(run.config, rate_hz))


def simulate_slowly(scenario: Scenario, seed: int, rate_hz: float = 2.5) -> SimulatedRun:
    """Simulate a run `with_few_states`."""
    return slowly(simulate(scenario, seed), rate_hz)


def sparsely(run: SimulatedRun, every: int = 4) -> SimulatedRun:
    """A run without its fixes and headings but for every fourth; its matches are the same, as lower rates in the scenario draw others."""
    kept, seen = [], Counter[str]()
    for m in run.recording.measurements:
        if isinstance(m, GnssPosition | CompassHeading):
            seen[m.sensor] += 1
            if seen[m.sensor] % every != 1:
                continue
        kept.append(m)
    gone = len(run.recording.measurements) - len(kept)
    recording = replace(run.recording, measurements=tuple(kept), message_count=run.recording.message_count - gone)
    return replace(run, recording=recording)


def beside_filters(run: SimulatedRun) -> app.Run:
    """Solve a run, and the filters beside it, but not the online mode: a third to a half of the time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_estimate, "_online", lambda *_: (None, ""))
        return app.simulated(run, compare=True)
