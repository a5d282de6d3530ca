# SPDX-License-Identifier: Apache-2.0
"""A receiver that is frozen under way is told from one that drifts, jumps, is noisy or late."""

from collections.abc import Callable, Collection
from dataclasses import replace

import numpy as np
import pytest

from graphloc.config import SlowErrorConfig
from graphloc.eval.simulate import Scenario, SimulatedRun
from graphloc.frames import Array, Datum, Geodetic
from graphloc.ledger import Outcome
from graphloc.measurements import GnssPosition, world_from_fixes
from graphloc.online._frozen_receiver import WINDOW_S, FrozenReceiverDetector
from graphloc.online._repeated_fix import RepeatedFixDetector
from graphloc.recording import Recording
from graphloc.replay import replay
from tests.slowly import simulate_slowly

Off = Callable[[float, Array], Array]


def frozen_at(off_m: Off, v_mps: Array, *, hz: float = 5.0, sigma_m: float = 0.2, until_s: float = 60.0, sigma_mps: float = 0.1) -> list[float]:  # fmt: skip
    """Times (s) at which a receiver is judged frozen; its error is `off_m` of the time and of a standard normal (2,)."""
    rng, detector, when = np.random.default_rng(1), FrozenReceiverDetector(), []
    for k in range(round(until_s * hz)):
        there_m = v_mps * k / hz
        detector.note(k / hz, there_m + off_m(k / hz, rng.standard_normal(2)), there_m, sigma_m, v_mps, sigma_mps)
        when += [k / hz] if detector.frozen else []
    return when


V = np.array([2.0, 1.0])
AHEAD = np.array([1.0, 0.0])


@pytest.mark.parametrize("hz", [1.0, 5.0, 20.0])
def test_a_frozen_receiver_is_detected_until_it_moves_along(hz: float) -> None:
    """It says the place of 20 s until 40 s, then the right one, where it is off by a jump."""
    when = frozen_at(lambda t, n: 0.2 * n - V * (t - 20.0) * (20.0 < t < 40.0), V, hz=hz)
    assert 20.0 < when[0] < 20.0 + 1.5 * WINDOW_S
    assert 38.9 < when[-1] < 41.0
    assert len(when) > 0.9 * hz * (when[-1] - when[0])


@pytest.mark.parametrize(
    ("off_m", "hz", "sigma_m"),
    [
        (lambda t, n: 1.5 * n, 1.0, 1.5),
        (lambda t, n: 1.5 * n, 10.0, 0.02),  # noisier than it claims
        (lambda t, n: 0.2 * n + np.array([0.3 * t, 0.0]), 5.0, 0.2),  # multipath that drifts
        (lambda t, n: 0.2 * n + 10.0 * np.array([t > 20.0, t > 40.0]), 5.0, 0.2),  # and that jumps
        (lambda t, n: 0.05 * n + 0.5 * 2.2 * np.array([np.cos(0.3 * t), np.sin(0.3 * t)]), 5.0, 0.05),  # 0.5 s late, in a turn
    ],
)  # fmt: skip
def test_a_receiver_that_drifts_jumps_is_noisy_or_late_is_not_frozen(off_m: Off, hz: float, sigma_m: float) -> None:
    assert frozen_at(off_m, V, hz=hz, sigma_m=sigma_m, until_s=200.0) == []


def test_a_velocity_that_is_hardly_known_tells_nothing() -> None:
    """After an outage it is the estimate that goes astray, and the receiver that is right."""
    assert frozen_at(lambda t, n: 0.2 * n - V * max(t - 20.0, 0.0), V, sigma_mps=1.0) == []


def test_a_frozen_receiver_stays_frozen_while_the_velocity_becomes_uncertain() -> None:
    """Nothing but it had told the velocity. What it has said since it stands is told, too: that drew the estimate along."""
    rng, detector, when = np.random.default_rng(1), FrozenReceiverDetector(), []
    for k in range(200):
        t = k / 5.0
        there_m, told_m = V * t, V * min(t, 20.0) + 0.2 * rng.standard_normal(2)
        detector.note(t, told_m, there_m, 0.2, V, 0.1 + 0.2 * max(t - 25.0, 0.0))
        when += [t] if detector.frozen else []
    assert when[-1] == 199 / 5.0
    assert len(when) > 0.9 * 5.0 * (when[-1] - when[0])
    assert 19.0 < detector.stands_s < 20.5


@pytest.mark.parametrize("sigma_m", [0.15, 1.2])
def test_one_that_goes_on_slower_is_not_frozen_whatever_it_claims(sigma_m: float) -> None:
    """Multipath had drawn the estimate on and turned: fixes 0.15 m noisy went on at 0.9 m/s, that claimed 1.2 m and so seemed to stand."""
    ahead = 0.9 * AHEAD
    assert frozen_at(lambda t, n: 0.15 * n - 1.3 * AHEAD * max(t - 20.0, 0.0), ahead + 1.3 * AHEAD, hz=2.0, sigma_m=sigma_m, until_s=30.0) == []  # fmt: skip


@pytest.mark.parametrize("hz", [1.0, 2.0])
def test_one_that_goes_on_is_believed_again(hz: float) -> None:
    """A boat at 0.9 m/s whose multipath went astern as fast for 5 s; without fixes the estimate goes astray: the fixes' error grows on."""
    rng, detector, when = np.random.default_rng(1), FrozenReceiverDetector(), []
    for t in np.arange(0.0, 60.0, 1.0 / hz).tolist():
        estimated_m = 0.9 * AHEAD * t + np.array([0.0, 0.5]) * max(t - 25.0, 0.0)
        told_m = 0.9 * AHEAD * (min(t, 20.0) + max(t - 25.0, 0.0)) + 0.1 * rng.standard_normal(2)
        detector.note(t, told_m, estimated_m, 0.2, 0.9 * AHEAD, 0.05)
        when += [t] if detector.frozen else []
    assert 20.0 < when[0] < 26.0
    assert when[-1] <= 28.0


def test_one_that_moves_otherwise_may_be_right() -> None:
    """The estimate went astray: it stands while the receiver goes on, or goes much faster."""
    assert frozen_at(lambda t, n: 0.2 * n + V * max(t - 20.0, 0.0), 0.0 * V) == []
    assert frozen_at(lambda t, n: 0.2 * n - 4.0 * V * max(t - 20.0, 0.0), 5.0 * V) == []


@pytest.mark.parametrize(
    ("hz", "noise_m", "sigma_m"), [(1.0, 0.5, 2.0), (5.0, 1.0, 2.0), (5.0, 1.0, 0.5), (10.0, 1.0, 2.0)]
)
def test_a_noisy_receiver_that_moves_another_way_is_not_frozen(hz: float, noise_m: float, sigma_m: float) -> None:
    """The estimate turns about, as where the IMU is mounted the other way round than is configured."""
    for seed in range(4):
        rng, detector = np.random.default_rng(seed), FrozenReceiverDetector()
        for t in np.arange(0.0, 120.0, 1.0 / hz):
            v_mps = V if t < 20.0 else -V
            there_m = V * (min(t, 20.0) - max(t - 20.0, 0.0))
            detector.note(t, V * t + noise_m * rng.standard_normal(2), there_m, sigma_m, v_mps, 0.1)
            assert not detector.frozen


def test_at_the_start_it_may_be_the_estimate_that_is_wrong() -> None:
    assert frozen_at(lambda t, n: 0.2 * n - V * t * (t < 8.0), V, until_s=16.0) == []


def old_at(place_m: Callable[[float], Array], v_mps: Callable[[float], Array], *, hz: float = 5.0, until_s: float = 40.0, sigma_mps: float = 0.2) -> tuple[list[float], list[float]]:  # fmt: skip
    """Times (s) of fixes that are old, and those at which the receiver is judged frozen."""
    detector, old, frozen = RepeatedFixDetector(), [], []
    for t in np.arange(0.0, until_s, 1.0 / hz).tolist():
        detector.note(round(t * 1e9), place_m(t), v_mps(t), sigma_mps)
        old += [t] if detector.is_old(round(t * 1e9), place_m(t)) else []
        frozen += [t] if detector.frozen else []
    return old, frozen


@pytest.mark.parametrize("hz", [1.0, 5.0, 20.0])
@pytest.mark.parametrize(("noise_m", "wait_s"), [(0.0, 0.0), (0.03, 0.45)])
def test_a_fix_that_is_repeated_under_way_is_old_until_another_comes(hz: float, noise_m: float, wait_s: float) -> None:
    """Bit for bit from the first repetition on; but for centimetres, once the vessel is a metre on (at 2.2 m/s)."""
    rng = np.random.default_rng(1)
    noise = {round(t, 6): noise_m * rng.standard_normal(2) for t in np.arange(0.0, 40.0, 1.0 / hz).tolist()}
    held = 20.0
    old, frozen = old_at(
        lambda t: V * (held if held < t < 30.0 else t) + noise[round(t, 6)] * (t >= held), lambda t: 2.2 * AHEAD, hz=hz
    )
    assert held + wait_s - 0.1 < old[0] < held + wait_s + 1.01 / hz  # a place is that of the first fix within 0.2 m
    assert 30.0 - 1.01 / hz < old[-1] < 30.0
    assert len(old) == round((old[-1] - old[0]) * hz) + 1
    assert 2.4 < frozen[0] - old[0] < 3.1
    assert frozen[-1] == old[-1]


@pytest.mark.parametrize("hz", [1.0, 5.0, 20.0])
def test_a_position_that_is_held_at_rest_or_below_a_speed_is_believed(hz: float) -> None:
    """It brakes from 3 m/s by 1 m/s^2, and the estimate learns of that a fifth of a second late."""

    def true_mps(t: float) -> float:
        return 3.0 - min(max(t - 20.0, 0.0), 3.0)

    def place_m(t: float) -> Array:  # held from 0.5 m/s on
        braked_s = min(max(t - 20.0, 0.0), 2.5)
        return np.array([3.0 * min(t, 22.5) - braked_s**2 / 2.0, 0.0])

    assert old_at(place_m, lambda t: true_mps(t - 0.2) * AHEAD, hz=hz) == ([], [])


@pytest.mark.parametrize("hz", [1.0, 5.0])
@pytest.mark.parametrize("off_deg", [20.0, 45.0, 90.0])
def test_at_rest_a_wrong_heading_that_keeps_a_speed_in_the_estimate_makes_no_fix_old(off_deg: float, hz: float) -> None:
    """It brakes from 3 m/s by 1 m/s^2, which the estimate takes for another direction. A vessel 60 s at rest was put 43 m off by 20 deg."""
    off = np.radians(off_deg)
    turned = np.array([[np.cos(off), -np.sin(off)], [np.sin(off), np.cos(off)]])

    def braked_mps(t: float) -> float:
        return min(max(t - 20.0, 0.0), 3.0)

    def place_m(t: float) -> Array:
        return (3.0 * min(t, 23.0) - braked_mps(t) ** 2 / 2.0) * AHEAD

    def v_mps(t: float) -> Array:
        return np.asarray(3.0 * AHEAD - turned @ AHEAD * braked_mps(t))

    assert np.linalg.norm(v_mps(30.0)) > 1.0
    assert old_at(place_m, v_mps, hz=hz) == ([], [])


def test_a_speed_that_is_hardly_known_makes_no_fix_old_and_its_growth_none_young() -> None:
    def place_m(t: float) -> Array:
        return V * min(t, 20.0)

    assert old_at(place_m, lambda t: 2.2 * AHEAD, sigma_mps=1.0) == ([], [])
    detector = RepeatedFixDetector()
    for t in np.arange(0.0, 40.0, 0.2).tolist():
        detector.note(round(t * 1e9), place_m(t), 2.2 * AHEAD, 0.2 + 0.5 * max(t - 20.0, 0.0))
        assert detector.is_old(round(t * 1e9), place_m(t)) == (t > 20.0)


@pytest.mark.parametrize("hz", [1.0, 5.0])
def test_a_position_that_jumps_on_was_frozen_though_the_estimate_was_held_back(hz: float) -> None:
    """By its own speed: the fixes had drawn the estimate to rest. One that goes on from where it stood was at rest."""
    for goes_on in (True, False):
        detector, since, fixes = RepeatedFixDetector(), [], []
        for t in np.arange(0.0, 40.0, 1.0 / hz).tolist():
            on = max(t - 30.0, 0.0) if not goes_on else t - 20.0 if t >= 30.0 else 0.0
            fixes.append((round(t * 1e9), V * (min(t, 20.0) + on)))
            since.append(detector.note(*fixes[-1], np.zeros(2), 0.2))
        found = [at_ns for at_ns in since if at_ns is not None]
        old = [at_ns for at_ns, place in fixes if detector.is_old(at_ns, place)]
        if goes_on:
            assert since[round(30.0 * hz)] is not None
            assert len(found) == 1
            assert old == [at_ns for at_ns, _ in fixes if 20.0 < at_ns * 1e-9 < 30.0]
        else:
            assert found == old == []


def test_a_swing_at_rest_does_not_make_a_receiver_frozen() -> None:
    """It has repeated its position for long by then: only repetitions while the vessel moves count."""
    old, frozen = old_at(lambda t: V * min(t, 20.0), lambda t: 2.2 * AHEAD * (t <= 20.0 or 30.0 < t < 30.5))
    assert frozen == []
    assert old
    assert all(30.0 < t < 30.5 for t in old)


def frozen(run: SimulatedRun, begin_ns: int, end_ns: int, sensors: Collection[str]) -> Recording:
    """The recording of some sensors; between two times the receiver says one place, but for centimetres."""
    fixes = run.recording.of(GnssPosition)
    held = next(m for m in fixes if m.stamp_ns >= begin_ns)
    datum, rng = Datum(held.position), np.random.default_rng(5)

    def heard(m: GnssPosition) -> GnssPosition:
        if not begin_ns <= m.stamp_ns < end_ns:
            return m
        place = world_from_fixes([held], datum) + 0.03 * rng.standard_normal((1, 3))
        return replace(m, position=Geodetic(*datum.geodetic_from_enu(place)[0]))

    kept = [m for m in run.recording.measurements if m.sensor in sensors]
    return replace(run.recording, measurements=tuple(heard(m) if isinstance(m, GnssPosition) else m for m in kept))


def test_online_a_frozen_receiver_and_compass_do_not_pull_the_estimate() -> None:
    """Beside a compass alone. As long as its fixes were used for seconds they set the estimate back by 16 m, and braked it: 86 m later."""
    scenario = Scenario(
        path="loops", duration_s=50.0, noise="clean", gnss_hz=5.0, gnss_sigma_m=0.5, accel_bias_mps2=0.3, gyro_bias_radps=0.03,
        wave_roll_deg=5.0, wave_heave_m=0.3,
    )  # fmt: skip
    run = simulate_slowly(scenario, 1)
    sensors = {name: run.config.sensors[name] for name in ("imu", "gnss", "compass")}
    sensors["gnss"] = sensors["gnss"].model_copy(update={"slow_error": SlowErrorConfig()})
    assert run.recording.imu is not None
    begin_ns = int(run.recording.imu.stamps_ns[0]) + 25 * 10**9
    said = frozen(run, begin_ns, begin_ns + 20 * 10**9, ("gnss", "compass"))
    track = replay(said, run.config.model_copy(update={"sensors": sensors})).solution.trajectory
    off_m = np.hypot(*(track.p_world_m - run.truth.at(track.stamps_ns).p_world_m)[:, :2].T)
    since_s = (track.stamps_ns - begin_ns) * 1e-9
    assert off_m[since_s < 6.0].max() < 5.0
    assert off_m.max() < 25.0  # of dead reckoning for 20 s
    assert off_m[since_s > 22.0].max() < 1.0


def test_online_frozen_sensors_are_not_followed() -> None:
    """Beside matches, 40 % of them false. Followed, it would be off by 30 m and more, and call that good."""
    run = simulate_slowly(Scenario(path="loops", duration_s=45.0, noise="drift"), 1)
    begin_ns = next(m.stamp_ns for m in run.recording.of(GnssPosition)) + 18 * 10**9
    end_ns = begin_ns + 15 * 10**9
    said = frozen(run, begin_ns, end_ns, {m.sensor for m in run.recording.measurements})
    found = replay(said, run.config).solution
    track = found.trajectory
    off_m = (track.p_world_m - run.truth.at(track.stamps_ns).p_world_m)[:, :2]
    seen = ~((track.stamps_ns > begin_ns) & (track.stamps_ns < begin_ns + 6 * 10**9))
    assert np.hypot(*off_m[seen].T).max() < 1.0
    rows = [row for row in found.ledger if row.sensor == "gnss" and begin_ns + 6 * 10**9 < row.stamp_ns < end_ns]
    assert {row.outcome for row in rows} == {Outcome.REJECTED}
    assert {row.reason for row in rows} == {"frozen receiver: it repeats one position while the vessel moves"}
    late = [row for row in found.ledger if row.sensor == "gnss" and row.stamp_ns > end_ns + 2 * 10**9]
    assert not any("frozen" in row.reason for row in late)
    assert any("gnss: frozen receiver: it repeats one position while" in line for line in found.stats.events)
    assert any("gnss: no longer frozen" in line for line in found.stats.events)
