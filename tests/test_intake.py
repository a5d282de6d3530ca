"""Which IMU samples are taken: stamps that jump, clocks that are set back, late samples; none is lost or taken twice."""

import numpy as np
import pytest

from graphloc.measurements import ImuSample
from graphloc.online._intake import ImuIntake, Taken

MS = 1_000_000
GRAVITY = np.array([0.0, 0.0, 9.81])


def sample(at_ms: float, seq: int = 0, reading: float = 0.0) -> ImuSample:
    """A sample at rest; `reading`: what tells it from others."""
    force_mps2 = GRAVITY + np.array([1e-6 * reading, 0.0, 0.0])
    return ImuSample(
        stamp_ns=round(at_ms * MS), sensor="imu", seq=seq, accel_mps2=force_mps2, gyro_radps=np.zeros(3)
    )  # fmt: skip


def fed(intake: ImuIntake, at_ms: float, *, started: bool = True, seq: int = 0, reading: float = 0.0) -> Taken:
    taken = intake.take(sample(at_ms, seq, reading), started=started)
    for m in taken.accepted:
        intake.accept(m)
    return taken


def running() -> ImuIntake:
    """100 samples, 10 ms apart, until 990 ms; more than 200 ms are a jump."""
    intake = ImuIntake(0.2, floats=True)
    for k in range(100):
        assert len(fed(intake, 10.0 * k).accepted) == 1
    return intake


def test_a_single_stamp_that_jumps_waits_for_fifty_that_do_not_follow_it() -> None:
    intake = running()
    assert fed(intake, 60_000.0) == Taken()
    for k in range(49):
        assert not fed(intake, 1000.0 + 10.0 * k).dropped
    ((lost, why),) = fed(intake, 1490.0).dropped
    assert lost.stamp_ns == 60_000 * MS
    assert "jumps ahead" in why
    assert intake.jumped is None


def test_a_gap_is_no_stamp_jump_once_another_sample_follows() -> None:
    intake = running()
    assert not fed(intake, 5000.0).accepted
    assert [m.stamp_ns // MS for m in fed(intake, 4990.0).accepted] == [4990, 5000]
    assert intake.newest is not None
    assert intake.newest.stamp_ns == 5000 * MS


def test_a_late_one_is_taken_where_one_is_missing_alone() -> None:
    intake = running()
    for k in (100, 101, 103, 104):
        fed(intake, 10.0 * k)
    found = fed(intake, 1020.0)
    assert found.late is not None
    assert found.hole == (1010 * MS, 1030 * MS)
    assert fed(intake, 1020.0).dropped  # twice
    assert fed(intake, 1015.0).dropped  # between two that are there
    assert fed(intake, -10.0).dropped  # before all that is remembered


def test_a_clock_that_is_set_back_is_believed_after_fifty() -> None:
    intake = running()
    for k in range(49):
        assert fed(intake, -9000.0 + 10.0 * k).dropped
    found = fed(intake, -8510.0)
    assert found.set_back_s == (990.0 + 9000.0) / 1e3
    assert len(found.accepted) == 1


@pytest.mark.parametrize("started", [True, False])
@pytest.mark.parametrize("back_ms", [200.0, 1003.0, 1500.0])
def test_a_clock_that_is_set_back_among_the_stamps_in_use_is_believed_after_ten(back_ms: float, started: bool) -> None:
    """After a step of 0.2 s the stamps have caught up within 20 samples: nothing was said, and the vessel is 0.2 s ahead."""
    intake, newest_ms = ImuIntake(0.2, floats=True), 3000.0
    for at_ms in np.arange(0.0, newest_ms + 1.0, 10.0):
        fed(intake, at_ms, started=started, reading=at_ms)
    came_ms = newest_ms - back_ms + 10.0 * np.arange(1, 11)
    found = [fed(intake, at_ms, started=started, reading=5000.0 + at_ms) for at_ms in came_ms]
    assert not any(taken.accepted or taken.set_back_s for taken in found[:-1])
    assert found[-1].set_back_s == pytest.approx((back_ms - 10.0) / 1e3)
    assert len(found[-1].accepted) == 1


def test_samples_that_are_sent_again_set_no_clock_back() -> None:
    """A bridge that reconnects repeats its buffer, late ones that filled a hole in it; samples that overtake each other come in no order."""
    intake = ImuIntake(0.5, floats=True)
    for k in (k for k in range(300) if not 200 <= k < 220):
        fed(intake, 10.0 * k, reading=float(k))
    assert all(fed(intake, 10.0 * k, reading=float(k)).late for k in range(200, 220))
    assert all(fed(intake, 10.0 * k, reading=float(k)).dropped for k in range(200, 249))
    assert fed(intake, 3000.0, reading=300.0).accepted
    backwards = [fed(intake, 10.0 * k + 3.0, reading=0.5 + k) for k in range(290, 260, -1)]
    assert all(taken.dropped and not taken.set_back_s for taken in backwards)


@pytest.mark.parametrize(("rate_hz", "batch", "sigma_ms"), [(1000, 100, 8.0), (400, 40, 10.0), (200, 20, 20.0)])
def test_batches_that_overlap_set_no_clock_back(rate_hz: int, batch: int, sigma_ms: float) -> None:
    """A driver reads a buffer when it comes to it, and stamps its samples back from then on."""
    rng, intake = np.random.default_rng(0), ImuIntake(0.5, floats=True)
    apart_ms = 1e3 / rate_hz
    for n in range(20 * rate_hz // batch):
        read_ms = n * batch * apart_ms + rng.normal(0.0, sigma_ms)
        for k in range(batch):
            taken = fed(intake, read_ms - (batch - 1 - k) * apart_ms, reading=float(n * batch + k))
            assert not taken.set_back_s


def test_none_is_lost_and_none_taken_twice() -> None:
    rng = np.random.default_rng(0)
    for _ in range(40):
        intake, now_ms, started, out = ImuIntake(0.2, floats=True), 0.0, False, []
        for seq in range(300):
            now_ms += 10.0 + rng.choice([0.0, -4000.0, 4000.0], p=[0.99, 0.005, 0.005])
            off_ms = rng.choice([0.0, -2500.0, 1500.0], p=[0.93, 0.05, 0.02]) * rng.uniform()
            taken = fed(intake, now_ms + off_ms, started=started, seq=seq)
            late = () if taken.late is None else (taken.late,)
            out += [m.seq for m in (*taken.accepted, *late, *(m for m, _ in taken.dropped))]
            assert not (late and started and taken.hole is None)
            if taken.set_back_s:
                intake.restart([])
                started = False
            started |= bool(rng.uniform() < 0.05)
        out += [intake.jumped.seq] if intake.jumped else []
        assert sorted(out) == list(range(300))
