# SPDX-License-Identifier: Apache-2.0
"""Harbour failures, as functions from a recording to a recording. A seed always gives the same failure.

Each measurement that a failure removes keeps a row in the ledger, as held-out fixes do.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from graphloc.config import VesselConfig
from graphloc.eval.simulate.noise import drift_m
from graphloc.frames import Array, Datum, Geodetic, wrap_angle
from graphloc.ledger import Outcome
from graphloc.measurements import (
    CompassHeading,
    GnssPosition,
    GnssVelocity,
    Measurement,
    PoseFix,
    TagSighting,
    world_from_fixes,
)
from graphloc.recording import Recording
from graphloc.signals.series import interpolated
from graphloc.time import NS_PER_S

OUTAGES_S = (10.0, 30.0, 60.0, 120.0)
_TAKEN = "taken away by the drill"
# False matches lie where BL's matcher found its own: 1.5 to 5 m and up to 5 deg off.
_FALSE_M, _FALSE_DEG = (1.5, 5.0), 5.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Struck:
    """A recording with a failure in it.

    Attributes:
        recording: with the changed measurements. late_ns: by arrival number, the additional delay of its arrival.
    """

    recording: Recording
    late_ns: Mapping[int, int] = field(default_factory=dict)


Strike = Callable[[Recording, int, int, np.random.Generator], Struck]
"""Takes a recording, the failure's first stamp (ns), the stamp after its last, and a generator; returns the change."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Failure:
    """A failure that can be injected.

    Attributes:
        name: for tables, unique. family: name that failures share which differ only in length; they form a curve.
        length_s: duration. strike: changes a recording.
    """

    name: str
    family: str
    length_s: float
    strike: Strike

    def on(self, recording: Recording, begin_ns: int, seed: int) -> Struck:
        """Inject the failure into a recording, beginning at `begin_ns`."""
        rng = np.random.default_rng([seed, *self.name.encode()])
        return self.strike(recording, begin_ns, begin_ns + round(self.length_s * NS_PER_S), rng)


def script(
    recording: Recording, config: VesselConfig | None = None
) -> tuple[tuple[Failure, ...], tuple[tuple[str, str], ...]]:
    """Return the failures that are possible with a recording's sensors, and names and reasons of the others.

    Args:
        config: tells which sensors read one receiver; None: each reads its own.
    """
    has = {kind: any(isinstance(m, kind) for m in recording.measurements) for kind in _KINDS}
    receivers = {} if config is None else {name: config.receiver_of(name) for name in config.sensors}
    found: list[Failure] = []
    left: list[tuple[str, str]] = []

    def offer(why_not: str, *failures: Failure) -> None:
        if why_not:
            left.extend((name, why_not) for name in dict.fromkeys(f.family for f in failures))
        else:
            found.extend(failures)

    no_gnss = "" if has[GnssPosition] else "no GNSS fixes"
    no_pose = "" if has[PoseFix] else "no matches and no poses"
    no_compass = "" if has[CompassHeading] else "no compass"
    alone = has[GnssPosition] + has[PoseFix] + has[TagSighting] < 2
    tags = recording.of(TagSighting)
    flips = "" if any(len(m.modes) > 1 for m in tags) else "no sighting with a second pose" if tags else "no tags"
    offer(no_gnss, *(_timed("GNSS outage", s, partial(_silent, kinds=_GNSS)) for s in OUTAGES_S))
    nothing = "a single sensor measures position: the same as its outage" if alone else ""
    offer(nothing, *(_timed("no place at all", s, partial(_silent, kinds=_PLACES)) for s in OUTAGES_S[:3]))
    offer(
        no_gnss,
        _timed("GNSS drift of 3 m", 60.0, partial(_drift, rmse_m=3.0)),
        _timed("GNSS jump of 10 m", 10.0, partial(_jump, size_m=10.0)),
        _timed("GNSS frozen", 30.0, partial(_frozen, receivers=receivers)),
    )
    offer(
        no_compass,
        _timed("compass silent", 60.0, partial(_silent, kinds=(CompassHeading,))),
        _timed("compass off by 15 deg", 30.0, partial(_turned, off_deg=15.0)),
    )
    offer(
        no_pose,
        _timed("70 % of matches false", 30.0, partial(_false, share=0.7, alike=False)),
        _timed("all matches false alike", 20.0, partial(_false, share=1.0, alike=True)),
    )
    offer(flips, _timed("tags flipped", 20.0, _flipped))
    late = "" if has[PoseFix] or has[TagSighting] else "no matches, poses or tags"
    offer(late, *(_timed(f"matches late by {s:g} s", 30.0, partial(_late, late_s=s)) for s in (2.0, 12.0)))
    offer(
        "" if recording.imu is not None else "no IMU",
        _timed("IMU gap", 1.0, _imu_gap),
        _timed("IMU gap", 5.0, _imu_gap),
    )
    return tuple(found), tuple(left)


_GNSS: tuple[type[Measurement], ...] = (GnssPosition, GnssVelocity)
_PLACES: tuple[type[Measurement], ...] = (*_GNSS, PoseFix, TagSighting)
_KINDS = (GnssPosition, CompassHeading, PoseFix, TagSighting)


def _timed(family: str, length_s: float, strike: Strike) -> Failure:
    return Failure(name=f"{family}, {length_s:g} s", family=family, length_s=length_s, strike=strike)


def _during(m: Measurement, begin_ns: int, end_ns: int) -> bool:
    return begin_ns <= m.stamp_ns < end_ns


def _silent(recording: Recording, begin_ns: int, end_ns: int, _rng: np.random.Generator, *, kinds: tuple[type[Measurement], ...]) -> Struck:  # fmt: skip
    """Remove the measurements of some kinds."""
    gone = [m for m in recording.measurements if isinstance(m, kinds) and _during(m, begin_ns, end_ns)]
    left = {id(m) for m in gone}
    return Struck(
        recording=replace(
            recording,
            measurements=tuple(m for m in recording.measurements if id(m) not in left),
            rows=(*recording.rows, *(recording.row_of(m, Outcome.HELD_OUT, _TAKEN) for m in gone if m.seq >= 0)),
        )
    )


def _changed(recording: Recording, change: Callable[[Measurement], Measurement]) -> Struck:
    return Struck(recording=recording.changed(change))


def _moved_fixes(recording: Recording, begin_ns: int, end_ns: int, error_m: Callable[[Array], Array]) -> Struck:
    """Add errors to fixes; `error_m` maps times (N,), s since the failure began, to (N, 2) m, east, north."""
    fixes = [m for m in recording.of(GnssPosition) if _during(m, begin_ns, end_ns)]
    if not fixes:
        return Struck(recording=recording)
    datum = Datum(fixes[0].position)
    enu = world_from_fixes(fixes, datum)
    enu[:, :2] += error_m(np.array([(m.stamp_ns - begin_ns) / NS_PER_S for m in fixes]))
    moved = {id(m): Geodetic(*g) for m, g in zip(fixes, datum.geodetic_from_enu(enu), strict=True)}
    return _changed(
        recording, lambda m: replace(m, position=moved[id(m)]) if isinstance(m, GnssPosition) and id(m) in moved else m
    )


def _drift(recording: Recording, begin_ns: int, end_ns: int, rng: np.random.Generator, *, rmse_m: float) -> Struck:
    """Add multipath that grows, levels out, turns slowly and fades, as in the simulator (BL section 3.1.5)."""
    length_s = (end_ns - begin_ns) / NS_PER_S

    def error_m(t: Array) -> Array:
        grid = np.linspace(0.0, length_s, 601)
        drawn = drift_m(rng, grid, rmse_m) * np.clip((length_s - grid) / (0.1 * length_s), 0.0, 1.0)[:, None]
        return interpolated(t, grid, drawn)

    return _moved_fixes(recording, begin_ns, end_ns, error_m)


def _jump(recording: Recording, begin_ns: int, end_ns: int, rng: np.random.Generator, *, size_m: float) -> Struck:
    """Add a constant error to all fixes, which begins and ends suddenly."""
    angle = rng.uniform(0.0, 2.0 * np.pi)
    return _moved_fixes(
        recording, begin_ns, end_ns, lambda t: np.tile(size_m * np.array([np.cos(angle), np.sin(angle)]), (len(t), 1))
    )


def _frozen(recording: Recording, begin_ns: int, end_ns: int, _rng: np.random.Generator, *, receivers: Mapping[str, str]) -> Struck:  # fmt: skip
    """Repeat the last measurements of each receiver under new stamps, as the driver of a receiver that hangs does.

    Args:
        receivers: name of the receiver, by sensor.
    """
    last: dict[tuple[str, type[Measurement]], Measurement] = {}
    held: dict[int, Measurement] = {}
    for m in sorted(recording.measurements, key=lambda m: m.stamp_ns):
        if isinstance(m, _GNSS):
            said = (receivers.get(m.sensor, m.sensor), type(m))
            if _during(m, begin_ns, end_ns) and said in last:
                held[id(m)] = last[said]
            else:
                last[said] = m
    return _changed(recording, lambda m: replace(held[id(m)], stamp_ns=m.stamp_ns, seq=m.seq) if id(m) in held else m)


def _turned(recording: Recording, begin_ns: int, end_ns: int, rng: np.random.Generator, *, off_deg: float) -> Struck:
    """Turn the compass by a constant angle, as iron or a current does."""
    off = float(np.radians(off_deg) * rng.choice([-1.0, 1.0]))

    def change(m: Measurement) -> Measurement:
        if isinstance(m, CompassHeading) and _during(m, begin_ns, end_ns):
            return replace(m, yaw_rad=float(wrap_angle(m.yaw_rad + off)))
        return m

    return _changed(recording, change)


def _false(recording: Recording, begin_ns: int, end_ns: int, rng: np.random.Generator, *, share: float, alike: bool) -> Struck:  # fmt: skip
    """Displace a share of the poses: each by itself or, if `alike`, equally, as if a pier were taken for the next."""

    def draw() -> dict[str, float]:
        size, angle = rng.uniform(*_FALSE_M), rng.uniform(0.0, 2.0 * np.pi)
        off = np.radians(rng.uniform(-_FALSE_DEG, _FALSE_DEG))
        return {"x": size * np.cos(angle), "y": size * np.sin(angle), "yaw": float(off)}

    angle = rng.uniform(0.0, 2.0 * np.pi)
    fixed = {"x": 4.0 * np.cos(angle), "y": 4.0 * np.sin(angle)}

    def change(m: Measurement) -> Measurement:
        if not (isinstance(m, PoseFix) and _during(m, begin_ns, end_ns) and rng.uniform() < share):
            return m
        offsets = fixed if alike else draw()
        off = np.array([offsets.get(axis, 0.0) for axis in m.axes])
        return replace(m, modes=tuple(replace(mode, value=mode.value + off) for mode in m.modes))

    return _changed(recording, change)


def _flipped(recording: Recording, begin_ns: int, end_ns: int, _rng: np.random.Generator) -> Struck:
    """Exchange the probabilities of a tag's poses, so that the wrong one fits the image best."""

    def change(m: Measurement) -> Measurement:
        if not (isinstance(m, TagSighting) and _during(m, begin_ns, end_ns) and len(m.modes) > 1):
            return m
        shares = sorted(mode.probability for mode in m.modes)
        modes = sorted(m.modes, key=lambda mode: -mode.probability)
        flipped = [replace(mode, probability=p) for mode, p in zip(modes, shares, strict=True)]
        return replace(m, modes=tuple(sorted(flipped, key=lambda mode: -mode.probability)))

    return _changed(recording, change)


def _late(recording: Recording, begin_ns: int, end_ns: int, _rng: np.random.Generator, *, late_s: float) -> Struck:
    """Delay the arrival of measurements that are computed, as matches; their stamps stay right."""
    late = [m for m in recording.measurements if isinstance(m, PoseFix | TagSighting) and _during(m, begin_ns, end_ns)]
    return Struck(recording=recording, late_ns={m.seq: round(late_s * NS_PER_S) for m in late})


def _imu_gap(recording: Recording, begin_ns: int, end_ns: int, _rng: np.random.Generator) -> Struck:
    """Remove the samples of the IMU."""
    imu = recording.imu
    assert imu is not None  # the script asks for one
    gone = (imu.stamps_ns >= begin_ns) & (imu.stamps_ns < end_ns)
    rows = recording.imu_rows(gone, Outcome.HELD_OUT, _TAKEN)
    return Struck(recording=replace(recording, imu=imu.where(~gone), rows=(*recording.rows, *rows)))
