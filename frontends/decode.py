# SPDX-License-Identifier: Apache-2.0
"""Decoders by (sensor kind, message type): pure functions from message to measurement.

A reader (`_standard`, `vendors`) returns what a message says (`_said`), in the project's frames and units, and `measured` makes a measurement of
it: the same checks for all messages of a kind of sensor. An uncertainty is set only if the message has none; floors, scales
and kernels belong to the factors.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from math import isfinite, pi
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from graphloc.config import (
    STANDARD_GRAVITY_MPS2,
    BodyVelocityConfig,
    GnssConfig,
    ImuConfig,
    PoseConfig,
    VelocityConfig,
)
from graphloc.errors import ConfigError
from graphloc.extras import added
from graphloc.frames import Array, Geodetic, rpy_from_rotation, wrap_angle
from graphloc.frontends._fixes import RTK_SIGMA_M
from graphloc.frontends._rejections import Rejection, ignored, malformed, rejected
from graphloc.frontends._said import (
    Part,
    Said,
    SaidAlong,
    SaidHeading,
    SaidInertial,
    SaidPlace,
    SaidPose,
    SaidVelocity,
)
from graphloc.frontends._standard import MIN_STATUS, NO_FIX, STANDARD, VARIANCES, Reader, in_enu
from graphloc.frontends.vendors import VENDORS
from graphloc.measurements import (
    AXES,
    NO_HEIGHT_M2,
    BodyVelocity,
    CompassHeading,
    GnssPosition,
    GnssVelocity,
    Measurement,
    PoseFix,
    PoseMode,
)

_NO_CLIMB_MPS2 = 1e6  # variance of a vertical velocity that is not told, m^2/s^2
# No sensor of a vessel measures beyond these limits. Sums and squares of larger finite values may overflow.
_MOST_INERTIAL = 1e4  # in the unit of the bag: 1000 g in m/s^2, 30 turns a second in deg/s
MOST_SPEED_MPS, MOST_DISTANCE_M, _MOST_HEIGHT_M = 1e4, 1e7, 1e5
NO_LOCK_MPS = 32.768
"""Size of the least 16-bit integer, in mm/s, which Doppler logs write without a lock."""


class ImuReading(NamedTuple):
    """One inertial sample in axes of the sensor and SI units; `Readings` holds its stamp and arrival number."""

    accel_mps2: tuple[float, float, float]
    gyro_radps: tuple[float, float, float]


Decoded = Measurement | ImuReading | Rejection
# Message, stamp (ns), arrival number, sensor, configuration. Types of message and configuration depend on the row of
# `DECODERS`, hence Any.
Decoder = Callable[[Any, int, int, str, Any], Decoded]


def usable_covariance(cov: Array, default_variances: Array) -> Array:
    """Return `cov` (k, k) with default variances (k,) on axes whose variance is zero, negative or NaN.

    Such an axis loses its correlations. So does an axis whose variance is outside (1 nm)^2 to (1000 km)^2: it is
    clipped. If the matrix is still not positive definite, only its diagonal is kept.
    """
    variance = np.diagonal(cov)
    if all(VARIANCES[0] <= v <= VARIANCES[1] for v in variance.tolist()) and np.count_nonzero(cov) == len(cov):
        return np.diag(variance)  # the usual case, nothing to mend: takes a twentieth of the time
    good = np.isfinite(variance) & (variance > 0.0)
    known = good & (variance >= VARIANCES[0]) & (variance <= VARIANCES[1])
    # Covariances that make correlations larger than 1 are invalid, and may have any size.
    both = np.outer(known, known) & (np.abs(cov) <= VARIANCES[1])
    clean = np.where(both, cov, 0.0)
    clean = 0.5 * (clean + clean.T)
    clean[np.diag_indices_from(clean)] = np.where(good, np.clip(variance, *VARIANCES), default_variances)
    if np.linalg.eigvalsh(clean).min() <= 1e-9 * clean.diagonal().min():
        clean = np.diag(clean.diagonal())
    return clean


def is_rtk(status: int, cov: Array) -> bool:
    """Return whether a fix is of RTK, by its `NavSatStatus` and its covariance (3, 3), m^2, zeros or NaN if unknown."""
    variance = np.diagonal(cov)[:2]
    known = bool(np.isfinite(variance).all() and (variance > 0.0).all())
    return status >= MIN_STATUS["gbas"] and known and float(variance.max()) < RTK_SIGMA_M**2


def no_lock(value: ArrayLike) -> bool:
    """Return whether a velocity holds the value that Doppler logs write if they hear no echo."""
    # With a tolerance for float32, and of either sign, as axes may have been turned.
    return bool((np.abs(np.abs(value) - NO_LOCK_MPS) < 1e-5).any())


def measured(said: Said | SaidPose | Rejection, stamp_ns: int, seq: int, sensor: str, config: Any) -> Decoded:
    """Return the measurement of a sensor by what a message says, or why it is none.

    Args:
        said: in axes of world, of velocities and headings. stamp_ns, seq, sensor, config: as of a decoder.
    """
    of: dict[str, Any] = {"stamp_ns": stamp_ns, "seq": seq, "sensor": sensor}
    match said:
        case Rejection():
            return said
        case SaidInertial():
            return _inertial(said, config)
        case SaidPlace():
            return _fix(said, config, of)
        case SaidVelocity():
            return _over_ground(said, config, of)
        case SaidHeading():
            sigma = (said.sigma_rad if config.use_reported_sigma else 0.0) or float(np.radians(config.sigma_deg))
            return CompassHeading(**of, yaw_rad=said.angle_rad, sigma_rad=sigma)
        case SaidAlong():
            return _along_axes(said, config, of)
        case SaidPose():
            return _pose_fix(said, config, of)


def _inertial(said: SaidInertial, config: ImuConfig) -> ImuReading | Rejection:
    """Return a sample in SI units, converted from the configured units and sign of gravity."""
    accel, gyro = said
    if not all(map(isfinite, (*accel, *gyro))):
        return malformed("acceleration or angular rate is NaN")
    if max(map(abs, (*accel, *gyro))) > _MOST_INERTIAL:
        return malformed(f"acceleration or angular rate is beyond {_MOST_INERTIAL:g}, which nothing measures")
    k = STANDARD_GRAVITY_MPS2 if config.accel_unit == "g" else 1.0
    k = -k if config.gravity == "inverted" else k
    r = pi / 180.0 if config.gyro_unit == "deg/s" else 1.0
    return ImuReading((k * accel[0], k * accel[1], k * accel[2]), (r * gyro[0], r * gyro[1], r * gyro[2]))


def _fix(said: SaidPlace, config: GnssConfig, of: Mapping[str, Any]) -> Decoded:
    lat, lon, height = said[:3]
    if said.status < 0 and config.min_status != "any":
        return rejected(NO_FIX)
    if said.status < MIN_STATUS[config.min_status]:
        return rejected(f"fix status {said.status} is below min_status '{config.min_status}'")
    if not np.isfinite([lat, lon]).all():
        return malformed("latitude or longitude is NaN")
    planar = bool(np.isnan(height))  # NavSatFix: 'set to NaN if no altitude is available'
    if planar:
        height = 0.0
    if not abs(height) <= _MOST_HEIGHT_M:
        return malformed(f"height is beyond {_MOST_HEIGHT_M / 1e3:g} km")
    if lat == 0.0 and lon == 0.0:
        return rejected("position 0, 0: the receiver had none")
    if abs(lat) > 90.0:
        swapped = abs(lat) <= 360.0 and abs(lon) <= 90.0
        return malformed("latitude is beyond 90 deg" + (": latitude and longitude look swapped" if swapped else ""))
    if not -180.0 <= lon <= 360.0:
        return malformed("longitude is beyond 180 deg")
    cov = _covariance(said.covariance, said.horizontal_m, said.vertical_m)
    default = np.array([config.default_horizontal_sigma_m] * 2 + [config.default_vertical_sigma_m]) ** 2
    if planar:
        cov[2, :] = cov[:, 2] = 0.0  # the message gives no height, so its claim on one does not count
        default[2] = NO_HEIGHT_M2
    if config.takes_turns:
        rtk = is_rtk(said.status, cov)
        if rtk != (config.fixes == "rtk"):
            return ignored(
                f"{'of RTK' if rtk else 'without RTK'}, by its status and what it states, and fixes is {config.fixes}"
            )
    return GnssPosition(**of, position=Geodetic(lat, lon, height), cov_enu_m2=usable_covariance(cov, default))


def _covariance(told: Array | None, horizontal: float, vertical: float) -> Array:
    """Return a covariance (3, 3), east, north, up, as it is told, or else by sigmas; one of its own to change."""
    return np.diag([horizontal, horizontal, vertical]) ** 2 if told is None else np.array(told)


def _over_ground(said: SaidVelocity, config: VelocityConfig, of: Mapping[str, Any]) -> Decoded:
    """Return a velocity over ground, horizontal where its up is NaN."""
    value, cov = np.array(said.v_mps, dtype=float), _covariance(said.covariance, said.horizontal_mps, said.vertical_mps)
    default = np.full(3, config.default_sigma_mps**2)
    if np.isnan(value[2]):
        value[2], default[2] = 0.0, _NO_CLIMB_MPS2
        cov[2], cov[:, 2] = 0.0, 0.0
    if trouble := _no_velocity(value):
        return trouble
    return GnssVelocity(**of, v_enu_mps=value, cov_m2ps2=usable_covariance(cov, default))


def _no_velocity(value: Array) -> Rejection | None:
    if not np.isfinite(value).all():
        return malformed("velocity is NaN")
    if np.abs(value).max() > MOST_SPEED_MPS:
        return malformed(f"velocity is beyond {MOST_SPEED_MPS:g} m/s")
    return None


def _along_axes(said: SaidAlong, config: BodyVelocityConfig, of: Mapping[str, Any]) -> Decoded:
    """Return the velocity along the configured axes of the sensor."""
    if said.through not in ("", config.through):
        return ignored(f"its velocity is through the {said.through}, and through is {config.through}")
    axes = tuple(axis for axis in "xyz"[: len(said.v_mps)] if axis in config.axes)
    if not axes:
        return rejected(f"it tells the speed along x alone, and axes is [{', '.join(config.axes)}]")
    picked = ["xyz".index(axis) for axis in axes]
    value = np.array(said.v_mps, dtype=float)[picked]
    if trouble := _no_velocity(value):
        return trouble
    if no_lock(value):
        return rejected(f"it has no lock: a Doppler log's {NO_LOCK_MPS:g} m/s say so")
    cov = np.zeros((len(axes), len(axes)))
    if config.use_reported_sigma:
        cov = np.reshape(said.covariance, (len(said.v_mps), -1))[np.ix_(picked, picked)]
    usable = usable_covariance(cov, np.full(len(axes), config.sigma_mps**2))
    return BodyVelocity(**of, axes=axes, value=value, cov=usable)


def _pose_fix(said: SaidPose, config: PoseConfig, of: Mapping[str, Any]) -> Decoded:
    picked = [AXES.index(a) for a in config.axes]
    if said.rotation is None and max(picked) > 2:
        return malformed("orientation is NaN or no unit quaternion")
    angles = np.zeros(3) if said.rotation is None else rpy_from_rotation(said.rotation)
    value = np.concatenate([said.position_m, angles])[picked]
    if not np.isfinite(value).all():
        return malformed("position is NaN")
    if np.abs(value).max() > MOST_DISTANCE_M:
        return malformed(f"position is over {MOST_DISTANCE_M / 1e3:g} km from the datum")
    default = np.array([config.default_sigma_m] * 3 + [np.radians(config.default_sigma_deg)] * 3) ** 2
    mode = PoseMode(value=value, cov=usable_covariance(said.covariance[np.ix_(picked, picked)], default[picked]))
    return PoseFix(**of, axes=config.axes, modes=(mode,))


def _by_maker(part: Part) -> Reader:
    """Return the reader of one part of a maker's message."""

    def read(msg: Any, config: Any) -> Said | Rejection:
        said = part.read(msg)
        if isinstance(said, SaidVelocity) and not part.told:
            return in_enu(said, config)
        if isinstance(said, SaidHeading):
            turned = not part.told and config.convention == "ned"
            return said._replace(angle_rad=float(wrap_angle(pi / 2.0 - said.angle_rad if turned else said.angle_rad)))
        return said

    return read


def _decoder(read: Reader) -> Decoder:
    def decoder(msg: Any, stamp_ns: int, seq: int, sensor: str, config: Any) -> Decoded:
        return measured(read(msg, config), stamp_ns, seq, sensor, config)

    return decoder


_BY_MAKERS = {(part.kind, msgtype): _by_maker(part) for msgtype, parts in VENDORS.items() for part in parts}
DECODERS: dict[tuple[str, str], Decoder] = {of: _decoder(read) for of, read in (STANDARD | _BY_MAKERS).items()}


DECODERS_GROUP = (
    "graphloc.decoders"  # group of entry points: each is named as a kind, and loads {message type: decoder}
)


def decoder_of(kind: str, msgtype: str) -> Decoder | None:
    """Return the decoder of a message type for a kind of sensor, ours or an entry point's; None if there is none."""
    return DECODERS.get((kind, msgtype)) or _theirs(kind).get(msgtype)


def supported_types(kind: str) -> tuple[str, ...]:
    """Return the message types that a kind of sensor is read from; empty if the kind reads no topic."""
    return (*(msgtype for have, msgtype in DECODERS if have == kind), *_theirs(kind))


def _theirs(kind: str) -> Mapping[str, Decoder]:
    """Return what installed packages add to a kind.

    Raises:
        ConfigError: an entry is not a table of decoders.
    """
    table = added(DECODERS_GROUP).get(kind, {})
    if not isinstance(table, Mapping):
        raise ConfigError(
            f"{DECODERS_GROUP}: '{kind}': is a {type(table).__name__}, no dict of message types and decoders: mend or uninstall the package that adds it"
        )
    return table
