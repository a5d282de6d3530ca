# SPDX-License-Identifier: Apache-2.0
"""A receiver that comes back from an outage tens of metres off, and converges while it states a metre."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graphloc.eval.metrics import errors
from graphloc.eval.simulate import Scenario, SimulatedRun
from graphloc.factors import INERTIAL, SENSORS
from graphloc.frames import Datum
from graphloc.ledger import Outcome
from graphloc.measurements import GnssPosition
from graphloc.solution import Solution
from graphloc.solve import smooth
from tests.slowly import simulate_slowly

_OUTAGE_S, _TAU_S = (30.0, 70.0), 8.0


@pytest.fixture(scope="module")
def run() -> SimulatedRun:
    scenario = Scenario(
        path="loops", noise="clean", duration_s=130.0, outage_s=_OUTAGE_S, pose_hz=0.0, gnss_hz=1.0, compass_hz=1.0,
        gnss_sigma_m=1.0, imu_hz=50.0,
    )  # fmt: skip
    return simulate_slowly(scenario, 1, 1.25)


def _error_m(run: SimulatedRun, m: GnssPosition, off_m: float) -> float:
    assert run.recording.imu is not None
    since_s = (m.stamp_ns - run.recording.imu.stamps_ns[0]) * 1e-9 - _OUTAGE_S[1]
    return off_m * float(np.exp(-since_s / _TAU_S)) if since_s >= 0.0 else 0.0


def _smoothed(run: SimulatedRun, off_m: float, states: float = 1.0) -> Solution:
    """Smooth it with a receiver that comes back so far off, to the north-east, and states so many times its noise."""

    def bent(m: GnssPosition) -> GnssPosition:
        east_m = _error_m(run, m, off_m) / np.sqrt(2.0)
        there = Datum(m.position).geodetic_from_enu(np.array([[east_m, east_m, 0.0]]))
        return replace(m, position=there[0], cov_enu_m2=states**2 * m.cov_enu_m2)

    measurements = tuple(bent(m) if isinstance(m, GnssPosition) else m for m in run.recording.measurements)
    assert run.config.datum is not None
    recording = replace(run.recording, measurements=measurements)
    return smooth(recording, run.config, Datum(run.config.datum.geodetic), rows=SENSORS, inertial=INERTIAL)


def test_fixes_of_a_receiver_that_converges_are_left_out(run: SimulatedRun) -> None:
    """Receivers state their whole error, most of it slow: from fix to fix they scatter by a third of that, or less.

    Fixes left out were charged as if they scattered as stated, so with 3 times none was.
    """
    solution = _smoothed(run, 40.0, 3.0)
    left_out = {row.stamp_ns for row in solution.ledger if row.sensor == "gnss" and row.outcome is Outcome.REJECTED}
    fixes = run.recording.of(GnssPosition)
    after = [m for m in fixes if _error_m(run, m, 40.0) > 0.0]
    assert left_out == {m.stamp_ns for m in after[: len(left_out)]}  # the first ones, without a gap
    assert {m.stamp_ns for m in fixes if _error_m(run, m, 40.0) > 6.0} <= left_out
    assert not {m.stamp_ns for m in fixes if _error_m(run, m, 40.0) < 0.1} & left_out
    off = errors(solution.trajectory, run.truth)
    assert off.estimate.cov is not None
    bound_m = np.sqrt(5.99 * np.linalg.eigvalsh(off.estimate.cov[:, :2, :2])[:, -1])
    assert np.mean(off.horizontal_m <= bound_m) >= 0.95
    (said,) = [w for w in solution.stats.warnings if "back from an outage" in w]
    assert said.startswith("gnss: back from an outage of 41 s")
    assert f"its {len(left_out)} fixes of that time are left out" in said
    assert 30.0 < float(said.partition("it was up to ")[2].split()[0]) < 50.0


def test_fixes_of_a_receiver_that_comes_back_right_are_used(run: SimulatedRun) -> None:
    solution = _smoothed(run, 0.0, 1.0)
    assert not [row for row in solution.ledger if row.sensor == "gnss" and row.outcome is Outcome.REJECTED]
    assert not [w for w in solution.stats.warnings if "back from an outage" in w]


def test_right_fixes_are_used_where_it_is_the_imu_that_is_off(run: SimulatedRun) -> None:
    """Its bias steps by 20 mg in the outage: solved without the fixes, the track is off till the next one that is used."""
    imu = run.recording.imu
    assert imu is not None
    late = (imu.stamps_ns - imu.stamps_ns[0])[:, None] * 1e-9 > 0.5 * sum(_OUTAGE_S)
    stepped = replace(imu, accel_mps2=imu.accel_mps2 + late * [0.2, 0.0, 0.0])
    solution = _smoothed(replace(run, recording=replace(run.recording, imu=stepped)), 0.0, 3.0)
    assert not [row for row in solution.ledger if row.sensor == "gnss" and row.outcome is Outcome.REJECTED]
