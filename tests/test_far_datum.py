# SPDX-License-Identifier: Apache-2.0
"""A run 60 km from its datum, where north, east and up lie otherwise than there."""

from dataclasses import replace

import numpy as np
import pytest

from graphloc import app
from graphloc.config import CompassConfig
from graphloc.eval.ekf._inputs import MountedMeasurement
from graphloc.eval.ekf._planar import _measurement
from graphloc.eval.simulate import Scenario
from graphloc.frames import Datum, Geodetic, heading_deg_from_yaw, wrap_angle
from graphloc.measurements import CompassHeading, GnssVelocity
from graphloc.replay import replay
from tests.slowly import simulate_slowly


@pytest.mark.parametrize("place", [(60_000.0, 0.0, 0.0), (-40_000.0, 30_000.0, 0.0), (0.0, -70_000.0, 50.0)])
def test_local_axes_are_those_of_the_ellipsoid(place: tuple[float, float, float]) -> None:
    """A metre to the east, north and up of there, by geodesy."""
    datum, there = Datum(Geodetic(59.3, 18.1, 20.0)), np.array(place)
    ((latitude, longitude, height),) = datum.geodetic_from_enu(there)
    own = Datum(Geodetic(latitude, longitude, height))
    metres = datum.enu_from_geodetic(*own.geodetic_from_enu(np.eye(3)).T) - there
    np.testing.assert_allclose(datum.local_axes(there), metres.T, atol=2e-4)  # of 0.016 rad at most
    north = np.arctan2(-metres[1, 0], metres[1, 1])
    assert float(datum.convergence_rad(there)) == pytest.approx(north, abs=1e-4)
    # A bow that looks north there.
    assert float(wrap_angle(np.radians(datum.true_heading_deg(north + np.pi / 2, there)))) == pytest.approx(0, abs=1e-4)


def test_the_filters_turn_headings_and_velocities() -> None:
    """They move as the measurements say."""
    datum, x = Datum(Geodetic(59.3, 18.1, 20.0)), np.array([50_000.0, 20_000.0, 3.0, -1.0, 0.4])
    place, c, s = np.array([*x[:2], 0.0]), np.cos(x[4]), np.sin(x[4])
    v = datum.local_axes(place).T @ [c * x[2] - s * x[3], s * x[2] + c * x[3], 0.0]
    north = np.pi / 2 - np.radians(float(datum.true_heading_deg(x[4], place)))
    velocity = GnssVelocity(stamp_ns=0, sensor="v", seq=0, v_enu_mps=v, cov_m2ps2=np.eye(3))
    heading = CompassHeading(stamp_ns=0, sensor="c", seq=0, yaw_rad=north, sigma_rad=0.01)
    for m in (velocity, heading):
        innovation, *_ = _measurement(MountedMeasurement(m, np.zeros(3), 0.0), x, 0.0, datum)
        np.testing.assert_allclose(innovation, 0.0, atol=1e-5)


@pytest.mark.parametrize("online", [False, True])
def test_far_from_the_datum_headings_count_from_where_the_vessel_is(online: bool) -> None:
    """North there is 0.9 deg off."""
    scenario = Scenario(
        path="loops", duration_s=30.0, noise="clean", pose_hz=0.0, imu_hz=50.0, gnss_hz=2.0, compass_hz=5.0
    )  # fmt: skip
    run = simulate_slowly(scenario, 5)
    near = app.choose_datum(run.recording, run.config)
    origin = Geodetic(*near.geodetic_from_enu(np.array([[-60_000.0, 0.0, 0.0]]))[0])
    gyrocompass = {"topic": "/h", "mount_offset_sigma_deg": 0.0, "deviation_sigma_deg": 0.0, "wander_sigma_deg": 0.0}
    config = run.config.with_sensors({"compass": CompassConfig.model_validate(gyrocompass)})
    assert config.datum is not None
    config = config.model_copy(update={"datum": config.datum.model_copy(update=origin._asdict())})
    solution = (replay if online else app.smooth_recording)(replace(run.recording, truth=None), config).solution
    track = solution.trajectory
    true = run.truth.at(track.stamps_ns)
    here, ahead = (
        solution.datum.enu_from_geodetic(*near.geodetic_from_enu(p).T)
        for p in (true.p_world_m, true.p_world_m + true.R_world_body[:, :, 0])
    )
    yaw = np.arctan2(*(ahead - here)[:, 1::-1].T)
    assert abs(np.degrees(wrap_angle(track.yaw_rad - yaw)).mean()) < 0.3
    off = solution.datum.true_heading_deg(track.yaw_rad, track.p_world_m) - heading_deg_from_yaw(true.yaw_rad)
    assert abs(np.degrees(wrap_angle(np.radians(off))).mean()) < 0.3
