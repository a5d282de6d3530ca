# SPDX-License-Identifier: Apache-2.0
"""The graph of the window: iSAM2, whose oldest keys are marginalised.

Additions and removals are staged, and applied whole or not at all. `ISAM2` cannot be used after an exception: the
caller then throws the window away and builds another.

GTSAM's own fixed-lag smoother orders elimination by fill-in alone. Here the newest keys come last, so that what every
update queries and adds is at the root of the Bayes tree.
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
from graphloc.judge.linearised import sparse_rows
from graphloc.keys import is_leaf, is_pose

# Change of any tangent component (m, rad, m/s) from which a key is relinearised; millimetres from the batch
_RELINEARIZE = 0.02
_NEVER = 1_000_000_000  # updates


def keys_of(factor: Any) -> list[int]:
    """Return the keys of a factor."""
    return [int(key) for key in factor.keys()]  # noqa: SIM118 - no mapping


@dataclass(slots=True, eq=False)
class Held:
    """Factors that were added together: keys, number, and slots in iSAM2 (none while staged or removed)."""

    keys: frozenset[int]
    count: int
    slots: list[int] = field(default_factory=list)


class LazyEstimates:
    """Estimates of the keys of a window as of its last commit, and the guesses of keys staged since.

    Each is computed only when it is asked for: nine of ten never are, those of leaves and older states.
    """

    def __init__(self, solver: gtsam.ISAM2, staged: gtsam.Values) -> None:
        self._solver, self._staged = solver, staged
        self._whole: gtsam.Values | None = None

    def exists(self, key: int) -> bool:
        """Return whether a key is in the window, or staged."""
        return bool(self._solver.valueExists(key) or self._staged.exists(key))

    def atPose3(self, key: int) -> Any:
        """Return a pose. This and the next methods have the names of those of `gtsam.Values`."""
        known = self._solver.valueExists(key)
        return self._solver.calculateEstimatePose3(key) if known else self._staged.atPose3(key)

    def atVector(self, key: int) -> Array:
        """Return a vector."""
        known = self._solver.valueExists(key)
        return np.asarray(self._solver.calculateEstimateVector(key) if known else self._staged.atVector(key))

    def atConstantBias(self, key: int) -> Any:
        """Return a bias of the IMU."""
        known = self._solver.valueExists(key)
        return self._solver.calculateEstimateConstantBias(key) if known else self._staged.atConstantBias(key)

    def whole(self) -> gtsam.Values:
        """Return the estimates of all keys of the last commit."""
        if self._whole is None:
            self._whole = self._solver.calculateEstimate()
        return self._whole


@dataclass(frozen=True, slots=True, eq=False)
class Mark:
    """A copy of all that a commit changes, to restore a window; nothing was staged when it was made."""

    solver: gtsam.ISAM2
    linearised: gtsam.Values
    alive: dict[int, float]
    newest: set[int]


class Window:
    """A fixed-lag smoother.

    Args:
        lag_s: time after which a key that was not touched is marginalised.

    Attributes:
        lag_s: as given. values: estimate of every key in it, and the guess of staged keys.
    """

    def __init__(self, lag_s: float) -> None:
        params = gtsam.ISAM2Params()
        params.setOptimizationParams(gtsam.ISAM2GaussNewtonParams(0.0))
        params.setFactorization("QR")  # Cholesky gives up on slow biases
        params.findUnusedFactorSlots = True  # else slots grow without end
        params.relinearizeSkip = _NEVER  # not by itself: see `relinearise`
        params.setRelinearizeThreshold(_RELINEARIZE)
        self.lag_s = lag_s
        self._solver = gtsam.ISAM2(params)
        self._alive: dict[int, float] = {}  # keys in the solver, and the time (s) when each was last touched
        self._newest: set[int] = set()  # keys of the last commit
        self._linearised = gtsam.Values()  # linearisation point of each key in the solver
        self._clear()

    def _clear(self) -> None:
        self._graph, self._guess = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self.values = LazyEstimates(self._solver, self._guess)
        self._stamps: dict[int, float] = {}
        self._remove: list[int] = []
        self._bare: set[int] = set()  # keys whose factors are all removed: the solver forgets them
        self._added: list[Held] = []
        self._to_relinearise = False

    def guess(self, key: int, value: Any, t_s: float) -> None:
        """Stage a new key, with the value to solve it from."""
        self._guess.insert(key, value)
        self._linearised.insert_or_assign(key, value)
        self._stamps[key] = t_s

    def touch(self, key: int, t_s: float) -> None:
        """Keep a key in the window until `t_s` + lag."""
        self._stamps[key] = max(t_s, self._stamps.get(key, self._alive.get(key, t_s)))

    def stamp_of(self, key: int) -> float:
        """Return the time (s) when a key was last touched."""
        return self._stamps.get(key, self._alive.get(key, -np.inf))

    def add(self, factors: Iterable[Any]) -> Held:
        """Stage factors.

        Raises:
            SolveError: a key of a factor is not in the window, or has left it.
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
        """Stage the removal of factors; return False where some of them have been marginalised."""
        if not held.slots or any(key not in self._alive for key in held.keys):
            return False
        self._remove += held.slots
        self._bare |= {key for key in held.keys if is_leaf(key)}
        held.slots = []
        return True

    def linearised_at(self, key: int) -> Any:
        """Return the linearisation point of a pose key."""
        return self._linearised.atPose3(key)

    def relinearise(self) -> bool:
        """Have the next commit relinearise the keys that have moved; `linearised_at` gives their new points at once.

        Returns:
            Whether any key has moved.
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
        """Apply what is staged, marginalise what is older than the lag, and solve.

        Raises:
            SolveError: the linear algebra failed; this window cannot be used any more.
        """
        alive = {key: touched_s for key, touched_s in (self._alive | self._stamps).items() if key not in self._bare}
        oldest_s = max(alive.values(), default=0.0) - self.lag_s
        gone = [key for key, touched_s in alive.items() if touched_s < oldest_s]
        self._newest = {key for key in self._stamps if not is_leaf(key)} or self._newest
        params = gtsam.ISAM2UpdateParams()
        params.removeFactorIndices = self._remove
        params.force_relinearize = self._to_relinearise
        if gone or self._to_relinearise or self._remove:  # else little is eliminated again, and needs no order
            params.constrainedKeys = _groups(alive, gone, self._newest)
        if gone:  # marginalised keys must be leaves of the tree
            params.extraReelimKeys = _listed(self._alive.keys() & alive)
        with self._solving():
            slots = list(self._solver.update(self._graph, self._guess, params).getNewFactorsIndices())
            if gone:
                self._solver.marginalizeLeaves(_listed(gone))
            for key in gone:
                del alive[key]
            self._solver.calculateEstimatePose3(next(filter(is_pose, alive)))  # solves for all keys: it may fail
            if gone or self._to_relinearise:
                self._linearised = gtsam.Values(self._solver.getLinearizationPoint())
        for held in self._added:
            held.slots, slots = slots[: held.count], slots[held.count :]
        self._alive = alive
        self._clear()

    def settle(self, steps: int = 1) -> None:
        """Apply what is staged, if anything is; then relinearise and solve up to `steps` times, while keys move."""
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
        """Return a copy of the window (nothing being staged), for `back_to`."""
        assert not self._added
        assert not self._remove
        return Mark(
            gtsam.ISAM2(self._solver),
            gtsam.Values(self._linearised),
            dict(self._alive),
            set(self._newest),
        )

    def back_to(self, mark: Mark, held: Iterable[tuple[Held, Sequence[int]]]) -> None:
        """Restore a mark, also after an exception; each mark can be used once.

        Args:
            held: factors that may have been removed since the mark, and the slots that they had then.
        """
        self._solver, self._linearised = mark.solver, mark.linearised
        self._alive, self._newest = mark.alive, mark.newest
        self._clear()
        for factors, slots in held:
            factors.slots = list(slots)

    def leaving(self, keys: Iterable[int], now_s: float) -> list[int]:
        """Return those of the keys that the next commit at `now_s` marginalises."""
        return [key for key in keys if self.values.exists(key) and self.stamp_of(key) < now_s - self.lag_s]

    def covariance(self, keys: Sequence[int]) -> Array:
        """Return the joint covariance of committed keys, in their order; poses must come first.

        That of a pose is in the body tangent at its estimate.

        Raises:
            SolveError: the covariance could not be computed.
        """
        try:
            if len(keys) == 1:
                cov = self._solver.marginalCovariance(keys[0])
            else:
                cov = np.asarray(self._solver.jointMarginalCovariance(list(keys)).fullMatrix())
        except (RuntimeError, IndexError, ValueError) as error:
            raise not_solved("the covariance could not be computed", error) from error
        # The solver's tangents are at its linearisation points; turn the tangents of poses to the estimate.
        for n, key in enumerate(itertools.takewhile(is_pose, keys)):
            turn = self.values.atPose3(key).rotation().matrix().T @ self.linearised_at(key).rotation().matrix()
            for rows in (slice(6 * n, 6 * n + 3), slice(6 * n + 3, 6 * n + 6)):
                cov[rows] = turn @ cov[rows]
                cov[:, rows] = cov[:, rows] @ turn.T
        return cov

    def error(self, without: Iterable[Held] = ()) -> float:
        """Return the cost of the graph at the estimate (half the weighted squares), not counting factors `without`."""
        graph = self._solver.getFactorsUnsafe()
        return float(graph.error(self.values.whole())) - self._bent(graph) - sum(self.errors_of(without))

    def _bent(self, graph: gtsam.NonlinearFactorGraph) -> float:
        """Return how much more the factors at the oldest poses cost than in the solver, which keeps these poses fixed.

        Half a metre from the linearisation point, the IMU factor there costs tens more. Every change that moves the
        oldest end of the window would be rejected for that alone.
        """
        solver = self._solver
        held, slots = solver.getFixedVariables(), solver.getVariableIndex()
        oldest = [key for key in self._alive if is_pose(key) and held.count(key)]
        point, step = solver.getLinearizationPoint(), solver.getDelta()
        steps = [graph.at(slot) for slot in {slot for key in oldest for slot in slots.at(key)}]
        # A linear factor costs the same in both; a robust one is left out, as linearised it has another loss.
        bent = [
            f
            for f in steps
            if isinstance(f, gtsam.NoiseModelFactor) and not isinstance(f.noiseModel(), gtsam.noiseModel.Robust)
        ]
        values = self.values.whole()
        return float(sum(f.error(values) - f.linearize(point).error(step) for f in bent))

    def errors_of(self, parts: Iterable[Held]) -> list[float]:
        """Return the cost of committed factors, summed for each `Held`."""
        factors, values = self._solver.getFactorsUnsafe(), self.values.whole()
        return [float(sum(factors.at(slot).error(values) for slot in held.slots)) for held in parts]

    def linear(self, first: Iterable[Held]) -> tuple[Any, Array]:
        """Return J (rows, columns) and b (rows,) of all factors at the estimate, whitened; rows of `first` lead."""
        factors = self._solver.getFactorsUnsafe()
        begin = [slot for held in first for slot in held.slots]
        rest = set(range(factors.size())).difference(begin)
        graph = gtsam.NonlinearFactorGraph()
        for slot in (*begin, *sorted(rest)):
            if (factor := factors.at(slot)) is not None:
                graph.add(factor)
        return sparse_rows(graph, self.values.whole())

    def is_committed(self, key: int) -> bool:
        return key in self._alive

    @property
    def factor_slots(self) -> int:
        """Number of slots that iSAM2 keeps for factors; it must not grow with time."""
        return int(self._solver.getFactorsUnsafe().size())


def _listed(keys: Iterable[int]) -> Any:
    found = gtsam.KeyList()
    for key in keys:
        found.push_back(key)
    return found


def _groups(alive: Iterable[int], gone: Collection[int], newest: Collection[int]) -> Any:
    """Return the groups of the elimination order: keys that are marginalised, keys that stay, and the newest keys.

    CCOLAMD fails where the number of a group is not below the number of keys. So where nothing is marginalised, groups
    are numbered without a first one for that.
    """
    stays = 1 if gone else 0
    groups = gtsam.KeyGroupMap()
    for key in gone:
        groups.insert2(key, 0)
    for key in alive:  # a key that has a group keeps it
        groups.insert2(key, stays + 1 if key in newest else stays)
    return groups
