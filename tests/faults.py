# SPDX-License-Identifier: Apache-2.0
"""A simulated run as it arrives, and what can go wrong with it on the way (design.md: 'Bad input').

A fault takes the arrivals of a run, a time, and a generator, and returns the arrivals with the fault in them, and
when it is over. Benchmarks inject a thousand of them.
"""

from __future__ import annotations

import copy
import copyreg
import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any
from unittest.mock import patch

import gtsam
import numpy as np

from graphloc.estimate import Estimate
from graphloc.eval.simulate import SimulatedRun
from graphloc.frames import Geodetic
from graphloc.ledger import LedgerRow
from graphloc.measurements import CompassHeading, GnssPosition, ImuSample, Measurement, PoseFix
from graphloc.online import OnlineSmoother
from graphloc.recording import Recording

STEP_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Arrival:
    """A message, and when it was true: its stamp may lie."""

    true_ns: int
    m: Measurement


Arrivals = list[Arrival]
Fault = Callable[[Arrivals, int, np.random.Generator], tuple[Arrivals, int]]


def arrivals_of(run: SimulatedRun) -> Arrivals:
    """Everything of a run, by stamp; a list of the caller's own."""
    return list(_arrivals_of(run.recording))


@lru_cache(maxsize=4)
def _arrivals_of(recording: Recording) -> Arrivals:
    imu = recording.imu
    assert imu is not None
    columns = zip(imu.stamps_ns.tolist(), imu.accel_mps2, imu.gyro_radps, imu.seqs.tolist(), strict=True)
    samples = [
        ImuSample(stamp_ns=s, sensor=imu.sensor, seq=q, accel_mps2=a, gyro_radps=g) for s, a, g, q in columns
    ]  # fmt: skip
    every: list[Measurement] = sorted([*samples, *recording.measurements], key=lambda m: (m.stamp_ns, m.seq))
    return [Arrival(m.stamp_ns, m) for m in every]


def delayed(
    arrivals: Arrivals, rng: np.random.Generator, longest_s: float, *, imu: bool, quiet_s: float = 0.0
) -> Arrivals:
    """Each message late by 0 to `longest_s`, each for itself; in the last `quiet_s` none is."""
    until_ns = arrivals[-1].true_ns - quiet_s * 1e9
    late = [
        a.true_ns
        + (
            rng.uniform(0.0, longest_s) * 1e9
            if a.true_ns <= until_ns and (imu or not isinstance(a.m, ImuSample))
            else 0.0
        )
        for a in arrivals
    ]
    return [arrivals[i] for i in np.argsort(late, kind="stable")]


def numbered(arrivals: Arrivals, first: int = 0) -> Arrivals:
    """Arrival numbers anew: a fault may have doubled messages."""
    return [replace(a, m=replace(a.m, seq=n)) for n, a in enumerate(arrivals, first)]


@dataclass(slots=True)
class Fed:
    """What came of a stream.

    Attributes:
        estimates, errors_m, true_ns: of each estimate, its distance from the truth, and when it was true.
        rows, events: all of them.
    """

    estimates: list[Estimate] = field(default_factory=list)
    errors_m: list[float] = field(default_factory=list)
    true_ns: list[int] = field(default_factory=list)
    rows: list[LedgerRow] = field(default_factory=list)
    events: list[str] = field(default_factory=list)

    def copied(self) -> Fed:
        """Return what came until now, to which more can be added."""
        return replace(self, **{name: list(getattr(self, name)) for name in self.__slots__})

    def recovered_s(self, since_ns: int, within_m: float = 3.0) -> float:
        """Time from `since_ns` until there are estimates again and their error is, and stays, small; inf: never."""
        later = [(t, e) for t, e in zip(self.true_ns, self.errors_m, strict=True) if t >= since_ns]
        last_bad = max((n for n, (_, e) in enumerate(later) if e >= within_m), default=-1)
        return (later[last_bad + 1][0] - since_ns) * 1e-9 if last_bad + 1 < len(later) else float("inf")

    def worst_m(self, since_ns: int = 0) -> float:
        """Largest error from `since_ns` on."""
        return max((e for t, e in zip(self.true_ns, self.errors_m, strict=True) if t >= since_ns), default=np.inf)


def feed(smoother: OnlineSmoother, run: SimulatedRun, arrivals: Sequence[Arrival], fed: Fed | None = None) -> Fed:
    """Feed a stream, and compare with the truth; the stream goes on."""
    fed, begin = fed or Fed(), len(fed.estimates) if fed else 0
    for a in arrivals:
        estimate = smoother.feed(a.m)
        fed.rows += smoother.rows()
        fed.events += [event.text for event in smoother.events()]
        if estimate is not None:
            fed.estimates.append(estimate)
            fed.true_ns.append(estimate.stamp_ns - (a.m.stamp_ns - a.true_ns))
    if len(fed.estimates) > begin:
        true_m, _ = run.truth.poses_at(np.array(fed.true_ns[begin:]))
        off_m = np.array([e.p_world_m for e in fed.estimates[begin:]]) - true_m
        fed.errors_m += np.hypot(off_m[:, 0], off_m[:, 1]).tolist()
    return fed


def _itself(x: Any) -> tuple[Any, ...]:
    return (lambda: x), ()


def _anew(x: Any) -> tuple[Any, ...]:
    return (lambda: x.__class__(x)), ()


# How GTSAM's objects are copied: those that change by their constructors; all others are made once, and shared, as measurements are.
_KINDS = {
    kind for of in (gtsam, gtsam.noiseModel, gtsam.imuBias) for kind in vars(of).values() if inspect.isclass(kind)
}
_COPIERS: dict[type, Callable[[Any], Any]] = {
    **dict.fromkeys({*_KINDS, ImuSample, GnssPosition, CompassHeading, PoseFix}, _itself),
    **dict.fromkeys((gtsam.ISAM2, gtsam.Values, gtsam.NonlinearFactorGraph), _anew),
}


def copied(online: OnlineSmoother) -> OnlineSmoother:
    """Return a smoother that goes on as this one would, apart from it."""
    with patch.dict(copyreg.dispatch_table, _COPIERS):
        return copy.deepcopy(online)


def finish(smoother: OnlineSmoother, fed: Fed) -> Fed:
    """End the stream."""
    fed.rows += smoother.finish()
    fed.events += [event.text for event in smoother.events()]
    return fed


def complaints(arrivals: Sequence[Arrival], fed: Fed) -> list[str]:
    """What must not be, whatever happened: a message without its one row, an estimate that is no number."""
    found = []
    rows = sorted(row.seq for row in fed.rows)
    if rows != (wanted := sorted(a.m.seq for a in arrivals)):
        missing, twice = set(wanted) - set(rows), len(rows) - len(set(rows))
        found.append(f"{len(rows)} rows for {len(wanted)} messages: {len(missing)} missing, {twice} twice")
    for e in fed.estimates:
        arrays = (e.p_world_m, e.R_world_body, e.v_world_mps, e.cov, e.v_cov, e.p_odom_m, e.R_odom_body, e.step_cov)
        if not all(np.isfinite(a).all() for a in arrays) or np.linalg.eigvalsh(e.cov).min() <= 0.0:
            found.append(f"an estimate at {e.stamp_ns} is no number, or has no covariance")
            break
    return found


# Faults


def _changed(
    arrivals: Arrivals, at_ns: int, until_ns: int, kind: type[Any], change: Callable[[Any], Measurement | None]
) -> Arrivals:
    """Messages of a kind within a time changed; None takes one away."""
    changed = []
    for a in arrivals:
        if at_ns <= a.true_ns < until_ns and isinstance(a.m, kind):
            m = change(a.m)
            if m is not None:
                changed.append(replace(a, m=m))
        else:
            changed.append(a)
    return changed


def _for(kind: type[Any], least_s: float, most_s: float, make: Callable[[np.random.Generator], Any]) -> Fault:
    """A fault that changes messages of a kind for a while; `make` draws how."""

    def fault(arrivals: Arrivals, at_ns: int, rng: np.random.Generator) -> tuple[Arrivals, int]:
        until_ns = at_ns + int(rng.uniform(least_s, most_s) * 1e9)
        return _changed(arrivals, at_ns, until_ns, kind, make(rng)), until_ns

    return fault


def _gap(kinds: tuple[type[Any], ...], least_s: float, most_s: float) -> Fault:
    def fault(arrivals: Arrivals, at_ns: int, rng: np.random.Generator) -> tuple[Arrivals, int]:
        until_ns = at_ns + int(np.exp(rng.uniform(np.log(least_s), np.log(most_s))) * 1e9)
        return [a for a in arrivals if not (at_ns <= a.true_ns < until_ns and isinstance(a.m, kinds))], until_ns

    return fault


def _moved(m: GnssPosition, north_m: float, east_m: float) -> GnssPosition:
    lat, lon, height = m.position
    lat_deg = lat + np.degrees(north_m / 6.371e6)
    lon_deg = lon + np.degrees(east_m / (6.371e6 * np.cos(np.radians(lat))))
    return replace(m, position=Geodetic(float(lat_deg), float(lon_deg), height))


def _jump(rng: np.random.Generator) -> Callable[[GnssPosition], GnssPosition]:
    far, way = 10.0 ** rng.uniform(1.0, 4.0), rng.uniform(0.0, 2.0 * np.pi)
    return lambda m: _moved(m, far * np.sin(way), far * np.cos(way))


def _absurd_cov(rng: np.random.Generator) -> Callable[[GnssPosition], GnssPosition]:
    size = float(rng.choice([1e-12, 1e12]))
    return lambda m: replace(m, cov_enu_m2=np.eye(3) * size)


def _absurd_sigma(rng: np.random.Generator) -> Callable[[CompassHeading], CompassHeading]:
    size = float(rng.choice([1e-12, 1e12]))
    return lambda m: replace(m, sigma_rad=size)


def _absurd_modes(rng: np.random.Generator) -> Callable[[PoseFix], PoseFix]:
    size = float(rng.choice([1e-12, 1e12]))
    return lambda m: replace(m, modes=tuple(replace(mode, cov=np.eye(len(mode.value)) * size) for mode in m.modes))


def _turned(rng: np.random.Generator) -> Callable[[CompassHeading], CompassHeading]:
    by = rng.uniform(-np.pi, np.pi)
    return lambda m: replace(m, yaw_rad=m.yaw_rad + by)


def _false(rng: np.random.Generator) -> Callable[[PoseFix], PoseFix]:
    off = np.array([*rng.normal(0.0, 20.0, 2), rng.normal(0.0, 0.3)])
    return lambda m: replace(m, modes=tuple(replace(mode, value=mode.value + off) for mode in m.modes))


def _swapped(m: GnssPosition) -> GnssPosition:
    return replace(m, position=Geodetic(m.position[1], m.position[0], m.position[2]))


def _stamped(by_ns: int) -> Callable[[Measurement], Measurement]:
    return lambda m: replace(m, stamp_ns=m.stamp_ns + by_ns)


def _clock(least_s: float, most_s: float) -> Fault:
    """From now on every clock is off."""

    def fault(arrivals: Arrivals, at_ns: int, rng: np.random.Generator) -> tuple[Arrivals, int]:
        by_ns = int(rng.uniform(least_s, most_s) * 1e9)
        return _changed(arrivals, at_ns, 1 << 62, Measurement, _stamped(by_ns)), at_ns

    return fault


def _some(kind: type[Any], share: float, make: Callable[[np.random.Generator], Any]) -> Fault:
    """A fault of single messages here and there, for three seconds."""

    def fault(arrivals: Arrivals, at_ns: int, rng: np.random.Generator) -> tuple[Arrivals, int]:
        change, until_ns = make(rng), at_ns + 3 * STEP_NS
        return _changed(arrivals, at_ns, until_ns, kind, lambda m: change(m) if rng.random() < share else m), until_ns

    return fault


def _repeated(arrivals: Arrivals, at_ns: int, rng: np.random.Generator) -> tuple[Arrivals, int]:
    """Half of all messages come twice, for two seconds."""
    until_ns, found = at_ns + 2 * STEP_NS, []
    for a in arrivals:
        found += [a, a] if at_ns <= a.true_ns < until_ns and rng.random() < 0.5 else [a]
    return found, until_ns


def flood(arrivals: Arrivals, at_ns: int, rng: np.random.Generator, times: int = 3000) -> tuple[Arrivals, int]:
    """A message that is no IMU's comes very often."""
    n = next((n for n, a in enumerate(arrivals) if a.true_ns >= at_ns and not isinstance(a.m, ImuSample)), 0)
    return [*arrivals[:n], *[arrivals[n]] * times, *arrivals[n:]], at_ns


def _strangers(arrivals: Arrivals, at_ns: int, rng: np.random.Generator) -> tuple[Arrivals, int]:
    """Every message comes again, of a sensor that nobody asked for; one of another IMU too."""
    until_ns, found = at_ns + 2 * STEP_NS, []
    for a in arrivals:
        found.append(a)
        if at_ns <= a.true_ns < until_ns:
            found.append(replace(a, m=replace(a.m, sensor=str(rng.choice(["nobody", "", "gnss", "imu"])))))
    return found, until_ns


FAULTS: dict[str, Fault] = {
    "repeated": _repeated,
    "backward stamps": _some(Measurement, 0.3, lambda rng: _stamped(-int(rng.uniform(0.02, 5.0) * 1e9))),
    "jumping stamps": _some(Measurement, 0.05, lambda rng: _stamped(int(rng.uniform(1.0, 1e6) * 1e9))),
    "zero stamps": _some(Measurement, 0.1, lambda rng: lambda m: replace(m, stamp_ns=0)),
    "one clock off": _for(GnssPosition, 2.0, 6.0, lambda rng: _stamped(int(rng.uniform(-9.0, 9.0) * 1e9))),
    "IMU clock off": _for(ImuSample, 2.0, 6.0, lambda rng: _stamped(int(rng.uniform(-9.0, 9.0) * 1e9))),
    "clock forward": _clock(1.0, 4000.0),
    "clock back": _clock(-4000.0, -1.0),
    "IMU gap": _gap((ImuSample,), 0.3, 60.0),
    "all silent": _gap((Measurement,), 0.3, 30.0),
    "GNSS outage": _gap((GnssPosition,), 5.0, 40.0),
    "dead reckoning": _gap((GnssPosition, PoseFix), 5.0, 40.0),
    "accelerometer in g": _for(
        ImuSample, 0.5, 5.0, lambda rng: lambda m: replace(m, accel_mps2=m.accel_mps2 / 9.80665)
    ),
    "gyroscope in deg/s": _for(
        ImuSample, 0.5, 5.0, lambda rng: lambda m: replace(m, gyro_radps=np.degrees(m.gyro_radps))
    ),
    "latitude and longitude swapped": _for(GnssPosition, 1.0, 8.0, lambda rng: _swapped),
    "GNSS jump": _for(GnssPosition, 1.0, 8.0, _jump),
    "single GNSS jumps": _some(GnssPosition, 0.3, _jump),
    "absurd GNSS covariance": _for(GnssPosition, 1.0, 5.0, _absurd_cov),
    "absurd compass sigma": _for(CompassHeading, 1.0, 5.0, _absurd_sigma),
    "absurd pose covariance": _for(PoseFix, 2.0, 5.0, _absurd_modes),
    "wrong headings": _for(CompassHeading, 1.0, 8.0, _turned),
    "false poses": _for(PoseFix, 2.0, 8.0, _false),
    "strangers": _strangers,
    "flood": flood,
}
