# SPDX-License-Identifier: Apache-2.0
"""Clocks of sensors against each other, by the recording times: behind or ahead, set during the run, or drifting."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from graphloc.frontends import _clock, _order
from graphloc.frontends._readings import Readings


class _SensorClock(NamedTuple):
    """A sensor's clock by the recording times: its gain, its usual latency, s, and the step if it was set.

    `logs` are the recording times (N,), ns, as if the recorder's clock had not been set.
    """

    readings: Readings
    logs: _order.Stamps
    gain: _clock.Gain
    latency_s: float
    step: _clock.ClockStep | None

    @classmethod
    def of(cls, readings: Readings) -> _SensorClock:
        stamps = readings.stamps()
        logs = _clock.steady_logs(stamps, readings.logs())
        latency_s = _clock.usual_latency_s(stamps, logs)
        return cls(readings, logs, _clock.gain(stamps, logs), latency_s, _clock.step(stamps, logs))

    @property
    def sensor(self) -> str:
        return self.readings.sensor


def clock_warnings(sensors: Sequence[Readings]) -> tuple[list[str], tuple[str, ...]]:
    """Return a warning on each sensor whose clock differs from the reference: the IMU's or, without an IMU, the first.

    Where a clock was set during the run, one warning on the step names all sensors that it concerns: if it is the
    reference's, all others.

    Returns:
        The warnings; and the ones of them that make all poses doubtful, as no bound includes the error.
    """
    clocks = [_SensorClock.of(r) for r in sensors if r.stamps_ns]
    if len(clocks) < 2:
        return [], ()
    reference = next((c for c in clocks if c.readings.config.kind == "imu"), clocks[0])
    recorder = _clock.recorder_set(reference.readings.stamps(), reference.readings.logs())
    lines = [] if recorder is None else [recorder.said_of_recorder]
    stepped: dict[str, list[str]] = {}
    doubts = []
    for own in clocks:
        gain_s = own.gain.gained_s - reference.gain.gained_s
        gains, was_set = abs(gain_s) > _clock.GAIN_LIMIT_S, own if own.step else reference
        if gains and was_set.step is not None:
            stepped.setdefault(was_set.step.said(was_set.sensor), []).append(own.sensor)
            continue
        lines += _epoch_warning(own, reference)
        if gains:
            lines.append(_gain_warning(own, reference, gain_s))
            if abs(gain_s) > max(_clock.SCANS_AHEAD_S, 2.0 * getattr(own.readings.config, "stamp_sigma_s", 0.0)):
                doubts.append(lines[-1])
    set_lines = [f"{', '.join(names)}: {said}" for said, names in stepped.items()]
    return [*set_lines, *lines], (*set_lines, *doubts)


def _epoch_warning(own: _SensorClock, reference: _SensorClock) -> list[str]:
    """Return a warning on a clock that is behind or ahead by more than its time offset and latencies explain."""
    behind_s = own.latency_s - reference.latency_s
    now_s = own.readings.config.time_offset_s
    set_s = now_s - reference.readings.config.time_offset_s
    meant = abs(behind_s + set_s) <= _clock.EPOCH_LIMIT_S and abs(set_s) <= _clock.FARTHEST_LATE_S
    if abs(behind_s) <= _clock.EPOCH_LIMIT_S or meant:
        return []
    way = "behind" if behind_s > 0 else "ahead of"
    instead = f" instead of {now_s:g}" if now_s else ""
    said = f"its clock is {abs(behind_s):.3f} s {way} that of {reference.sensor}, by the recording times"
    cure = f"set its time_offset_s to {now_s + behind_s:.3f}{instead} (this includes the difference of their transport delays)"
    return [
        f"{own.sensor}: {said}; {cure}, unless its messages take that long to arrive (by radio): see what `inspect` drafts"
    ]


def _gain_warning(own: _SensorClock, reference: _SensorClock, gain_s: float) -> str:
    """Return a warning on a clock that gains `gain_s` on the reference: in a step, evenly, or otherwise."""
    steps = (_clock.step(c.readings.stamps(), c.logs, _clock.GAIN_LIMIT_S) for c in (own, reference))
    when = next((f", {at.when}" for at in steps if at), "")
    drift_ppm = own.gain.drift_ppm - reference.gain.drift_ppm
    if when:
        cure = "use the part on one side (--start, --duration), or synchronise the clocks"
    elif own.gain.even and reference.gain.even and drift_ppm:
        cure = f"set its clock_drift_ppm to {own.readings.config.clock_drift_ppm + drift_ppm:.1f}"
    else:
        cure = "synchronise the clocks, or smooth short parts (--start, --duration)"
    return (
        f"{own.sensor}: its clock {'gains' if gain_s > 0 else 'loses'} {abs(gain_s):.2f} s on that of {reference.sensor} "
        f"during the run, by the recording times{when}: no time_offset_s holds throughout, and no bound includes it; {cure}"
    )
