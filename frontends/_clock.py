# SPDX-License-Identifier: Apache-2.0
"""Clocks, by stamps and recording times: latency, drift, steps, jumps and leaps, the pace of a recording."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from graphloc.config import AerialConfig, SensorConfig
from graphloc.frontends._order import SET_BACK_S, Stamps, set_backs
from graphloc.time import GPS_AHEAD_S, NS_PER_S, duration_ns, utc_text

JUMP_LIMIT_S = 60.0
"""A header stamp further than this from its topic's usual latency is a clock jump."""
EPOCH_LIMIT_S = 1.0
"""Clocks of two sensors that differ by more are said to disagree."""
MOST_LATE_S = 1.5
"""Largest delay of a sensor's stamps on one clock: receivers filter their velocity, drivers wait for a whole burst."""
FARTHEST_LATE_S = 3.0
"""Largest delay of fixes and velocities that is searched by the motion: a radio link or a slow driver holds them up."""
MOST_ON_ITS_WAY_S = 0.6
"""Largest delay of a fix that is stamped on arrival and was delayed only on its way to the computer."""
NO_DATE_NS = 946_684_800 * NS_PER_S
"""2000-01-01: a stamp before it is no date."""
SCANS_AHEAD_S = 0.15
"""Scans stamped ahead of an IMU by no more may have the same clock: the IMU's samples may be late by as much."""
LEAP_S = 0.5
"""A step within so much of an expected one, as GPS time minus UTC, is taken for it."""
GAIN_LIMIT_S = 0.1
"""A clock that gains more on another during a run is said to drift."""

FEWEST_STAMPS = 100
"""Fewer messages do not tell what their clock gains."""

_WHOLE_S = 0.1  # largest deviation of a leap from whole seconds: latencies vary
_BESIDE, _FEWEST_BESIDE = 20, 10  # most and fewest messages to either side that tell a leap
_SOONER = 0.75  # quantile of stamp minus recording time that stands for a side: other messages were delayed
# Least share of a side's messages near that quantile. It is less of two clocks on one topic, and of scattered
# latencies.
_ALIKE = 0.7
_TENTHS = 10  # parts of a run
_EVEN = 0.15  # share of the gain by which a clock may deviate from a steady drift, or from a single step
_MOST_DRIFT = 0.1  # share of time: a larger drift is none, and the configuration takes none
_STEADY = 0.95  # share of messages that are near one of the two levels of a step
_PACE_OF, _STEADIER = 21, 0.5  # samples of which the median latency is taken; share of the spread that is left


def usual_latency_s(stamps_ns: Stamps, logs_ns: Stamps) -> float:
    """Return the median of recording time minus header stamp, s."""
    return float(np.median(logs_ns - stamps_ns)) / NS_PER_S


class Gain(NamedTuple):
    """What a clock gains on the recording times.

    Attributes:
        gained_s: gain from the first tenth of its messages to the last.
        drift_ppm: by how much it runs faster; 0 where it gains unevenly, or nearly nothing. It gains in a step where it
            is set, or where messages are delayed from some time on.
    """

    gained_s: float
    drift_ppm: float

    @property
    def even(self) -> bool:
        """Whether the drift explains the whole gain."""
        return self.drift_ppm != 0.0 or abs(self.gained_s) <= GAIN_LIMIT_S


def gain(stamps_ns: Stamps, logs_ns: Stamps) -> Gain:
    """Return what a clock gains on the recording times; nothing of fewer than `FEWEST_STAMPS` messages.

    Of each tenth of the messages it takes one that was recorded soon, as others were delayed: the 95 % point of stamp
    minus recording time, since a few stamps may be wrong. Tenths are of messages, since a topic may be silent for long.
    """
    if len(stamps_ns) < FEWEST_STAMPS:
        return Gain(0.0, 0.0)
    t_s, ahead_s = np.zeros(_TENTHS), np.zeros(_TENTHS)
    for k, tenth in enumerate(np.array_split(np.arange(len(stamps_ns)), _TENTHS)):
        ahead_ns = stamps_ns[tenth] - logs_ns[tenth]
        soon = np.argsort(ahead_ns)[int(0.95 * (len(tenth) - 1))]
        t_s[k], ahead_s[k] = (logs_ns[tenth[soon]] - logs_ns[0]) / NS_PER_S, ahead_ns[soon] / NS_PER_S
    gained_s = float(ahead_s[-1] - ahead_s[0])
    if abs(gained_s) <= GAIN_LIMIT_S:
        return Gain(gained_s, 0.0)
    slope, at_start = np.polyfit(t_s, ahead_s, 1)
    uneven_s = float(np.abs(ahead_s - at_start - slope * t_s).max())
    stands = abs(slope) > _MOST_DRIFT  # stamps that hardly advance, or much too fast, are no drift
    return Gain(gained_s, 0.0 if stands or uneven_s > _EVEN * abs(gained_s) else float(slope) * 1e6)


class ClockStep(NamedTuple):
    """How a clock was set against the recording times: by how much, s, positive forward, and at what recording time."""

    by_s: float
    at_ns: int

    def said(self, whose: str) -> str:
        """Return the step in words, with what to do."""
        said = self.what(whose)
        return f"{said}: no time_offset_s holds on both sides, and no bound includes it; use the part on one side (--start, --duration)"

    def what(self, whose: str) -> str:
        """Return the step in words."""
        way = "forward" if self.by_s > 0.0 else "back"
        said = f"the clock of {whose} was set {way} by {abs(self.by_s):.2f} s at {utc_text(self.at_ns)}, recording time"
        if abs(abs(self.by_s) - GPS_AHEAD_S) < LEAP_S:
            said += f", as from {'UTC to GPS time' if self.by_s > 0.0 else 'GPS time to UTC'}"
        return said

    @property
    def when(self) -> str:
        """When the step was, in words."""
        return f"all of it at {utc_text(self.at_ns)}, recording time"

    @property
    def said_of_recorder(self) -> str:
        """The step in words, if the clock is the recorder's."""
        return (
            f"the recorder's clock was set by {self.by_s:+.0f} s at {utc_text(self.at_ns)}, recording time, while the stamps of the headers "
            "go on: these are right on both sides; messages without one are on one side only"
        )


def step(stamps_ns: Stamps, logs_ns: Stamps, least_s: float = EPOCH_LIMIT_S) -> ClockStep | None:
    """Return the one step that explains the gain of a clock on the recording times; None if none does, or it is small.

    Args:
        least_s: smallest step. One smaller than the default may also be messages that are delayed from some time on.
    """
    gained_s = gain(stamps_ns, logs_ns).gained_s
    if abs(gained_s) < least_s:
        return None
    ahead_s = (stamps_ns - logs_ns) / NS_PER_S * np.sign(gained_s)
    part = max(len(ahead_s) // _TENTHS, 1)
    before_s, after_s = (float(np.median(ahead_s[own])) for own in (slice(part), slice(-part, None)))
    later = ahead_s > 0.5 * (before_s + after_s)
    first = int(np.argmax(np.cumsum(np.where(later, -1, 1)))) + 1
    if not part <= first <= len(later) - part:
        return None
    off_s = np.abs(ahead_s - np.where(np.arange(len(later)) < first, before_s, after_s))
    even = float(np.percentile(off_s, 100.0 * _STEADY)) < _EVEN * abs(gained_s)
    return ClockStep(gained_s, int(logs_ns[first])) if even else None


def leaps(stamps_ns: Stamps, logs_ns: Stamps) -> list[tuple[int, ClockStep]]:
    """Return at which indices and how a clock was set by whole seconds: UTC to GPS time, a leap second, an hour.

    Only leaps between messages that were recorded evenly are found: else messages may be late from then on. The
    recording times tell the number of seconds, and rounding gives the exact step.
    """
    if len(stamps_ns) < 2 * _FEWEST_BESIDE:
        return []
    ahead_ns, apart_ns = stamps_ns - logs_ns, np.diff(logs_ns)
    by_ns, uneven_ns = np.diff(ahead_ns), np.abs(apart_ns - np.median(apart_ns))
    found: list[tuple[int, ClockStep]] = []
    for i in (np.flatnonzero((np.abs(by_ns) > 0.5 * NS_PER_S) & (2 * uneven_ns < np.abs(by_ns))) + 1).tolist():
        before_ns, after_ns = ahead_ns[max(i - _BESIDE, found[-1][0] if found else 0) : i], ahead_ns[i : i + _BESIDE]
        if min(len(before_ns), len(after_ns)) < _FEWEST_BESIDE:
            continue
        usual_ns = [np.quantile(side_ns, _SOONER) for side_ns in (before_ns, after_ns)]
        steady = all(
            np.mean(np.abs(side_ns - level_ns) < 2 * _WHOLE_S * NS_PER_S) >= _ALIKE
            for side_ns, level_ns in zip((before_ns, after_ns), usual_ns, strict=True)
        )
        by_s = float(usual_ns[1] - usual_ns[0]) / NS_PER_S
        whole_s = round(by_s)
        here = steady and abs(by_ns[i - 1] / NS_PER_S - whole_s) < LEAP_S
        if whole_s and here and abs(by_s - whole_s) < _WHOLE_S:
            found.append((i, ClockStep(float(whole_s), int(logs_ns[i]))))
    return found


def without_leaps(stamps_ns: Stamps, logs_ns: Stamps, latency_s: float, whose: str) -> tuple[Stamps, str]:
    """Return stamps (N,) without the leaps of their clock, and a warning, '' if there are no leaps.

    Args:
        latency_s: usual latency of the IMU. The part of the stamps whose latency is nearest to it stays as it is.
        whose: name of the sensor.
    """
    found = leaps(stamps_ns, logs_ns)
    if not found:
        return stamps_ns, ""
    off_ns = np.zeros(len(stamps_ns), dtype=np.int64)
    for i, at in found:
        off_ns[i:] += duration_ns(at.by_s)
    parts = np.split(np.arange(len(stamps_ns)), [i for i, _ in found])
    apart_s = [abs(usual_latency_s(stamps_ns[part], logs_ns[part]) - latency_s) for part in parts]
    off_ns -= off_ns[parts[int(np.argmin(apart_s))][0]]
    what, wrong = " and ".join(at.what(whose) for _, at in found), int((off_ns != 0).sum())
    said = f"{what}: {wrong} of its stamps are corrected by that; the others are nearer to the IMU's"
    return stamps_ns - off_ns, said


def corrected_ns(stamp_ns: int, config: SensorConfig, elapsed_ns: int) -> int:
    """Return a stamp, ns, with the sensor's `time_offset_s` added and the gain by its `clock_drift_ppm` taken off.

    Args:
        elapsed_ns: time from the beginning of the bag until the message was recorded.
    """
    return stamp_ns + duration_ns(config.time_offset_s - 1e-6 * config.clock_drift_ppm * elapsed_ns / NS_PER_S)


class Clock(NamedTuple):
    """Clock of a topic: its first stamp, ns, and its usual latency, s."""

    first_ns: int
    latency_s: float


def reference_of(imu: Clock, others: Iterable[Clock]) -> Clock:
    """Return the clock that others are compared with: the IMU's, or the first that tells a date if it tells none.

    A clock that counts from its start would date the track 1970.
    """
    return next((c for c in (imu, *others) if c.first_ns >= NO_DATE_NS), imu)


def behind_s(own: Clock, imu: Clock, reference: Clock) -> float:
    """Return by how much a clock is behind the reference, s.

    A clock that agrees with the IMU's is behind by as much as the IMU's: messages from one computer have different
    latencies, for which their stamps must not be shifted against each other.
    """
    same = abs(own.latency_s - imu.latency_s) <= EPOCH_LIMIT_S
    return (imu if same else own).latency_s - reference.latency_s


def most_early_s(own_s: float, imu_s: float) -> float:
    """Return by how much, s, a message can have been measured after its stamp, on the clock of the IMU.

    However it was stamped, it was measured before it was recorded. The IMU's samples may be stamped late, too.

    Args:
        own_s, imu_s: usual latencies, recording time minus stamp, of the message's topic and of the IMU.
    """
    return max(own_s - imu_s, 0.0) + MOST_ON_ITS_WAY_S


class ScanClock(NamedTuple):
    """How far a LiDAR's stamps are ahead of the IMU's, s, by the recording times.

    It is the usual latency of the IMU minus that of the scans, so it is too small by what scans take longer on their
    way.
    """

    ahead_s: float

    def said(self, sensor: str, config: AerialConfig) -> str:
        """Return a warning where this is more than latencies and `stamp_sigma_s` explain; else ''."""
        allowed_s = 2.0 * config.stamp_sigma_s
        if -max(MOST_ON_ITS_WAY_S, allowed_s) <= self.ahead_s <= max(SCANS_AHEAD_S, allowed_s):
            return ""
        way = "ahead of" if self.ahead_s > 0.0 else "behind"
        at_least = f"at least {abs(self.ahead_s):.2f} s" if self.ahead_s > 0.0 else f"{abs(self.ahead_s):.2f} s"
        taken = "" if self.ahead_s > 0.0 else ", or its scans come as late"
        return (
            f"{sensor}: by the recording times the clock of its LiDARs is {at_least} {way} the IMU's{taken}: set time_offset_s "
            f"(to {config.time_offset_s - self.ahead_s:.2f} or less), or stamp_sigma_s to as much"
        )

    def astray(self, config: AerialConfig) -> bool:
        """Return whether scans are stamped later than they can have been taken, by more than bounds allow for."""
        return self.ahead_s > max(SCANS_AHEAD_S, 2.0 * config.stamp_sigma_s)


def clock_jumps(stamps_ns: Stamps, logs_ns: Stamps) -> NDArray[np.bool_]:
    """Return (N,) whether the latency of a message is off the usual one of its topic by more than `JUMP_LIMIT_S`."""
    return _unusual(steady_logs(stamps_ns, logs_ns) - stamps_ns)


def steady_logs(stamps_ns: Stamps, logs_ns: Stamps) -> Stamps:
    """Return recording times (N,) as if the recorder's clock had not been set during the run; its last setting counts.

    It was set where recording times leap while the stamps go on. They are corrected only if more messages then have a
    latency near the usual one: after a stall, messages are late for a while.
    """
    limit_ns, latency_ns = duration_ns(JUMP_LIMIT_S), logs_ns - stamps_ns
    unusual = int(_unusual(latency_ns).sum())
    if not unusual:
        return logs_ns
    by_ns, own_ns = np.diff(latency_ns), np.diff(stamps_ns)
    by_ns[(np.abs(by_ns) < limit_ns) | (own_ns < -duration_ns(SET_BACK_S)) | (own_ns > limit_ns)] = 0
    steady_ns = logs_ns + by_ns.sum() - np.concatenate([[0], np.cumsum(by_ns)])
    return steady_ns if int(_unusual(steady_ns - stamps_ns).sum()) < unusual else logs_ns


def recorder_set(stamps_ns: Stamps, logs_ns: Stamps) -> ClockStep | None:
    """Return the largest step by which the recorder's clock was set, as `steady_logs` finds it; None if it was not."""
    off_ns = logs_ns - steady_logs(stamps_ns, logs_ns)
    by_ns = np.diff(off_ns)
    if not by_ns.any():
        return None
    k = int(np.argmax(np.abs(by_ns)))
    return ClockStep(float(by_ns[k]) / NS_PER_S, int(logs_ns[k + 1]))


class RecordingPace(NamedTuple):
    """How recording times run beside the stamps of the headers: recording times (K,) and latencies (K,) there, ns."""

    logs_ns: Stamps
    late_ns: Stamps

    def of_stamps(self, logs_ns: Stamps) -> Stamps:
        """Return recording times (N,) at the pace of the stamps, so that messages are as late as at the beginning."""
        grown = np.interp(logs_ns - self.logs_ns[0], self.logs_ns - self.logs_ns[0], self.late_ns - self.late_ns[0])
        return np.asarray(logs_ns - np.rint(grown).astype(np.int64))

    @property
    def said(self) -> str:
        """The pace in words."""
        took_s, grown_s = (float(of[-1] - of[0]) / NS_PER_S for of in (self.logs_ns, self.late_ns))
        return (
            f"recording took {took_s:.0f} s while the stamps of the headers went on by {took_s - grown_s:.0f} s, as from a simulator, or from a bag "
            "that was played at another speed or with pauses: the stamps are used"
        )


def pace(imu: tuple[Stamps, Stamps], others: Iterable[tuple[Stamps, Stamps]]) -> RecordingPace | None:
    """Return the pace of the recording times if it is not that of the stamps of most topics, else None.

    Clocks are compared by usual latencies, which mean nothing if all latencies grow. The IMU's clock alone may be
    wrong: so most other topics must get steadier by its latencies.

    Args:
        imu, others: stamps and recording times (N,) of topics with stamps.
    """
    stamps_ns, logs_ns = imu
    if len(stamps_ns) < FEWEST_STAMPS or set_backs(stamps_ns):
        return None
    late_ns, limit_ns = steady_logs(stamps_ns, logs_ns) - stamps_ns, duration_ns(EPOCH_LIMIT_S)
    if np.diff(stamps_ns).min() < -limit_ns:  # single recording times are wrong, by which messages are in order
        return None
    if _spread(late_ns) <= limit_ns:
        return None
    from scipy.ndimage import median_filter  # seldom needed, and slow to load

    found = RecordingPace(logs_ns, np.asarray(median_filter(late_ns, _PACE_OF, mode="nearest")))
    spreads = [
        (_spread(logs - stamps), _spread(found.of_stamps(logs) - stamps)) for stamps, logs in others if len(stamps)
    ]
    steadier = [left < _STEADIER * own for own, left in spreads if max(own, left) > limit_ns]
    return found if 2 * sum(steadier) > len(steadier) else None


def _spread(latency_ns: Stamps) -> float:
    """Return the range of most latencies (N,), ns."""
    return float(np.subtract(*np.percentile(latency_ns, [95.0, 5.0])))


def _unusual(latency_ns: Stamps) -> NDArray[np.bool_]:
    if len(latency_ns) == 0:
        return np.zeros(0, dtype=bool)
    return np.asarray(np.abs(latency_ns - np.int64(np.median(latency_ns))) > duration_ns(JUMP_LIMIT_S))
