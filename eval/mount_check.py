# SPDX-License-Identifier: Apache-2.0
"""Warn of a solved track on which the vessel moves sideways or lies on its side: a sign of a wrong IMU mount.

Measurements can agree with such a track: if an IMU mount is turned by 90 deg, so is the estimated body, and where GNSS
positions are the only other measurements, nothing contradicts that.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from graphloc.build import mount_of
from graphloc.config import VesselConfig
from graphloc.eval.formatting import percent
from graphloc.frames import rpy_from_rotation, wrap_angle
from graphloc.recording import Recording
from graphloc.trajectory import Trajectory, bounds_95

_MOVES_MPS = 1.0  # speed below which a vessel may well drift sideways
_CREEPS_MPS = 0.3  # the same for a craft that never goes as fast, as a robot
# Least spread of the headings; and largest spread of the angle between course and heading over that, which is 1 if a
# current sets the craft.
_TURNS, _STEADIER = 0.02, 0.25
_WAY_M, _MOST = 30.0, 0.6  # least distance to judge by; share of it over which course and heading must differ
_SIDEWAYS_DEG, _TILTED_DEG = 45.0, 45.0
_KNOWN_DEG = 20.0  # 95 % bound of a heading up to which it counts as known
_STEADY = 0.8  # length of the mean direction of the angle, from which it is steady; 1 if it is the same all the way


class MountDoubt(NamedTuple):
    """What is odd about a solved track (`seen`), and what to do about it (`cure`); as text: the two together."""

    seen: str
    cure: str

    def __str__(self) -> str:
        return f"{self.seen}: {self.cure}"


def mount_doubts(track: Trajectory, recording: Recording, config: VesselConfig) -> list[MountDoubt]:
    """Return a doubt for a tilted vessel, and one for a course that differs from the heading over most of the distance.

    Args:
        track: solved, with covariance and velocity. recording, config: name the IMU and its mount.
    """
    found = (_tilted(track), _sideways(track, recording, config))
    return [doubt for doubt in found if doubt is not None]


def _tilted(track: Trajectory) -> MountDoubt | None:
    tilt_deg = (
        float(np.degrees(np.median(np.arccos(np.clip(track.R_world_body[:, 2, 2], -1.0, 1.0))))) if len(track) else 0.0
    )
    if tilt_deg < _TILTED_DEG or track.planar:
        return None
    seen = f"the vessel is tilted by {tilt_deg:.0f} deg for most of the run"
    return MountDoubt(seen, "check the IMU's mount.rpy_deg and the sign of its accelerations")


def _sideways(track: Trajectory, recording: Recording, config: VesselConfig) -> MountDoubt | None:
    if track.v_world_mps is None or track.cov is None or len(track) < 2:
        return None
    v, step_s = track.v_world_mps, np.diff(track.stamps_ns, append=track.stamps_ns[-1]) / 1e9
    speed = np.hypot(v[:, 0], v[:, 1])
    known = (bounds_95(track.cov)[:, 2] < _KNOWN_DEG) & (step_s < 1.0)
    fast = float((speed * step_s)[known & (speed > _MOVES_MPS)].sum()) >= _WAY_M
    above_mps = _MOVES_MPS if fast else _CREEPS_MPS
    judged = known & (speed > above_mps)
    way_m = (speed * step_s)[judged]
    if way_m.sum() < _WAY_M:
        return None
    off = np.asarray(wrap_angle(np.arctan2(v[judged, 1], v[judged, 0]) - track.yaw_rad[judged]))
    share = float(way_m[np.abs(off) > np.radians(_SIDEWAYS_DEG)].sum() / way_m.sum())
    if share < _MOST:
        return None
    seen = (
        f"the course is more than {_SIDEWAYS_DEG:.0f} deg off the solved heading for {percent(share)} of the {way_m.sum():.0f} m "
        f"made above {above_mps:g} m/s"
    )
    unless = "unless the vessel goes sideways or astern"
    mean = complex((way_m * np.exp(1j * off)).sum() / way_m.sum())
    turns = 1.0 - abs(complex((way_m * np.exp(1j * track.yaw_rad[judged])).sum() / way_m.sum()))
    if not fast and (abs(mean) < _STEADY or turns < _TURNS or 1.0 - abs(mean) > _STEADIER * turns):
        return None  # by a current, the drift has a constant direction in world; by a wrong mount, in body
    if abs(mean) < _STEADY or recording.imu is None or recording.imu.sensor not in config.sensors:
        wrong = (
            "the heading is wrong: check the IMU's axes (mount, signs of its rates and accelerations) and the compasses"
        )
        return MountDoubt(seen, f"{unless}, {wrong}")
    _, R_body_imu = mount_of(recording.imu.sensor, config.sensors[recording.imu.sensor], recording.mounts)
    yaw_deg = float(np.degrees(rpy_from_rotation(R_body_imu)[2]))
    turned = float(np.degrees(wrap_angle(np.radians(yaw_deg) - np.angle(mean))))
    cure = (
        f"{unless}, {recording.imu.sensor}.mount.rpy_deg[2] should be about {turned:.0f} instead of {yaw_deg:.0f}, or the heading "
        "from a compass, a pose sensor or start.heading_deg is off by that much"
    )
    return MountDoubt(seen, cure)
