# SPDX-License-Identifier: Apache-2.0
"""The row of numbers that `inspect` keeps of a message, by its type, by NMEA sentence, or by what a maker's message says."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from graphloc.frontends import nmea
from graphloc.frontends._rejections import Rejection
from graphloc.frontends._said import Said, SaidAlong, SaidHeading, SaidInertial, SaidPlace, SaidVelocity
from graphloc.frontends._standard import NMEA_STATUS, nav_sat_status, nmea_sigmas_m, pose_numbers
from graphloc.frontends.decode import no_lock
from graphloc.frontends.msgtypes import (
    GPS_FIXES,
    IMU,
    NAV_SAT_FIX,
    NUMBERS,
    ODOMETRY,
    PLACES,
    PLAIN_TWIST,
    QUATERNION,
    TWIST,
    VECTOR,
)
from graphloc.ledger import Outcome

Row = tuple[float, ...]


def _xyz(v: Any) -> tuple[float, float, float]:
    return (v.x, v.y, v.z)


def _velocity_row(v: Any) -> tuple[float, float, float]:
    said = _xyz(v)
    return (np.nan, np.nan, np.nan) if no_lock(said) else said


def _xyzw(q: Any) -> tuple[float, float, float, float]:
    return (q.x, q.y, q.z, q.w)


def _imu_row(m: Any) -> tuple[float, ...]:
    covariances = (m.linear_acceleration_covariance[0], m.angular_velocity_covariance[0], m.orientation_covariance[0])
    return (*_xyz(m.linear_acceleration), *_xyz(m.angular_velocity), *_xyzw(m.orientation), *covariances)


def _fix_row(m: Any) -> tuple[float, ...]:
    c = m.position_covariance
    kind = m.position_covariance_type
    return (m.latitude, m.longitude, m.altitude, nav_sat_status(m.status.status), kind, c[0], c[4], c[8])


def _pose_row(m: Any) -> tuple[float, ...]:
    return (*pose_numbers(m), 0.0, 0.0, 0.0)


def _odometry_row(m: Any) -> tuple[float, ...]:
    return (*_pose_row(m)[:7], *_xyz(m.twist.twist.linear))


ROWS: dict[str, Callable[[Any], tuple[float, ...]]] = {
    IMU: _imu_row,
    NAV_SAT_FIX: _fix_row,
    QUATERNION: lambda m: _xyzw(m.quaternion),
    ODOMETRY: _odometry_row,
    **dict.fromkeys(PLACES, _pose_row),
    TWIST: lambda m: _velocity_row(m.twist.twist.linear),
    PLAIN_TWIST: lambda m: _velocity_row(m.twist.linear),
    VECTOR: lambda m: _velocity_row(m.vector),
    **dict.fromkeys(GPS_FIXES, _fix_row),
    **dict.fromkeys(NUMBERS, lambda m: (m.data,)),
}


def _nmea_place(text: str, wanted: str) -> SaidPlace | Rejection:
    said = nmea.fix(text, [wanted])
    if isinstance(said, Rejection):
        return said
    sigmas_m = nmea_sigmas_m(said, (0.0, 0.0))  # only the qualities of RTK imply one
    return SaidPlace(said.latitude_deg, said.longitude_deg, said.height_m, NMEA_STATUS.get(said.quality, 0), *sigmas_m)


def _nmea_heading(text: str, wanted: str) -> SaidHeading | Rejection:
    said = nmea.heading_deg(text, [wanted])
    return said if isinstance(said, Rejection) else SaidHeading(float(np.radians(90.0 - said)))


def nmea_velocity(text: str, wanted: str) -> SaidVelocity | Rejection:
    said = nmea.velocity_mps(text, [wanted])
    return said if isinstance(said, Rejection) else SaidVelocity((*said, 0.0))


def nmea_speed(text: str, wanted: str, through: str = "ground") -> SaidVelocity | Rejection:
    said = nmea.log_velocity_mps(text, [wanted], through)
    if isinstance(said, Rejection):
        return said
    ahead, port = (*said, 0.0)[:2]
    return SaidVelocity((ahead, port, 0.0))


# By sentence: the kind of sensor that reads it, and what it says.
SENTENCES: dict[str, tuple[str, Callable[[str, str], Said | Rejection]]] = {
    **dict.fromkeys(nmea.HEADINGS, ("compass", _nmea_heading)),
    "VTG": ("gnss_velocity", nmea_velocity),
    **dict.fromkeys(nmea.SPEEDS, ("body_velocity", nmea_speed)),
    **dict.fromkeys(nmea.PLACES, ("gnss", _nmea_place)),
}

# By kind of sensor, of what NMEA and makers' messages say: the message type of the same content, and a row without a value.
LIKE: dict[str, tuple[str, Row]] = {
    "imu": (IMU, (*[np.nan] * 6, *[0.0] * 4, 0.0, 0.0, -1.0)),
    "gnss": (NAV_SAT_FIX, (np.nan, np.nan, np.nan, -1.0, 0.0, 0.0, 0.0, 0.0)),
    "gnss_velocity": (TWIST, (np.nan, np.nan, np.nan)),
    "compass": (QUATERNION, (0.0, 0.0, np.nan, np.nan)),
    "body_velocity": (TWIST, (np.nan, np.nan, np.nan)),
}


def row_of(said: Said | Rejection, kind: str) -> Row | None:
    """Return the row of what a sentence or a maker's message says to a kind of sensor; None if it is damaged."""
    match said:
        case Rejection():
            return None if said.outcome is Outcome.MALFORMED else LIKE[kind][1]
        case SaidInertial():
            return (*said.accel_mps2, *said.gyro_radps, *LIKE["imu"][1][6:])
        case SaidPlace():
            h, v = said.horizontal_m**2, said.vertical_m**2
            return (*said[:3], said.status, 2.0 * (h > 0.0), h, h, v)
        case SaidVelocity():
            return said.v_mps
        case SaidHeading():
            return (0.0, 0.0, float(np.sin(said.angle_rad / 2.0)), float(np.cos(said.angle_rad / 2.0)))
        case SaidAlong():
            ahead, starboard, down = said.v_mps
            return (ahead, -starboard, -down)  # to port, up
