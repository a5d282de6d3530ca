# SPDX-License-Identifier: Apache-2.0
"""GNSS position: lever arm, white noise, and a slow error.

    z = p + R (l + o) + u tau + d + w,   w ~ N(0, C + W),   d: first-order Gauss-Markov per axis

z: fix in world; p, R: body in world; l: configured place of the antenna in body (carried, see `Attachment`); u: its velocity;
C: the reported covariance; W: what d walks between its nodes (`Attachment.slow_walk`). Constants of the run, estimated where they are
not known: o: place of the antenna less l; tau: time of measurement less the stamp (negative: the stamp is late). The slow state
holds n = -d.

Without a slow state, o and tau the factor is `GPSFactorArm`. With any of them it is one linear factor, written anew at every pass. A
solver that keeps older linearisations (online) would have to write that anew whenever the pose turns. There, without o and tau, native
factors turn with the pose: the antenna `A = p + R l` is a variable of its own (a leaf: `ReferenceFrameFactor`, tied within 5 mm), and
`A - N = z` is a `BetweenFactor` with the kernel. These leaves are 45 % of the variables where each state has a fix. Not handled:
correlation between the axes of d; change of u within tau; what a delayed fix tells of the velocity.
"""

from __future__ import annotations

import math
from weakref import WeakKeyDictionary

import gtsam
import numpy as np

from graphloc.config import GnssConfig
from graphloc.factors._noise import noise_model, with_floors
from graphloc.factors._receiver import late_and_off, stamps_and_antenna
from graphloc.frames import Array, Datum, Geodetic, skew
from graphloc.graph import (
    Attachment,
    Decision,
    GraphUpdate,
    Hint,
    Residual,
    Sensor,
    SlowProcess,
)
from graphloc.measurements import GnssPosition, world_from_fixes

_TIE_M = 0.005  # how exactly leaf and lever arm follow the pose; far below any GNSS noise
_LOST_S = 2.0  # without RTK fixes, after which the receiver resolves its ambiguities anew, rightly or wrongly
_TIE = gtsam.noiseModel.Isotropic.Sigma(3, _TIE_M)


def white_covariance(m: GnssPosition, config: GnssConfig) -> Array:
    """Covariance (3, 3) of the white part: reported, scaled, with floors, m^2."""
    horizontal, vertical = config.min_horizontal_sigma_m**2, config.min_vertical_sigma_m**2
    return with_floors(m.cov_enu_m2 * config.sigma_scale**2, np.array([horizontal, horizontal, vertical]))


# Places of fixes, which every pass asks for. They are kept as long as the fix itself, so that memory does not grow with the run.
_PLACES: WeakKeyDictionary[GnssPosition, tuple[Datum, Array]] = WeakKeyDictionary()


def _world_m(m: GnssPosition, datum: Datum) -> Array:
    known = _PLACES.get(m)
    if known is None or known[0] != datum:
        known = (datum, world_from_fixes([m], datum)[0])
        _PLACES[m] = known
    return known[1]


def _fix_world_m(m: GnssPosition, at: Attachment) -> Array:
    return _world_m(m, at.datum)


def _predicted_m(at: Attachment, config: GnssConfig) -> Array:
    """Return the predicted fix (3,), without white noise, in world."""
    late, off = late_and_off(at, config)
    place = at.sensor_m(off)
    if at.slow_value is not None:
        place = place - at.slow_value
    if late:
        place = place + at.sensor_velocity_mps(off) * late
    return np.asarray(place)


def _by_constants(at: Attachment, config: GnssConfig) -> tuple[Array, ...]:
    """Return the derivative (3, k) of the fix by tau and o, as far as they are estimated."""
    late, off = late_and_off(at, config)
    columns = [at.sensor_velocity_mps(off)[:, None]] if config.stamp_sigma_s > 0.0 else []
    if config.mount_sigma_m > 0.0:
        turn = at.T_state_sensor.rotation().matrix()
        columns.append(at.R_by_constants @ (turn + late * skew(at.gyro_radps) @ turn))
    return (np.hstack(columns),) if columns else ()


def residuals(m: GnssPosition, config: GnssConfig, at: Attachment) -> tuple[Residual, ...]:
    """Residual predicted - measured (3,) in m, world axes."""
    raw = _predicted_m(at, config) - _fix_world_m(m, at)
    white = white_covariance(m, config)
    cov = white + at.walked()
    return (
        Residual(
            raw=raw,
            cov=cov,
            white=white,
            jacobian=lambda: _antenna_jacobian(at, config),
            slow_jacobian=lambda: -np.eye(3),
            constant_jacobians=lambda: _by_constants(at, config),
            size_m=math.hypot(raw[0], raw[1]),
            expected_nis=float((white.diagonal() / cov.diagonal())[: 3 if m.has_height else 2].sum()),
        ),
    )


def factors(m: GnssPosition, config: GnssConfig, at: Attachment, decision: Decision) -> GraphUpdate | None:
    """Return the native factors of one fix; None where the linear one serves better."""
    if at.constants or (at.slow_key is not None and at.T_solver is None):
        return None
    z = _fix_world_m(m, at) - at.carried_m
    lever = np.asarray(at.T_state_sensor.translation())
    model = noise_model(white_covariance(m, config) + at.walked(), decision)
    if at.slow_key is None:
        return GraphUpdate(factors=(gtsam.GPSFactorArm(at.pose_key, z, lever, model),))
    antenna_key, lever_key = at.leaf_keys
    return GraphUpdate(
        factors=(
            gtsam.PriorFactorPoint3(lever_key, lever, _TIE),
            gtsam.ReferenceFrameFactorPoint3Pose3(lever_key, at.pose_key, antenna_key, _TIE),
            gtsam.BetweenFactorPoint3(at.slow_key, antenna_key, z, model),
        ),
        guesses=((antenna_key, at.T_world_body.transformFrom(lever)), (lever_key, lever)),
    )


def slow(config: GnssConfig) -> SlowProcess | None:
    """Return the slow error that the configuration asks for."""
    s = config.slow_error
    if s.enabled is False:
        return None
    return SlowProcess(
        name="GNSS error",
        axes=("east", "north", "up"),
        units=("m", "m", "m"),
        scale=np.full(3, -1.0),
        sigma=np.array([s.horizontal_sigma_m, s.horizontal_sigma_m, s.vertical_sigma_m]),
        time_constant_s=np.full(3, s.time_constant_s),
        jumps=s.jumps,
        far=("east", "north") if s.jumps else (),
        follows=("up",) if s.jumps else (),
        needs_company=s.enabled is None,
        anew_after_s=_LOST_S if config.fixes == "rtk" else math.inf,
    )


def ideal(at: Attachment, config: GnssConfig) -> GnssPosition:
    """Return the fix that the attachment's estimate would give."""
    lat, lon, height = at.datum.geodetic_from_enu(_predicted_m(at, config))[0]
    return GnssPosition(
        stamp_ns=0, sensor="gnss", seq=0, position=Geodetic(lat, lon, height), cov_enu_m2=np.diag([0.25, 0.25, 1.0])
    )


def _antenna_jacobian(at: Attachment, config: GnssConfig) -> Array:
    """d(p + R (l + o) + u tau) / d(body tangent), (3, 6)."""
    R, (late, off) = at.T_world_body.rotation().matrix(), late_and_off(at, config)
    arm = at.T_state_sensor.transformFrom(off)
    if late:
        arm = arm + late * at.swing_mps(off)
    return np.hstack([-R @ skew(arm), R])


def hint(m: GnssPosition, mount_yaw_rad: float, datum: Datum) -> Hint:
    """Return the antenna's place."""
    known = np.array([1.0, 1.0, 1.0 if m.has_height else np.nan])
    return Hint(p_world_m=known * _world_m(m, datum), p_sigma_m=known * np.sqrt(np.diagonal(m.cov_enu_m2)))


ROW = Sensor(
    kind="gnss",
    measurement=GnssPosition,
    config=GnssConfig,
    residuals=residuals,
    factors=factors,
    ideal=ideal,
    hint=hint,
    slow=slow,
    constants=stamps_and_antenna,
    scaled=lambda _fix: {"sigma_scale": [0, 1]},
    absolute=True,
    company=True,
)
