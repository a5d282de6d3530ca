# SPDX-License-Identifier: Apache-2.0
"""Online, an estimate of the heading that turns back and forth does not tell where an antenna sits."""

from dataclasses import replace
from typing import Any

import gtsam
import numpy as np
import pytest

from graphloc.config import GnssConfig, VelocityConfig
from graphloc.eval.metrics import compare_to_truth
from graphloc.eval.simulate import Scenario
from graphloc.factors import gnss, velocity
from graphloc.graph import Sensor
from graphloc.online._anchor import Anchor
from graphloc.replay import replay
from tests.faults import arrivals_of, feed
from tests.test_antenna_place import displaced
from tests.test_factors import attachment
from tests.test_online_faults import smoother

LIES = Scenario(
    path="still", noise="clean", duration_s=50.0, imu_hz=50.0, compass_hz=5.0, gnss_sigma_m=0.02, wave_roll_deg=0.2, wave_pitch_deg=0.2
)  # fmt: skip


def test_where_nothing_turns_the_bounds_hold() -> None:
    """Factors marginalised with one heading, and new ones with another, told the antenna's place: NEES 9.4, inside 25 %."""
    run = displaced(1.0, (0.9, -0.6, 1.2), LIES)
    told = {"imu", "gnss", "compass"}
    config = run.config.model_copy(update={"sensors": {name: run.config.sensors[name] for name in told}})
    track = replay(run.recording.where(lambda m: m.sensor in told), config).solution.trajectory
    found = compare_to_truth(track, run.truth)
    assert found.nees is not None
    assert found.nees < 3.5
    assert found.coverage_95 is not None
    assert found.coverage_95 > 0.95


@pytest.mark.parametrize(
    ("row", "config"),
    [
        (gnss.ROW, GnssConfig(kind="gnss", mount_sigma_m=1.0)),
        (velocity.ROW, VelocityConfig(kind="gnss_velocity", mount_sigma_m=1.0)),
    ],
)
def test_only_what_turns_with_the_antenna_is_taken_at_the_first_attitude(row: Sensor, config: Any) -> None:
    at = replace(attachment(row, config, slow=False), constants=((6, np.array([0.3, -0.2, 0.1])),))
    turned = gtsam.Rot3.Rz(0.3) * at.T_world_body.rotation()
    m = row.ideal(at, config)
    (plain,), (first,), (there,) = (
        row.residuals(m, config, a)
        for a in (at, replace(at, R_first=turned.matrix()),
                  replace(at, T_world_body=gtsam.Pose3(turned, at.T_world_body.translation())))
    )  # fmt: skip
    (of_first,), (of_there,) = first.constant_jacobians(), there.constant_jacobians()
    np.testing.assert_allclose(of_first, of_there, atol=1e-9)
    np.testing.assert_allclose(first.raw, plain.raw)
    np.testing.assert_allclose(first.jacobian(), plain.jacobian())


def test_a_window_that_begins_anew_keeps_the_first_attitude() -> None:
    """Its anchor correlates antenna and position at that attitude; it goes through a snapshot, too."""
    run = displaced(1.0)
    online = smoother(run)
    feed(online, run, arrivals_of(run)[: len(arrivals_of(run)) // 2])
    tracking = online._tracking  # noqa: SLF001 - what no estimate shows
    assert tracking is not None
    anchor = tracking.lag.anchor()
    assert abs(anchor.turned_rad) > 1e-4
    assert Anchor.from_dict(anchor.as_dict()).turned_rad == anchor.turned_rad
    lag = tracking._built(replace(anchor, turned_rad=0.2), tracking._recent.samples())  # noqa: SLF001
    first = lag._constants.first_attitude(anchor.pose)  # noqa: SLF001
    around = tracking._built(replace(anchor, turned_rad=2.0), tracking._recent.samples())  # noqa: SLF001
    assert around._constants.turned_rad == 0.0  # noqa: SLF001 - the heading was wrong: steps would go the wrong way
    np.testing.assert_allclose(first, gtsam.Rot3.Rz(0.2).matrix() @ anchor.pose.rotation().matrix(), atol=1e-4)
