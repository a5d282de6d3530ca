# SPDX-License-Identifier: Apache-2.0
"""How the cost of a solved run would change if a lever arm, a mount or a stamp were not as configured.

The solution has adapted to the configuration, so its residuals alone show too little; here all states follow the offset. The
graph is linearised at the solution, J dx = b in whitened rows, with one column B for each offset theta. A sensor that is
mounted elsewhere, or measures at another time, measures what it would if the body were elsewhere, e(T Exp(xi theta)), so

    B = J_pose xi + J_velocity eta

with (rotation, translation; body axes) xi = (0, e) for a lever along e, (z, -z x l) for a yaw of the mount at l,
(w, R'v) for a stamp; and eta = R (w x e), 0, a: the change of velocity at the end of the lever. The part of B that no change
of the states explains, B~ = B - J argmin |J X - B|, carries the information on theta: H = B~'B~, g = B~'b.

Robust weights are chosen again with the offsets free: otherwise the effect of a wrong lever in a turn would count as a jump of
the GNSS error.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import splu
from scipy.stats import chi2

from graphloc import keys
from graphloc.build import JUMP, Problem, Stream, build_graph
from graphloc.config import KernelConfig
from graphloc.frames import Array
from graphloc.graph import Attachment, Constant, Decision, SlowProcess
from graphloc.offsets import Misfit, Offset, Offsets, Probe
from graphloc.solve._batch import BatchResult

BLOCK_S = 2.0
# Rounds of choosing weights; they end early where the weights, or theta (in sigmas), change little.
_ROUNDS, _SAME_WEIGHT, _SAME = 6, 0.2, 0.1
# How far an offset may be off while weights are chosen, 1 sigma: m, rad, s.
_FREE: dict[Offset, float] = {"x": 3.0, "y": 3.0, "yaw": 0.5, "time": 1.0}
_LEAST_WEIGHT = 1e-6
_HELD_RAD = 1e-6  # sigma of a mount that is held
_DRAWS = 16  # random vectors for the estimate of a trace
_NOISE_ROUNDS, _LEAST_FREEDOM, _UNLIKELY = 5, 3.0, 1e-4


_Solved = tuple[Any, Array, Callable[[Array], Array]]
"""J, weighted; residuals (rows,); and the solution of J'J x = y."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Rows:
    """The run in whitened rows, J dx = b, without losses.

    Attributes:
        J: (rows, columns), sparse. b: (rows,). states: poses, whose columns come last; before them their velocities.
        starts: first row of each factor, and of the end. stamps_ns: (rows,) when each row is.
        made: range of factors of each measurement. kernels: factors that share a loss, and the loss.
    """

    J: Any
    b: Array
    states: int
    starts: NDArray[np.int64]
    stamps_ns: NDArray[np.int64]
    made: dict[tuple[int, int], range]
    kernels: list[tuple[range, KernelConfig]]


def offsets_of(result: BatchResult, probe: Probe) -> Offsets | None:
    """Return the information of a solved run on the offsets of its sensors; None where there is none to examine.

    Raises:
        RuntimeError, numpy.linalg.LinAlgError: a state or offset is not determined.
    """
    problem, values = _with_offsets_free(result)
    rows = _linearised(problem, values, result)
    columns: dict[tuple[str, Offset], Array] = {}
    for stream in problem.streams:
        wanted = tuple(probe.get(stream.config.kind, ()))
        own = _columns(problem, stream, rows, values, result, wanted) if wanted else np.zeros((0, 0))
        for c, what in enumerate(wanted):
            name = _antenna_of(problem, stream, probe) if what in ("x", "y") else stream.name
            columns[name, what] = own[:, c] + columns.get((name, what), 0.0)
    if not columns:
        return None
    names, B = list(columns), np.column_stack(list(columns.values()))
    weak = np.array([1.0 / _FREE[what] for _, what in names])
    fresh = _root_weights(rows, -rows.b)
    theta = np.zeros(len(names))
    for n in range(_ROUNDS):
        root, before = fresh, theta
        J, b, own = diags_array(root) @ rows.J, root * rows.b, root[:, None] * B
        solve = _normal_solver(J)
        left = own - J @ solve(J.T @ own)
        r = b - J @ solve(J.T @ b)
        cov = np.linalg.inv(left.T @ left + np.diag(weak**2))
        theta = cov @ (left.T @ r)
        r_free = r - left @ theta
        fresh = _root_weights(rows, r_free / root)
        moved = float((np.abs(theta - before) / np.sqrt(np.diagonal(cov))).max())
        if moved < _SAME if n else np.abs(fresh**2 - root**2).max() < _SAME_WEIGHT:
            break
    gradient, curvature = _in_blocks(rows, left, r)
    gyroscope, accelerometer = _imu_misfit(rows, root, rows.b - B @ theta, (J, r_free, solve))
    return Offsets(
        names=tuple(names),
        block_s=BLOCK_S,
        gradient=gradient,
        curvature=curvature,
        gyroscope=gyroscope,
        accelerometer=accelerometer,
        noise_scale=problem.noise_scale,
    )


def _antenna_of(problem: Problem, stream: Stream, probe: Probe) -> str:
    """Return the sensor whose lever a stream shares: the first of the first kind in `probe` at its place, of which it is another output.

    Fixes and velocities of one antenna, both configured where it is not, bear each other out: one at a time, neither could
    leave. Two of a kind are two antennas.
    """
    kinds = list(probe)
    before = [kind for kind in kinds[: kinds.index(stream.config.kind)] if "x" in probe[kind]]
    place = np.asarray(stream.mount.translation())
    there = [s for s in problem.streams if np.array_equal(np.asarray(s.mount.translation()), place)]
    return next((s.name for kind in before for s in there if s.config.kind == kind), stream.name)


def _in_blocks(rows: _Rows, left: Array, r: Array) -> tuple[Array, Array]:
    """Return left'r (n, k) and left'left (n, k, k) of each block of time."""
    block = (rows.stamps_ns - rows.stamps_ns.min()) // round(BLOCK_S * 1e9)
    order = np.argsort(block, kind="stable")
    edges = np.searchsorted(block[order], np.arange(int(block.max()) + 2))
    parts = [order[a:b] for a, b in pairwise(edges)]
    return np.array([left[p].T @ r[p] for p in parts]), np.array([left[p].T @ left[p] for p in parts])


def _with_offsets_free(result: BatchResult) -> tuple[Problem, gtsam.Values]:
    """Return the problem without mount offsets that are states already, and with the slow errors that were left out."""
    problem, values = result.problem, gtsam.Values(result.values)
    streams = []
    for stream in problem.streams:
        slow, left_out = stream.slow, stream.left_out
        if slow is not None and slow.axes[0] == "yaw" and not np.isfinite(slow.time_constant_s[0]):
            slow = _without_mount(problem, stream, slow, values)
        if left_out is not None:
            slow = left_out
            for j in range(len(problem.timeline.slow_stamps_ns)):
                values.insert(keys.slow(stream.number, j), np.zeros(len(slow.sigma)))
        streams.append(replace(stream, slow=slow, left_out=None, constants=_surveyed(stream)))
    return replace(problem, streams=tuple(streams)), values


def _surveyed(stream: Stream) -> tuple[Constant, ...]:
    """Return a stream's constants without those that correct a setting: as configured, they are zero."""
    return tuple(constant for constant in stream.constants if not constant.corrects)


def _linearised(problem: Problem, values: gtsam.Values, result: BatchResult) -> _Rows:
    last, made, decided = len(problem.timeline) - 1, dict[tuple[int, int], range](), {}
    streams = {s.number: s for s in problem.streams}
    for key, verdict in result.verdicts.items():
        if verdict.decision is not None:
            plain = Decision(mode=verdict.decision.mode, weight=verdict.decision.weight)
            decided[key] = (plain, _attached(problem, streams[key[0]], key[1], verdict.at, values))
    graph, guess = build_graph(problem, values, decided, 0, last, result.prior, jumps=False, made=made)
    kernels = [
        (factors, kernel)
        for key, factors in made.items()
        if (decision := result.verdicts[key].decision) and (kernel := decision.kernel) and kernel.kind != "none"
    ]
    held = [graph.at(f).keys() for f in range(graph.size())]
    kernels += [(range(f, f + 1), JUMP) for f in _jumps(problem, held)]
    row, column, entry = np.asarray(graph.linearize(guess).sparseJacobian_())
    row, column = row.astype(np.int64) - 1, column.astype(np.int64) - 1
    starts = np.concatenate([[0], np.cumsum([graph.at(f).dim() for f in range(graph.size())])])
    width = int(column.max())  # the last column is b
    right = column == width
    b = np.zeros(int(starts[-1]))
    b[row[right]] = entry[right]
    J = csr_array((entry[~right], (row[~right], column[~right])), shape=(len(b), width))
    stamps = np.repeat(_stamps_ns(problem, held), np.diff(starts))
    return _Rows(J=J, b=b, states=last + 1, starts=starts, stamps_ns=stamps, made=made, kernels=kernels)


def _without_mount(problem: Problem, stream: Stream, slow: SlowProcess, values: gtsam.Values) -> SlowProcess | None:
    """Return a compass's slow state without its mount, which is held as configured (in `values` too); None where nothing else is in it."""
    if len(slow.axes) == 1:
        return None
    for j in range(len(problem.timeline.slow_stamps_ns)):
        key = keys.slow(stream.number, j)
        values.update(key, np.concatenate([[0.0], values.atVector(key)[1:]]))
    return replace(slow, sigma=np.concatenate([[_HELD_RAD], slow.sigma[1:]]))


def _attached(problem: Problem, stream: Stream, i: int, at: Attachment, values: gtsam.Values) -> Attachment:
    """Return an attachment of the solution, with the slow states and constants that the stream has here."""
    if not stream.constants:
        at = replace(at, constants=())
    if stream.slow is None:
        return replace(at, slow_key=None, slow_value=None, slow_next=None)
    key = keys.slow(stream.number, int(problem.timeline.slow_of[stream.state[i]]))
    return replace(at, slow_key=key, slow_value=np.atleast_1d(values.atVector(key)))


def _jumps(problem: Problem, held: list[Any]) -> list[int]:
    """Return the factors that are steps of slow states which may jump."""
    nodes = range(len(problem.timeline.slow_stamps_ns))
    slow = {keys.slow(s.number, j) for s in problem.streams if s.slow is not None and s.slow.jumps for j in nodes}
    return [f for f, own in enumerate(held) if len(own) == 2 and own[0] in slow and own[1] in slow]


def _stamps_ns(problem: Problem, held: list[Any]) -> NDArray[np.int64]:
    """Return the stamp (ns) of each factor: that of its first state. The prior of a leaf comes before the factor that connects it."""
    nodes = problem.timeline.slow_stamps_ns.tolist()
    at = {key(k): n for key in (keys.pose, keys.velocity) for k, n in enumerate(problem.timeline.stamps_ns.tolist())}
    at |= {keys.bias(j): n for j, n in enumerate(nodes)}
    at |= {keys.slow(s.number, j): n for s in problem.streams if s.slow is not None for j, n in enumerate(nodes)}
    stamps, after = np.zeros(len(held), dtype=np.int64), nodes[0]
    for f in range(len(held) - 1, -1, -1):
        after = stamps[f] = min((at[key] for key in held[f] if key in at), default=after)
    return stamps


def _columns(
    problem: Problem,
    stream: Stream,
    rows: _Rows,
    values: gtsam.Values,
    result: BatchResult,
    wanted: tuple[Offset, ...],
) -> Array:
    """B (rows, wanted) of one sensor."""
    B = np.zeros((len(rows.b), len(wanted)))
    used = [i for i in range(len(stream.measurements)) if (stream.number, i) in rows.made]
    if not used:
        return B
    met = [result.verdicts[(stream.number, i)].at for i in used]
    state = stream.state[used]
    R = np.array([at.T_world_body.rotation().matrix() for at in met])
    w = np.array([at.gyro_radps for at in met])
    v = np.array([at.v_world_mps + at.dv_world_mps for at in met])
    every = np.array([values.atVector(keys.velocity(k)) for k in range(rows.states)])
    t = (problem.timeline.stamps_ns - problem.timeline.stamps_ns[0]) * 1e-9
    gain = np.gradient(every, t, axis=0)[state]
    lever = np.asarray(stream.mount.translation())
    shift = np.zeros((len(used), 9, len(wanted)))  # rotation, translation, velocity
    for c, what in enumerate(wanted):
        if what == "time":
            shift[:, :, c] = np.hstack([w, np.einsum("nji,nj->ni", R, v), gain])
        elif what == "yaw":
            up = np.array([0.0, 0.0, 1.0])
            shift[:, :6, c] = np.concatenate([up, -np.cross(up, lever)])
        else:
            along = np.eye(3)["xy".index(what)]
            shift[:, 3:6, c] = along
            shift[:, 6:, c] = np.einsum("nij,nj->ni", R, np.cross(w, along))
    spans = [rows.made[(stream.number, i)] for i in used]
    begin, end = rows.starts[[s.start for s in spans]], rows.starts[[s.stop for s in spans]]
    of = np.repeat(np.arange(len(used)), end - begin)
    own = np.concatenate([np.arange(a, b) for a, b in zip(begin, end, strict=True)])
    part = rows.J[own].tocoo()
    poses = rows.J.shape[1] - 6 * rows.states  # keys are sorted by letter: x, the poses, comes last, v before it
    for width, first, at_shift in ((6, poses, 0), (3, poses - 3 * rows.states, 6)):
        place = part.col - (first + width * state[of[part.row]])
        hit = (place >= 0) & (place < width)
        np.add.at(B, own[part.row[hit]], part.data[hit, None] * shift[of[part.row[hit]], place[hit] + at_shift])
    return B


def _root_weights(rows: _Rows, misfit: Array) -> Array:
    """Return the root of the weight of each row, by the losses."""
    total, root = np.concatenate([[0.0], np.cumsum(misfit**2)]), np.ones(len(misfit))
    for factors, kernel in rows.kernels:
        a, b = rows.starts[factors.start], rows.starts[factors.stop]
        root[a:b] = np.sqrt(max(kernel.weight(float(total[b] - total[a])), _LEAST_WEIGHT))
    return root


def _normal_solver(J: Any) -> Callable[[Array], Array]:
    """Return the solution of J'J x = y as a function of y."""
    N = (J.T @ J).tocsc()
    scale = 1.0 / np.sqrt(N.diagonal())
    scaled = (diags_array(scale) @ N @ diags_array(scale)).tocsc()
    factor = splu(scaled, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}, diag_pivot_thresh=0.0)

    def solve(y: Array) -> Array:
        by = scale if y.ndim == 1 else scale[:, None]
        return np.asarray(by * factor.solve(np.asarray(by * y)))

    return solve


def _imu_misfit(rows: _Rows, root: Array, b: Array, solved: _Solved) -> tuple[Misfit, Misfit]:
    """Return the misfit of gyroscope and accelerometer, and by what factor smaller noise would explain it.

    The IMU factors come first, nine rows each: attitude (gyroscope), position, velocity. With smaller noise the share of the other
    sensors changes, so the factor is found in some rounds (variance components, Helmert).

    Args:
        root: (rows,) of the weights. b: (rows,) of `rows`, the offsets taken out. solved: the run with these.
    """
    links = np.arange(9 * (rows.states - 1)).reshape(-1, 9)
    own, needed = (links[:, :3].ravel(), links[:, 3:].ravel()), np.ones(2)
    squares, freedom = first = _squares_and_freedom(solved, own)
    low = [f > _LEAST_FREEDOM and chi2.cdf(s, f) < _UNLIKELY for s, f in zip(squares, freedom, strict=True)]
    for _ in range(_NOISE_ROUNDS if any(low) else 0):
        needed[low] *= np.clip(np.sqrt(squares / np.maximum(freedom, 1e-9)), 0.3, 1.2)[low]
        scaled = root.copy()
        for part, times in zip(own, needed, strict=True):
            scaled[part] /= times
        J = diags_array(scaled) @ rows.J
        solve = _normal_solver(J)
        squares, freedom = _squares_and_freedom((J, scaled * b - J @ solve(J.T @ (scaled * b)), solve), own)
    sigma = needed / np.sqrt(2.0 * np.maximum(freedom, 1.0))
    gyroscope, accelerometer = (
        Misfit(squares=float(first[0][k]), freedom=float(first[1][k]), needed=float(needed[k]), sigma=float(sigma[k]))
        for k in range(2)
    )
    return gyroscope, accelerometer


def _squares_and_freedom(solved: _Solved, parts: tuple[NDArray[np.intp], ...]) -> tuple[Array, Array]:
    """Squared residuals of parts of the rows, and the trace of 1 - J (J'J)^-1 J' over each (Hutchinson, random signs)."""
    rng, (J, r, solve) = np.random.default_rng(0), solved
    signs = [rng.choice(np.array([-1.0, 1.0]), (len(part), _DRAWS)) for part in parts]
    back = np.hstack([J[part].T @ s for part, s in zip(parts, signs, strict=True)])
    explained = (back * solve(back)).sum(axis=0).reshape(len(parts), _DRAWS).mean(axis=1)
    squares = np.array([(r[part] ** 2).sum() for part in parts])
    return squares, np.maximum(np.array([len(part) for part in parts]) - explained, 0.0)
