# SPDX-License-Identifier: Apache-2.0
"""What a sensor row promises to the graph builder, and what it gets to see.

A row turns a measurement into residuals (to weigh it, choose its mode, write its ledger row, and make its factor of) and,
where they serve better, into native GTSAM factors. Both functions are pure; what a row returns enters the graph whole or not
at all. Builder and solvers know rows only through this module, never by name. The inertial sensor links states instead of measuring
one: `graphloc.inertial`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from graphloc import gauss
from graphloc.berths import Berth
from graphloc.config import KernelConfig, SensorConfig
from graphloc.frames import Array, Datum
from graphloc.measurements import Measurement


def _cross(a: Array, b: Array) -> Array:
    """Return a x b of two vectors (3,): `np.cross` takes ten times as long, and is asked for at every pass."""
    (ax, ay, az), (bx, by, bz) = a.tolist(), b.tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


@dataclass(frozen=True, slots=True)
class GraphUpdate:
    """Factors, and initial values of the keys that no other factor has."""

    factors: tuple[Any, ...] = ()
    guesses: tuple[tuple[int, Any], ...] = ()


class FeltMotion(NamedTuple):
    """What an IMU measures about a stamp, biases removed.

    Attributes:
        force_mps2: (3,) specific force, axes of the body at the state. spin_radps2: (3,) angular acceleration, the same axes.
        gravity_mps2: (3,) gravity, world axes: an acceleration is the specific force, turned into world, plus this.
    """

    force_mps2: Array
    spin_radps2: Array
    gravity_mps2: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class Attachment:
    """Where a measurement meets the graph, and what the graph believes there now.

    A measurement between two states belongs to the nearest one (in an IMU gap, to the one before it). The IMU measures the motion in
    between. Its rotation is part of `T_state_sensor`, as if the sensor were mounted so, because it turns with the attitude at the state.
    Its translation (`carried_m`) is not, because it does not turn with that attitude: as part of the mount it would hold the heading at the
    present estimate (fixes of centimetres at 20 Hz, to some tenths of a degree).

    Attributes:
        pose_key, velocity_key: keys of the state.
        slow_key: key of the sensor's slow state, at the slow node of the state; None where it has none.
        leaf_keys: two keys that belong to this measurement alone.
        T_world_body: estimated pose of the state (gtsam.Pose3): axes of the body, origin at the IMU (see `graphloc.build`).
        v_world_mps: (3,) its estimated velocity, world axes.
        T_solver: pose (gtsam.Pose3) about which the solver linearises, where it keeps older linearisations (see `graphloc.linear`);
            None: `T_world_body`, because all factors are written anew at every pass.
        R_first: attitude (3, 3), body to world, at which derivatives by constants are taken, where the solver keeps older linearisations
            (see `online._constants`); None: that of `T_world_body`.
        T_state_sensor: axes and lever arm of the sensor at the measurement's stamp, axes of the body at the state (gtsam.Pose3).
        carried_m: (3,) way of the body from the state to the measurement, world axes, as estimated.
        dv_world_mps: (3,) velocity at the measurement less that at the state, world axes.
        gyro_radps: (3,) angular rate at the measurement, body axes, bias removed.
        lever_m: (3,) origin of the sensor seen from the IMU, body axes.
        slow_value: (n,) estimate of the slow state at `slow_key`, or None.
        slow_next: of the node after that one: key and estimate (n,) of the slow state, share (0 to 1) of the time between both nodes
            that has passed at the measurement, and that time in s; None where there is no such node (yet).
        slow_age_s: time from the slow node to the measurement, at least 0.
        slow_walk: (n,) variances to add to the measurement, because its slow error goes on changing between two nodes (see
            `build.walk_between_nodes`) or its height is not used; None: nothing is added.
        constants: key and estimate of each of the sensor's constants.
        own: for each constant, which of its components this sensor's measurements depend on (see `Constant.own`).
        datum: origin of world.
        felt: what the IMU measures about the measurement; None unless the delay of the sensor's stamps is estimated.
    """

    pose_key: int
    velocity_key: int
    slow_key: int | None
    leaf_keys: tuple[int, int]
    T_world_body: Any
    v_world_mps: Array
    T_state_sensor: Any
    carried_m: Array
    dv_world_mps: Array
    gyro_radps: Array
    lever_m: Array
    slow_value: Array | None
    datum: Datum
    slow_next: tuple[int, Array, float, float] | None = None
    slow_age_s: float = 0.0
    slow_walk: Array | None = None
    constants: tuple[tuple[int, Array], ...] = ()
    T_solver: Any | None = None
    R_first: Array | None = None
    felt: FeltMotion | None = None
    own: tuple[tuple[int, ...], ...] = ()

    def own_of(self, n: int) -> tuple[int, ...]:
        """Return which components of constant `n` the sensor's measurements depend on; empty: all (see `Constant.own`)."""
        return self.own[n] if n < len(self.own) else ()

    def walked(self, shown: Array | None = None) -> Array | float:
        """Return the covariance (k, k) that `slow_walk` adds to a measurement; 0 where it adds nothing.

        Args:
            shown: (k, n) d measurement / d (slow state); None: the unit matrix.
        """
        if self.slow_walk is None:
            return 0.0
        walk = np.diag(self.slow_walk)
        return walk if shown is None else np.asarray(shown @ walk @ shown.T)

    @property
    def R_by_constants(self) -> Array:
        """Attitude (3, 3), body to world, at which derivatives by constants are taken."""
        return self.T_world_body.rotation().matrix() if self.R_first is None else self.R_first

    @property
    def body_m(self) -> Array:
        """Position (3,) of the body at the measurement, in world, m."""
        return np.asarray(self.T_world_body.translation() + self.carried_m)

    def sensor_m(self, off_m: Array | None = None) -> Array:
        """Return the position (3,) of the sensor at the measurement, in world, m; `off_m`: see `swing_mps`."""
        at_state = self.T_state_sensor.translation() if off_m is None else self.T_state_sensor.transformFrom(off_m)
        return np.asarray(self.T_world_body.transformFrom(at_state) + self.carried_m)

    def swing_mps(self, off_m: Array | None = None) -> Array:
        """Return the part of the sensor's velocity (3,) that comes from the rotation of the body, w x l, body axes, m/s.

        Args:
            off_m: (3,) estimated place of the sensor less that of its mount, axes of the sensor; None: zero.
        """
        return _cross(self.gyro_radps, self._lever_m(off_m))

    def _lever_m(self, off_m: Array | None) -> Array:
        return self.lever_m if off_m is None else self.lever_m + self.T_state_sensor.rotation().matrix() @ off_m

    def sensor_velocity_mps(self, off_m: Array | None = None) -> Array:
        """Return the velocity (3,) of the sensor at the measurement, world axes, m/s; `off_m`: see `swing_mps`."""
        swing = self.T_world_body.rotation().matrix() @ self.swing_mps(off_m)
        return np.asarray(self.v_world_mps + self.dv_world_mps + swing)

    def pushed_mps2(self, off_m: Array | None = None) -> Array:
        """Return the specific force (3,) at the sensor, f + a x l + w x (w x l), body axes, m/s^2; `off_m`: see `swing_mps`.

        Raises:
            ValueError: `felt` is None.
        """
        if self.felt is None:
            raise ValueError("an attachment without what the IMU feels")
        turning = _cross(self.felt.spin_radps2, self._lever_m(off_m)) + _cross(self.gyro_radps, self.swing_mps(off_m))
        return np.asarray(self.felt.force_mps2 + turning)

    def sensor_acceleration_mps2(self, off_m: Array | None = None) -> Array:
        """Return the acceleration (3,) of the sensor at the measurement, world axes, m/s^2; arguments and errors as of `pushed_mps2`."""
        pushed = self.T_world_body.rotation().matrix() @ self.pushed_mps2(off_m)
        return np.asarray(pushed + self.felt.gravity_mps2 if self.felt is not None else pushed)


@dataclass(frozen=True, slots=True, kw_only=True)
class Residual:
    """Residual of one hypothesis of a measurement at the current estimate.

    Attributes:
        raw: (k,) in m, rad or m/s. cov: (k, k) of the measurement.
        jacobian: returns (k, 6) d raw / d (body tangent of the state's pose).
        slow_jacobian: returns (k, n) d raw / d (slow state); None: the residual does not depend on it.
        velocity_jacobian: returns (k, 3) d raw / d (velocity in world); None: the residual does not depend on it.
        constant_jacobians: returns (k, n) d raw / d (constant) for each of the attachment's constants.
        white: (k, k) part of `cov` that is independent of the sensor's neighbouring measurements; None: all of it.
        expected_nis: expected squared error of its factor; None: k, the number of its axes.
        prior: prior probability of this hypothesis.
        size_m, size_deg: physical size, for the ledger; None: it has none in that unit.
    """

    raw: Array
    cov: Array
    jacobian: Callable[[], Array]
    slow_jacobian: Callable[[], Array] | None = None
    velocity_jacobian: Callable[[], Array] | None = None
    constant_jacobians: Callable[[], tuple[Array, ...]] = tuple
    white: Array | None = None
    expected_nis: float | None = None
    prior: float = 1.0
    size_m: float | None = None
    size_deg: float | None = None

    @property
    def white_cov(self) -> Array:
        """Part (k, k) of `cov` that is independent of the sensor's neighbouring measurements."""
        return self.cov if self.white is None else self.white

    def _spread(self, inflation: Array | None) -> Array:
        return self.cov if inflation is None else self.cov + inflation

    def nis(self, inflation: Array | None = None) -> float:
        """Squared residual normalised by `cov` (+ `inflation`)."""
        return gauss.square(self.raw, self._spread(inflation))

    def normalised(self, inflation: Array | None = None) -> Array:
        """The residual (k,) divided by the Cholesky root of `cov` (+ `inflation`): its squared length is `nis`."""
        s = self._spread(inflation)
        if len(self.raw) == 1:
            return np.asarray(self.raw / np.sqrt(s[0]))
        return np.asarray(np.linalg.solve(np.linalg.cholesky(s), self.raw))

    def log_density(self, inflation: Array | None = None) -> float:
        """Log of prior x Gaussian density of the residual, covariance `cov` (+ `inflation`)."""
        return float(np.log(self.prior)) + gauss.log_density(self.raw, self._spread(inflation))


@dataclass(frozen=True, slots=True, kw_only=True)
class Decision:
    """What the solver has decided about a measurement for this pass.

    Attributes:
        mode: index of the hypothesis that enters the graph.
        weight: factor on its information, in (0, 1].
        kernel: robust loss of the weighted residual, or None.
    """

    mode: int = 0
    weight: float = 1.0
    kernel: KernelConfig | None = None


LATE = "late"
"""Name of a constant axis of a slow state: time of measurement less the stamp, s, of a sensor; `time_offset_s` would correct it."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SlowProcess:
    """A slow state of a sensor: each of its k axes is a first-order Gauss-Markov process about zero, or a constant.

    Attributes:
        name: of the state, for outputs.
        axes: name of each axis. units: unit of each axis in outputs. scale: (k,) factor from the state's unit to that one.
        sigma: (k,) standard deviation of the process. time_constant_s: (k,) its correlation time; inf: the axis is a constant.
        offset: what a warning calls the constant axes, where not all axes are constants; empty: `name`.
        no_tails: constant axes whose prior is Gaussian, because they are never far from zero. The other constants have the tails of
            Student's t: a mount may be turned by any angle.
        jumps: whether a step may be a jump; steps then have a robust loss.
        far: axes that, together, may stay at a level many sigmas from zero, as after a jump; their priors then have Cauchy tails.
        follows: axes that step, too, where the far axes jump, by an unknown amount: a wrong fix is wrong in height as well.
        stepped: axes that a step of the measurements moves, which the gyroscope does not show (`signals/heading_steps.py`).
        needs_company: whether it is estimated only if a second sensor can tell it from motion. If none can, it is left out of the
            graph, and its size is added to the bounds.
        anew_after_s: a silence of the sensor after which the state is independent of what it was before; inf: it never is.
    """

    name: str
    axes: tuple[str, ...]
    units: tuple[str, ...]
    scale: Array
    sigma: Array
    time_constant_s: Array
    offset: str = ""
    no_tails: tuple[str, ...] = ()
    jumps: bool = False
    far: tuple[str, ...] = ()
    follows: tuple[str, ...] = ()
    stepped: tuple[str, ...] = ()
    needs_company: bool = False
    anew_after_s: float = math.inf

    @property
    def constant(self) -> NDArray[np.bool_]:
        """Which axes (k,) do not change."""
        return ~np.isfinite(self.time_constant_s)

    @property
    def mount_yaw(self) -> int | None:
        """Number of the axis that is the yaw of the sensor's mount; None where there is none."""
        return next((k for k, axis in enumerate(self.axes) if axis == "yaw" and self.constant[k]), None)

    @property
    def late(self) -> int | None:
        """Number of the axis `LATE`; None where there is none."""
        return self.axes.index(LATE) if LATE in self.axes else None

    @property
    def far_axes(self) -> NDArray[np.bool_]:
        """Which axes (k,) may stay far from zero (`far`)."""
        return np.array([axis in self.far for axis in self.axes])

    @property
    def jump_axes(self) -> NDArray[np.bool_]:
        """Which axes (k,) a jump or a step seen in the measurements moves."""
        return np.array([axis in (*self.far, *self.follows, *self.stepped) for axis in self.axes])

    def after(self, dt_s: float) -> tuple[Array, Array]:
        """Return the factors (k,) by which the state has decayed after `dt_s`, and the variances (k,) of the noise added since."""
        kept = np.exp(-dt_s / self.time_constant_s)
        return kept, self.sigma**2 * (1.0 - kept**2)


CONSTANT_TAILS = 9.0
"""Square of a constant's estimate, in squared sigmas of its prior, at which the re-weighted variance of that prior has doubled."""
TIME_OFFSET = "time_offset_s"
"""Key of vessel.yaml that a sensor's estimated time of measurement less its stamp is added to."""
PLACE = ("mount.xyz_m[0]", "mount.xyz_m[1]", "mount.xyz_m[2]")
"""Keys of vessel.yaml that the estimated place of an antenna, less the configured one, is added to."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Constant:
    """A vector (k,) that is the same throughout a run and that several of a sensor's measurements depend on; its prior is about zero.

    Attributes:
        name: for warnings. sigma: (k,) standard deviations of the prior.
        corrects: for each component, the key of vessel.yaml that it is added to, in the unit of that key; empty for what was surveyed.
        own: components that this sensor's measurements depend on, where it shares the constant with other sensors; empty: all.
        of_another: number of components, counted from the first, that belong to another sensor as well; warnings name that one.
    """

    name: str
    sigma: Array
    corrects: tuple[str, ...] = ()
    own: tuple[int, ...] = ()
    of_another: int = 0

    @property
    def settings(self) -> list[tuple[int, str]]:
        """Component and key of each setting of this sensor that the constant corrects."""
        return [(n, key) for n, key in enumerate(self.corrects) if not self.own or n in self.own]

    def widened(self, value: Array) -> Array:
        """Return the sigmas (k,) of the prior, re-weighted at an estimate (k,): the prior has the tails of Student's t.

        With a Gaussian prior, a tag surveyed 0.5 m wrong pulls two good ones along: error at the berth 0.5 m, with tails 0.05 m.
        """
        return self.sigma * np.sqrt(1.0 + self._squares(value) / CONSTANT_TAILS)

    def cost(self, value: Array) -> float:
        """Return -log of the prior's density at a value (k,), up to an additive constant."""
        squares = self._squares(value)
        together = ~self._alone
        costs = np.append(squares[~together], squares[together][:1])
        return 0.5 * CONSTANT_TAILS * float(np.log1p(costs / CONSTANT_TAILS).sum())

    @property
    def _alone(self) -> NDArray[np.bool_]:
        """Components (k,) with tails of their own; all others share theirs. An antenna that sits far off says nothing of a delay."""
        return np.array([key == TIME_OFFSET for key in self.corrects] or [False] * len(self.sigma))

    def _squares(self, value: Array) -> Array:
        squares, alone = (value / self.sigma) ** 2, self._alone
        return np.where(alone, squares, squares[~alone].sum())


def corrections(solved: Iterable[tuple[Constant, Array]], mount: Any) -> dict[str, float]:
    """Return what the estimates of a sensor's constants add to its settings, by their keys in vessel.yaml.

    Args:
        solved: constants and their estimates (k,). mount: pose of the sensor in body (gtsam.Pose3): a place is estimated in its axes,
            and returned in those of body.
    """
    found = {key: float(value[n]) for constant, value in solved for n, key in constant.settings}
    if PLACE[0] in found:
        off_m = mount.rotation().matrix() @ np.array([found[key] for key in PLACE])
        found |= zip(PLACE, off_m.tolist(), strict=True)
    return found


def antenna_off_m(corrected: Mapping[str, float]) -> Array | None:
    """Return an antenna's estimated place less the configured one (3,), m, body axes; None where it is not estimated.

    Args:
        corrected: as `corrections` returns it.
    """
    return np.array([corrected[key] for key in PLACE]) if PLACE[0] in corrected else None


@dataclass(frozen=True, slots=True, kw_only=True)
class FalseModel:
    """How often a sensor's measurements are false, and how their errors are distributed.

    Attributes:
        probability: that a measurement is false. cov: (k, k) of a false one's residual, about the truth.
        repeats: probability that a false measurement repeats the error of a false one before it: a moored boat that is taken
            for another one is so again in the next scan.
        news: share of a measurement's evidence, for being right or false, that is independent of the measurement before it.
    """

    probability: float
    cov: Array
    repeats: float
    news: float = 1.0


def _unknown() -> Array:
    return np.full(3, np.nan)


@dataclass(frozen=True, slots=True, kw_only=True)
class Hint:
    """What a single measurement says of the body, before there is an estimate. NaN: nothing.

    Attributes:
        p_world_m, p_sigma_m: (3,) position of the sensor, as lever arms are not removed, and its sigmas. v_world_mps: (3,) velocity.
        yaw_rad, yaw_sigma_rad: yaw of the body, from east, counter-clockwise, and its sigma.
    """

    p_world_m: Array = field(default_factory=_unknown)
    p_sigma_m: Array = field(default_factory=_unknown)
    v_world_mps: Array = field(default_factory=_unknown)
    yaw_rad: float = math.nan
    yaw_sigma_rad: float = math.nan


@dataclass(frozen=True, slots=True, kw_only=True)
class Sensor:
    """One row of the table of sensors: all that builder and solvers know of a kind of sensor.

    Attributes:
        kind: as `kind:` in vessel.yaml.
        measurement, config: classes of its measurements and of its configuration.
        residuals: returns the residual of each hypothesis of a measurement, at the current estimate.
        ideal: returns the noise-free measurement that a state would give (for conformance tests).
        hint: returns what a measurement says at the start, given the yaw of the sensor's mount (rad) and the datum.
        slow: returns the slow state of a sensor that is configured so; None: it has none.
        factors: returns the factors of the hypothesis that was chosen; None: the linearised residual is the factor (`graphloc.linear`).
        false: returns how false measurements look; None in its place: no measurement is taken for false, and the robust loss alone
            limits what a wrong one does.
        constants: returns the constants that several measurements of a sensor depend on.
        scaled: returns, for a measurement, the keys of its configuration that scale its sigmas, each with the axes (of k) that it scales.
        describe: returns what the ledger should say of a measurement besides.
        berths: returns the berths that the sensor's slow state moves (floating docks), and from which the vessel is seen.
        synthetic: makes the measurements, over the stamps of the run, of a sensor that is configured and has no topic.
        one_likelihood: whether the hypotheses are maxima of one likelihood, and that is the factor whichever is chosen. Doubt between
            them then takes no weight from the factor.
        absolute: whether it measures position.
        company: whether, beside another sensor, it can tell that one's slow error from motion.
        in_world: whether its measurements are in world coordinates, so that the datum must be known.
        along_body: whether it measures motion along the body's axes: with positions, that tells the heading.
    """

    kind: str
    measurement: type[Measurement]
    config: type[SensorConfig]
    residuals: Callable[[Any, Any, Attachment], tuple[Residual, ...]]
    ideal: Callable[[Attachment, Any], Measurement]
    hint: Callable[[Any, float, Datum], Hint]
    slow: Callable[[Any], SlowProcess | None] = lambda _config: None
    factors: Callable[[Any, Any, Attachment, Decision], GraphUpdate | None] = lambda *_: None
    false: Callable[[Any, Any], FalseModel] | None = None
    constants: Callable[[Any], tuple[Constant, ...]] = lambda _config: ()
    scaled: Callable[[Any], Mapping[str, list[int]]] = lambda _measurement: {}
    describe: Callable[[Any], str] = lambda _measurement: ""
    berths: Callable[[Any], tuple[Berth, ...]] = lambda _config: ()
    synthetic: Callable[[str, Any, Sequence[int], float], Sequence[Measurement]] | None = None
    one_likelihood: bool = False
    absolute: bool = False
    company: bool = False
    in_world: bool = False
    along_body: bool = False

    @property
    def has_hypotheses(self) -> bool:
        """Whether each measurement is right or false; else the robust loss alone limits what a wrong one does."""
        return self.false is not None

    def of(self, config: SensorConfig) -> Sensor:
        """Return the row as it holds for a configuration: poses that give only height or heading are neither `absolute` nor `company`."""
        return self if config.tells_place else replace(self, absolute=False, company=False)
