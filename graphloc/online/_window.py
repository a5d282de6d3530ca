# SPDX-License-Identifier: Apache-2.0
"""The graph of the last seconds: iSAM2, whose oldest keys are marginalised.

What is added and taken out is staged, and goes in whole or not at all. `ISAM2` is not safe after
an exception: from then on it is thrown away, and the caller builds another.

GTSAM's own fixed lag leaves the order of elimination to fill-in. Here the newest keys come last: what is asked and
added at every update is then at the root of the tree.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import gtsam
import numpy as np

from graphloc.errors import SolveError, not_solved
from graphloc.frames import Array
from graphloc.keys import is_leaf, is_pose

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


@dataclass(frozen=True, slots=True, eq=False)
class Mark:
    """A window with nothing staged, to go back to: a copy of all that a commit changes."""

    solver: gtsam.ISAM2
    values: gtsam.Values
    linearised: gtsam.Values
    alive: dict[int, float]
    newest: set[int]


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
        self._solver = gtsam.ISAM2(params)
        self.values = gtsam.Values()
        self._alive: dict[int, float] = {}  # keys in the solver, and when each was last touched
        self._newest: set[int] = set()  # keys of the last commit
        self._linearised = gtsam.Values()  # the point of each key that the solver's tangents are those of
        self._clear()

    def _clear(self) -> None:
        self._graph, self._guess = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self._stamps: dict[int, float] = {}
        self._remove: list[int] = []
        self._bare: set[int] = set()  # leaves whose factors are removed: the solver forgets them
        self._added: list[Held] = []
        self._to_relinearise = False

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
        self._bare -= keys
        return held

    def remove(self, held: Held) -> bool:
        """Stage the removal of factors; False where a part of them has left with the lag."""
        if not held.slots or any(key not in self._alive for key in held.keys):
            return False
        self._remove += held.slots
        self._bare |= {key for key in held.keys if is_leaf(key)}
        held.slots = []
        return True

    def linearised_at(self, key: int) -> Any:
        """Return the value that the solver's tangent of a key is that of."""
        return self._linearised.atPose3(key)

    def relinearise(self) -> bool:
        """Have the next commit linearise anew where the estimate has moved away; `linearised_at` says at once where.

        Tell whether it has anywhere.
        """
        step = self._solver.getDelta()
        poses = [key for key in self._alive if is_pose(key)]
        moved = np.abs(step.vector(poses).reshape(-1, 6)).max(axis=1) >= _RELINEARIZE
        held = self._solver.getFixedVariables()
        for key in itertools.compress(poses, moved):
            if not held.count(key):
                self._linearised.update(key, self.values.atPose3(key))
        self._to_relinearise = bool(np.abs(step.vector()).max(initial=0.0) >= _RELINEARIZE)
        return self._to_relinearise

    def commit(self) -> None:
        """Take in what is staged, and estimate anew.

        Raises:
            SolveError: the linear algebra failed; this window is of no use from now on.
        """
        alive = {key: touched_s for key, touched_s in (self._alive | self._stamps).items() if key not in self._bare}
        oldest_s = max(alive.values(), default=0.0) - self.lag_s
        gone = [key for key, touched_s in alive.items() if touched_s < oldest_s]
        self._newest = {key for key in self._stamps if not is_leaf(key)} or self._newest
        params = gtsam.ISAM2UpdateParams()
        params.removeFactorIndices = self._remove
        params.force_relinearize = self._to_relinearise
        if gone or self._to_relinearise:
            params.constrainedKeys = _groups(alive, gone, self._newest)
        if gone:  # it must have nothing below it in the tree
            params.extraReelimKeys = _listed(self._alive.keys() & alive)
        with self._solving():
            slots = list(self._solver.update(self._graph, self._guess, params).getNewFactorsIndices())
            if gone:
                self._solver.marginalizeLeaves(_listed(gone))
            self.values = self._solver.calculateEstimate()
            if gone or self._to_relinearise:
                self._linearised = gtsam.Values(self._solver.getLinearizationPoint())
        for held in self._added:
            held.slots, slots = slots[: held.count], slots[held.count :]
        for key in gone:
            del alive[key]
        self._alive = alive
        self._clear()

    def settle(self, steps: int = 1) -> None:
        """Take in what is staged, if anything is, and relinearise `steps` times."""
        if self._added or self._remove:
            self.commit()
        for _ in range(steps):
            if not self.relinearise():
                break
            self.commit()

    @staticmethod
    @contextmanager
    def _solving() -> Iterator[None]:
        try:
            yield
        except (RuntimeError, IndexError, ValueError, MemoryError) as error:
            raise not_solved("the solver failed", error) from error

    def marked(self) -> Mark:
        """Return a window as it is, nothing being staged, for `back_to`."""
        assert not self._added
        assert not self._remove
        return Mark(
            gtsam.ISAM2(self._solver),
            gtsam.Values(self.values),
            gtsam.Values(self._linearised),
            dict(self._alive),
            set(self._newest),
        )

    def back_to(self, mark: Mark, held: Iterable[tuple[Held, Sequence[int]]]) -> None:
        """Go back to a mark, also after an exception; once for each mark.

        Args:
            held: factors that may have been removed since, and their places then.
        """
        self._solver, self.values, self._linearised = mark.solver, mark.values, mark.linearised
        self._alive, self._newest = mark.alive, mark.newest
        self._clear()
        for factors, slots in held:
            factors.slots = list(slots)

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
                cov = np.atleast_2d(self._solver.marginalCovariance(keys[0]))
            else:
                cov = np.asarray(self._solver.jointMarginalCovariance(list(keys)).fullMatrix())
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
        graph = self._solver.getFactorsUnsafe()
        return float(graph.error(self.values)) - self._bent(graph) - sum(self.errors_of(without))

    def _bent(self, graph: gtsam.NonlinearFactorGraph) -> float:
        """What steps from the oldest poses seem to cost beyond what they cost in the solver, which never linearises these anew.

        Half a metre from where they were linearised the IMU's own step from there costs tens: whatever moves the end of the lag
        would be refused.
        """
        solver = self._solver
        held, slots = solver.getFixedVariables(), solver.getVariableIndex()
        oldest = [key for key in self._alive if is_pose(key) and held.count(key)]
        point, step = solver.getLinearizationPoint(), solver.getDelta()
        steps = [graph.at(slot) for slot in {slot for key in oldest for slot in slots.at(key)}]
        # A linear factor costs the same either way; a robust one is another loss where it is linear.
        bent = [
            f
            for f in steps
            if isinstance(f, gtsam.NoiseModelFactor) and not isinstance(f.noiseModel(), gtsam.noiseModel.Robust)
        ]
        return float(sum(f.error(self.values) - f.linearize(point).error(step) for f in bent))

    def errors_of(self, parts: Iterable[Held]) -> list[float]:
        """Return the share of the cost that committed factors have, together as they went in."""
        factors = self._solver.getFactorsUnsafe()
        return [float(sum(factors.at(slot).error(self.values) for slot in held.slots)) for held in parts]

    def is_committed(self, key: int) -> bool:
        return key in self._alive

    @property
    def factor_slots(self) -> int:
        """Places that the smoother keeps for factors: must not grow with time."""
        return int(self._solver.getFactorsUnsafe().size())


def _listed(keys: Iterable[int]) -> Any:
    found = gtsam.KeyList()
    for key in keys:
        found.push_back(key)
    return found


def _groups(alive: Iterable[int], gone: Collection[int], newest: Collection[int]) -> Any:
    """The order of elimination: what leaves, what stays, what is asked and added next.

    CCOLAMD fails at a group whose number is not below that of the keys that it orders: where nothing leaves these are two, or one.
    """
    stays = 1 if gone else 0
    groups = gtsam.KeyGroupMap()
    for key in gone:
        groups.insert2(key, 0)
    for key in alive:  # what has a group keeps it
        groups.insert2(key, stays + 1 if key in newest else stays)
    return groups
