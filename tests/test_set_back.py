# SPDX-License-Identifier: Apache-2.0
"""A computer's clock that is set back within a bag: two parts bear the same times, and one is kept."""

from pathlib import Path

import numpy as np
import pytest

from graphloc.errors import InputError
from graphloc.frontends._order import set_backs
from graphloc.frontends.bag import read_recording
from graphloc.frontends.inspect import inspect_bag
from graphloc.frontends.part import BagPart
from graphloc.ledger import Outcome
from graphloc.recording import Recording
from tests.bagfactory import START_NS, Item, Messages, S, write_bag
from tests.test_bag_bad_input import accounted, one_line, rows_of, vessel

MAKE = Messages(2)
LATE_NS = 10_000_000


def run(tmp_path: Path, at_s: float, back_s: float, seconds: float = 20.0, held_up: int = 0) -> Recording:
    """A craft that goes north at 1 m/s by /truth; all clocks are set back at a time.

    Args:
        held_up: one in so many IMU messages comes 50 ms late.
    """
    items: list[Item] = []
    for k in range(round(seconds * 50)):
        true = START_NS + k * S // 50
        stamp = true - (round(back_s * S) if k >= at_s * 50 else 0)
        way_ns = S // 20 if held_up and k % held_up == held_up - 1 else 0
        items.append(("/imu", true + LATE_NS + way_ns, MAKE.imu(stamp, gyro=(1e-6 * (k % 2), 0.0, 0.0))))
        if k % 10 == 0:
            items.append(("/fix", true + LATE_NS, MAKE.fix(stamp, lat=57.7 + k * 1.8e-7)))
            items.append(("/truth", true + LATE_NS, MAKE.odometry(stamp, xyz=(0.0, k / 50, 0.0))))
    path = write_bag(tmp_path / "run", MAKE, items, "mcap")
    recording = read_recording(path, vessel().model_copy(update={"truth_topic": "/truth"}))
    assert recording.message_count == accounted(recording)
    return recording


@pytest.mark.parametrize(("at_s", "first_s", "last_s"), [(14.0, 0.0, 14.0), (5.0, 5.0, 20.0)])
def test_the_longer_part_is_kept_of_all(tmp_path: Path, at_s: float, first_s: float, last_s: float) -> None:
    recording = run(tmp_path, at_s, 3.0)
    shift_s = 3.0 if first_s else 0.0
    assert recording.imu is not None
    assert recording.imu.stamps_ns[0] == START_NS + round((first_s - shift_s) * S)
    assert len(recording.imu) == (last_s - first_s) * 50
    assert np.all(np.diff(recording.imu.stamps_ns) == S // 50)
    assert len(recording.measurements) == (last_s - first_s) * 5
    lost = rows_of(recording, "imu")
    assert len(lost) == 1000 - len(recording.imu)
    assert all(r.outcome is Outcome.REJECTED and "set back by 3.0 s" in r.reason for r in lost)
    assert any(w.startswith("gnss: ") and "set back by 3.0 s" in w for w in recording.warnings)
    truth = recording.truth
    assert truth is not None
    north = truth.p_world_m[:, 1] - (truth.stamps_ns - START_NS) / S - shift_s
    assert np.abs(north).max() < 1e-6


@pytest.mark.parametrize(("at_s", "first_s", "last_s"), [(14.0, 0.0, 14.0), (5.0, 5.0, 20.0)])
def test_the_longer_part_is_kept_where_samples_come_late(
    tmp_path: Path, at_s: float, first_s: float, last_s: float
) -> None:
    """One in 25, the last before the clock is set back among them: it arrives after that."""
    recording = run(tmp_path, at_s, 3.0, held_up=25)
    assert recording.imu is not None
    begin_ns = START_NS + round((first_s - (3.0 if first_s else 0.0)) * S)
    assert abs(recording.imu.stamps_ns[0] - begin_ns) <= S // 50
    assert abs(recording.imu.stamps_ns[-1] - begin_ns - (last_s - first_s) * S) <= S // 20
    assert len(recording.measurements) == (last_s - first_s) * 5
    assert all("set back by 3.0 s" in w for w in recording.warnings if "its clock" in w or w.startswith("gnss: "))
    assert any(w.startswith("gnss: ") and "set back by 3.0 s" in w for w in recording.warnings)


def test_steady_clocks_late_samples_and_lone_stamps_are_left_alone() -> None:
    steady = np.arange(1000, dtype=np.int64) * (S // 100)
    assert set_backs(steady) == []
    held_up = np.concatenate([steady[:300], steady[500:900], steady[300:500], steady[900:]])
    assert set_backs(held_up) == []
    lone = steady.copy()
    lone[::70] -= 5 * S
    assert set_backs(lone) == []
    assert set_backs(np.concatenate([steady[:600], steady[300:]])) == [600]
    assert set_backs(np.concatenate([steady[:600], steady[300:500], steady[400:]])) == [600, 800]
    back = np.where(steady >= 6 * S, steady - 3 * S, steady)
    arrived = steady + np.where(np.arange(1000) % 25 == 24, 5 * (S // 100) + 1, 0)
    assert set_backs(back[np.argsort(arrived)]) == [599]
    woven = np.stack([steady[500:900], steady[100:500]], axis=1).ravel()  # of two clocks at once
    assert set_backs(np.concatenate([steady[:500], woven])) == []


def parts(tmp_path: Path, second_s: tuple[float, float], back_s: float) -> list[Path]:
    """Two files of one run: 0 to 20 s, and a part whose clocks, that of the recording too, were set back."""
    found = []
    for name, (first_s, last_s), back in (("a", (0.0, 20.0), 0.0), ("b", second_s, back_s)):
        items: list[Item] = []
        for k in range(round(first_s * 50), round(last_s * 50)):
            stamp = START_NS + k * S // 50 - round(back * S)
            items.append(("/imu", stamp + LATE_NS, MAKE.imu(stamp, gyro=(1e-6 * k, 0.0, 0.0))))
        found.append(write_bag(tmp_path / name, MAKE, items, "mcap"))
    return found


@pytest.mark.parametrize("back_s", [5.0, 5.013])  # equal stamps are no repeats where they say other things
@pytest.mark.parametrize("first", [0, 1])
def test_parts_that_lie_over_each_other_are_refused(tmp_path: Path, back_s: float, first: int) -> None:
    paths = parts(tmp_path, (20.0, 40.0), back_s)
    for read in (lambda p: read_recording(p, vessel(gnss=None)), inspect_bag):
        with pytest.raises(InputError) as error:
            read(paths if not first else paths[::-1])
        one_line(error, "b: /imu goes back by", "into times that a has too", "give them one at a time")


def test_a_folder_whose_second_file_was_set_back_is_refused(tmp_path: Path) -> None:
    """rosbags reads the files of a folder one after the other: in order of arrival the recording times go back as well."""
    paths = parts(tmp_path, (20.0, 40.0), 5.0)
    folder = tmp_path / "both"
    folder.mkdir()
    for k, path in enumerate(paths):
        (file,) = path.glob("*.mcap")
        file.rename(folder / f"both_{k}.mcap")
    with pytest.raises(InputError) as error:
        read_recording(folder, vessel(gnss=None))
    one_line(error, "both_1.mcap: /imu goes back by 5.0 s", "into times that both_0.mcap has too")


def test_two_recorders_that_lose_messages_are_one_run(tmp_path: Path) -> None:
    """What the second alone has follows the first's end, and goes back to its begin: no clock did."""
    rng, paths = np.random.default_rng(1), []
    for name, late_ns in (("a", 0), ("b", 1_000_000)):
        heard = np.flatnonzero(rng.uniform(size=6000) > 0.03)
        items: list[Item] = []
        for k in heard.tolist():
            stamp = START_NS + k * S // 50
            items.append(("/imu", stamp + LATE_NS + late_ns, MAKE.imu(stamp, gyro=(1e-6 * k, 0.0, 0.0))))
        paths.append(write_bag(tmp_path / name, MAKE, items, "mcap"))
    recording = read_recording(paths, vessel(gnss=None))
    assert recording.imu is not None
    assert 5980 < len(recording.imu) < 6000


@pytest.mark.parametrize(("second_s", "samples"), [((20.0, 40.0), 2000), ((10.0, 30.0), 1500)])
def test_parts_that_follow_or_repeat_each_other_are_one_run(
    tmp_path: Path, second_s: tuple[float, float], samples: int
) -> None:
    recording = read_recording(parts(tmp_path, second_s, 0.0), vessel(gnss=None))
    assert recording.imu is not None
    assert len(recording.imu) == samples


@pytest.mark.parametrize("kind", ["sqlite3", "mcap", "ros1"])
def test_a_recorder_whose_clock_was_set_back_within_a_file_is_refused(tmp_path: Path, kind: str) -> None:
    """All readers put messages in order of time: the parts were woven into one run, 39 m off."""
    make = Messages(1 if kind == "ros1" else 2)
    items: list[Item] = []
    for k in range(2000):
        stamp = START_NS + k * S // 50 - (round(15.013 * S) if k >= 1000 else 0)
        items.append(("/imu", stamp + LATE_NS, make.imu(stamp, gyro=(1e-6 * k, 0.0, 0.0))))
    path = write_bag(tmp_path / f"run{'.bag' if kind == 'ros1' else ''}", make, items, kind)
    for read in (lambda p: read_recording(p, vessel(gnss=None)), inspect_bag):
        with pytest.raises(InputError) as error:
            read(path)
        one_line(error, "run", "/imu goes back by 15.0 s within the file", "--start, --duration")
    for part, samples in ((BagPart((path,), duration_s=4.5), 225), (BagPart((path,), start_s=21.0), 199)):
        recording = read_recording(part, vessel(gnss=None))
        assert recording.imu is not None
        assert abs(len(recording.imu) - samples) < 3


def test_a_file_that_holds_a_part_twice_is_one_run(tmp_path: Path) -> None:
    steady: list[Item] = [("/imu", START_NS + k * S // 50, MAKE.imu(START_NS + k * S // 50)) for k in range(1500)]
    path = write_bag(tmp_path / "run", MAKE, [*steady[:1000], *steady[500:]], "sqlite3")
    recording = read_recording(path, vessel(gnss=None))
    assert recording.imu is not None
    assert len(recording.imu) == 1500
