# SPDX-License-Identifier: Apache-2.0
"""The graph of the last seconds: iSAM2 in a fixed lag.

What is added and taken out is staged, and goes in whole or not at all. GTSAM's smoother is not safe after
an exception: from then on it is thrown away, and the caller builds another.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import gtsam
import numpy as np

from graphloc.errors import SolveError, not_solved
from graphloc.frames import Array
from graphloc.keys import is_pose

_RELINEARIZE = 0.02  # of any tangent: m, rad, m/s; the gap to the batch is millimetres
_NEVER = 1_000_000_000  # updates


def keys_of(factor: Any) -> list[int]:
    """Return the keys that a factor holds on to."""
    return [int(key) for key in factor.keys()]  # noqa: SIM118 - no mapping


@dataclass(slots=True, eq=False)
class Held:
    """Factors that went in together: their places in the smoother, and the keys that they hold on to."""

    keys: frozenset[int]
    count: int
    slots: list[int] = field(default_factory=list)


class Window:
    """A fixed lag. `values` is the estimate of every key in it, and the guess of what is staged."""

    def __init__(self, lag_s: float) -> None:
        params = gtsam.ISAM2Params()
        params.setOptimizationParams(gtsam.ISAM2GaussNewtonParams(0.0))
        params.setFactorization("QR")  # Cholesky gives up on slow biases
        params.findUnusedFactorSlots = True  # else slots grow without end
        params.relinearizeSkip = _NEVER  # but see `relinearise`
        params.setRelinearizeThreshold(_RELINEARIZE)
        self.lag_s = lag_s
        self._smoother = gtsam.IncrementalFixedLagSmoother(lag_s, params)
        self.values = gtsam.Values()
        self._alive: dict[int, float] = {}  # keys in the smoother, and when each was last touched
        self._linearised = gtsam.Values()  # the point of each key that the solver's tangents are those of
        self._clear()

    def _clear(self) -> None:
        self._graph, self._guess = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self._stamps: dict[int, float] = {}
        self._remove: list[int] = []
        self._added: list[Held] = []

    def guess(self, key: int, value: Any, t_s: float) -> None:
        """Stage a new key."""
        self._guess.insert(key, value)
        self.values.insert(key, value)
        self._linearised.insert_or_assign(key, value)
        self._stamps[key] = t_s

    def touch(self, key: int, t_s: float) -> None:
        """Keep a key from leaving before `t_s` + lag."""
        self._stamps[key] = max(t_s, self._stamps.get(key, self._alive.get(key, t_s)))

    def stamp_of(self, key: int) -> float:
        """When a key was last touched."""
        return self._stamps.get(key, self._alive.get(key, -np.inf))

    def add(self, factors: Iterable[Any]) -> Held:
        """Stage factors.

        Raises:
            SolveError: one of them holds on to a key that is not there (any more).
        """
        found = list(factors)
        keys = frozenset(key for factor in found for key in keys_of(factor))
        if missing := [key for key in keys if not self.values.exists(key)]:
            raise SolveError(f"a factor needs {len(missing)} states that have left the window")
        for factor in found:
            self._graph.add(factor)
        held = Held(keys, len(found))
        self._added.append(held)
        return held

    def remove(self, held: Held) -> bool:
        """Stage the removal of factors; False where a part of them has left with the lag."""
        if not held.slots or any(key not in self._alive for key in held.keys):
            return False
        self._remove += held.slots
        held.slots = []
        return True

    def linearised_at(self, key: int) -> Any:
        """Return the value that the solver's tangent of a key is that of."""
        return self._linearised.atPose3(key)

    def commit(self) -> None:
        """Take in what is staged, and estimate anew.

        Raises:
            SolveError: the linear algebra failed; this window is of no use from now on.
        """
        with self._solving():
            self._smoother.update(self._graph, self._guess, self._stamps, self._remove)  # type: ignore[arg-type]
            slots = list(self._smoother.getISAM2Result().getNewFactorsIndices())
            self.values = self._smoother.calculateEstimate()
        for held in self._added:
            held.slots, slots = slots[: held.count], slots[held.count :]
        self._alive |= self._stamps
        self._clear()
        if min(self._alive.values(), default=0.0) < max(self._alive.values(), default=0.0) - self.lag_s:
            self._alive = self._smoother.timestamps()  # some have left; asked for each time it is a tenth of an update
            self._linearised = gtsam.Values(self._smoother.getLinearizationPoint())

    def relinearise(self) -> None:
        """Linearise anew where the estimate has moved away."""
        with self._solving():
            solver = self._smoother.getISAM2()  # the smoother's own, not a copy
            if not solver.update(force_relinearize=True).getVariablesRelinearized():
                return
            self.values = self._smoother.calculateEstimate()
            self._linearised = gtsam.Values(self._smoother.getLinearizationPoint())
        for values in (self.values, self._linearised):
            values.insert(self._guess)

    def settle(self, steps: int = 1) -> None:
        """Take in what is staged, if anything is, and relinearise `steps` times."""
        if self._added or self._remove:
            self.commit()
        for _ in range(steps):
            self.relinearise()

    @staticmethod
    @contextmanager
    def _solving() -> Iterator[None]:
        try:
            yield
        except (RuntimeError, IndexError, ValueError, MemoryError) as error:
            raise not_solved("the solver failed", error) from error

    def leaving(self, keys: Iterable[int], now_s: float) -> list[int]:
        """Return those of the keys that the next commit at `now_s` lets go."""
        return [key for key in keys if self.values.exists(key) and self.stamp_of(key) < now_s - self.lag_s]

    def covariance(self, keys: Sequence[int]) -> Array:
        """Return the joint covariance of keys that were committed, in their order, poses first; of a pose in the tangent of its estimate.

        Raises:
            SolveError: it could not be computed.
        """
        try:
            if len(keys) == 1:
                cov = np.atleast_2d(self._smoother.marginalCovariance(keys[0]))
            else:
                cov = np.asarray(self._smoother.getISAM2().jointMarginalCovariance(list(keys)).fullMatrix())
        except (RuntimeError, IndexError, ValueError) as error:
            raise not_solved("the covariance could not be computed", error) from error
        # Poses first, by the signature: the solver's own tangents are those of its linearisation.
        for n, key in enumerate(itertools.takewhile(is_pose, keys)):
            turn = self.values.atPose3(key).rotation().matrix().T @ self.linearised_at(key).rotation().matrix()
            for rows in (slice(6 * n, 6 * n + 3), slice(6 * n + 3, 6 * n + 6)):
                cov[rows] = turn @ cov[rows]
                cov[:, rows] = cov[:, rows] @ turn.T
        return cov

    def error(self, without: Iterable[Held] = ()) -> float:
        """Return the cost of the graph at the estimate (half of the weighted squares), less that of some factors."""
        return float(self._smoother.getFactors().error(self.values)) - sum(self.errors_of(without))

    def errors_of(self, parts: Iterable[Held]) -> list[float]:
        """Return the share of the cost that committed factors have, together as they went in."""
        factors = self._smoother.getFactors()
        return [float(sum(factors.at(slot).error(self.values) for slot in held.slots)) for held in parts]

    def is_committed(self, key: int) -> bool:
        return key in self._alive

    @property
    def factor_slots(self) -> int:
        """Places that the smoother keeps for factors: must not grow with time."""
        return int(self._smoother.getFactors().size())
