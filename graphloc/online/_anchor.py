# SPDX-License-Identifier: Apache-2.0
"""The estimate at one state, to continue from: after the start, after a solver's failure, after a killed process.

It holds the joint Gaussian of pose, velocity and bias. It also holds the Gaussian of each slow state, and of each
constant in the window, conditional on pose, velocity and bias: the slow error of a receiver is correlated with the
position, and so is the place of its antenna. If that place were kept independent of the position, each next fix would
tell it anew from the same prior. After five restarts the position of a vessel that lay still then had a sigma of 0.24 m
instead of 0.54 m, and was 1.1 m off.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import gtsam
import numpy as np

from graphloc import gauss, keys
from graphloc.build import Level, Past, Problem, StartPrior, closing_variance, constant_keys, revisable
from graphloc.frames import Array

_CORE = 15  # pose, velocity, bias
_PARTS = (slice(0, 6), slice(6, 9), slice(9, _CORE))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ConditionalGaussian:
    """A vector conditional on a state: its mean is value + gain * (state - anchor), its covariance cov.

    The condition includes velocity and bias. With the pose alone, all that later data say of the velocity would move
    the vector together with the position: after a second of data, the sigma of a tide fell from 0.5 m to 0.47 m, and
    the tide was 0.12 m off, only because the vessel heaved in that second.

    Attributes:
        value: (k,), mean at the anchor. gain: (k, 15) by pose (tangent), velocity and bias. cov: (k, k).
    """

    value: Array
    gain: Array
    cov: Array

    @classmethod
    def independent(cls, value: Array, cov: Array) -> ConditionalGaussian:
        """Return the Gaussian of a vector that is independent of the state."""
        return cls(value=value, gain=np.zeros((len(value), _CORE)), cov=cov)


def in_world(pose: Any) -> Array:
    """Return the rotation (15, 15) of pose, velocity and bias from the body tangent of a pose to axes of world."""
    turn = np.eye(_CORE)
    turn[:3, :3] = turn[3:6, 3:6] = pose.rotation().matrix()
    return turn


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Anchor:
    """A state and its Gaussian.

    Attributes:
        stamp_ns: of the state. pose: gtsam.Pose3 at the IMU with the body's axes, in world. velocity: (3,), in world.
        bias: (6,), accelerometer first.
        cov: (15, 15) of pose (body tangent, rotation first), velocity and bias.
        step: (15,) from pose, velocity and bias above, where the Gaussian is linearised, to its mean, in the order of
            `cov`. The mean may lie tens of degrees away; if a start were linearised there, it would not stay at its
            solution.
        slow: slow states, by sensor. constants: by sensor and number. level: levelling factor of a start; None: there
            is none, as in a snapshot.
        turned_rad: angle about the vertical from the attitude of `pose` to that at which the Gaussian takes derivatives by
            constants (see `Constants.turned_rad`).
    """

    stamp_ns: int
    pose: Any
    velocity: Array
    bias: Array
    cov: Array
    step: Array = field(default_factory=lambda: np.zeros(_CORE))
    slow: Mapping[str, ConditionalGaussian] = field(default_factory=dict)
    constants: Mapping[tuple[str, int], ConditionalGaussian] = field(default_factory=dict)
    level: Level | None = None
    turned_rad: float = 0.0

    @classmethod
    def of_start(cls, stamp_ns: int, prior: StartPrior) -> Anchor:
        """Return the anchor of a start's prior; it has no slow states."""
        cov = np.zeros((_CORE, _CORE))
        cov[:6, :6], cov[6:9, 6:9], cov[9:, 9:] = prior.pose_cov, prior.velocity_cov, prior.bias_cov
        bias = np.concatenate([prior.bias.accelerometer(), prior.bias.gyroscope()])
        velocity = np.asarray(prior.velocity)
        return cls(stamp_ns=stamp_ns, pose=prior.pose, velocity=velocity, bias=bias, cov=cov, level=prior.level)

    def widened(self, times: float) -> Anchor:
        """Return the anchor with covariances `times` as large: it was estimated with too little noise."""
        slow = {name: replace(known, cov=known.cov * times) for name, known in self.slow.items()}
        constants = {of: replace(known, cov=known.cov * times) for of, known in self.constants.items()}
        return replace(self, cov=self.cov * times, slow=slow, constants=constants)

    @classmethod
    def of_joint(
        cls,
        stamp_ns: int,
        point: tuple[gtsam.Pose3, Array, Array],
        mean: Array,
        cov: Array,
        slow: Mapping[str, int],
        constants: Mapping[tuple[str, int], int],
    ) -> Anchor:
        """Return the anchor of a joint Gaussian.

        Args:
            stamp_ns: of the state. point: pose, velocity (3,) and bias (6,) at which the Gaussian is linearised.
            mean: (n,) step (15,) from `point` to the mean, then the values of the slow states and of the constants.
            cov: (n, n), in the same order. slow, constants: number of rows of each, by sensor, or by sensor and number.
        """
        ends = np.cumsum([_CORE, *slow.values(), *constants.values()])
        own = [np.arange(a, b) for a, b in pairwise(ends)]
        pose, velocity, bias = point
        core = range(_CORE)
        beside = [_conditional(mean[[*core, *rows]], cov[np.ix_([*core, *rows], [*core, *rows])]) for rows in own]
        return cls(
            stamp_ns=stamp_ns,
            pose=pose,
            velocity=np.asarray(velocity),
            bias=bias,
            step=mean[:_CORE],
            cov=cov[:_CORE, :_CORE],
            slow=dict(zip(slow, beside, strict=False)),
            constants=dict(zip(constants, beside[len(slow) :], strict=True)),
        )

    @classmethod
    def of_past(cls, problem: Problem, values: gtsam.Values, past: Past, k: int) -> Anchor:
        """Return the anchor at state `k` of a solved run, from all data before it.

        Raises:
            numpy.linalg.LinAlgError: the data do not determine the state.
        """
        j = int(problem.timeline.slow_of[k])
        slow = {s.name: keys.slow(s.number, j) for s in problem.streams if s.slow is not None}
        named = {key: (s.name, n) for s in reversed(problem.streams) for n, key in enumerate(constant_keys(s))}
        constants = {of: key for key, of in named.items() if key in past.known}  # shared ones once
        order = gtsam.Ordering()
        for key in (keys.pose(k), keys.velocity(k), keys.bias(j), *slow.values(), *constants.values()):
            order.push_back(key)
        A, b = past.factors.linearize(values).jacobian(order)
        Q, R = np.linalg.qr(A)
        root = np.linalg.solve(R, np.eye(len(R)))
        vectors = {name: values.atVector(key) for name, key in [*slow.items(), *constants.items()]}
        bias = values.atConstantBias(keys.bias(j))
        mean, cov = root @ (Q.T @ b) + np.concatenate([np.zeros(_CORE), *vectors.values()]), root @ root.T
        slow_of = [s.slow for s in problem.streams if s.slow is not None]
        variances = [
            np.where(process.constant, closing_variance(process, value), np.inf)
            for process, value in zip(slow_of, vectors.values(), strict=False)
        ]
        of = {s.name: s for s in problem.streams}
        for (name, n), key in constants.items():
            constant = of[name].constants[n]
            own = revisable(constant.sigma, constant.widened(values.atVector(key))) ** 2
            variances.append(own if constant.corrects else np.full(len(own), np.inf))
        mean, cov = without_priors(mean, cov, np.concatenate([np.full(_CORE, np.inf), *variances]))
        return cls.of_joint(
            int(problem.timeline.stamps_ns[k]),
            (values.atPose3(keys.pose(k)), values.atVector(keys.velocity(k)), bias.vector()),
            mean,
            cov,
            {name: len(vectors[name]) for name in slow},
            {number: len(vectors[number]) for number in constants},
        )

    def factors(self, pose: int, velocity: int, bias: int) -> list[Any]:
        """Return the prior factors of the state.

        They are linear in the axes of world (reason: `conditional_factor`).

        Args:
            pose, velocity, bias: keys of the state.
        """
        turn = in_world(self.pose)
        whiten, mean = gauss.whitening(sound(turn @ self.cov @ turn.T)), turn @ self.step

        def error(this: Any, values: gtsam.Values, H: list[Array] | None) -> Array:
            off, steps = self._off(this.keys(), values)
            if H is not None:
                for n, (part, step) in enumerate(zip(_PARTS, steps, strict=True)):
                    H[n] = np.asfortranarray(whiten[:, part] @ step)
            return np.asarray(whiten @ (off - mean))

        found = [gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(_CORE), [pose, velocity, bias], error)]
        return found if self.level is None else [*found, _upright(self.level, pose, bias)]

    def conditional_factor(self, known: ConditionalGaussian, state: Sequence[int], key: int) -> Any:
        """Return the factor of a vector conditional on the state.

        It is linear in the axes of world. Position and slow error may each be hardly known, while their sum is known to
        centimetres. If the factor were linear in the body tangent, and the heading later corrected by 20 deg, it would
        constrain another sum; two different sums together would determine the position.

        Args:
            known: the vector. state: keys of the pose, velocity and bias. key: of the vector.
        """
        whiten = gauss.whitening(sound(known.cov))
        gain = whiten @ known.gain @ in_world(self.pose).T

        def error(this: Any, values: gtsam.Values, H: list[Array] | None) -> Array:
            *own, other = this.keys()
            off, steps = self._off(own, values)
            if H is not None:
                for n, (part, step) in enumerate(zip(_PARTS, steps, strict=True)):
                    H[n] = np.asfortranarray(-gain[:, part] @ step)
                H[len(_PARTS)] = np.asfortranarray(whiten)
            return np.asarray(whiten @ (values.atVector(other) - known.value) - gain @ off)

        return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(len(known.value)), [*state, key], error)

    def _off(self, state: Sequence[int], values: gtsam.Values) -> tuple[Array, tuple[Array, ...]]:
        """Return the difference (15,) of a state from this one, in axes of world, and its Jacobians by the 3 parts."""
        pose, velocity, bias = state
        R, p = values.atPose3(pose).rotation(), values.atPose3(pose).translation()
        turned = gtsam.Rot3.Logmap(R.compose(self.pose.rotation().inverse()))
        v, b = values.atVector(velocity) - self.velocity, values.atConstantBias(bias).vector() - self.bias
        off = np.concatenate([turned, p - self.pose.translation(), v, b])
        return off, (np.asarray(np.kron(np.eye(2), R.matrix()), dtype=np.float64), np.eye(3), np.eye(6))

    def as_dict(self) -> dict[str, Any]:
        """Return the anchor as plain data, for JSON; without `level`."""
        return {
            "stamp_ns": self.stamp_ns,
            "pose": self.pose.matrix().tolist(),
            "velocity": self.velocity.tolist(),
            "bias": self.bias.tolist(),
            "step": self.step.tolist(),
            "cov": self.cov.tolist(),
            "turned_rad": self.turned_rad,
            "slow": {name: _plain(b) for name, b in self.slow.items()},
            "constants": [[name, k, _plain(b)] for (name, k), b in self.constants.items()],
        }

    @classmethod
    def from_dict(cls, raw: Mapping[str, Any]) -> Anchor:
        """Read an anchor from plain data.

        Raises:
            KeyError, TypeError, ValueError: the data are damaged.
        """
        matrix = _array(raw["pose"], (4, 4))
        return cls(
            stamp_ns=int(raw["stamp_ns"]),
            pose=gtsam.Pose3(gtsam.Rot3.ClosestTo(matrix[:3, :3]), matrix[:3, 3]),
            velocity=_array(raw["velocity"], (3,)),
            bias=_array(raw["bias"], (6,)),
            step=_array(raw["step"], (_CORE,)),
            cov=_array(raw["cov"], (_CORE, _CORE)),
            turned_rad=float(_array(raw["turned_rad"], ())),
            slow={str(name): _read(b) for name, b in raw["slow"].items()},
            constants={(str(name), int(k)): _read(b) for name, k, b in raw["constants"]},
        )


def _upright(level: Level, pose: int, bias: int) -> Any:
    """Return the factor of a levelling on a pose and a bias (keys)."""

    def error(this: Any, values: gtsam.Values, H: list[Array] | None) -> Array:
        own, held = this.keys()
        off, by_turn, by_bias = level.error(
            values.atPose3(own).rotation().matrix(), values.atConstantBias(held).vector()
        )
        if H is not None:
            H[0] = np.asfortranarray(np.hstack([by_turn, np.zeros((2, 3))]))
            H[1] = np.asfortranarray(by_bias)
        return off

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(2), [pose, bias], error)


def _conditional(mean: Array, joint: Array) -> ConditionalGaussian:
    """Return a vector conditional on the state, from the joint Gaussian (15 + k,) of the state's step and it."""
    gain = np.linalg.solve(sound(joint[:_CORE, :_CORE]), joint[:_CORE, _CORE:]).T
    cov = joint[_CORE:, _CORE:] - gain @ joint[:_CORE, _CORE:]
    value = mean[_CORE:] - gain @ mean[:_CORE]
    return ConditionalGaussian(value=value, gain=np.asarray(gain, dtype=np.float64), cov=cov)


def without_priors(mean: Array, cov: Array, variance: Array) -> tuple[Array, Array]:
    """Return mean (n,) and covariance (n, n) after removing independent priors of mean 0.

    Such a prior closes a slow chain at its end, or may get another weight later. If it stayed in an anchor, it would
    count twice.

    Args:
        mean, cov: with the priors. variance: (n,) of the priors; inf: there is none.
    """
    rows = np.flatnonzero(np.isfinite(variance))
    variance = variance[rows]
    gain = np.linalg.solve(np.diag(variance) - cov[np.ix_(rows, rows)], cov[rows]).T
    return mean + gain @ mean[rows], cov + gain @ cov[rows]


def sound(cov: Array) -> Array:
    """Return a covariance made symmetric and positive definite again, where rounding has spoiled that."""
    whole = 0.5 * (cov + cov.T)
    scale = np.sqrt(np.maximum(np.diagonal(whole), 1e-18))
    values, vectors = np.linalg.eigh(whole / np.outer(scale, scale))
    kept = (vectors * np.maximum(values, 1e-9)) @ vectors.T
    return np.asarray(kept * np.outer(scale, scale))


def _plain(b: ConditionalGaussian) -> dict[str, Any]:
    return {"value": b.value.tolist(), "gain": b.gain.tolist(), "cov": b.cov.tolist()}


def _read(raw: Mapping[str, Any]) -> ConditionalGaussian:
    size = len(raw["value"])
    return ConditionalGaussian(
        value=_array(raw["value"], (size,)),
        gain=_array(raw["gain"], (size, _CORE)),
        cov=_array(raw["cov"], (size, size)),
    )


def _array(raw: Any, shape: tuple[int, ...]) -> Array:
    array = np.array(raw, dtype=np.float64)
    if array.shape != shape or not np.isfinite(array).all():
        raise ValueError(f"an array of {shape} is damaged")
    return array
