# SPDX-License-Identifier: Apache-2.0
"""What is known at one state, to go on from: after the start, after a failure, after a kill.

Kept are the joint Gaussian of pose, velocity and bias, and each slow state and constant given the pose: what is
known of a drifting receiver is known together with the place, not apart from it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import gtsam
import numpy as np

from graphloc import keys
from graphloc.build import Past, Problem, StartPrior, constant_keys
from graphloc.frames import Array

_CORE = 15  # pose, velocity, bias


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Beside:
    """A vector known beside a pose: value (k,) at the pose's own value, gain (k, 6) by its tangent, cov (k, k) given it."""

    value: Array
    gain: Array
    cov: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Anchor:
    """A state and its Gaussian.

    Attributes:
        stamp_ns: of the state. pose: gtsam.Pose3 of the IMU's place, body axes. velocity: (3,). bias: (6,) accelerometer first.
        cov: (15, 15) of pose (tangent), velocity, bias.
        slow: by sensor. constants: by sensor and number.
    """

    stamp_ns: int
    pose: Any
    velocity: Array
    bias: Array
    cov: Array
    slow: Mapping[str, Beside] = field(default_factory=dict)
    constants: Mapping[tuple[str, int], Beside] = field(default_factory=dict)

    @classmethod
    def of_start(cls, stamp_ns: int, prior: StartPrior) -> Anchor:
        """Return the prior of a start; nothing is known of slow states."""
        cov = np.zeros((_CORE, _CORE))
        cov[:6, :6], cov[6:9, 6:9], cov[9:, 9:] = prior.pose_cov, prior.velocity_cov, prior.bias_cov
        bias = np.concatenate([prior.bias.accelerometer(), prior.bias.gyroscope()])
        return cls(stamp_ns=stamp_ns, pose=prior.pose, velocity=np.asarray(prior.velocity), bias=bias, cov=cov)

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
        """Return what a joint Gaussian says.

        Args:
            point: pose, velocity, bias (6,) that it is about.
            mean: (n,) steps from there (pose in the tangent), and then the slow states and constants themselves, in turn.
            cov: (n, n). slow, constants: how many rows each has.
        """
        ends = np.cumsum([_CORE, *slow.values(), *constants.values()])
        own = [np.arange(a, b) for a, b in pairwise(ends)]
        pose, velocity, bias = point
        # The tangent turns along with the pose: where the heading is a guess, by tens of degrees.
        there, turn = pose.retract(mean[:6]), np.eye(len(mean))
        turn[:3, :3] = turn[3:6, 3:6] = there.rotation().matrix().T @ pose.rotation().matrix()
        cov = turn @ cov @ turn.T
        beside_pose = {
            name: _beside_pose(mean[rows], cov[np.ix_([*range(6), *rows], [*range(6), *rows])])
            for name, rows in zip(slow, own, strict=False)
        }
        # Not given the pose: a constant's prior, when it is seen again, does not have that.
        alone = {
            number: Beside(value=mean[rows], gain=np.zeros((len(rows), 6)), cov=cov[np.ix_(rows, rows)])
            for number, rows in zip(constants, own[len(slow) :], strict=True)
        }
        return cls(
            stamp_ns=stamp_ns,
            pose=there,
            velocity=np.asarray(velocity) + mean[6:9],
            bias=bias + mean[9:_CORE],
            cov=cov[:_CORE, :_CORE],
            slow=beside_pose,
            constants=alone,
        )

    @classmethod
    def of_past(cls, problem: Problem, values: gtsam.Values, past: Past, k: int) -> Anchor:
        """Return what all that was before says of state `k` of a solved run.

        Raises:
            numpy.linalg.LinAlgError: it says too little.
        """
        j = int(problem.timeline.slow_of[k])
        slow = {s.name: keys.slow(s.number, j) for s in problem.streams if s.slow is not None}
        constants = {
            (s.name, n): key for s in problem.streams for n, key in enumerate(constant_keys(s)) if key in past.known
        }
        order = gtsam.Ordering()
        for key in (keys.pose(k), keys.velocity(k), keys.bias(j), *slow.values(), *constants.values()):
            order.push_back(key)
        A, b = past.factors.linearize(values).jacobian(order)
        Q, R = np.linalg.qr(A)
        root = np.linalg.solve(R, np.eye(len(R)))
        vectors = {name: np.atleast_1d(values.atVector(key)) for name, key in [*slow.items(), *constants.items()]}
        bias = values.atConstantBias(keys.bias(j))
        return cls.of_joint(
            int(problem.timeline.stamps_ns[k]),
            (values.atPose3(keys.pose(k)), values.atVector(keys.velocity(k)), bias.vector()),
            root @ (Q.T @ b) + np.concatenate([np.zeros(_CORE), *vectors.values()]),
            root @ root.T,
            {name: len(vectors[name]) for name in slow},
            {number: len(vectors[number]) for number in constants},
        )

    def factors(self, pose: int, velocity: int, bias: int) -> list[Any]:
        """Return the prior of the state, by its keys; linear in world, as in `beside`."""
        R0, p0, turn = self.pose.rotation(), self.pose.translation(), np.eye(_CORE)
        turn[:3, :3] = turn[3:6, 3:6] = self.pose.rotation().matrix()
        whiten = np.linalg.inv(np.linalg.cholesky(sound(turn @ self.cov @ turn.T)))

        def error(this: Any, values: gtsam.Values, H: list[Array] | None) -> Array:
            own, fast, held = this.keys()
            R, p = values.atPose3(own).rotation(), values.atPose3(own).translation()
            if H is not None:
                H[0] = np.asfortranarray(whiten[:, :6] @ np.kron(np.eye(2), R.matrix()))
                H[1], H[2] = np.asfortranarray(whiten[:, 6:9]), np.asfortranarray(whiten[:, 9:])
            moved = np.concatenate([gtsam.Rot3.Logmap(R.compose(R0.inverse())), p - p0])
            v, b = values.atVector(fast) - self.velocity, values.atConstantBias(held).vector() - self.bias
            return np.asarray(whiten @ np.concatenate([moved, v, b]))

        return [gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(_CORE), [pose, velocity, bias], error)]

    def beside(self, known: Beside, pose: int, key: int) -> Any:
        """Return the prior of a vector, given the pose.

        Linear in world: a place that is hardly known is known to centimetres together with a slow error. In tangents of a
        heading that turns on by 20 deg, that would be another sum, and both sums together would tell the place.
        """
        whiten = np.linalg.inv(np.linalg.cholesky(sound(known.cov)))
        R0, p0, gain = (
            self.pose.rotation(),
            self.pose.translation(),
            known.gain.reshape(-1, 2, 3) @ self.pose.rotation().matrix().T,
        )
        gain = whiten @ gain.reshape(-1, 6)

        def error(this: Any, values: gtsam.Values, H: list[Array] | None) -> Array:
            own, other = this.keys()
            R, p = values.atPose3(own).rotation(), values.atPose3(own).translation()
            if H is not None:
                turn = np.kron(np.eye(2), R.matrix())
                H[0], H[1] = np.asfortranarray(-gain @ turn), np.asfortranarray(whiten)
            moved = np.concatenate([gtsam.Rot3.Logmap(R.compose(R0.inverse())), p - p0])
            return np.asarray(whiten @ (np.atleast_1d(values.atVector(other)) - known.value) - gain @ moved)

        return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(len(known.value)), [pose, key], error)

    def as_dict(self) -> dict[str, Any]:
        """Return plain data."""
        return {
            "stamp_ns": self.stamp_ns,
            "pose": self.pose.matrix().tolist(),
            "velocity": self.velocity.tolist(),
            "bias": self.bias.tolist(),
            "cov": self.cov.tolist(),
            "slow": {name: _plain(b) for name, b in self.slow.items()},
            "constants": [[name, k, _plain(b)] for (name, k), b in self.constants.items()],
        }

    @classmethod
    def from_dict(cls, raw: Mapping[str, Any]) -> Anchor:
        """Read plain data.

        Raises:
            KeyError, TypeError, ValueError: it is damaged.
        """
        matrix = _array(raw["pose"], (4, 4))
        return cls(
            stamp_ns=int(raw["stamp_ns"]),
            pose=gtsam.Pose3(gtsam.Rot3.ClosestTo(matrix[:3, :3]), matrix[:3, 3]),
            velocity=_array(raw["velocity"], (3,)),
            bias=_array(raw["bias"], (6,)),
            cov=_array(raw["cov"], (_CORE, _CORE)),
            slow={str(name): _beside(b) for name, b in raw["slow"].items()},
            constants={(str(name), int(k)): _beside(b) for name, k, b in raw["constants"]},
        )


def _beside_pose(value: Array, joint: Array) -> Beside:
    """Return what a joint covariance of pose and vector (6 + k, 6 + k) says of the vector given the pose."""
    gain = np.linalg.solve(sound(joint[:6, :6]), joint[:6, 6:]).T
    return Beside(value=value, gain=np.asarray(gain, dtype=np.float64), cov=joint[6:, 6:] - gain @ joint[:6, 6:])


def without_prior(mean: Array, cov: Array, rows: Array, variance: Array) -> tuple[Array, Array]:
    """Return mean (n,) and covariance (n, n) as they would be without a prior on some rows (k,), of mean 0 and variance (k,).

    That is what closes a slow chain: kept in what it goes on from, it would count again at each of its ends.
    """
    gain = np.linalg.solve(np.diag(variance) - cov[np.ix_(rows, rows)], cov[rows]).T
    return mean + gain @ mean[rows], cov + gain @ cov[rows]


def sound(cov: Array) -> Array:
    """Return the covariance, symmetric, and positive where rounding took that away."""
    whole = 0.5 * (cov + cov.T)
    scale = np.sqrt(np.maximum(np.diagonal(whole), 1e-18))
    values, vectors = np.linalg.eigh(whole / np.outer(scale, scale))
    kept = (vectors * np.maximum(values, 1e-9)) @ vectors.T
    return np.asarray(kept * np.outer(scale, scale))


def _plain(b: Beside) -> dict[str, Any]:
    return {"value": b.value.tolist(), "gain": b.gain.tolist(), "cov": b.cov.tolist()}


def _beside(raw: Mapping[str, Any]) -> Beside:
    size = len(raw["value"])
    return Beside(
        value=_array(raw["value"], (size,)), gain=_array(raw["gain"], (size, 6)), cov=_array(raw["cov"], (size, size))
    )


def _array(raw: Any, shape: tuple[int, ...]) -> Array:
    array = np.array(raw, dtype=np.float64)
    if array.shape != shape or not np.isfinite(array).all():
        raise ValueError(f"an array of {shape} is damaged")
    return array
