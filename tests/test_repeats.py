# SPDX-License-Identifier: Apache-2.0
"""Messages that come twice: the same stamp and value, as far back as is remembered."""

from graphloc.measurements import CompassHeading
from graphloc.signals.repeats import Repeats


def heading(stamp_ns: int, yaw_rad: float = 0.5) -> CompassHeading:
    return CompassHeading(stamp_ns=stamp_ns, sensor="compass", seq=0, yaw_rad=yaw_rad, sigma_rad=0.01)


def test_stamp_and_value_must_be_the_same() -> None:
    repeats = Repeats()
    assert [repeats.repeats(m.stamp_ns, m) for m in (heading(1), heading(2), heading(1, 0.6))] == [False] * 3
    assert repeats.repeats(1, heading(1))
    assert not repeats.repeats(1, object())  # of other kinds nothing is compared
    assert not repeats.repeats(1, object())
    repeats.forget()
    assert not repeats.repeats(1, heading(1))


def test_online_it_remembers_the_newest_and_offline_all() -> None:
    for most, old in ((3, False), (None, True)):
        repeats = Repeats(most)
        assert not any(repeats.repeats(n, heading(n)) for n in range(10))
        assert repeats.repeats(9, heading(9))
        assert repeats.repeats(0, heading(0)) is old
