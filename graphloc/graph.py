# SPDX-License-Identifier: Apache-2.0
"""What a sensor row promises to the graph builder, and what it gets to see.

A row turns a measurement into residuals (to weigh it, choose its mode, write its ledger row, and make its factor of) and,
where they serve better, into native GTSAM factors. Both functions are pure; what a row returns enters the graph whole or not
at all. Builder and solvers know rows only through this module, never by name.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from graphloc import gauss
from graphloc.berths import Berth
from graphloc.config import KernelConfig, SensorConfig
from graphloc.frames import Array, Datum
from graphloc.measurements import ImuSeries, Measurement


def _cross(a: Array, b: Array) -> Array:
    """Return a x b of two vectors (3,): `np.cross` takes ten times as long, and is asked for at every pass."""
    (ax, ay, az), (bx, by, bz) = a.tolist(), b.tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


@dataclass(frozen=True, slots=True)
class GraphUpdate:
    """Factors and the guesses of the keys that only these factors introduce."""

    factors: tuple[Any, ...] = ()
    guesses: tuple[tuple[int, Any], ...] = ()


class FeltMotion(NamedTuple):
    """What an IMU feels about a stamp, biases removed.

    Attributes:
        force_mps2: (3,) specific force. spin_radps2: (3,) change of the angular rate; both in the axes of the body at the state.
        gravity_mps2: (3,) what is to be added to the force for an acceleration, world axes.
    """

    force_mps2: Array
    spin_radps2: Array
    gravity_mps2: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class Attachment:
    """Where a measurement meets the graph, and what the graph believes there now.

    A measurement between two states is carried to the nearest one with the IMU's own relative motion:
    `T_state_sensor` is the pose of the sensor at the measurement's stamp, seen from the body at the
    state. Carrying is thus the same thing as a mount.

    Attributes:
        pose_key, velocity_key: keys of the state.
        slow_key: key of the sensor's slow state, or None.
        leaf_keys: two keys that belong to this measurement alone.
        T_world_body: estimate at the state: body axes, origin at the IMU (see `graphloc.build`). v_world_mps: of its velocity (3,).
        T_solver: where a solver that goes on from older linearisations linearises the pose (see `graphloc.linear`); None: at the
            estimate, as all factors are written anew at every pass.
        T_state_sensor: see above (gtsam.Pose3).
        dv_world_mps: (3,) what velocity gains from the state to the measurement.
        gyro_radps: (3,) body rate at the measurement, body axes, bias removed.
        lever_m: (3,) sensor origin from the IMU, body axes.
        slow_value: estimate of the slow state, or None.
        slow_next: key and estimate of the next node of the slow state, how far from the one to the other the measurement
            is (share), and how far apart they are in s; None where there is no next (yet).
        slow_age_s: how long after its node the measurement is, at least 0.
        slow_walk: (n,) variances: what a slow state that is held from node to node is off by, each measurement's share (see
            `build.walk_between_nodes`); None: there is no slow state.
        constants: key and estimate of each of the sensor's constants.
        datum: origin of world.
        felt: what the IMU feels about the measurement; None where the delay of its stamp is not asked for.
    """

    pose_key: int
    velocity_key: int
    slow_key: int | None
    leaf_keys: tuple[int, int]
    T_world_body: Any
    v_world_mps: Array
    T_state_sensor: Any
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
    felt: FeltMotion | None = None
    own: tuple[tuple[int, ...], ...] = ()

    def own_of(self, n: int) -> tuple[int, ...]:
        """Return which rows of constant `n` the sensor's measurements have; none: all (`Constant.own`)."""
        return self.own[n] if n < len(self.own) else ()

    def walked(self, shown: Array | None = None) -> Array | float:
        """Return the covariance (k, k) that `slow_walk` adds to a measurement; 0 where there is no slow state.

        Args:
            shown: (k, n) d measurement / d (slow state); default: the measurement shows each of its axes.
        """
        if self.slow_walk is None:
            return 0.0
        walk = np.diag(self.slow_walk)
        return walk if shown is None else np.asarray(shown @ walk @ shown.T)

    def swing_mps(self, off_m: Array | None = None) -> Array:
        """Return the velocity (3,) of the sensor by the turning of the body, w x l, body axes, m/s.

        Args:
            off_m: (3,) how far from its mount the sensor is, in its own axes.
        """
        return _cross(self.gyro_radps, self._lever_m(off_m))

    def _lever_m(self, off_m: Array | None) -> Array:
        return self.lever_m if off_m is None else self.lever_m + self.T_state_sensor.rotation().matrix() @ off_m

    def sensor_velocity_mps(self, off_m: Array | None = None) -> Array:
        """Return the velocity (3,) of the sensor at the measurement, world axes, m/s; `off_m`: see `swing_mps`."""
        swing = self.T_world_body.rotation().matrix() @ self.swing_mps(off_m)
        return np.asarray(self.v_world_mps + self.dv_world_mps + swing)

    def pushed_mps2(self, off_m: Array | None = None) -> Array:
        """Return what accelerates the sensor at the measurement but for gravity (3,), body axes, m/s^2; `off_m`: see `swing_mps`.

        Raises:
            ValueError: it is not known what the IMU feels.
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
        jacobian: gives (k, 6) d raw / d (body tangent of the state's pose), for the predicted covariance.
        slow_jacobian: gives (k, n) d raw / d (slow state), for the same; None: it has no part in that.
        velocity_jacobian: gives (k, 3) d raw / d (velocity in world), for the same; None: it has no part in that.
        constant_jacobians: gives (k, n) d raw / d (each of the attachment's constants), for its factor.
        white: (k, k) covariance of what it does not share with the measurements beside it; None: all of `cov` (see `white_cov`).
        expected_nis: expected square of the factor; None: that of its length, one per axis.
        prior: prior probability of this hypothesis.
        size_m, size_deg: physical size, for the ledger.
    """

    raw: Array
    cov: Array
    jacobian: Callable[[], Array]
    prior: float
    size_m: float | None
    size_deg: float | None
    slow_jacobian: Callable[[], Array] | None = None
    velocity_jacobian: Callable[[], Array] | None = None
    constant_jacobians: Callable[[], tuple[Array, ...]] = tuple
    white: Array | None = None
    expected_nis: float | None = None

    @property
    def white_cov(self) -> Array:
        """Covariance (k, k) of what it does not share with the measurements beside it."""
        return self.cov if self.white is None else self.white

    def _spread(self, inflation: Array | None) -> Array:
        return self.cov if inflation is None else self.cov + inflation

    def nis(self, inflation: Array | None = None) -> float:
        """Squared residual normalised by `cov` (+ `inflation`)."""
        return gauss.square(self.raw, self._spread(inflation))

    def normalised(self, inflation: Array | None = None) -> Array:
        """The residual (k,) by a root of `cov` (+ `inflation`): its square is `nis`."""
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
        kernel: robust loss of what is weighted so, or None.
    """

    mode: int = 0
    weight: float = 1.0
    kernel: KernelConfig | None = None


LATE = "late"
"""Axis of a slow state, a constant: the delay of all stamps of a sensor, which `time_offset_s` would correct."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SlowProcess:
    """A slow state: per axis a first-order Gauss-Markov process.

    Attributes:
        name: for outputs. offset: what its constants are together, where it has others beside them.
        axes: k names. units: k of them. scale: (k,) from the state's units to these.
        sigma: (k,) standing size. time_constant_s: (k,) correlation time; inf for a constant.
        no_tails: axes of constants that are never far from zero; a mount may be turned by any angle.
        jumps: put a robust loss on its steps. far: axes that together may stand much farther off than sigma; tails of their prior.
        needs_company: leave it out where no second sensor can tell it from motion; its size is then
            added to the bounds.
        anew_after_s: where the sensor was silent for so long it is drawn anew, and says nothing of what it was before; inf: never.
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
        """Number of the axis that is how much later than stamped the sensor measures, s; None where there is none."""
        return self.axes.index(LATE) if LATE in self.axes else None

    @property
    def far_axes(self) -> NDArray[np.bool_]:
        """Which axes (k,) may stand far off, and jump."""
        return np.array([axis in self.far for axis in self.axes])

    def after(self, dt_s: float) -> tuple[Array, Array]:
        """Return what share of the state is left after a time (k,), and the variance (k,) that has come to it."""
        kept = np.exp(-dt_s / self.time_constant_s)
        return kept, self.sigma**2 * (1.0 - kept**2)


CONSTANT_TAILS = 9.0
"""Squared sigmas at which the variance of a constant's prior doubles."""
TIME_OFFSET = "time_offset_s"
PLACE = ("mount.xyz_m[0]", "mount.xyz_m[1]", "mount.xyz_m[2]")


@dataclass(frozen=True, slots=True, kw_only=True)
class Constant:
    """Something that does not change in a run and that some of a sensor's measurements share; expected to be zero.

    Attributes:
        name: for warnings. sigma: (k,).
        corrects: for each of the k, the key of vessel.yaml that it is added to, in its unit; none for what was surveyed.
        own: which of the k this sensor's measurements have, where it shares it with other sensors; none: all.
        of_another: how many, from the first on, another sensor has too, which says them.
    """

    name: str
    sigma: Array
    corrects: tuple[str, ...] = ()
    own: tuple[int, ...] = ()
    of_another: int = 0

    @property
    def settings(self) -> list[tuple[int, str]]:
        """Number and key of each setting of this sensor that it corrects."""
        return [(n, key) for n, key in enumerate(self.corrects) if not self.own or n in self.own]

    def widened(self, value: Array) -> Array:
        """Return the sigmas (k,) of its prior re-weighted at an estimate (k,): it has the tails of Student's t.

        With a Gaussian one, a tag that was surveyed 0.5 m wrong pulls two good ones along (error at the berth 0.5 m; 0.05 m with tails).
        """
        return self.sigma * np.sqrt(1.0 + self._squares(value) / CONSTANT_TAILS)

    def cost(self, value: Array) -> float:
        """Return -log of how probable a value (k,) is, but for a constant."""
        squares = self._squares(value)
        together = ~self._alone
        costs = np.append(squares[~together], squares[together][:1])
        return 0.5 * CONSTANT_TAILS * float(np.log1p(costs / CONSTANT_TAILS).sum())

    @property
    def _alone(self) -> NDArray[np.bool_]:
        """Which of the k have tails of their own: that an antenna sits far off says nothing of a delay."""
        return np.array([key == TIME_OFFSET for key in self.corrects] or [False] * len(self.sigma))

    def _squares(self, value: Array) -> Array:
        squares, alone = (value / self.sigma) ** 2, self._alone
        return np.where(alone, squares, squares[~alone].sum())


def corrections(solved: Iterable[tuple[Constant, Array]], mount: Any) -> dict[str, float]:
    """Return what the estimate of a sensor's constants adds to its settings, by their keys; a place is turned into the axes of its mount (gtsam.Pose3)."""
    found = {key: float(value[n]) for constant, value in solved for n, key in constant.settings}
    if PLACE[0] in found:
        off_m = mount.rotation().matrix() @ np.array([found[key] for key in PLACE])
        found |= zip(PLACE, off_m.tolist(), strict=True)
    return found


def antenna_off_m(corrected: Mapping[str, float]) -> Array | None:
    """Return how far from where it is taken to sit an antenna is (3,), m, body axes; None where that is not estimated."""
    return np.array([corrected[key] for key in PLACE]) if PLACE[0] in corrected else None


@dataclass(frozen=True, slots=True, kw_only=True)
class FalseModel:
    """What a sensor's false measurements look like.

    Attributes:
        probability: that a measurement is false. cov: (k, k) of a false residual, around the truth.
        repeats: probability that a false one that follows a false one repeats its error (a moored boat
            taken for another one is so again in the next scan).
        news: share of its evidence for right or false that is independent of the measurement before it.
    """

    probability: float
    cov: Array
    repeats: float
    news: float = 1.0


def _unknown() -> Array:
    return np.full(3, np.nan)


@dataclass(frozen=True, slots=True, kw_only=True)
class Hint:
    """What a measurement says of the body by itself, before there is an estimate. NaN: nothing.

    Attributes:
        p_world_m, p_sigma_m: (3,) place, lever arms aside. v_world_mps: (3,) velocity.
        yaw_rad, yaw_sigma_rad: heading, from east, counter-clockwise.
    """

    p_world_m: Array = field(default_factory=_unknown)
    p_sigma_m: Array = field(default_factory=_unknown)
    v_world_mps: Array = field(default_factory=_unknown)
    yaw_rad: float = math.nan
    yaw_sigma_rad: float = math.nan


@dataclass(frozen=True, slots=True, kw_only=True)
class Sensor:
    """One row of the table of sensors.

    Attributes:
        kind: what `kind:` in vessel.yaml says.
        measurement, config: their classes.
        residuals: all hypotheses of a measurement at the current estimate.
        ideal: the noise-free measurement that a state would give (used by conformance tests).
        hint: what a measurement says at the start; takes it, the mount's yaw (rad) and the datum.
        slow: the slow state that a config asks for.
        factors: factors of the chosen hypothesis; None: the linear one of its residual is its factor (`graphloc.linear`).
        false: the hypothesis that a measurement is false; None: the sensor has no such hypothesis
            and is guarded by its kernel alone.
        constants: that a config's measurements may share.
        scaled: keys of its configuration that scale the sigmas of a measurement, and the axes (of k) that each scales.
        describe: what of a measurement its row of the ledger should say.
        berths: places that its slow state moves, and that the vessel is seen from.
        synthetic: measurements made from the configuration over the run's stamps (no topic).
        one_likelihood: the modes are maxima of one likelihood, which is the factor of each: doubt between them takes
            no weight from it.
        absolute: whether it says something about position (for health).
        company: whether it can tell another sensor's slow error from motion.
        in_world: whether it is given in world coordinates, so that the datum must be known.
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

    def of(self, config: SensorConfig) -> Sensor:
        """Return the row of a sensor that is configured so: poses of height or heading alone are no positions, and no company."""
        return self if config.tells_place else replace(self, absolute=False, company=False)


class InertialRow(Protocol):
    """The row of the inertial sensor: it links states instead of measuring one."""

    kind: str

    @property
    def config(self) -> type[SensorConfig]:
        """The class of its configuration."""
        ...

    def link(
        self, imu: ImuSeries, config: Any, R_body_imu: Array, gravity_mps2: float, noise_scale: float = 1.0
    ) -> InertialLink:
        """Return the links that one IMU gives, its noise densities scaled."""
        ...


class Going(NamedTuple):
    """What goes on where the inertial sensor is silent: its bias, and the velocity (3,), m/s, along the body's axes."""

    bias: Any
    v_body_mps: Array

    @classmethod
    def of(cls, state: Any, bias: Any) -> Going:
        """What goes on from a NavState."""
        return cls(bias, np.asarray(state.attitude().unrotate(state.velocity())))


class InertialLink(Protocol):
    """Preintegration of one IMU between any two stamps."""

    def integrate(self, start_ns: int, stop_ns: int, bias: Any, going: Going | None = None) -> Any:
        """Return the preintegrated measurement from `start_ns` to `stop_ns` (start < stop).

        Args:
            bias: about which it is linearised. going: what goes on in a hole of the data, which is linearised about its bias;
                without, `bias` and a vessel at rest.
        """
        ...

    def extend(self, stamps_ns: NDArray[np.int64], samples: Array) -> None:
        """Add samples (N, 6), late ones among them: specific force, m/s^2, and rate, rad/s, in IMU axes."""
        ...

    def leave_out(self, after_ns: int, until_ns: int) -> None:
        """Treat an interval as a gap, however short: its samples are dropped, and those that are added later are after it."""
        ...

    def pause(self, after_ns: int, until_ns: int) -> None:
        """Allow for no time having passed between two samples, however near to each other: a clock may have been set."""
        ...

    def forget(self, before_ns: int) -> None:
        """Drop the samples before a stamp, but for the last of them."""
        ...

    def factor(self, k: int, j: int, preintegrated: Any) -> Any:
        """Return the factor between states `k` and `k + 1` with the bias of slow node `j`."""
        ...

    def gyro_at(self, stamps_ns: NDArray[np.int64]) -> Array:
        """Return the raw angular rates (M, 3) in body axes at M stamps."""
        ...

    def gyro_variance_at(self, stamps_ns: NDArray[np.int64]) -> Array:
        """Return the variances (M,), each axis, rad^2/s^2, of what `gyro_at` gives, biases aside."""
        ...

    def felt_at(self, stamps_ns: NDArray[np.int64]) -> Array:
        """Return specific force and change of the rate (M, 6) about M stamps, body axes, m/s^2 and rad/s^2; means, so that a hull may vibrate."""
        ...

    @property
    def gravity_mps2(self) -> Array:
        """What is to be added to a specific force (3,), world axes, m/s^2; zero where the driver has done so."""
        ...

    def bias_steps(self, from_ns: int, to_ns: int) -> Array:
        """Return the sigmas (6,) of how far the bias goes from one stamp to another, accelerometer first."""
        ...

    def bias_sigmas(self) -> Array:
        """Return the turn-on sigmas (6,), accelerometer first."""
        ...

    def gaps(self) -> list[tuple[int, int]]:
        """Return the holes in the data as (start, stop) stamps in ns."""
        ...
