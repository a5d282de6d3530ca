# SPDX-License-Identifier: Apache-2.0
"""From a recording to the graph of any stretch of it.

A `Problem` holds what does not change while solving: timeline, preintegrated links, and per sensor a
`Stream` of measurements with the state that each attaches to. `build_graph` turns a stretch of it into
factors, at the current estimate and with the current decisions. It knows sensors only as rows.

The states stand where the IMU stands, with the axes of the body: inertial data then need no lever arm,
whose Euler term GTSAM's preintegration leaves out. Every other mount is taken from there, and the
solution is moved to the body's origin at the end (`graphloc.solve`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, Protocol

import gtsam
import numpy as np
from numpy.typing import NDArray

from graphloc import keys
from graphloc.config import KernelConfig, SensorConfig, VesselConfig
from graphloc.errors import SolveError
from graphloc.frames import Array, Datum
from graphloc.graph import Attachment, Constant, Decision, InertialLink, InertialRow, Sensor, SlowProcess
from graphloc.ledger import LedgerRow, Outcome
from graphloc.measurements import ImuSeries, Measurement
from graphloc.recording import Recording
from graphloc.time import utc_text
from graphloc.timeline import Timeline, make_timeline

# A step of a slow state is believed to be a jump beyond this many sigmas.
JUMP = KernelConfig(kind="cauchy", scale=2.0)
CONSTANT_TAILS = 9.0  # of a constant's prior: squared sigmas that double its variance
_NOTHING = 1e6  # sigmas: a prior that says nothing
CHAIN_END = 2.0  # times its variance: the prior at either end of a slow chain


@dataclass(frozen=True, slots=True, eq=False)
class Stream:
    """The measurements of one sensor and where they attach.

    Attributes:
        number: of the sensor, for keys. name, row, config: the sensor.
        slow: its slow state, or None. left_out: the slow state that it would have in company.
        constants: what its measurements may share.
        mount: pose of the sensor from the IMU's place, body axes.
        measurements: M of them by stamp. state: (M,) nearest state. carry: per measurement the
            preintegrated motion from the state before it, or None where it stands on a state.
        gyro_radps: (M, 3) raw rate at each measurement, body axes.
        sparse: (M,) true for the first measurement at each slow node.
    """

    number: int
    name: str
    row: Sensor
    config: SensorConfig
    slow: SlowProcess | None
    left_out: SlowProcess | None
    constants: tuple[Constant, ...]
    mount: Any
    measurements: tuple[Measurement, ...]
    state: NDArray[np.int64]
    carry: tuple[tuple[int, Any] | None, ...]
    gyro_radps: Array
    sparse: NDArray[np.bool_]

    def between(self, first: int, last: int) -> range:
        """Indices of the measurements that attach to states first..last (inclusive)."""
        lo, hi = np.searchsorted(self.state, [first, last + 1])
        return range(int(lo), int(hi))


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """A run, ready to be solved.

    `preintegrated` and `inertial` have the motion from each state to the next, and the factor of it: neither depends on
    the estimate, so every graph shares them.
    """

    config: VesselConfig
    datum: Datum
    timeline: Timeline
    imu: ImuSeries
    t_body_imu_m: Array
    R_body_imu: Array
    relink: Callable[[float], InertialLink]
    links: InertialLink
    noise_scale: float
    preintegrated: tuple[Any, ...]
    inertial: tuple[Any, ...]
    streams: tuple[Stream, ...]
    rejected: tuple[LedgerRow, ...]
    warnings: tuple[str, ...] = field(default=())


Mounts = Mapping[str, tuple[Array, Array]]  # by sensor, from /tf_static: t (3,), R (3, 3) in body


def mount_of(name: str, config: SensorConfig, mounts: Mounts) -> tuple[Array, Array]:
    """Return (t (3,), R (3, 3)) of a sensor in body: from /tf_static where it was asked for."""
    return mounts.get(name) or (config.mount.t_body_sensor_m, config.mount.R_body_sensor)


def company_of(config: VesselConfig, rows: Sequence[Sensor], seen: Container[str] | None = None) -> int:
    """Return how many of the sensors (of those in `seen`, if given) can tell each other's slow errors from motion."""
    able = (name for row in rows if row.company for name in config.of_kind(row.kind))
    return sum(seen is None or name in seen for name in able)


def make_problem(
    recording: Recording,
    config: VesselConfig,
    datum: Datum,
    rows: Sequence[Sensor],
    inertial: InertialRow,
    company: int | None = None,
) -> Problem:
    """Lay out the timeline, preintegrate, and attach every measurement.

    `company`: how many sensors can tell each other's slow errors from motion; by default those that the recording has.

    Raises:
        SolveError: the recording has no usable IMU data.
    """
    imu = recording.imu
    if not any(sensor.kind == inertial.kind and sensor.enabled for sensor in config.sensors.values()):
        raise SolveError(
            f"{recording.source}: no enabled sensor of kind {inertial.kind} in vessel.yaml, and it needs one"
        )
    if imu is None or len(imu) < 10:
        lost = recording.lost(config.of_kind(inertial.kind))
        raise SolveError(
            f"{recording.source}: no IMU data (need at least 10 samples); check its topic and stamps{lost}"
        )
    imu_config = config.sensors[imu.sensor]
    t_body_imu, R = mount_of(imu.sensor, imu_config, recording.mounts)

    def relink(noise_scale: float) -> InertialLink:
        return inertial.link(imu, imu_config, R, datum.gravity_mps2, noise_scale)

    links = relink(1.0)
    by_kind = {row.kind: row for row in rows}
    inside, rejected, warnings = _sorted_out(recording, config, set(by_kind), imu)
    start, stop = int(imu.stamps_ns[0]), int(imu.stamps_ns[-1])
    timeline = make_timeline(start, stop, inside, config.timeline)
    by_sensor: dict[str, list[Measurement]] = {}
    for m in inside:
        by_sensor.setdefault(m.sensor, []).append(m)
    if company is None:
        company = company_of(config, rows, by_sensor)
    streams = []
    for number, (name, sensor) in enumerate(config.sensors.items()):
        if name in by_sensor:
            row = by_kind[sensor.kind]
            t, R_mount = mount_of(name, sensor, recording.mounts)
            mount = (t - t_body_imu, R_mount)
            slow = row.slow(sensor)
            left_out = slow if slow is not None and slow.needs_company and company < 2 else None
            slow = slow if left_out is None else None
            streams.append(_stream(number, name, row, sensor, slow, left_out, mount, by_sensor[name], timeline, links))
    preintegrated = _preintegrate(timeline, links)
    warnings += [f"IMU gap of {(b - a) / 1e9:.1f} s: bridged with unknown motion" for a, b in links.gaps()]
    return Problem(
        config=config,
        datum=datum,
        timeline=timeline,
        imu=imu,
        t_body_imu_m=t_body_imu,
        R_body_imu=R,
        relink=relink,
        links=links,
        noise_scale=1.0,
        preintegrated=preintegrated,
        inertial=_inertial(timeline, links, preintegrated),
        streams=tuple(streams),
        rejected=tuple(rejected),
        warnings=tuple(warnings),
    )


def _sorted_out(
    recording: Recording, config: VesselConfig, kinds: Container[str], imu: ImuSeries
) -> tuple[list[Measurement], list[LedgerRow], list[str]]:
    """Return the measurements that the graph can take, rows for the others, and warnings."""
    start, stop = int(imu.stamps_ns[0]), int(imu.stamps_ns[-1])
    asked_for = {name for name, sensor in config.sensors.items() if sensor.kind in kinds and sensor.enabled}
    inside, rows = [], []
    outside, every = Counter[str](), Counter[str]()
    for m in recording.measurements:
        every[m.sensor] += 1
        outcome, reason = Outcome.REJECTED, "no IMU data at this stamp"
        if m.sensor not in asked_for:
            outcome, reason = Outcome.IGNORED, "its sensor is switched off or not in the configuration"
        elif start <= m.stamp_ns <= stop:
            inside.append(m)
            continue
        else:
            outside[m.sensor] += 1
        if m.seq < 0:  # configuration, not a message
            outside[m.sensor] = 0
            continue
        topic = recording.topics.get(m.sensor, "")
        rows.append(
            LedgerRow(seq=m.seq, stamp_ns=m.stamp_ns, sensor=m.sensor, topic=topic, outcome=outcome, reason=reason)
        )
    span = f"{utc_text(start)} to {utc_text(stop)}"
    warnings = [
        f"{name}: {n} of {every[name]} measurements lie outside the IMU's span ({span}): no track there"
        for name, n in outside.items()
        if n > 0.02 * every[name] and n > 5
    ]
    return inside, rows, warnings


def _preintegrate(timeline: Timeline, links: InertialLink) -> tuple[Any, ...]:
    zero = gtsam.imuBias.ConstantBias()
    stamps = [int(s) for s in timeline.stamps_ns]
    return tuple(links.integrate(a, b, zero) for a, b in pairwise(stamps))


def _inertial(timeline: Timeline, links: InertialLink, preintegrated: Sequence[Any]) -> tuple[Any, ...]:
    return tuple(links.factor(k, int(timeline.slow_of[k]), pim) for k, pim in enumerate(preintegrated))


def with_noise_scale(problem: Problem, noise_scale: float) -> Problem:
    """Return the problem with the IMU's noise densities scaled."""
    links = problem.relink(noise_scale)
    preintegrated = _preintegrate(problem.timeline, links)
    return replace(
        problem, links=links, noise_scale=noise_scale, preintegrated=preintegrated,
        inertial=_inertial(problem.timeline, links, preintegrated),
    )  # fmt: skip


def _stream(
    number: int,
    name: str,
    row: Sensor,
    config: SensorConfig,
    slow: SlowProcess | None,
    left_out: SlowProcess | None,
    mount: tuple[Array, Array],
    measurements: list[Measurement],
    timeline: Timeline,
    links: InertialLink,
) -> Stream:
    zero = gtsam.imuBias.ConstantBias()
    state, carry = [], []
    for m in measurements:
        floor = timeline.floor(m.stamp_ns)
        state.append(timeline.nearest(m.stamp_ns))
        at = int(timeline.stamps_ns[floor])
        carry.append(None if m.stamp_ns <= at else (floor, links.integrate(at, m.stamp_ns, zero)))
    T_state_sensor = gtsam.Pose3(gtsam.Rot3(mount[1]), mount[0])
    return Stream(
        number,
        name,
        row,
        config,
        slow,
        left_out,
        row.constants(config),
        T_state_sensor,
        tuple(measurements),
        np.array(state, dtype=np.int64),
        tuple(carry),
        links.gyro_at(np.array([m.stamp_ns for m in measurements])),
        np.diff(timeline.slow_of[state], prepend=-1) > 0,
    )


Carry = tuple[int, Any]
"""A state, and the motion preintegrated from there."""


class OnTimeline(Protocol):
    """What `attach` needs to know of a timeline (`Timeline`, or a live one)."""

    @property
    def slow_of(self) -> Any:
        """Slow node of each state."""
        ...

    @property
    def slow_stamps_ns(self) -> Any:
        """Stamp of each slow node."""
        ...


class Sited(Protocol):
    """What `attach` needs to know of a problem."""

    @property
    def timeline(self) -> OnTimeline:
        """Where the states stand."""
        ...

    @property
    def R_body_imu(self) -> Array:
        """The IMU's axes."""
        ...

    @property
    def datum(self) -> Datum:
        """Origin of world."""
        ...


class Attaching(Protocol):
    """What `attach` needs to know of a stream (`Stream`, or a live one)."""

    @property
    def number(self) -> int:
        """Of the sensor, for keys."""
        ...

    @property
    def mount(self) -> Any:
        """Pose of the sensor from the IMU's place."""
        ...

    @property
    def slow(self) -> SlowProcess | None:
        """Its slow state."""
        ...

    @property
    def constants(self) -> tuple[Constant, ...]:
        """What its measurements may share."""
        ...

    @property
    def measurements(self) -> Any:
        """By index."""
        ...

    @property
    def state(self) -> Any:
        """State of each."""
        ...

    @property
    def carry(self) -> Any:
        """Motion to each from the state before it."""
        ...

    @property
    def gyro_radps(self) -> Any:
        """Raw rate at each."""
        ...


class Judged(Attaching, Protocol):
    """What judging needs to know of a stream."""

    @property
    def name(self) -> str:
        """Of the sensor."""
        ...

    @property
    def row(self) -> Sensor:
        """Of the table."""
        ...

    @property
    def config(self) -> Any:
        """Of the sensor."""
        ...


def nav_state(values: gtsam.Values, k: int) -> Any:
    """Return the NavState of state k."""
    return gtsam.NavState(values.atPose3(keys.pose(k)), values.atVector(keys.velocity(k)))


def attach(problem: Sited, stream: Attaching, i: int, values: gtsam.Values) -> Attachment:
    """Return how measurement `i` of a stream meets the graph at the current estimate."""
    k = int(stream.state[i])
    j = int(problem.timeline.slow_of[k])
    T = values.atPose3(keys.pose(k))
    v = values.atVector(keys.velocity(k))
    bias = values.atConstantBias(keys.bias(j))
    T_state_sensor, dv = stream.mount, np.zeros(3)
    carried = stream.carry[i]
    if carried is not None:
        floor, pim = carried
        there = pim.predict(nav_state(values, floor), bias)
        T_state_sensor = T.between(there.pose()).compose(stream.mount)
        dv = np.asarray(there.velocity()) - v
    slow_key = None if stream.slow is None else keys.slow(stream.number, j)
    return Attachment(
        pose_key=keys.pose(k),
        velocity_key=keys.velocity(k),
        slow_key=slow_key,
        leaf_keys=keys.leaves(stream.number * 100_000_000 + i),
        T_world_body=T,
        v_world_mps=v,
        T_state_sensor=T_state_sensor,
        dv_world_mps=dv,
        gyro_radps=stream.gyro_radps[i] - problem.R_body_imu @ bias.gyroscope(),
        lever_m=np.asarray(stream.mount.translation()),
        slow_value=None if slow_key is None else np.atleast_1d(values.atVector(slow_key)),
        datum=problem.datum,
        slow_next=None if slow_key is None else _next_slow(problem, stream, j, stream.measurements[i].stamp_ns, values),
        constants=_constants(stream, values),
    )


def _next_slow(
    problem: Sited, stream: Attaching, j: int, stamp_ns: int, values: gtsam.Values
) -> tuple[int, Array, float, float] | None:
    stamps, key = problem.timeline.slow_stamps_ns, keys.slow(stream.number, j + 1)
    if j + 1 >= len(stamps) or not values.exists(key):
        return None
    apart = int(stamps[j + 1] - stamps[j])
    share = min(max((stamp_ns - int(stamps[j])) / apart, 0.0), 1.0)
    return key, np.atleast_1d(values.atVector(key)), share, apart * 1e-9


def _constants(stream: Attaching, values: gtsam.Values) -> tuple[tuple[int, Array], ...]:
    """Keys and estimates; what no factor had yet is zero."""
    return tuple(
        (key, np.atleast_1d(values.atVector(key)) if values.exists(key) else np.zeros(len(constant.sigma)))
        for key, constant in zip(constant_keys(stream), stream.constants, strict=True)
    )


def constant_keys(stream: Attaching) -> list[int]:
    """Return the keys of a sensor's constants."""
    return [keys.constant(stream.number, k) for k in range(len(stream.constants))]


@dataclass(frozen=True, slots=True, kw_only=True)
class StartPrior:
    """Gaussian prior on the first state of a stretch (block-diagonal; sigmas or covariances).

    Attributes:
        slow, constants: value and covariance, by the sensor's number and by key; those that are not there have the prior
            of their kind.
    """

    pose: Any
    pose_cov: Array
    velocity: Array
    velocity_cov: Array
    bias: Any
    bias_cov: Array
    slow: Mapping[int, tuple[Array, Array]] = field(default_factory=dict)
    constants: Mapping[int, tuple[Array, Array]] = field(default_factory=dict)


# What was decided about (stream number, measurement index), and where it attaches; without it, or None: left out.
Decisions = Mapping[tuple[int, int], tuple[Decision, Attachment] | None]


def build_graph(
    problem: Problem,
    values: gtsam.Values,
    decisions: Decisions,
    first: int,
    last: int,
    prior: StartPrior,
    *,
    jumps: bool = True,
    made: dict[tuple[int, int], range] | None = None,
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Return the graph of states first..last and the values of its keys.

    `made` is filled with where the factors of each measurement stand in the graph; those between states come first.

    `jumps` lets slow states jump where their process may. Not while the estimate is far off: a GNSS error
    that may jump explains a dead-reckoned track that is 300 m off better than the track's own correction.
    """
    graph, guess = gtsam.NonlinearFactorGraph(), values.extract(state_keys(problem, first, last))
    for k in range(first, last):
        graph.add(problem.inertial[k])
    nodes = nodes_of(problem, first, last)
    for j in nodes[:-1]:
        graph.add(bias_step(problem.links, j, _node_dt_s(problem, j)))
    _add_start(graph, prior, first, nodes[0])
    for stream in problem.streams:
        if stream.slow is not None:
            _add_slow_chain(graph, problem, stream, stream.slow, values, nodes, prior, jumps)
        for i in stream.between(first, last):
            decided = decisions.get((stream.number, i))
            if decided is None:
                continue
            decision, at = decided
            if at.slow_next is not None and not guess.exists(at.slow_next[0]):
                at = replace(at, slow_next=None)  # the next node lies beyond the stretch
            update = stream.row.factors(stream.measurements[i], stream.config, at, decision)
            if made is not None:
                made[(stream.number, i)] = range(graph.size(), graph.size() + len(update.factors))
            for factor in update.factors:
                graph.add(factor)
            for key, value in update.guesses:
                guess.insert(key, value)
        _add_constants(graph, guess, stream, values, prior)
    return graph, guess


def nodes_of(problem: Problem, first: int, last: int) -> range:
    """Return the slow nodes of states first..last."""
    slow_of = problem.timeline.slow_of
    return range(int(slow_of[first]), int(slow_of[last]) + 1)


def state_keys(problem: Problem, first: int, last: int) -> list[int]:
    """Return the keys of states first..last and of their slow nodes."""
    nodes = nodes_of(problem, first, last)
    names = [key(k) for key in (keys.pose, keys.velocity) for k in range(first, last + 1)]
    names += [keys.bias(j) for j in nodes]
    return names + [keys.slow(s.number, j) for s in problem.streams if s.slow is not None for j in nodes]


def _add_constants(
    graph: gtsam.NonlinearFactorGraph, guess: gtsam.Values, stream: Stream, values: gtsam.Values, prior: StartPrior
) -> None:
    """Those that a factor has, each with its prior: what is not seen in a stretch needs no state there.

    The prior has the tails of Student's t, re-weighted at every pass: under a Gaussian one, a tag that was surveyed 0.5 m
    off drags two good ones along (0.5 m off at the berth, 0.05 m with tails).
    """
    used = set(graph.keyVector()) if stream.constants else set()
    for (key, known), constant in zip(_constants(stream, values), stream.constants, strict=True):
        if key in used:
            guess.insert(key, known)
            value, cov = prior.constants.get(key, (np.zeros(len(constant.sigma)), np.diag(constant.sigma**2)))
            cov = cov * (1.0 + float(((known / constant.sigma) ** 2).sum()) / CONSTANT_TAILS)
            graph.add(gtsam.PriorFactorVector(key, value, gtsam.noiseModel.Gaussian.Covariance(cov)))


def _node_dt_s(problem: Problem, j: int) -> float:
    stamps = problem.timeline.slow_stamps_ns
    return float((stamps[j + 1] - stamps[j]) * 1e-9)


def bias_step(links: InertialLink, j: int, dt_s: float) -> Any:
    """Return the factor of the bias walk from slow node `j` to the next."""
    model = gtsam.noiseModel.Diagonal.Sigmas(links.bias_steps(dt_s))
    return gtsam.BetweenFactorConstantBias(keys.bias(j), keys.bias(j + 1), gtsam.imuBias.ConstantBias(), model)


def _add_start(graph: gtsam.NonlinearFactorGraph, prior: StartPrior, first: int, node: int) -> None:
    gaussian = gtsam.noiseModel.Gaussian.Covariance
    graph.add(gtsam.PriorFactorPose3(keys.pose(first), prior.pose, gaussian(prior.pose_cov)))
    graph.add(gtsam.PriorFactorVector(keys.velocity(first), prior.velocity, gaussian(prior.velocity_cov)))
    graph.add(gtsam.PriorFactorConstantBias(keys.bias(node), prior.bias, gaussian(prior.bias_cov)))


def _add_slow_chain(
    graph: gtsam.NonlinearFactorGraph,
    problem: Problem,
    stream: Stream,
    slow: SlowProcess,
    values: gtsam.Values,
    nodes: range,
    prior: StartPrior,
    jumps: bool,
) -> None:
    key = [keys.slow(stream.number, j) for j in nodes]
    given = prior.slow.get(stream.number)
    if given is not None:
        graph.add(gtsam.PriorFactorVector(key[0], given[0], gtsam.noiseModel.Gaussian.Covariance(given[1])))
    else:
        graph.add(slow_begin(slow, key[0], np.atleast_1d(values.atVector(key[0]))))
    for n, j in enumerate(nodes[:-1]):
        for factor in slow_step(slow, key[n], key[n + 1], _node_dt_s(problem, j), jumps=jumps):
            graph.add(factor)
    for factor in slow_end(slow, key[-1]):
        graph.add(factor)


# A slow state is a chain of first-order Gauss-Markov steps, from native factors. Its path measure,
# exp(-int x'^2/2q - int x^2/2p) with q = 2 s^2/T, p = 2 s^2 T, and x^2/4s^2 at both ends, is a random walk with a
# standing prior at each node: exact as the node period goes to 0, and the steps stay free for a robust loss (a
# `JacobianFactor` with the decay in it takes none).


def slow_begin(slow: SlowProcess, key: int, known: Array) -> Any:
    """Return the prior of a chain's first node; `known`: its estimate, for the tails of what is constant."""
    constant = ~np.isfinite(slow.time_constant_s)
    tails = float(
        np.sqrt(1.0 + float(((known / slow.sigma)[constant] ** 2).sum()) / CONSTANT_TAILS)
    )  # see `_add_constants`
    ends = slow.sigma * np.where(constant, tails, np.sqrt(CHAIN_END))
    return gtsam.PriorFactorVector(key, np.zeros(len(ends)), gtsam.noiseModel.Diagonal.Sigmas(ends))


def slow_step(slow: SlowProcess, key: int, following: int, dt_s: float, *, jumps: bool = True) -> Iterator[Any]:
    """Yield the factors of the step from one node to the next, `dt_s` later."""
    constant, zero = ~np.isfinite(slow.time_constant_s), np.zeros(len(slow.sigma))
    # A constant still gets a step of 1e-4 of its sigma: one key on every state would make the tree dense.
    step = slow.sigma * np.where(constant, 1e-4, np.sqrt(2.0 * dt_s / slow.time_constant_s))
    model: Any = gtsam.noiseModel.Diagonal.Sigmas(step)
    if slow.jumps and jumps:
        model = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Cauchy.Create(JUMP.scale), model)
    yield gtsam.BetweenFactorVector(key, following, zero, model)
    if not constant.all():
        standing = slow.sigma * np.where(constant, _NOTHING, np.sqrt(2.0 * slow.time_constant_s / dt_s))
        yield gtsam.PriorFactorVector(following, zero, gtsam.noiseModel.Diagonal.Sigmas(standing))


def slow_end(slow: SlowProcess, key: int) -> Iterator[Any]:
    """Yield what closes a chain at its last node."""
    constant = ~np.isfinite(slow.time_constant_s)
    if not constant.all():
        last = np.where(constant, _NOTHING, np.sqrt(CHAIN_END)) * slow.sigma
        yield gtsam.PriorFactorVector(key, np.zeros(len(last)), gtsam.noiseModel.Diagonal.Sigmas(last))
