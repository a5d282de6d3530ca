# SPDX-License-Identifier: Apache-2.0
"""What is configured as known contradicts the run by many sigmas: online its prior is widened as the run tells more; one antenna has one place."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from graphloc.blocks import MountConfig
from graphloc.build import rows_of, shared_constants
from graphloc.config import GnssConfig, VelocityConfig, VesselConfig
from graphloc.eval.simulate import SimulatedRun
from graphloc.factors import SENSORS
from graphloc.factors.gnss import ROW as FIXES
from graphloc.factors.velocity import ROW as VELOCITIES
from graphloc.frames import Array
from graphloc.graph import Attachment, Constant, Decision, FeltMotion
from graphloc.linear import factors_of
from graphloc.measurements import GnssPosition, GnssVelocity
from graphloc.replay import replay
from tests.faults import arrivals_of, feed
from tests.test_antenna_place import displaced, yaw_errors_deg
from tests.test_factors import attachment, values_of
from tests.test_late_fixes import SCENARIO, solved
from tests.test_online_faults import smoother

OFF_M = (0.9, -0.6, 1.2)
CALM = replace(SCENARIO, path="still", wave_roll_deg=4.0, wave_pitch_deg=3.0, gnss_sigma_m=0.5)


def far_m(found: Array) -> float:
    return float(np.linalg.norm(found - OFF_M))


def test_online_an_antenna_16_sigmas_off_is_not_held_back() -> None:
    """Its prior kept the weight of the first seconds once these had left the window: 0.4 m of 1.6 were never found."""
    run = displaced(0.1)
    assert far_m(replay(run.recording, run.config).solution.antennas_off_m["gnss"]) < 0.2


def test_nor_after_restarts(tmp_path: Path) -> None:
    """A prior that may yet be widened is in no anchor: else it would count once more after each."""
    run, path = displaced(0.1), tmp_path / "snapshot.json"
    came = arrivals_of(run)
    for part in np.array_split(np.arange(len(came)), 4):
        online = smoother(run, snapshot=path)
        feed(online, run, came[part[0] : part[-1] + 1])
    online.finish()
    assert far_m(online.antennas_off_m["gnss"]) < 0.25


def test_online_a_compass_8_sigmas_off_is_not_held_to_its_mount() -> None:
    right = displaced(0.0, (0.0, 0.0, 0.0))
    compass = right.config.sensors["compass"]
    turned = {"mount": compass.mount.model_copy(update={"rpy_deg": (0.0, 0.0, 8.0)}), "mount_offset_sigma_deg": 1.0}
    wrong = replace(right, config=right.config.with_sensors({"compass": compass.model_copy(update=turned)}))
    fed = feed(smoother(wrong), wrong, arrivals_of(wrong))
    sigma_deg = np.degrees([np.sqrt(estimate.cov[5, 5]) for estimate in fed.estimates])
    late = slice(-len(sigma_deg) // 4, None)
    assert np.mean((yaw_errors_deg(right, fed) / sigma_deg)[late] ** 2) < 1.7


def test_a_place_far_off_says_nothing_of_a_delay() -> None:
    constant = Constant(
        name="", sigma=np.array([0.05, 1.0, 2.0]), corrects=("time_offset_s", "mount.xyz_m[0]", "mount.xyz_m[1]")
    )
    value = np.array([0.0, 6.0, 0.0])  # 36 squared sigmas, of which 9 double the variance
    np.testing.assert_allclose(constant.widened(value), [0.05, 5.0**0.5, 2.0 * 5.0**0.5])
    assert constant.cost(value) == pytest.approx(4.5 * np.log(5.0))


# One antenna


def config_of(**of_velocity: Any) -> VesselConfig:
    fixes = GnssConfig(topic="/fix", stamp_sigma_s=0.1, mount_sigma_m=1.5)
    return VesselConfig(sensors={"gnss": fixes, "v": VelocityConfig(topic="/vel", **of_velocity)})


def constants_of(config: VesselConfig, name: str) -> tuple[Constant, int | None]:
    ((constant,), shares) = shared_constants(name, config, rows_of(config, SENSORS))
    return constant, shares


def test_one_place_and_two_delays() -> None:
    config = config_of(antenna="gnss", stamp_sigma_s=0.2)
    fixes, velocities = constants_of(config, "gnss"), constants_of(config, "v")
    for constant, _ in (fixes, velocities):
        np.testing.assert_allclose(constant.sigma, [0.1, 1.5, 1.5, 1.5, 0.2])
    assert (fixes[1], velocities[1]) == (None, 0)
    assert (fixes[0].own, velocities[0].own) == ((0, 1, 2, 3), (4, 1, 2, 3))


@pytest.mark.parametrize("of_velocity", [{}, {"antenna": "gnss", "enabled": False}])
def test_else_each_has_its_own(of_velocity: dict[str, Any]) -> None:
    constant, shares = constants_of(config_of(mount_sigma_m=1.5, **of_velocity), "gnss")
    assert (len(constant.sigma), constant.own, shares) == (4, (), None)


def test_of_a_receiver_that_is_off_there_is_no_place_to_share() -> None:
    config = config_of(antenna="gnss", stamp_sigma_s=0.2)
    off = config.with_sensors({"gnss": config.sensors["gnss"].model_copy(update={"enabled": False})})
    constant, shares = constants_of(off, "v")
    assert (len(constant.sigma), constant.own, shares) == (4, (), None)


def test_it_sits_where_that_sensor_does() -> None:
    fixes = GnssConfig(topic="/fix", mount_sigma_m=1.5, mount=MountConfig(xyz_m=(1.0, 2.0, 3.0)))
    config = VesselConfig(sensors={"gnss": fixes, "v": VelocityConfig(topic="/vel", antenna="gnss")})
    assert config.sensors["v"].mount.xyz_m == (1.0, 2.0, 3.0)
    assert config.sensors["v"].mount_sigma_m == 1.5
    with pytest.raises(ValueError, match=r"v\.mount_sigma_m is not that of gnss"):
        config_of(antenna="gnss", mount_sigma_m=1.0)
    with pytest.raises(ValueError, match="no gnss sensor 'bow'"):
        config_of(antenna="bow")


def test_factors_of_one_antenna_have_its_place_alone_in_common() -> None:
    """By differences of the factors' own errors: the delay of the others does nothing."""
    config = config_of(antenna="gnss", stamp_sigma_s=0.2)
    value = np.array([0.05, 0.3, -0.2, 0.4, -0.1])
    felt = FeltMotion(np.array([0.8, -0.5, 9.9]), np.array([0.1, 0.3, -0.2]), np.array([0.0, 0.0, -9.81]))
    for row, name, foreign in ((FIXES, "gnss", 4), (VELOCITIES, "v", 0)):
        constant, _ = constants_of(config, name)
        block, plain = config.sensors[name], attachment(row, config.sensors[name], slow=False)
        at: Attachment = replace(plain, constants=((6, value),), own=(constant.own,), felt=felt)
        alone = replace(at, constants=((6, value[list(constant.own)]),), own=())
        m = row.ideal(attachment(row, block, slow=False), block)
        np.testing.assert_allclose(row.residuals(m, block, at)[0].raw, row.residuals(m, block, alone)[0].raw)
        (factor,) = factors_of(row, m, block, at, Decision()).factors
        values = values_of(at, ())
        here, found = factor.error(values), []
        for k in range(5):
            stepped = values_of(replace(at, constants=((6, value + 0.3 * np.eye(5)[k]),)), ())
            found.append(abs(factor.error(stepped) - here) > 1e-6 * max(here, 1.0))
        assert found == [k != foreign for k in range(5)]


@cache
def with_velocities(antenna: str) -> SimulatedRun:
    """A vessel that lies in waves, with fixes of half a metre: their antenna is 1.6 m off, which its velocities tell, 0.08 s late."""
    run = displaced(0.5, OFF_M, CALM)
    fixes = run.config.sensors["gnss"]
    assert isinstance(fixes, GnssConfig)
    own = [m for m in run.recording.measurements if isinstance(m, GnssPosition)]
    stamps = np.array([m.stamp_ns for m in own])
    lever = np.array(fixes.mount.xyz_m) + OFF_M

    def antenna_at(at_ns: NDArray[np.int64]) -> Array:
        body = run.truth.at(at_ns)
        return np.asarray(body.p_world_m + np.einsum("nij,j->ni", body.R_world_body, lever))

    step, past = 50_000_000, 80_000_000
    inside = stamps[(stamps > run.truth.stamps_ns[0] + step + past) & (stamps < run.truth.stamps_ns[-1] - step)]
    v = (antenna_at(inside - past + step) - antenna_at(inside - past - step)) / (2e-9 * step)
    v += np.random.default_rng(5).normal(0.0, 0.02, v.shape)
    seq = max(m.seq for m in run.recording.measurements) + 1
    told = [
        GnssVelocity(stamp_ns=int(at), sensor="v", seq=seq + n, v_enu_mps=v[n], cov_m2ps2=np.eye(3) * 0.02**2)
        for n, at in enumerate(inside)
    ]
    both = tuple(sorted([*run.recording.measurements, *told], key=lambda m: (m.stamp_ns, m.seq)))
    block = VelocityConfig(
        topic="/v", mount=fixes.mount, mount_sigma_m=fixes.mount_sigma_m, stamp_sigma_s=0.1, antenna=antenna
    )
    recording = replace(run.recording, measurements=both, message_count=run.recording.message_count + len(told))
    return replace(run, recording=recording, config=run.config.with_sensors({"v": block}))


def offline(run: SimulatedRun) -> Array:
    return np.asarray(solved(run).solution.antennas_off_m["gnss"])


def online(run: SimulatedRun) -> Array:
    return np.asarray(replay(run.recording, run.config).solution.antennas_off_m["gnss"])


@pytest.mark.parametrize("mode", [partial(offline), partial(online)], ids=["offline", "online"])
def test_velocities_tell_where_the_antenna_of_the_fixes_is(mode: Callable[[SimulatedRun], Array]) -> None:
    """Where nothing turns nothing else does."""
    apart, together = far_m(offline(with_velocities(""))), far_m(mode(with_velocities("gnss")))
    assert together < 0.1
    assert apart > 1.0
