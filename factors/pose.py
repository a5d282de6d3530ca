# SPDX-License-Identifier: Apache-2.0
"""Absolute pose in any subset of (x, y, z, roll, pitch, yaw), with several modes.

The measured axes replace those of the current estimate of the sensor's pose; the result, moved to the
body, anchors a native `PriorFactorPose3` whose unmeasured axes are wide:

    Z = T_world_sensor(measured axes), less `Attachment.carried_m` ;  anchor = Z T_state_sensor^-1 ;  e = Log(anchor^-1 T_world_body)

That is exact where the anchor has the roll and pitch of the estimate, so the solver makes the factor anew at every pass (with a level
anchor it is 11 % wrong at 3 deg of roll and pitch). Rotation errors are small rotations about the world's axes, as in ROS.
Each mode is a hypothesis, and so is 'none of them'; the solver weighs them. Not handled: pitch near
+-90 deg where roll and yaw are measured alone.

Poses may share an error d for a while (`PoseConfig.slow_error`: first-order Gauss-Markov, in those of x, y, z and yaw that are measured).
It is added to the prediction, `e = Log(anchor^-1 T_world_body) + d`; the factor then has two states, and is linearised at every pass
(`graphloc.linear`).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gtsam
import numpy as np

from graphloc import gauss
from graphloc.config import AnyPoseConfig, PoseConfig
from graphloc.factors._noise import robust, walked, with_floors
from graphloc.frames import Array, Datum
from graphloc.graph import Attachment, Decision, FalseModel, GraphUpdate, Hint, Residual, Sensor, SlowProcess
from graphloc.measurements import AXES, PoseFix, PoseMode

_WIDE_M, _WIDE_RAD = 1e3, 1e2
# Where a false pose may lie: about BL's search window, 5 m and 5 deg around the truth.
FALSE_SPREAD_M, FALSE_SPREAD_RAD = 5.0, float(np.radians(5.0))


def _covariance(mode: PoseMode, axes: tuple[str, ...], config: AnyPoseConfig) -> Array:
    long = np.array([AXES.index(a) < 3 for a in axes])
    scale = np.where(long, config.sigma_scale, config.angle_sigma_scale)
    floors = np.where(long, config.min_sigma_m, np.radians(config.min_sigma_deg))
    return with_floors(scale[:, None] * mode.cov * scale, floors**2)


def _sensor_pose(at: Attachment) -> Any:
    return gtsam.Pose3(at.T_world_body.rotation().compose(at.T_state_sensor.rotation()), at.sensor_m())


def _measured_sensor_pose(mode: PoseMode, axes: tuple[str, ...], T_world_sensor: Any) -> Any:
    """Return T_world_sensor with the measured axes replaced."""
    values = np.concatenate([T_world_sensor.translation(), T_world_sensor.rotation().rpy()])
    for axis, value in zip(axes, mode.value, strict=True):
        values[AXES.index(axis)] = value
    return gtsam.Pose3(gtsam.Rot3.RzRyRx(values[3:]), values[:3])


def without_slow(m: PoseFix, config: AnyPoseConfig, at: Attachment) -> tuple[Residual, ...]:
    """Return predicted - measured (k,), m and rad, for each mode, without a slow state."""
    T_world_sensor = _sensor_pose(at)
    R = T_world_sensor.rotation().matrix()
    picked = [AXES.index(a) for a in m.axes]
    world = _world_jacobian(R, at.T_state_sensor)
    found = []
    for mode in m.modes:
        Z = _measured_sensor_pose(mode, m.axes, T_world_sensor)
        rotation = gtsam.Rot3.Logmap(gtsam.Rot3(R @ Z.rotation().matrix().T))
        raw = np.concatenate([T_world_sensor.translation() - Z.translation(), rotation])[picked]
        found.append(
            Residual(
                raw=raw,
                cov=_covariance(mode, m.axes, config),
                jacobian=lambda: world[picked],
                prior=mode.probability * (1.0 - _false_probability(m, config)) / _stated(m),
                size_m=_size_m(raw, m.axes),
                size_deg=_size_deg(raw, m.axes),
            )
        )
    return tuple(found)


def _length(raw: Array, axes: tuple[str, ...], of: tuple[str, ...]) -> float | None:
    """Return the length of some components of a residual (k,); None where it has none of them."""
    picked = raw[[i for i, a in enumerate(axes) if a in of]]
    return float(np.linalg.norm(picked)) if len(picked) else None


def _size_m(raw: Array, axes: tuple[str, ...]) -> float | None:
    return _length(raw, axes, AXES[:2])


def _size_deg(raw: Array, axes: tuple[str, ...]) -> float | None:
    size = _length(raw, axes, AXES[3:])
    return None if size is None else float(np.degrees(size))


def with_slow(plain: Residual, axes: tuple[str, ...], value: Array, shown: Array, by_pose: Array) -> Residual:
    """Return a residual to which a slow state is added.

    Args:
        value: (n,) of the slow state. shown: (k, n) d raw / d (slow state).
        by_pose: (k, 6) d raw / d (body tangent of the state's pose), slow state included.
    """
    raw = plain.raw + shown @ value
    return replace(
        plain,
        raw=raw,
        jacobian=lambda: by_pose,
        slow_jacobian=lambda: shown,
        size_m=_size_m(raw, axes),
        size_deg=_size_deg(raw, axes),
    )


def residuals(m: PoseFix, config: PoseConfig, at: Attachment) -> tuple[Residual, ...]:
    """Return predicted - measured (k,), m and rad, for each mode."""
    found = without_slow(m, config, at)
    if at.slow_value is None:
        return found
    shown = _shown(m.axes, config)
    found = tuple(with_slow(plain, m.axes, at.slow_value, shown, plain.jacobian()) for plain in found)
    if at.slow_walk is None:
        return found
    return tuple(walked(residual, at.walked(shown)) for residual in found)


def _slow_axes(config: PoseConfig) -> tuple[str, ...]:
    """Return the axes that have a slow error."""
    s = config.slow_error
    sigma = {"x": s.sigma_m, "y": s.sigma_m, "z": s.sigma_m, "yaw": s.sigma_deg}
    return tuple(a for a in config.axes if sigma.get(a, 0.0) > 0.0)


def _shown(axes: tuple[str, ...], config: PoseConfig) -> Array:
    """Return d residual / d slow state (k, n)."""
    return np.array([[float(a == b) for b in _slow_axes(config)] for a in axes])


def slow(config: PoseConfig) -> SlowProcess | None:
    """Return the error that poses share for a while; None if none is configured."""
    axes, s = _slow_axes(config), config.slow_error
    if not axes:
        return None
    turns = [a == "yaw" for a in axes]
    return SlowProcess(
        name="pose error",
        axes=tuple({"x": "east", "y": "north", "z": "up"}.get(a, a) for a in axes),
        units=tuple(np.where(turns, "deg", "m").tolist()),
        scale=np.where(turns, 180.0 / np.pi, 1.0),
        sigma=np.where(turns, np.radians(s.sigma_deg), s.sigma_m),
        time_constant_s=np.full(len(axes), s.time_constant_s),
    )


def _stated(m: PoseFix) -> float:
    return sum(mode.probability for mode in m.modes)


def _false_probability(m: PoseFix, config: AnyPoseConfig) -> float:
    """Return the front-end's own probability of 'none of the modes' where it states one, else the configured share."""
    return min(max(m.none_probability if m.none_probability > 1e-6 else config.false_fraction, 1e-4), 0.99)


def false(m: PoseFix, config: AnyPoseConfig) -> FalseModel:
    """Return the model of a false pose: anywhere in BL's search window, and likely to repeat."""
    sigmas = np.array([FALSE_SPREAD_M if AXES.index(a) < 3 else FALSE_SPREAD_RAD for a in m.axes])
    return FalseModel(
        probability=_false_probability(m, config), cov=np.diag(sigmas**2), repeats=config.false_repeats, news=m.news
    )


def factors(m: PoseFix, config: AnyPoseConfig, at: Attachment, decision: Decision) -> GraphUpdate | None:
    """Return the native factor of the chosen mode; None where a slow state adds to it."""
    if at.slow_key is not None:
        return None
    mode = m.modes[decision.mode]
    T_world_sensor = _sensor_pose(at)
    Z = _measured_sensor_pose(mode, m.axes, T_world_sensor)
    # Whitened rows of d(world translation, world rotation of the sensor) / d(body tangent). Built as a
    # square root: inverting a covariance with 1 km and 0.1 deg in it leaves spurious information behind,
    # enough to hold the roll and pitch of the anchor (measured: 3 deg, and the run lost).
    picked = [AXES.index(a) for a in m.axes]
    rows = _world_jacobian(Z.rotation().matrix(), at.T_state_sensor)
    root = np.diag([1.0 / _WIDE_M] * 3 + [1.0 / _WIDE_RAD] * 3)
    cov = _covariance(mode, m.axes, config) / decision.weight
    root[np.ix_(picked, picked)] = gauss.whitening(cov)
    anchor = gtsam.Pose3(Z.rotation(), Z.translation() - at.carried_m).compose(at.T_state_sensor.inverse())
    upper = np.linalg.qr(root @ rows)[1]
    upper *= np.sign(np.diagonal(upper))[:, None]  # GTSAM takes a diagonal one for sigmas, and these are positive
    base = gtsam.noiseModel.Gaussian.SqrtInformation(upper)
    return GraphUpdate(factors=(gtsam.PriorFactorPose3(at.pose_key, anchor, robust(base, decision.kernel)),))


def _world_jacobian(R_world_sensor: Array, T_state_sensor: Any) -> Array:
    """Return d(translation, rotation of the sensor about world axes) / d(body tangent of the state), (6, 6)."""
    adjoint = np.asarray(T_state_sensor.inverse().AdjointMap())
    return np.vstack([R_world_sensor @ adjoint[3:], R_world_sensor @ adjoint[:3]])


def ideal_without_slow(at: Attachment, config: AnyPoseConfig) -> PoseFix:
    """Return the noise-free pose at the attachment's state, without a slow state."""
    T = _sensor_pose(at)
    values = np.concatenate([T.translation(), T.rotation().rpy()])
    sigmas = np.where(np.arange(6) < 3, 0.3, np.radians(2.0))
    picked = [AXES.index(a) for a in config.axes]
    mode = PoseMode(value=values[picked], cov=np.diag(sigmas[picked] ** 2))
    return PoseFix(stamp_ns=0, sensor="pose", seq=0, axes=config.axes, modes=(mode,))


def moved(ideal: PoseFix, by: Array) -> PoseFix:
    """Return a pose of one mode, its value (k,) moved by that of a slow state."""
    (mode,) = ideal.modes
    return replace(ideal, modes=(replace(mode, value=mode.value + by),))


def ideal(at: Attachment, config: PoseConfig) -> PoseFix:
    """Return the noise-free pose at the attachment's state."""
    found = ideal_without_slow(at, config)
    return found if at.slow_value is None else moved(found, _shown(found.axes, config) @ at.slow_value)


def hint(m: PoseFix, mount_yaw_rad: float, datum: Datum) -> Hint:
    """Return position and heading of the likeliest mode, as far as it has them."""
    best = max(m.modes, key=lambda mode: mode.probability)
    value, sigma = np.full(6, np.nan), np.full(6, np.nan)
    picked = [AXES.index(a) for a in m.axes]
    value[picked], sigma[picked] = best.value, np.sqrt(np.diagonal(best.cov))
    return Hint(
        p_world_m=value[:3], p_sigma_m=sigma[:3], yaw_rad=float(value[5]) - mount_yaw_rad, yaw_sigma_rad=float(sigma[5])
    )


def scaled(m: PoseFix) -> dict[str, list[int]]:
    """Return the keys of the configuration that scale sigmas, each with the axes (numbers) that it scales."""
    long = [k for k, axis in enumerate(m.axes) if AXES.index(axis) < 3]
    return {"sigma_scale": long, "angle_sigma_scale": [k for k in range(len(m.axes)) if k not in long]}


ROW = Sensor(
    kind="pose",
    measurement=PoseFix,
    config=PoseConfig,
    residuals=residuals,
    factors=factors,
    ideal=ideal,
    hint=hint,
    slow=slow,
    false=false,
    scaled=scaled,
    absolute=True,
    company=True,
    in_world=True,
)
