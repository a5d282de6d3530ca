# SPDX-License-Identifier: Apache-2.0
"""The states of the window: each predicted by the IMU, biases and slow errors by their random walks."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from graphloc import keys
from graphloc.build import bias_step, closing_variance, nav_state, slow_begin, slow_end, slow_step
from graphloc.errors import SolveError
from graphloc.frames import Array
from graphloc.graph import TIME_OFFSET, Attachment, Residual
from graphloc.inertial import GapMotion, InertialLink
from graphloc.judge.health import FAR_OFF, why_off_mount
from graphloc.judge.prediction import Prediction, prediction_of
from graphloc.judge.warnings import late_far_off
from graphloc.motion_model import UNSURE_MPS, Moving
from graphloc.online._anchor import Anchor, in_world, without_priors
from graphloc.online._constants import Constants
from graphloc.online._live import LiveProblem, LiveStream
from graphloc.online._window import Held, Window
from graphloc.time import NS_PER_S

_HOLE_S = 1.0  # length of an IMU gap from which the motion model is not applied across it
# Change of the newest position that means divergence: no vessel moves so far, even in the longest gap that is bridged
_AWAY_M = 2e3


@dataclass(frozen=True, slots=True, eq=False)
class Newest:
    """The newest solved state; while further states are staged, it is not the last of the timeline.

    Attributes:
        number, stamp_ns: in the timeline. pose, velocity: at the IMU with the body's axes, in world: gtsam.Pose3 and
            (3,), m/s.
        bias: of the IMU. pose_cov: (6, 6), rotation first, in the body tangent. velocity_cov: (3, 3), in world.
        bias_cov: (6, 6), accelerometers first, in the IMU's axes.
    """

    number: int
    stamp_ns: int
    pose: gtsam.Pose3
    velocity: Array
    bias: gtsam.imuBias.ConstantBias
    pose_cov: Array
    velocity_cov: Array
    bias_cov: Array

    @property
    def unsure(self) -> bool:
        """Whether the horizontal velocity is so uncertain that the motion model is applied."""
        return float(np.linalg.eigvalsh(self.velocity_cov[:2, :2])[-1]) >= UNSURE_MPS**2


def hole_within(links: InertialLink, begin_ns: int, end_ns: int) -> bool:
    """Return whether the IMU is silent for long in an interval: it is then unknown how the body has turned."""
    return silent_within(links, begin_ns, end_ns, _HOLE_S)


def silent_within(links: InertialLink, begin_ns: int, end_ns: int, longer_s: float = 0.0) -> bool:
    """Return whether an interval overlaps a gap of the IMU, or one that is longer than so many seconds."""
    return any(a < end_ns and b > begin_ns and b - a > longer_s * NS_PER_S for a, b in links.gaps())


def propagated_covariance(cov: Array, newest: Newest, R: Array, dt_s: float, noise: Array) -> Array:
    """Return a covariance at the newest state, propagated by dt_s.

    Args:
        cov: (n, n), of the pose (body tangent, rotation first), then of states that do not change. newest: the state.
        R: (3, 3), body -> world after dt_s. noise: (9, 9) covariance of the IMU's preintegration over dt_s; large
            across a gap.
    """
    turn = np.eye(len(cov))
    turn[:3, :3] = turn[3:6, 3:6] = R.T @ newest.pose.rotation().matrix()
    later = turn @ cov @ turn.T
    later[3:6, 3:6] += dt_s**2 * R.T @ newest.velocity_cov @ R
    later[:6, :6] += noise[:6, :6]
    return np.asarray(later)


class States:
    """States from an anchor on, in a window.

    Args:
        problem, window: where the states are. constants: shared by measurements; part of every anchor.
        anchor: prior of the first state. guess: pose, velocity (3,) and bias (6,) that the first state is first solved
            at.

    Raises:
        SolveError: by every method; the window cannot be used afterwards.
    """

    def __init__(
        self,
        problem: LiveProblem,
        window: Window,
        constants: Constants,
        anchor: Anchor,
        guess: tuple[gtsam.Pose3, Array, Array],
    ) -> None:
        self._problem, self._window, self._constants = problem, window, constants
        # By sensor: the prior that closes its slow chain, and the value (k,) by which that prior weighs the constant
        # components.
        self._ends: dict[str, tuple[Held, Array]] = {}
        self._links: dict[int, Held] = {}  # IMU factors, by the state that each begins at
        state = (keys.pose(0), keys.velocity(0), keys.bias(0))
        pose, velocity, bias = guess
        window.guess(state[0], pose, 0.0)
        window.guess(state[1], velocity, 0.0)
        window.guess(state[2], gtsam.imuBias.ConstantBias(bias[:3], bias[3:]), 0.0)
        window.add(anchor.factors(*state))
        for stream in problem.streams.values():
            if stream.slow is not None:
                key, known = keys.slow(stream.number, 0), anchor.slow.get(stream.name)
                if known is not None and len(known.value) != len(stream.slow.sigma):
                    raise SolveError(f"{stream.name}: its slow error is of another size")
                value = np.zeros(len(stream.slow.sigma)) if known is None else known.value
                window.guess(key, value, 0.0)
                window.add(slow_begin(stream.slow, key, None)
                           if known is None else [anchor.conditional_factor(known, state, key)])  # fmt: skip
                self._ends[stream.name] = window.add(slow_end(stream.slow, key, value)), value
        constants.begin(anchor, state)
        window.commit()
        self._newest = self._read()

    @property
    def newest(self) -> Newest:
        return self._newest

    def read(self) -> None:
        """Read the newest state from the window after it has been solved.

        Raises:
            SolveError: the solver diverged.
        """
        newest = self._read()
        if np.linalg.norm(newest.pose.translation() - self._newest.pose.translation()) > _AWAY_M:
            raise SolveError("the solver diverged")
        self._newest = newest

    def _read(self) -> Newest:
        timeline, values = self._problem.timeline, self._window.values
        k = timeline.last
        newest = Newest(
            number=k,
            stamp_ns=timeline.stamps_ns[k],
            pose=values.atPose3(keys.pose(k)),
            velocity=np.asarray(values.atVector(keys.velocity(k))),
            bias=values.atConstantBias(keys.bias(timeline.slow_of[k])),
            pose_cov=self._window.covariance([keys.pose(k)]),
            velocity_cov=self._window.covariance([keys.velocity(k)]),
            bias_cov=self._window.covariance([keys.bias(timeline.slow_of[k])]),
        )
        arrays = (newest.pose.matrix(), newest.velocity, newest.bias.vector(), newest.pose_cov, newest.velocity_cov)
        if not all(np.isfinite(a).all() for a in arrays) or min(np.diagonal(newest.pose_cov)) <= 0.0:
            raise SolveError("the solver's result is not a number")
        return newest

    def grow(self, stamp_ns: int) -> bool:
        """Stage the next state, predicted by the IMU; return whether slow states got a new node: commit then."""
        timeline, window, links = self._problem.timeline, self._window, self._problem.links
        k, values = timeline.last, window.values
        j, before_ns = timeline.slow_of[k], timeline.stamps_ns[k]
        timeline.append(stamp_ns)
        following, t = timeline.slow_of[k + 1], timeline.page_s(stamp_ns)
        bias = values.atConstantBias(keys.bias(j))
        state = nav_state(values, k)
        pim = links.integrate(before_ns, stamp_ns, gtsam.imuBias.ConstantBias(), GapMotion.of(state, bias))
        there = pim.predict(state, bias)
        window.guess(keys.pose(k + 1), there.pose(), t)
        window.guess(keys.velocity(k + 1), np.asarray(there.velocity()), t)
        self._links[k] = window.add([links.factor(k, j, pim)])
        if following != j:
            from_ns, to_ns = int(timeline.slow_stamps_ns[j]), int(timeline.slow_stamps_ns[following])
            dt_s = (to_ns - from_ns) * 1e-9
            window.guess(keys.bias(following), bias, t)
            window.add([bias_step(links, j, from_ns, to_ns)])
            self._next_slow(j, dt_s, t)
            self._next_motion(j, dt_s)
        window.touch(keys.bias(following), t)
        for stream in self._problem.streams.values():
            if stream.slow is not None:
                window.touch(keys.slow(stream.number, following), t)
        return bool(following != j)

    def _next_motion(self, j: int, dt_s: float) -> None:
        """Learn the motion model, or, where the velocity is uncertain, stage its factors from slow node j to now."""
        problem, newest, timeline = self._problem, self._newest, self._problem.timeline
        if not newest.unsure:
            problem.motion_model.learn(newest.stamp_ns, (newest.pose.rotation().matrix().T @ newest.velocity)[:2])
            return
        begin_ns, end_ns = timeline.slow_stamps_ns[j], timeline.stamps_ns[timeline.last]
        if begin_ns < timeline.stamps_ns[timeline.first]:
            return
        if not hole_within(problem.links, begin_ns, end_ns):
            before, now = (Moving.of(self._window.values, k) for k in (timeline.floor(begin_ns), timeline.last))
            self._window.add(problem.motion_model.step(before, now, dt_s))

    def _next_slow(self, j: int, dt_s: float, t: float) -> None:
        window = self._window
        for stream in self._problem.streams.values():
            if stream.slow is None:
                continue
            key, following = (keys.slow(stream.number, n) for n in (j, j + 1))
            jump, step = self._jumped(stream, j, j + 1)
            anew = stream.drawn_anew(self._problem.timeline.slow_stamps_ns[j + 1])
            value = (
                np.where(stream.slow.constant, window.values.atVector(key), 0.0)
                if anew
                else window.values.atVector(key)
            )
            # The guess includes the step of a jump: begun at the level before it, the slow error would be held at the
            # usual level by the prior that closes the chain, and the pose would be drawn along.
            value = value if step is None else value + step
            window.guess(following, value, t)
            window.add(slow_step(stream.slow, key, following, dt_s, jump=jump, expected=step, anew=anew))
            if window.remove(self._ends[stream.name][0]):
                self._ends[stream.name] = window.add(slow_end(stream.slow, following, value)), value

    def _jumped(self, stream: LiveStream, j: int, later: int) -> tuple[float, Array | None]:
        """Return `LiveStream.jumped` for the interval from slow node j to a later one."""
        timeline = self._problem.timeline
        return stream.jumped(*(timeline.attached_until_ns(timeline.slow_stamps_ns[n]) for n in (j, later)))

    def reintegrate(self, stale: Collection[int]) -> None:
        """Integrate the IMU steps that begin at the states `stale` again and stage their factors: samples came late."""
        timeline, links, window = self._problem.timeline, self._problem.links, self._window
        for k in sorted(stale):
            if k in self._links and window.remove(self._links[k]):
                j, values = timeline.slow_of[k], window.values
                going = GapMotion.of(nav_state(values, k), values.atConstantBias(keys.bias(j)))
                pim = links.integrate(
                    timeline.stamps_ns[k], timeline.stamps_ns[k + 1], gtsam.imuBias.ConstantBias(), going
                )
                self._links[k] = window.add([links.factor(k, j, pim)])

    def let_go(self) -> bool:
        """Forget the states that have left the window; return whether any have."""
        timeline = self._problem.timeline
        first = timeline.first
        gone = first
        while gone < timeline.last and not self._window.is_committed(keys.pose(gone)):
            gone += 1
        if gone == first:
            return False
        for k in range(first, gone):
            self._links.pop(k, None)
        timeline.forget(gone)
        self._problem.links.forget(timeline.stamps_ns[gone])
        return True

    def prediction(self, stream: LiveStream, at: Attachment, k: int, residual: Residual) -> Prediction:
        """Return the prediction of a residual at state k by the covariance of pose and slow state; zeros if unknown."""
        timeline, window, newest = self._problem.timeline, self._window, self._newest
        base = min(k, newest.number)
        wanted, size = [keys.pose(base)], 6
        if at.slow_value is not None:
            wanted.append(keys.slow(stream.number, timeline.slow_of[base]))
            size += len(at.slow_value)
        if any(not window.is_committed(key) for key in wanted):
            return Prediction(np.zeros((len(residual.raw), size)))
        P = np.array(window.covariance(wanted))
        if base != k:
            from_ns, to_ns = timeline.stamps_ns[base], timeline.stamps_ns[k]
            pim = self._problem.links.integrate(from_ns, to_ns, newest.bias)
            P = propagated_covariance(
                P, newest, at.T_world_body.rotation().matrix(), (to_ns - from_ns) * 1e-9, pim.preintMeasCov()
            )
            jump, _ = self._jumped(stream, timeline.slow_of[base], timeline.slow_of[k])
            if stream.slow is not None and size > 6 and jump > 0.0:
                P[6:, 6:] += np.diag(np.where(stream.slow.jump_axes, jump**2, 0.0))
        return prediction_of(residual, at, P, newest.velocity_cov)

    def covariance(self, slow_of: Sequence[LiveStream]) -> Array:
        """Return the joint covariance (15 + k, 15 + k) of the newest pose, velocity, bias, and slow errors of streams.

        Rotation and position are in axes of world.
        """
        k, window = self._newest.number, self._window
        j = self._problem.timeline.slow_of[k]
        slow = [keys.slow(stream.number, j) for stream in slow_of]
        joint = window.covariance([keys.pose(k), keys.velocity(k), keys.bias(j), *slow])
        turn = np.eye(len(joint))
        turn[:15, :15] = in_world(self._newest.pose)
        return np.asarray(turn @ joint @ turn.T)

    def joint(self, attached: Sequence[Attachment], residuals: Sequence[Residual]) -> Array:
        """Return the joint covariance of the newest position in world (first 3 rows) and of the residuals.

        The residuals' part is the covariance of their prediction: the noise of the measurements is not in it.
        """
        newest, window = keys.pose(self._problem.timeline.last), self._window
        poses = list(dict.fromkeys([newest, *(at.pose_key for at in attached)]))
        slow = list(dict.fromkeys(at.slow_key for at in attached if at.slow_key is not None))
        width = len(window.values.atVector(slow[0])) if slow else 0
        first = {key: 6 * n for n, key in enumerate(poses)}
        first |= {key: 6 * len(poses) + width * n for n, key in enumerate(slow)}
        ends = np.cumsum([3, *(len(r.raw) for r in residuals)])
        J = np.zeros((ends[-1], 6 * len(poses) + width * len(slow)))
        J[:3, 3:6] = window.values.atPose3(newest).rotation().matrix()
        for n, (at, residual) in enumerate(zip(attached, residuals, strict=True)):
            rows = slice(ends[n], ends[n + 1])
            J[rows, first[at.pose_key] : first[at.pose_key] + 6] = residual.jacobian()
            if at.slow_key is not None and residual.slow_jacobian is not None:
                J[rows, first[at.slow_key] : first[at.slow_key] + width] = residual.slow_jacobian()
        return np.asarray(J @ window.covariance([*poses, *slow]) @ J.T)

    def why_off_mount(self, stream: LiveStream) -> str:
        """Return `judge.health.why_off_mount` of the newest slow state; empty once headings have stepped."""
        key = keys.slow(stream.number, self._problem.timeline.slow_of[self._newest.number])
        if stream.slow is None or not stream.slow.stepped or stream.receiver.heading.stepped:
            return ""
        if not self._window.is_committed(key):
            return ""
        return why_off_mount(stream.name, stream.slow, self._window.values.atVector(key))

    def late_far_off(self, stream: LiveStream) -> list[tuple[str, float, str]]:
        """Return `TIME_OFFSET`, the delay (s) in the slow state and a line, if that is clearly far from the setting."""
        if stream.slow is None or (axis := stream.slow.late) is None:
            return []
        key = keys.slow(stream.number, self._problem.timeline.slow_of[self._newest.number])
        if not self._window.is_committed(key):
            return []
        late_s = float(self._window.values.atVector(key)[axis])
        said = late_far_off(stream.name, stream.slow, late_s)
        # The sigma is computed last, because it takes time.
        clear = said and abs(late_s) > FAR_OFF * np.sqrt(self._window.covariance([key])[axis, axis])
        return [(TIME_OFFSET, late_s, line) for line in said] if clear else []

    def links(self) -> list[Held]:
        """Return the IMU factors without the oldest tenth: the solver cannot relinearise the poses there."""
        held = [held for _, held in sorted(self._links.items()) if held.slots]
        return held[len(held) // 10 + 1 :]

    def step_cost(self) -> float:
        """Return the median cost of the IMU factors; 0 where none is in the graph."""
        steps = self._window.errors_of(held for held in self._links.values() if held.slots)
        return float(np.median(steps)) if steps else 0.0

    def steps_cost(self, since_ns: int) -> float:
        """Return the summed cost of the IMU factors that reach beyond a stamp."""
        first = self._problem.timeline.floor(since_ns)
        return sum(self._window.errors_of(held for k, held in self._links.items() if k >= first and held.slots))

    def anchor(self) -> Anchor:
        """Return the anchor at the newest state.

        It leaves out the priors that close the slow chains, as the chains continue from here, and the parts of other
        priors that may be weighed otherwise later.
        """
        timeline, window, streams = self._problem.timeline, self._window, self._problem.streams
        k = timeline.last
        j = timeline.slow_of[k]
        core = [keys.pose(k), keys.velocity(k), keys.bias(j)]
        slow = {s.name: keys.slow(s.number, j) for s in streams.values() if s.slow is not None}
        constants = self._constants.seen()
        every = [*core, *slow.values(), *constants.values()]
        joint = window.covariance(every)
        vectors = [window.values.atVector(key) for key in every[3:]]
        mean = np.concatenate([np.zeros(15), *vectors])
        variances = []
        for name, value in zip(slow, vectors, strict=False):
            process = streams[name].slow
            assert process is not None
            variances.append(closing_variance(process, np.where(process.constant, self._ends[name][1], value)))
        variances += map(self._constants.revisable_variance, constants.values())
        mean, joint = without_priors(mean, joint, np.concatenate([np.full(15, np.inf), *variances]))
        bias = window.values.atConstantBias(core[2])
        anchor = Anchor.of_joint(
            timeline.stamps_ns[k],
            (window.values.atPose3(core[0]), window.values.atVector(core[1]), bias.vector()),
            mean,
            joint,
            dict(zip(slow, map(len, vectors), strict=False)),
            dict(zip(constants, map(len, vectors[len(slow) :]), strict=True)),
        )
        every_constant = {**self._constants.remembered(), **anchor.constants}
        return replace(anchor, constants=every_constant, turned_rad=self._constants.turned_rad)

    def track(self) -> tuple[NDArray[np.int64], Array, Array, Array]:
        """Return stamps (N,), ns; and positions (N, 3), attitudes (N, 3, 3), velocities (N, 3) of the body in world."""
        timeline, values, lever = self._problem.timeline, self._window.values, -self._problem.t_body_imu_m
        states = range(timeline.first, len(timeline))
        poses = [values.atPose3(keys.pose(k)) for k in states]
        stamps = np.array([timeline.stamps_ns[k] for k in states], dtype=np.int64)
        R = np.array([pose.rotation().matrix() for pose in poses])
        bias = [values.atConstantBias(keys.bias(timeline.slow_of[k])).gyroscope() for k in states]
        gyro = self._problem.links.gyro_at(stamps) - np.array(bias) @ self._problem.R_body_imu.T
        v = np.array([values.atVector(keys.velocity(k)) for k in states])
        p = np.array([pose.transformFrom(lever) for pose in poses])
        return stamps, p, R, v + np.einsum("nij,nj->ni", R, np.cross(gyro, lever))
