# SPDX-License-Identifier: Apache-2.0
"""The factors and values of a stretch of a problem."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import gtsam
import numpy as np

from graphloc import keys
from graphloc.build._attach import constants_of
from graphloc.build._chains import after_step, at_level, bias_step, slow_begin, slow_end, slow_step
from graphloc.build._problem import Problem, Stream
from graphloc.frames import Array, skew
from graphloc.graph import Attachment, Decision, GraphUpdate, Residual, SlowProcess
from graphloc.linear import factors_of


@dataclass(frozen=True, slots=True, kw_only=True)
class Level:
    """Levelling: the vertical, from the mean specific force over some time in axes propagated by the gyroscope.

    It depends on the biases, so its factor has them, too. When it was a prior on roll and pitch alone, a levelling that
    was 20 mrad off bent the accelerometer bias by 30 mm/s^2 for a minute: the run determines tilt minus bias to 2 mrad,
    but each of them only after the vessel has turned.

    Attributes:
        up: (3,) unit vector upwards, body axes at the first state, with the biases `bias`.
        by_bias: (3, 6) derivative of `up` by the biases. bias: (6,), accelerometer first.
        sigma_rad: sigma of roll and pitch, at the true biases.
    """

    up: Array
    by_bias: Array
    bias: Array
    sigma_rad: float

    def turned(self, turn: Array) -> Level:
        """Return the levelling by an IMU whose mount is turned by a rotation (3, 3), body axes."""
        return replace(self, up=turn @ self.up, by_bias=turn @ self.by_bias)

    def error(self, R: Array, bias: Array) -> tuple[Array, Array, Array]:
        """Return the horizontal part (2,) of `up` in world, in sigmas, and its Jacobians.

        Args:
            R: (3, 3), body in world. bias: (6,), accelerometer first.

        Returns:
            Error (2,), Jacobian (2, 3) by the body tangent of the attitude, Jacobian (2, 6) by the bias.
        """
        up = self.up + self.by_bias @ (bias - self.bias)
        horizontal = R[:2] / self.sigma_rad
        return horizontal @ up, -horizontal @ skew(up), horizontal @ self.by_bias


@dataclass(frozen=True, slots=True, kw_only=True)
class StartPrior:
    """Gaussian prior on the first state of a stretch: pose, velocity and bias, independent but for `level`.

    Attributes:
        pose: gtsam.Pose3, body in world. pose_cov: (6, 6), body tangent, rotation first.
        velocity: (3,) m/s, world axes. velocity_cov: (3, 3).
        bias: gtsam.imuBias.ConstantBias. bias_cov: (6, 6), accelerometer first.
        level: levelling of roll and pitch, which ties them to the bias (their part of `pose_cov` is wide then); None:
            no such factor.
        slow: value (k,) and covariance (k, k) of slow states, by sensor number. A slow state that is not in it has the
            prior of its process.
    """

    pose: Any
    pose_cov: Array
    velocity: Array
    velocity_cov: Array
    bias: Any
    bias_cov: Array
    level: Level | None = None
    slow: Mapping[int, tuple[Array, Array]] = field(default_factory=dict)

    def with_imu_turned(self, turn_rad: Array) -> StartPrior:
        """Return the prior levelled by an IMU whose mount is turned by a small rotation (3,), rad, body axes."""
        if self.level is None:
            return self
        return replace(self, level=self.level.turned(gtsam.Rot3.Expmap(turn_rad).matrix()))


@dataclass(frozen=True, slots=True, kw_only=True)
class Past:
    """All data before a stretch, as a joint prior on its first state, its slow states and constants.

    It is joint because position and slow error of a receiver may each be hardly known, but their sum well.

    Attributes:
        factors: linear factors. known: the keys that they have.
    """

    factors: gtsam.NonlinearFactorGraph
    known: Collection[int]


@dataclass(slots=True, eq=False)
class Decided:
    """How a measurement enters graphs.

    Attributes:
        decision: mode, weight and loss. at: its attachment.
        residual: of the mode of `decision`, at the attachment; None: not computed yet.
    """

    decision: Decision
    at: Attachment
    residual: Residual | None = None
    _update: GraphUpdate | None = field(init=False, default=None)

    def update(self, stream: Stream, i: int) -> GraphUpdate:
        """Return the factors of measurement `i`. They are made once, because several graphs may have them."""
        if self._update is None:
            m, config = stream.measurements[i], stream.config
            self._update = factors_of(stream.row, m, config, self.at, self.decision, self.residual)
        return self._update


Made = dict[tuple[int, int], range]
"""By (stream number, measurement index): the range of the measurement's factors in a graph."""
# By (stream number, measurement index). A measurement that is missing, or whose value is None, is left out of the
# graph.
Decisions = Mapping[tuple[int, int], Decided | None]


def build_graph(
    problem: Problem,
    values: gtsam.Values,
    decisions: Decisions,
    first: int,
    last: int,
    prior: StartPrior | Past,
    *,
    jumps: bool = True,
    made: Made | None = None,
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Return the graph of states first..last (inclusive), and the values of its keys.

    Args:
        values: the estimate at which factors that depend on it are built. decisions: on the measurements.
        prior: on the first state.
        jumps: whether slow states may jump where their process allows it. Not while the estimate may be far off: a GNSS
            error that may jump explains a dead-reckoned track that is 300 m off at less cost than correcting the track.
        made: filled with the range of factors of each measurement in the graph. The factors between states come before
            them.
    """
    graph, guess = gtsam.NonlinearFactorGraph(), values.extract(state_keys(problem, first, last))
    for k in range(first, last):
        graph.add(problem.inertial[k])
    nodes = nodes_of(problem, first, last)
    for j in nodes[:-1]:
        from_ns, to_ns = problem.timeline.slow_stamps_ns[j : j + 2]
        graph.add(bias_step(problem.links, j, int(from_ns), int(to_ns)))
    if problem.usual_motion is not None:
        for factor in problem.usual_motion.factors(problem.timeline, values, nodes, first):
            graph.add(factor)
    if isinstance(prior, Past):
        graph.push_back(prior.factors)
    else:
        _add_start(graph, values, prior, first, nodes[0])
    for stream in problem.streams:
        if stream.slow is not None:
            _add_slow_chain(graph, problem, stream, stream.slow, values, nodes, prior, jumps)
        _add_measurements(graph, guess, stream, stream.between(first, last), decisions, made)
        _add_constants(graph, guess, stream, values, prior)
    return graph, guess


def _add_measurements(
    graph: gtsam.NonlinearFactorGraph,
    guess: gtsam.Values,
    stream: Stream,
    indices: Iterable[int],
    decisions: Decisions,
    made: Made | None,
) -> None:
    """Add the factors of measurements of a stream, and the values of their leaves."""
    for i in indices:
        decided = decisions.get((stream.number, i))
        if decided is None:
            continue
        at = decided.at
        if at.slow_next is not None and not guess.exists(at.slow_next[0]):  # it is beyond the stretch
            decided = Decided(decided.decision, replace(at, slow_next=None))
        update = decided.update(stream, i)
        if made is not None:
            made[(stream.number, i)] = range(graph.size(), graph.size() + len(update.factors))
        for factor in update.factors:
            graph.add(factor)
        for key, value in update.guesses:
            guess.insert(key, value)


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


def cost_of_constants(problem: Problem, values: gtsam.Values, known: Collection[int]) -> float:
    """Return -log of the probability of the constants in `values`, up to an additive constant.

    Args:
        known: keys of constants that do not count.
    """
    cost, seen = 0.0, set(known)
    for stream in problem.streams:
        for (key, value), constant in zip(constants_of(stream, values), stream.constants, strict=True):
            if key not in seen:
                seen.add(key)
                cost += constant.cost(value)
    return cost


def _add_constants(
    graph: gtsam.NonlinearFactorGraph,
    guess: gtsam.Values,
    stream: Stream,
    values: gtsam.Values,
    prior: StartPrior | Past,
) -> None:
    """Add the constants that factors of this stretch have, each with its prior, re-weighted at the estimate.

    A constant that a `Past` knows has its prior there.
    """
    used = set(graph.keyVector()) if stream.constants else set()
    for (key, known), constant in zip(constants_of(stream, values), stream.constants, strict=True):
        if key in used and not guess.exists(key):  # two sensors may share a constant
            guess.insert(key, known)
            if isinstance(prior, Past) and key in prior.known:
                continue
            model = gtsam.noiseModel.Diagonal.Sigmas(constant.widened(known))
            graph.add(gtsam.PriorFactorVector(key, np.zeros(len(constant.sigma)), model))


@lru_cache(maxsize=1 << 14)
def _step(
    slow: SlowProcess, key: int, following: int, dt_s: float, jumps: bool, far: bool, jump: float, anew: bool
) -> tuple[Any, ...]:
    """Return the factors of a step of a slow state (`slow_step`).

    They do not depend on the estimate, so they are made once and shared by all graphs.
    """
    return tuple(slow_step(slow, key, following, dt_s, jumps=jumps, far=far, jump=jump, anew=anew))


def _jumps_of(problem: Problem, stream: Stream) -> dict[int, float]:
    """Return, by slow node, the size (m, rad) of the jump or step in the measurements from there to the next node.

    It is somewhere between the last measurement before it and the first after it, or where it is over, so each step
    between these has its size.
    """
    found: dict[int, float] = {}
    jumps = ((at_ns, at_ns, size_m) for at_ns, size_m in zip(*stream.position_jumps, strict=True))
    seen = [*jumps, *((step.after_ns, step.until_ns, abs(step.size_rad)) for step in stream.heading_steps)]
    if not seen or not stream.measurements:
        return found
    nodes_ns = problem.timeline.slow_stamps_ns
    stamps_ns = [m.stamp_ns for m in stream.measurements]
    for at_ns, until_ns, size in seen:
        before_ns = stamps_ns[max(int(np.searchsorted(stamps_ns, at_ns)) - 1, 0)]
        first, last = np.searchsorted(nodes_ns, [before_ns, until_ns], side="right") - 1
        found |= dict.fromkeys(range(int(first), int(last) + 1), float(size))
    return found


def _node_dt_s(problem: Problem, j: int) -> float:
    stamps = problem.timeline.slow_stamps_ns
    return float((stamps[j + 1] - stamps[j]) * 1e-9)


def _add_start(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, prior: StartPrior, first: int, node: int
) -> None:
    gaussian = gtsam.noiseModel.Gaussian.Covariance
    graph.add(gtsam.PriorFactorPose3(keys.pose(first), prior.pose, gaussian(prior.pose_cov)))
    graph.add(gtsam.PriorFactorVector(keys.velocity(first), prior.velocity, gaussian(prior.velocity_cov)))
    graph.add(gtsam.PriorFactorConstantBias(keys.bias(node), prior.bias, gaussian(prior.bias_cov)))
    if prior.level is not None:
        pose, bias = values.atPose3(keys.pose(first)), values.atConstantBias(keys.bias(node))
        error, by_turn, by_bias = prior.level.error(pose.rotation().matrix(), bias.vector())
        point = gtsam.Values()
        point.insert(keys.pose(first), pose)
        point.insert(keys.bias(node), bias)
        by_pose = np.hstack([by_turn, np.zeros((2, 3))])
        linear = gtsam.JacobianFactor(
            keys.pose(first), by_pose, keys.bias(node), by_bias, -error, gtsam.noiseModel.Unit.Create(2)
        )
        graph.add(gtsam.LinearContainerFactor(linear, point))


def _add_slow_chain(
    graph: gtsam.NonlinearFactorGraph,
    problem: Problem,
    stream: Stream,
    slow: SlowProcess,
    values: gtsam.Values,
    nodes: range,
    prior: StartPrior | Past,
    jumps: bool,
) -> None:
    key = [keys.slow(stream.number, j) for j in nodes]
    dt_s = [_node_dt_s(problem, j) for j in nodes[:-1]]
    far = stream.usual is None
    if isinstance(prior, StartPrior):
        if (given := prior.slow.get(stream.number)) is not None:
            graph.add(gtsam.PriorFactorVector(key[0], given[0], gtsam.noiseModel.Gaussian.Covariance(given[1])))
        else:
            for factor in slow_begin(slow, key[0], values.atVector(key[0]), jumps=jumps, far=far):
                graph.add(factor)
    sizes, anew = _jumps_of(problem, stream), np.isin(nodes[:-1], stream.anew)
    for n, j in enumerate(nodes[:-1]):
        for factor in _step(slow, key[n], key[n + 1], dt_s[n], jumps, far, sizes.get(j, 0.0), bool(anew[n])):
            graph.add(factor)
        if j in sizes and j + 1 not in sizes and slow.stepped:
            for factor in after_step(slow, key[n + 1], values.atVector(key[n + 1])):
                graph.add(factor)
    for factor in slow_end(slow, key[-1], jumps=jumps, far=far):
        graph.add(factor)
    if stream.usual is not None:
        for factor in at_level(slow, key, np.array(dt_s), stream.usual[nodes.start : nodes.stop], anew):
            graph.add(factor)
