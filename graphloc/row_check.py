# SPDX-License-Identifier: Apache-2.0
"""Is a row of the sensor table right in itself? For who adds one (docs/adding-a-sensor.md), before it meets a solver.

A Jacobian of the wrong sign or shape otherwise shows as a track that is a little off, or as an error far from its cause.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np

from graphloc.frames import Array, Datum, Geodetic
from graphloc.graph import Attachment, FeltMotion, Residual, Sensor
from graphloc.measurements import Measurement

_STATES = 3  # that are drawn
_STEP = 1e-5  # of central differences, m, rad, m/s
_WITHIN = 1e-4  # largest deviation of a Jacobian, of its largest entry or of 1
_ZERO = 1e-6  # of the residual of an ideal measurement


def check_row(row: Sensor, config: Any) -> list[str]:
    """Return what is wrong with a row as it is configured, in words; empty: nothing was found.

    At states drawn at random, an ideal measurement must have a residual of zero, and off it the Jacobians must be the slopes of the
    residual, by central differences, for each state that it depends on. Shapes and covariances are checked, too. Not checked: whether
    the measurement model is that of the sensor, native factors (`Sensor.factors`), and the slow state of the node after the measurement.
    """
    rng = np.random.default_rng(0)
    found: dict[str, None] = {}
    for _ in range(_STATES):
        truth = drawn(row, config, rng)
        m = row.ideal(truth, config)
        found |= dict.fromkeys(_of_measurement(row, config, m, truth))
        if not found:
            found |= dict.fromkeys(_of_slopes(row, config, m, truth))
    return list(found)


def drawn(row: Sensor, config: Any, rng: np.random.Generator) -> Attachment:
    """Return where a measurement meets the graph: between two states of a craft that turns, heels and moves."""
    process, lever_m = row.slow(config), np.array([-1.5, 0.4, 2.2])
    roll, pitch, yaw = rng.uniform([-0.2, -0.2, -3.0], [0.2, 0.2, 3.0])
    return Attachment(
        pose_key=1,
        velocity_key=2,
        slow_key=None if process is None else 3,
        leaf_keys=(4, 5),
        T_world_body=gtsam.Pose3(gtsam.Rot3.RzRyRx(roll, pitch, yaw), rng.uniform(-50.0, 50.0, 3)),
        v_world_mps=rng.normal(0.0, 2.0, 3),
        T_state_sensor=gtsam.Pose3(gtsam.Rot3.RzRyRx(0.05, -0.08, 0.4), lever_m + np.array([0.3, -0.1, 0.05])),
        carried_m=np.array([0.3, -0.2, 0.05]),
        dv_world_mps=np.array([0.1, -0.05, 0.02]),
        gyro_radps=np.array([0.02, -0.01, 0.2]),
        lever_m=lever_m,
        slow_value=None if process is None else rng.normal(0.0, 0.1, len(process.sigma)),
        datum=Datum(Geodetic(59.3, 18.1, 20.0)),
        constants=tuple((6 + k, rng.normal(0.0, 0.1, len(c.sigma))) for k, c in enumerate(row.constants(config))),
        own=tuple(constant.own for constant in row.constants(config)),
        felt=FeltMotion(np.array([0.8, -0.5, 9.9]), np.array([0.1, 0.3, -0.2]), np.array([0.0, 0.0, -9.81])),
    )


def sizes_of(at: Attachment) -> dict[int, int]:
    """Return the dimension of each state of an attachment, by key."""
    slow = {} if at.slow_key is None else {at.slow_key: len(np.asarray(at.slow_value))}
    return {at.pose_key: 6, at.velocity_key: 3, **slow, **{key: len(value) for key, value in at.constants}}


def moved(at: Attachment, key: int, step: Array) -> Attachment:
    """Return the attachment after a step (n,) in the tangent of one of its states."""
    if key == at.pose_key:
        return replace(at, T_world_body=at.T_world_body.retract(step))
    if key == at.velocity_key:
        return replace(at, v_world_mps=at.v_world_mps + step)
    if key == at.slow_key:
        return replace(at, slow_value=np.asarray(at.slow_value) + step)
    return replace(at, constants=tuple((k, value + step if k == key else value) for k, value in at.constants))


def away(at: Attachment, by: float) -> Attachment:
    """Return the attachment after a step of size `by` in each of its states."""
    for key, size in sizes_of(at).items():
        at = moved(at, key, by * np.resize([1.0, -0.7, 0.4], size))
    return at


def slopes(of: Callable[[Attachment], Array], at: Attachment) -> dict[int, Array]:
    """Return, by key, the central differences (k, n) of a function by each state of an attachment."""
    return {
        key: np.column_stack(
            [(of(moved(at, key, step)) - of(moved(at, key, -step))) / (2.0 * _STEP) for step in _STEP * np.eye(size)]
        )
        for key, size in sizes_of(at).items()
    }


def _of_measurement(row: Sensor, config: Any, m: Measurement, at: Attachment) -> Iterator[str]:
    """Yield what is wrong with the ideal measurement at an attachment: types, shapes, covariances, a residual that is not zero."""
    if not isinstance(m, row.measurement):
        yield f"ideal returns a {type(m).__name__}, not a {row.measurement.__name__}"
        return
    residuals = row.residuals(m, config, at)
    if not residuals:
        yield "residuals returns none: a measurement has one hypothesis or more"
        return
    for n, residual in enumerate(residuals):
        which, k = f"hypothesis {n}: " if len(residuals) > 1 else "", len(residual.raw)
        if np.shape(residual.raw) != (k,) or not np.isfinite(residual.raw).all():
            yield f"{which}raw has the shape {np.shape(residual.raw)} or is not finite; (k,) is wanted"
        elif np.shape(residual.cov) != (k, k):
            yield f"{which}cov has the shape {np.shape(residual.cov)}, where raw has {k} numbers: ({k}, {k}) is wanted"
        elif not _positive(residual.cov):
            yield f"{which}cov is no covariance: not symmetric, not finite, or not positive"
        elif not 0.0 < residual.prior <= 1.0:
            yield f"{which}prior is {residual.prior:g}, no probability"
        else:
            yield from (f"{which}{said}" for said in _of_shapes(residual, at))
    if not min(np.abs(r.raw).max() for r in residuals) < _ZERO:
        yield "the residual of the ideal measurement is not zero: `ideal` and `residuals` have different models"
    if row.false is not None and np.shape(row.false(m, config).cov) != np.shape(residuals[0].cov):
        yield f"false gives a covariance of the shape {np.shape(row.false(m, config).cov)}, residuals {np.shape(residuals[0].cov)}"


def _positive(cov: Array) -> bool:
    return bool(np.isfinite(cov).all() and np.allclose(cov, cov.T) and np.linalg.eigvalsh(cov)[0] > 0.0)


def _of_shapes(residual: Residual, at: Attachment) -> Iterator[str]:
    """Yield which Jacobians have not as many rows as the residual, and columns as the state."""
    for name, key, jacobian in _jacobians(residual, at):
        wanted = (len(residual.raw), len(_own(at, key)) or sizes_of(at)[key])
        if np.shape(jacobian) != wanted:
            yield f"{name} has the shape {np.shape(jacobian)}; {wanted} is wanted"


def _of_slopes(row: Sensor, config: Any, m: Measurement, at: Attachment) -> Iterator[str]:
    """Yield which Jacobians are not the slopes of the residual."""
    for n, residual in enumerate(row.residuals(m, config, at)):
        told = {key: (name, jacobian) for name, key, jacobian in _jacobians(residual, at)}
        for key, expected in slopes(lambda there, n=n: row.residuals(m, config, there)[n].raw, at).items():  # type: ignore[misc]
            own = _own(at, key)
            slope, within = expected[:, own] if own else expected, _WITHIN * max(float(np.abs(expected).max()), 1.0)
            if key not in told:
                if float(np.abs(slope).max()) > within:
                    yield f"the residual depends on {_state(at, key)}, and no Jacobian says so"
            elif (apart := np.abs(told[key][1] - slope)).max() > within:
                i, j = np.unravel_index(int(apart.argmax()), apart.shape)
                yield f"{told[key][0]}[{i}, {j}] is {told[key][1][i, j]:.4g}, and the residual's slope there {slope[i, j]:.4g}"


def _jacobians(residual: Residual, at: Attachment) -> Iterator[tuple[str, int, Array]]:
    """Yield name, key and value of each Jacobian of a residual."""
    yield "jacobian", at.pose_key, residual.jacobian()
    if residual.velocity_jacobian is not None:
        yield "velocity_jacobian", at.velocity_key, residual.velocity_jacobian()
    if residual.slow_jacobian is not None and at.slow_key is not None:
        yield "slow_jacobian", at.slow_key, residual.slow_jacobian()
    for n, ((key, _), jacobian) in enumerate(zip(at.constants, residual.constant_jacobians(), strict=False)):
        yield f"constant_jacobians[{n}]", key, jacobian


def _own(at: Attachment, key: int) -> tuple[int, ...]:
    """Return which components of a constant the sensor's measurements depend on; empty: all, and of any other state."""
    return next((at.own_of(n) for n, (known, _) in enumerate(at.constants) if known == key), ())


def _state(at: Attachment, key: int) -> str:
    names = {at.pose_key: "the pose", at.velocity_key: "the velocity", at.slow_key: "the slow state"}
    constants = [known for known, _ in at.constants]
    return names[key] if key in names else f"constant {constants.index(key)}"
