# SPDX-License-Identifier: Apache-2.0
"""A solved run as a sparse linear system J dx = b in whitened rows, for questions that the graph does not answer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import splu

from graphloc import keys
from graphloc.build import JUMP, Decided, Made, Problem, StartPrior, Stream, build_graph
from graphloc.config import KernelConfig
from graphloc.frames import Array
from graphloc.graph import Attachment, Decision
from graphloc.judge.decide import Verdicts

_LEAST_WEIGHT = 1e-6  # as for a linear factor (`linear.linear_update`), so that no row vanishes


class Weighed(NamedTuple):
    """A linear system J dx = b, weighted by its losses.

    Attributes:
        root: (rows,) roots of the weights. J: (rows, columns), sparse. b: (rows,).
    """

    root: Array
    J: Any
    b: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rows:
    """The run in whitened rows, J dx = b, without losses.

    Attributes:
        J: (rows, columns), sparse. b: (rows,).
        states: number of poses, whose columns come last, after those of their velocities.
        starts: first row of each factor, and of the end. stamps_ns: (rows,) time of each row.
        made: range of factors of each measurement. kernels: factors that share a loss, and the loss.
    """

    J: Any
    b: Array
    states: int
    starts: NDArray[np.int64]
    stamps_ns: NDArray[np.int64]
    made: Made
    kernels: list[tuple[range, KernelConfig]]

    def weighed(self, misfit: Array | None = None) -> Weighed:
        """Return the system with the weights that its losses give at a misfit (rows,).

        By default that is the misfit of the estimate, -b.
        """
        misfit = -self.b if misfit is None else misfit
        total, root = np.concatenate([[0.0], np.cumsum(misfit**2)]), np.ones(len(misfit))
        for factors, kernel in self.kernels:
            a, b = self.starts[factors.start], self.starts[factors.stop]
            root[a:b] = np.sqrt(max(kernel.weight(float(total[b] - total[a])), _LEAST_WEIGHT))
        return Weighed(root, diags_array(root) @ self.J, root * self.b)

    def used(self, stream: Stream) -> list[int]:
        """Return the indices of the measurements of a stream that have rows."""
        return [i for i in range(len(stream.measurements)) if (stream.number, i) in self.made]

    def moved(self, stream: Stream, used: list[int], shift: Array) -> Array:
        """Return by how much (rows, c) the rows change if M measurements see their states moved, and nothing else does.

        Args:
            used: indices of the M measurements. shift: (M, 9, c), rotation and translation in body axes, velocity in
                world.
        """
        B = np.zeros((len(self.b), shift.shape[2]))
        spans = [self.made[(stream.number, i)] for i in used]
        begin, end = self.starts[[s.start for s in spans]], self.starts[[s.stop for s in spans]]
        of = np.repeat(np.arange(len(used)), end - begin)
        own = np.concatenate([np.arange(a, b) for a, b in zip(begin, end, strict=True)])
        part, state = self.J[own].tocoo(), stream.state[used]
        for width, first, at_shift in ((6, self.first_pose, 0), (3, self.first_velocity, 6)):
            place = part.col - (first + width * state[of[part.row]])
            hit = (place >= 0) & (place < width)
            np.add.at(B, own[part.row[hit]], part.data[hit, None] * shift[of[part.row[hit]], place[hit] + at_shift])
        return B

    @property
    def first_pose(self) -> int:
        """First column of the poses (rotation, translation; body axes): keys are sorted by letter, and x comes last."""
        return int(self.J.shape[1]) - 6 * self.states

    @property
    def first_velocity(self) -> int:
        """First column of the velocities (world axes)."""
        return self.first_pose - 3 * self.states


def linearised(problem: Problem, values: gtsam.Values, verdicts: Verdicts, prior: StartPrior) -> Rows:
    """Return a solved run, linearised at `values`.

    Args:
        problem: that of the solution, or one with other slow states, which `values` then has.
        verdicts, prior: of the solution.
    """
    last, made, decided = len(problem.timeline) - 1, Made(), {}
    streams = {s.number: s for s in problem.streams}
    for key, verdict in verdicts.items():
        if verdict.decision is not None:
            plain = Decision(mode=verdict.decision.mode, weight=verdict.decision.weight)
            at = _attached(problem, streams[key[0]], key[1], verdict.at, values)
            decided[key] = Decided(plain, at, verdict.residual if at is verdict.at else None)
    graph, guess = build_graph(problem, values, decided, 0, last, prior, jumps=False, made=made)
    kernels = [
        (factors, kernel)
        for key, factors in made.items()
        if (decision := verdicts[key].decision) and (kernel := decision.kernel) and kernel.kind != "none"
    ]
    held = [graph.at(f).keys() for f in range(graph.size())]
    kernels += [(range(f, f + 1), JUMP) for f in _jumps(problem, held)]
    starts = np.concatenate([[0], np.cumsum([graph.at(f).dim() for f in range(graph.size())])])
    J, b = sparse_rows(graph, guess)
    stamps = np.repeat(_stamps_ns(problem, held), np.diff(starts))
    return Rows(J=J, b=b, states=last + 1, starts=starts, stamps_ns=stamps, made=made, kernels=kernels)


def with_left_out(problem: Problem, values: gtsam.Values) -> tuple[Problem, gtsam.Values]:
    """Return the problem with the left-out slow errors as states, and a copy of the values with these at zero."""
    values, streams = gtsam.Values(values), []
    for stream in problem.streams:
        if (slow := stream.left_out) is not None:
            for j in range(len(problem.timeline.slow_stamps_ns)):
                key, zero = keys.slow(stream.number, j), np.zeros(len(slow.sigma))
                values.insert_or_assign(key, zero)
            stream = replace(stream, slow=slow, left_out=None)
        streams.append(stream)
    return replace(problem, streams=tuple(streams)), values


def sparse_rows(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> tuple[Any, Array]:
    """Return J (rows, columns), sparse, and b (rows,) of a graph linearised at `values`, whitened, with its losses."""
    row, column, entry = np.asarray(graph.linearize(values).sparseJacobian_())
    row, column = row.astype(np.int64) - 1, column.astype(np.int64) - 1
    width = int(column.max())  # the last column is b
    right = column == width
    b = np.zeros(sum(graph.at(f).dim() for f in range(graph.size())))
    b[row[right]] = entry[right]
    return csr_array((entry[~right], (row[~right], column[~right])), shape=(len(b), width)), b


def _attached(problem: Problem, stream: Stream, i: int, at: Attachment, values: gtsam.Values) -> Attachment:
    """Return an attachment of the solution with the slow states and constants that its stream has in this problem.

    It is the same object where these are the same.
    """
    constants = at.constants if stream.constants else ()
    if stream.slow is None:
        return replace(at, constants=constants, slow_key=None, slow_value=None, slow_next=None)
    key = keys.slow(stream.number, int(problem.timeline.slow_of[stream.state[i]]))
    value = values.atVector(key)
    if not at.constants and at.slow_value is not None and np.array_equal(at.slow_value, value):
        return at
    return replace(at, constants=constants, slow_key=key, slow_value=value)


def _jumps(problem: Problem, held: list[Any]) -> list[int]:
    """Return the factors that are steps of slow states which may jump."""
    nodes = range(len(problem.timeline.slow_stamps_ns))
    slow = {keys.slow(s.number, j) for s in problem.streams if s.slow is not None and s.slow.jumps for j in nodes}
    return [f for f, own in enumerate(held) if len(own) == 2 and own[0] in slow and own[1] in slow]


def _stamps_ns(problem: Problem, held: list[Any]) -> NDArray[np.int64]:
    """Return the stamp (ns) of each factor: that of its earliest state.

    The prior of a leaf has none, and takes that of the next factor, which connects the leaf.
    """
    nodes = problem.timeline.slow_stamps_ns.tolist()
    at = {key(k): n for key in (keys.pose, keys.velocity) for k, n in enumerate(problem.timeline.stamps_ns.tolist())}
    at |= {keys.bias(j): n for j, n in enumerate(nodes)}
    at |= {keys.slow(s.number, j): n for s in problem.streams if s.slow is not None for j, n in enumerate(nodes)}
    stamps, after = np.zeros(len(held), dtype=np.int64), nodes[0]
    for f in range(len(held) - 1, -1, -1):
        after = stamps[f] = min((at[key] for key in held[f] if key in at), default=after)
    return stamps


def normal_solver(J: Any) -> Callable[[Array], Array]:
    """Return a function of y that solves J'J x = y."""
    return normal_solver_and_log_det(J)[0]


def normal_solver_and_log_det(J: Any) -> tuple[Callable[[Array], Array], float]:
    """Return a function of y that solves J'J x = y, and the logarithm of the determinant of J'J."""
    N = (J.T @ J).tocsc()
    scale = 1.0 / np.sqrt(N.diagonal())
    scaled = (diags_array(scale) @ N @ diags_array(scale)).tocsc()
    factor = splu(scaled, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}, diag_pivot_thresh=0.0)

    def solve(y: Array) -> Array:
        by = scale if y.ndim == 1 else scale[:, None]
        return np.asarray(by * factor.solve(np.asarray(by * y)))

    return solve, float(np.log(np.abs(factor.U.diagonal())).sum() - 2.0 * np.log(scale).sum())
