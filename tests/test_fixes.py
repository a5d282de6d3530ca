# SPDX-License-Identifier: Apache-2.0
"""Fixes that say more than they know: repeated under new stamps, stamped in steps, noisier than they claim."""

from pathlib import Path

import numpy as np
import pytest

from graphloc.frames import Datum, Geodetic
from graphloc.frontends.bag import read_recording
from graphloc.frontends.inspect import draft_config, inspect_bag
from graphloc.ledger import Outcome
from graphloc.measurements import GnssPosition
from graphloc.recording import Recording
from tests.bagfactory import START_NS, Item, Messages, S, write_bag
from tests.test_bag_bad_input import accounted, rows_of, vessel

MAKE = Messages(2)
DATUM = Datum(Geodetic(57.7, 11.9, 40.0))


def fixes(
    hz: int = 10, *, every: int = 1, seconds: int = 40, noise_m: float = 0.0, sigma_m: float = 0.1, step_ns: int = 1
) -> list[Item]:
    """A craft that turns at 2 m/s and 0.3 rad/s; the receiver measures at every `every`-th message only."""
    rng = np.random.default_rng(8)
    items: list[Item] = []
    place = np.zeros(3)
    for k in range(hz * seconds):
        t = k / hz
        if k % every == 0:
            place = np.array([6.7 * np.cos(0.3 * t), 6.7 * np.sin(0.3 * t), 0.0]) + noise_m * rng.normal(size=3)
        lla = DATUM.geodetic_from_enu(place[None, :])[0]
        stamp = START_NS + k * S // hz // step_ns * step_ns
        items.append(
            (
                "/fix",
                START_NS + k * S // hz,
                MAKE.fix(stamp, lla[0], lla[1], lla[2], covariance=(sigma_m**2 * np.eye(3)).ravel()),
            )
        )
    return items


def read(tmp_path: Path, items: list[Item], **gnss: object) -> Recording:
    path = write_bag(tmp_path / "run", MAKE, items, "mcap")
    recording = read_recording(path, vessel(imu=None, gnss={"topic": "/fix", **gnss}))
    assert recording.message_count == accounted(recording)
    return recording


def test_places_held_by_a_driver_count_once(tmp_path: Path) -> None:
    recording = read(tmp_path, fixes(10, every=10))
    stamps = [m.stamp_ns for m in recording.measurements if isinstance(m, GnssPosition)]
    # The last one is not known to be held: nothing came after it.
    assert stamps[:40] == [START_NS + k * S for k in range(40)]
    assert len(stamps) == 49
    held = rows_of(recording, "gnss")
    assert len(held) == 351
    assert all(r.outcome is Outcome.REJECTED and "repeats the place" in r.reason for r in held)
    (line,) = recording.warnings
    assert "351 of 400 fixes repeat" in line


@pytest.mark.parametrize("every", [1, 50])
def test_fixes_that_move_or_stand_are_kept(every: int, tmp_path: Path) -> None:
    """A receiver that says the same for 5 s holds still itself."""
    recording = read(tmp_path, fixes(10, every=every))
    assert len(recording.measurements) == 400
    assert recording.warnings == ()


def test_a_few_places_said_twice_are_no_habit(tmp_path: Path) -> None:
    items = fixes(10)
    for k in range(20, 400, 40):
        items[k][2].latitude, items[k][2].longitude = items[k - 1][2].latitude, items[k - 1][2].longitude
    assert len(read(tmp_path, items).measurements) == 400


@pytest.mark.parametrize(("step_ns", "said"), [(1, 0), (S // 10, 0), (S, 1)])
def test_stamps_cut_to_seconds_are_said(step_ns: int, said: int, tmp_path: Path) -> None:
    warnings = read(tmp_path, fixes(10, step_ns=step_ns)).warnings
    assert len(warnings) == said
    assert all("400 measurements have 40 stamps, 1 s apart" in line for line in warnings)


@pytest.mark.parametrize(
    ("hz", "noise_m", "sigma_m", "scale", "expected"),
    [
        (10, 0.5, 0.05, 1.0, 10.0),
        (10, 0.5, 0.05, 4.0, 10.0),  # of the scale that is configured already
        (10, 0.5, 0.05, 9.0, None),
        (10, 0.05, 0.05, 1.0, None),
        (10, 0.0, 0.05, 1.0, None),
        (1, 0.5, 0.05, 1.0, None),  # motion could be in it
    ],
)
def test_noise_that_a_receiver_hides(
    hz: int, noise_m: float, sigma_m: float, scale: float, expected: float | None, tmp_path: Path
) -> None:
    """White noise of 0.5 m on fixes that claim 0.05 m: sigma_scale 10, in the warning and in the draft."""
    items = fixes(hz, noise_m=noise_m, sigma_m=sigma_m, seconds=200)
    lines = [w for w in read(tmp_path, items, sigma_scale=scale).warnings if "scatter" in w]
    assert len(lines) == (expected is not None)
    if expected is not None:
        assert float(lines[0].rsplit("sigma_scale:", 1)[1]) == pytest.approx(expected, rel=0.15)
    if scale == 1.0:
        found = [line for line in draft_config(inspect_bag(tmp_path / "run")).splitlines() if "sigma_scale:" in line]
        assert len(found) == (expected is not None)
        if expected is not None:
            assert float(found[0].split("sigma_scale:")[1].split("#")[0]) == pytest.approx(expected, rel=0.15)
