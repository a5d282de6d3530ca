# SPDX-License-Identifier: Apache-2.0
"""The origin of world, and the measurements that the configuration makes itself."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from graphloc.build import mount_of
from graphloc.config import VesselConfig
from graphloc.errors import InputError
from graphloc.frames import Datum, Geodetic, continuous_longitudes
from graphloc.graph import Sensor
from graphloc.measurements import GnssPosition, Measurement
from graphloc.recording import Recording

_FAR_M = 200e3
# As types of topics are named.
_FIXES = ("NavSatFix", "GPSFix", "SbgGpsPos", "NavPVT", "BESTPOS", "PVTGeodetic", "SensorGps", "VehicleGpsPosition")


def choose_datum(recording: Recording, config: VesselConfig, rows: Sequence[Sensor]) -> Datum:
    """Return the configured datum, or the median of the first fixes; height 0 where none says one.

    Raises:
        InputError: none is configured, and there is no fix to take one from, or a sensor measures in world.
    """
    if config.datum is not None:
        datum = Datum(config.datum.geodetic)
        refuse_far_fixes(recording, datum)
        return datum
    refuse_world_without_datum(config, recording.source, rows)
    found = fixes_of(recording)
    fixes = np.array([m.position for m in found][:5])
    if not len(fixes):
        raise InputError(f"{recording.source}: {why_no_fix(recording, config)}")
    fixes[:, 1] = continuous_longitudes(fixes[:, 1])
    lat, lon = (float(v) for v in np.median(fixes[:, :2], axis=0))
    heights = [m.position.height_m for m in found if m.has_height][:5]
    return Datum(Geodetic(lat, lon, float(np.median(heights)) if heights else 0.0))


def fixes_of(recording: Recording) -> list[GnssPosition]:
    """Return the fixes that an origin can be taken from."""
    return recording.of(GnssPosition)


def refuse_far_fixes(recording: Recording, datum: Datum) -> None:
    """A forgotten minus sign puts the datum on the other side of the world, where nothing can be solved.

    Raises:
        InputError: most fixes lie farther away than any run goes.
    """
    fixes = [m.position for m in fixes_of(recording)]
    if fixes:
        away_m = np.linalg.norm(datum.enu_from_geodetic(*np.array(fixes).T), axis=1)
        if np.median(away_m) > _FAR_M:
            raise InputError(
                f"{recording.source}: its fixes lie {np.median(away_m) / 1e3:.0f} km from `datum:`, near latitude "
                f"{fixes[0].latitude_deg:.4f}, longitude {fixes[0].longitude_deg:.4f}: correct the datum"
            )


def why_no_fix(recording: Recording, config: VesselConfig) -> str:
    """Return why no origin can be taken from the fixes of a recording that has none: what became of their messages."""
    receivers = config.of_kind("gnss")
    if not receivers:
        return f"no GNSS sensor to take a datum from{_why_no_receiver(recording, config)}"
    reasons: Counter[str] = Counter()
    for row in recording.rows:
        if row.sensor in receivers:
            reasons[f"{row.sensor}: {row.common_reason}"] += row.count
    if not reasons:
        return f"no GNSS fix from {', '.join(receivers)}: the topic holds no message"
    (reason, count), *_ = reasons.most_common(1)
    return f"no usable GNSS fix: {count} messages of {reason}"


def _why_no_receiver(recording: Recording, config: VesselConfig) -> str:
    if not config.sensors:
        return "; vessel.yaml names no sensor at all: `graphloc inspect` writes a first one"
    off = [name for name, sensor in config.sensors.items() if sensor.kind == "gnss"]
    if off:
        return f": {', '.join(off)} is switched off (enabled: false); switch it on, or set datum: in vessel.yaml"
    unread = sorted({row.topic for row in recording.rows if not row.sensor and any(f in row.reason for f in _FIXES)})
    if unread:
        told = "`graphloc inspect` says whether its fixes can be used"
        return f": vessel.yaml has none for {', '.join(unread)}; {told}. Add it, or set datum: in vessel.yaml"
    off = [name for name, sensor in config.sensors.items() if sensor.kind == "pose" and not sensor.enabled]
    if off:
        return f", and {', '.join(off)} is switched off; switch it on (enabled: true), and set datum: in vessel.yaml"
    # Those in world were asked for their datum before.
    return ", nor another that measures position (matches, tags, poses): without one the vessel cannot be placed"


def refuse_world_without_datum(config: VesselConfig, where: str, rows: Sequence[Sensor]) -> None:
    """Refuse a configuration with sensors that measure in world, if it does not give the origin of world.

    Raises:
        InputError: there are such sensors.
    """
    in_world = [f"sensors.{name}" for row in rows if row.in_world for name in config.of_kind(row.kind)]
    in_world += [key for key in ("truth_topic", "truth_file") if getattr(config, key)]
    if in_world and config.datum is None:
        raise InputError(
            f"{where}: {', '.join(in_world)}: positions in the world frame, but its origin is not given; "
            "set datum: (`graphloc inspect` guesses it)"
        )


def with_synthetic(recording: Recording, config: VesselConfig, datum: Datum, rows: Sequence[Sensor]) -> Recording:
    """Add the measurements that the configuration makes itself (the height prior)."""
    if recording.imu is None or not len(recording.imu):
        return recording
    span = (int(recording.imu.stamps_ns[0]), int(recording.imu.stamps_ns[-1]))
    added: list[Measurement] = []
    for name, sensor in config.sensors.items():
        row = next((r for r in rows if r.kind == sensor.kind), None)
        if row is not None and row.synthetic is not None and sensor.enabled:
            added.extend(row.synthetic(name, sensor, span, height_m(recording, config, sensor.height_m, datum)))
    if not added:
        return recording
    every = sorted([*recording.measurements, *added], key=lambda m: (m.stamp_ns, m.seq))
    return replace(recording, measurements=tuple(every))


def height_m(recording: Recording, config: VesselConfig, configured_m: float | None, datum: Datum) -> float:
    """Return the height of the body in world: as configured (ellipsoidal), or the median fix less its antenna's height."""
    if configured_m is not None:
        return configured_m - datum.origin.height_m
    heights = [
        m.position.height_m - float(mount_of(m.sensor, config.sensors[m.sensor], recording.mounts)[0][2])
        for m in fixes_of(recording)
        if m.has_height
    ]
    return float(np.median(heights)) - datum.origin.height_m if heights else 0.0
