# SPDX-License-Identifier: Apache-2.0
"""The height of a vessel that floats, where the fixes' median stands for it."""

from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from graphloc import app
from graphloc.config import HeightConfig
from graphloc.eval.simulate import Scenario, SimulatedRun, simulate
from graphloc.factors.height import slow
from graphloc.measurements import GnssPosition, Measurement
from graphloc.replay import replay
from graphloc.trajectory import Trajectory, bounds_95
from tests.faults import arrivals_of, feed
from tests.slowly import with_few_states
from tests.test_online_faults import smoother

UP_M = 4.0  # a slow error of height that lasts longer than the run


def raised(sigma_m: float) -> SimulatedRun:
    run = simulate(
        Scenario(duration_s=30.0, noise="clean", false_fraction=0.0, imu_hz=50.0, gnss_hz=2.0, compass_hz=2.0), 3
    )

    def up(m: Measurement) -> Measurement:
        if not isinstance(m, GnssPosition):
            return m
        return replace(m, position=m.position._replace(height_m=m.position.height_m + UP_M))

    height = HeightConfig(median_sigma_m=sigma_m)
    config = with_few_states(run.config.with_sensors({"height": height}), 1.25)
    return replace(run, recording=run.recording.changed(up), config=config)


def in_bounds(track: Trajectory, truth: Trajectory) -> float:
    """Return for which share of the states the height is inside its bound."""
    assert track.cov is not None
    both = truth.covers(track.stamps_ns)
    off_m = np.abs(track.p_world_m[both, 2] - truth.at(track.stamps_ns[both]).p_world_m[:, 2])
    return float((off_m < bounds_95(track.cov[both])[:, 1]).mean())


@pytest.mark.parametrize("mode", ["offline", "online"])
def test_the_median_of_fixes_is_no_better_than_their_slow_error(mode: Literal["offline", "online"]) -> None:
    """Believed to a tide, it was 4 m off with bounds of 1 m."""
    inside = []
    for sigma_m in (0.0, 5.0):
        run = raised(sigma_m)
        found = app.simulated(run).solution if mode == "offline" else replay(run.recording, run.config).solution
        inside.append(in_bounds(found.trajectory, run.truth))
    assert inside == [0.0, 1.0]


@pytest.mark.parametrize(("height_m", "sigma_m"), [(None, np.hypot(0.5, 5.0)), (7.0, 0.5)])
def test_a_configured_height_is_off_by_tide_and_load_alone(height_m: float | None, sigma_m: float) -> None:
    process = slow(HeightConfig(height_m=height_m))
    assert process is not None
    assert process.sigma == pytest.approx(sigma_m)


def test_a_height_that_has_been_set_since_a_snapshot_counts(tmp_path: Path) -> None:
    """Not the median in it, by fixes that are 4 m high."""
    run, path = raised(5.0), tmp_path / "snapshot.json"
    mean_m = float(run.truth.p_world_m[:, 2].mean())
    assert run.config.datum is not None
    block = HeightConfig(height_m=run.config.datum.height_m + mean_m)
    measured = replace(run, config=run.config.with_sensors({"height": block}))
    came = arrivals_of(run)
    half = len(came) // 2
    before = feed(smoother(run, snapshot=path), run, came[:half]).estimates[-1]
    assert before.p_world_m[2] - mean_m > 0.5 * UP_M
    resumed = feed(smoother(measured, snapshot=path), measured, came[half:])
    assert any(e.startswith("resumed from a snapshot") for e in resumed.events)
    assert abs(resumed.estimates[-1].p_world_m[2] - mean_m) < 1.0
