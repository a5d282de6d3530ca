# SPDX-License-Identifier: Apache-2.0
"""Calibration suggestions: lever arms, time offsets, mounts and IMU noise that a run contradicts; never applied."""

from __future__ import annotations

import numpy as np

from graphloc.build import mount_of
from graphloc.chi2 import SIGMAS_95
from graphloc.config import AerialConfig, GnssConfig, VelocityConfig, VesselConfig
from graphloc.eval.calibrate._evidence import LEAST, Evidence, Name, OffsetEstimate
from graphloc.eval.calibrate._findings import Calibration, Check, Suggestion
from graphloc.eval.calibrate._imu import imu_noise
from graphloc.eval.formatting import significant
from graphloc.frames import rpy_from_rotation
from graphloc.offsets import Offset, Probe
from graphloc.recording import Recording
from graphloc.solution import Solution

__all__ = ["PROBE", "Calibration", "Check", "Suggestion", "calibrate"]

PROBE: Probe = {
    "gnss": ("x", "y", "time"),
    "gnss_velocity": ("x", "y", "time"),
    "body_velocity": ("time",),
    "compass": ("yaw", "time"),
    "pose": ("yaw", "time"),
    "aerial": ("yaw", "time"),
}
"""Offsets that are checked, by kind of sensor, the most often wrong first; a run hardly shows vertical ones."""

_MUCH_LESS = 0.3  # share of a delay that the track's own estimate may miss and still count as a correction of it
_DOUBTFUL = 3.0  # sigmas of an offset: too few for a suggestion, too many to say that the setting fits
_AXIS: dict[Offset, int] = {"x": 0, "y": 1}
_UNIT: dict[Offset, tuple[str, float]] = {
    "x": ("m", 1.0),
    "y": ("m", 1.0),
    "yaw": ("deg", 180.0 / np.pi),
    "time": ("s", 1.0),
}
# Sigma of an offset above which the run says nothing useful of it; the manoeuvre that would tell it.
_USEFUL: dict[Offset, float] = {"x": 0.15, "y": 0.15, "yaw": float(np.radians(1.0)), "time": 0.05}
_WOULD_TELL: dict[Offset, str] = {
    "x": "turns by 90 degrees and more, within a minute or so",
    "y": "turns by 90 degrees and more, within a minute or so",
    "yaw": "a longer run with fixes or matches, at changing speed",
    "time": "turns, and speeding up and down",
}
_MEANS: dict[Offset, str] = {
    "x": "its measurements fit the run better from there, whatever the heading",
    "y": "its measurements fit the run better from there, whatever the heading",
    "yaw": "its headings are turned against those that the other sensors give",
    "time": "its measurements fit the motion better when read at another time",
}


def calibrate(recording: Recording, config: VesselConfig, solution: Solution) -> Calibration:
    """Return the settings that a smoothed run contradicts (docs/calibration.md).

    Args:
        recording, config: as smoothed. solution: with the `offsets` that `PROBE` requests. If it has none, only the
            noise of the IMU's samples is checked.
    """
    suggestions, checks = [], []
    if solution.offsets is not None and len(solution.offsets.names):
        kinds = list(PROBE)

        def taken(name: Name) -> float | None:
            return solution.time_offsets_s.get(name[0]) if name[1] == "time" else None

        evidence = Evidence(solution.offsets, lambda name: kinds.index(config.sensors[name[0]].kind))
        wrong = evidence.wrong()
        estimates = evidence.estimates(wrong)
        for name in wrong:
            others = evidence.alternatives(name, wrong)
            suggestions.append(_suggestion(name, estimates[name], others, recording, config, taken(name)))
        for name in evidence.names:
            if name not in wrong:
                found = evidence.estimates((*wrong, name))[name]
                checks.append(_check(name, found, recording, config, taken(name)))
    if recording.imu is not None and recording.imu.sensor in config.sensors:
        for said in imu_noise(recording.imu, config.sensors[recording.imu.sensor], solution.offsets):
            (suggestions if isinstance(said, Suggestion) else checks).append(said)  # type: ignore[arg-type]
    return Calibration(suggestions=tuple(suggestions), checks=tuple(checks))


def _configured(name: Name, recording: Recording, config: VesselConfig) -> tuple[str, float]:
    """Return the key in vessel.yaml that an offset corrects, and its value in the unit of the key."""
    sensor, what = name
    block = config.sensors[sensor]
    if what == "time":
        return f"sensors.{sensor}.time_offset_s", float(block.time_offset_s)
    t, R = mount_of(sensor, block, recording.mounts)
    if what == "yaw" and isinstance(block, AerialConfig):
        return f"sensors.{sensor}.lidars.*.mount.rpy_deg[2], beside what is configured", 0.0
    if what == "yaw":
        return f"sensors.{sensor}.mount.rpy_deg[2]", float(np.degrees(rpy_from_rotation(R))[2])
    return f"sensors.{sensor}.mount.xyz_m[{_AXIS[what]}]", float(t[_AXIS[what]])


def _of_one_antenna(sensor: str, recording: Recording, config: VesselConfig) -> list[str]:
    """Return the other sensors whose lever arm is estimated together with that of a sensor, as they have one position.

    They are of another kind, or of the same receiver. Sensors whose `antenna` is the given one are not listed: they
    take its position.
    """
    own = config.sensors[sensor]
    place = mount_of(sensor, own, recording.mounts)[0]
    others = [n for kind in PROBE if kind != own.kind and "x" in PROBE[kind] for n in config.of_kind(kind)]
    others += config.by_turns(sensor)[1:]
    others = [n for n in others if getattr(config.sensors[n], "antenna", "") != sensor]
    return [n for n in others if np.array_equal(mount_of(n, config.sensors[n], recording.mounts)[0], place)]


def _of_one_clock(sensor: str, config: VesselConfig) -> list[str]:
    """Return the other sensors whose delay is estimated together with that of a sensor.

    They read the same receiver by turns, and have the same `time_offset_s`.
    """
    block = config.sensors[sensor]
    return [n for n in config.by_turns(sensor)[1:] if config.sensors[n].time_offset_s == block.time_offset_s]


def _imu_at_origin(recording: Recording, config: VesselConfig) -> str:
    """Return the name of the IMU, if its position in body is set to 0; else empty.

    Fixes and an IMU only tell the vector between antenna and IMU, so the IMU may be the one that is elsewhere. The 0
    may be a guess of `inspect`; in a vessel.effective.yaml it may also come from /tf_static.
    """
    imu = "" if recording.imu is None else recording.imu.sensor
    zero = imu in config.sensors and imu not in recording.mounts and not any(config.sensors[imu].mount.xyz_m)
    return imu if zero else ""


def _suggestion(
    name: Name,
    found: OffsetEstimate,
    others: dict[Name, OffsetEstimate],
    recording: Recording,
    config: VesselConfig,
    taken_s: float | None = None,
) -> Suggestion:
    """Return the suggestion that follows from an offset.

    Args:
        name, found: the offset and its estimate. others: offsets that explain the run as well.
        taken_s: delay that the track itself has estimated; None: it estimates none.
    """
    key, configured = _configured(name, recording, config)
    unit, factor = _UNIT[name[1]]
    action = _action(name, found, recording, config, taken_s)
    if others:
        either = "; or ".join(_instead(n, e, recording, config) for n, e in others.items())
        action += f"; this run cannot tell it from {either}"
    return Suggestion(
        sensor=name[0], key=key, unit=unit, configured=configured, suggested=configured + factor * found.value,
        sigma=factor * found.sigma, z=found.z, evidence=_MEANS[name[1]], action=action,
    )  # fmt: skip


def _action(
    name: Name, found: OffsetEstimate, recording: Recording, config: VesselConfig, taken_s: float | None
) -> str:
    """Return what to do about an offset, and what else may be the cause; arguments as of `_suggestion`."""
    action = "measure it, then set it"
    block = config.sensors[name[0]]
    if (
        name[1] == "time"
        and isinstance(block, GnssConfig | VelocityConfig | AerialConfig)
        and block.stamp_sigma_s > 0.0
    ):
        action = "already corrected in the track, by stamp_sigma_s"
        if taken_s is not None and abs(found.value - taken_s) > _MUCH_LESS * abs(found.value):
            action = (
                f"the track has only {taken_s:+.2g} s of it corrected, as far as stamp_sigma_s lets it (a warning may name that); measure "
                "it, then set it"
            )
    if name[1] in _AXIS and isinstance(block, GnssConfig | VelocityConfig) and block.mount_sigma_m > 0.0:
        action = "already corrected in the track, by mount_sigma_m; measure it, then set it and mount_sigma_m: 0"
    if name[1] in _AXIS and (shares := _of_one_antenna(name[0], recording, config)):
        action += f", also of {', '.join(shares)}, taken for the same antenna"
    if name[1] == "time" and (same := _of_one_clock(name[0], config)):
        action += f", also of {', '.join(same)}, of the same receiver"
    if name[1] != "time" and name[0] in recording.mounts:
        action = (
            "measure it; its mount comes from /tf_static: correct it there, or set xyz_m and rpy_deg without tf_frame"
        )
    if name[1] == "yaw" and recording.imu is not None:
        # If fixes and the IMU's accelerations tell the heading, it includes the yaw of the IMU's mount, which is no
        # state.
        action += f"; or sensors.{recording.imu.sensor}.mount.rpy_deg[2] is off, the other way"
    if name[1] in _AXIS and (imu := _imu_at_origin(recording, config)):
        action += f"; or it is the IMU that sits elsewhere, the other way: measure sensors.{imu}.mount.xyz_m, too, unless the 0 there is measured"
    return action


def _instead(name: Name, found: OffsetEstimate, recording: Recording, config: VesselConfig) -> str:
    key, configured = _configured(name, recording, config)
    unit, factor = _UNIT[name[1]]
    return f"{key} {configured + factor * found.value:.3g} {unit}"


def _check(
    name: Name, found: OffsetEstimate, recording: Recording, config: VesselConfig, taken_s: float | None = None
) -> Check:
    key, configured = _configured(name, recording, config)
    unit, factor = _UNIT[name[1]]
    if abs(found.z) > _DOUBTFUL and abs(found.value) > LEAST[name[1]]:
        said = f"off by {significant(factor * found.value, 2)} {unit}, {abs(found.z):.1f} sigmas: doubtful"
    elif found.sigma > _USEFUL[name[1]]:
        said = f"this run does not show it (1 sigma {significant(factor * found.sigma, 2)} {unit}); it would take {_WOULD_TELL[name[1]]}"
    else:
        said = f"fits, within {significant(SIGMAS_95 * factor * found.sigma, 2)} {unit} (95 %)"
    if taken_s is not None:
        said += f"; {found.value:+.2f} s by itself, {taken_s:+.2f} s in the track (stamp_sigma_s)"
    return Check(
        key=key, unit=unit, configured=configured, change=factor * found.value, sigma=factor * found.sigma, said=said
    )
