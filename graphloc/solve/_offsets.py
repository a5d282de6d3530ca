# SPDX-License-Identifier: Apache-2.0
"""How the cost of a solved run would change if a lever arm, a mount or a stamp were not as configured.

The solution has adapted to the configuration, so its residuals alone show too little; here all states follow the
offset. The graph is linearised at the solution, J dx = b in whitened rows, with one column B for each offset theta. A
sensor that is mounted elsewhere, or measures at another time, measures what it would if the body were elsewhere, e(T
Exp(xi theta)), and moved otherwise, v + eta theta, so

    B = J_pose xi + J_velocity eta

                            xi (rotation, translation; body axes)    eta (world axes)
    lever arm along e       (0, e)                                   R (w x e)
    yaw of a mount at l     (z, -z x l)                              0
    stamp                   (w, R'v)                                 a

with unit vectors e and z (up), and attitude R, rate w, velocity v and acceleration a of the body. The part of B that no
change of the states explains, B~ = B - J argmin |J X - B|, carries the information on theta: H = B~'B~, g = B~'b.

Robust weights are chosen again with the offsets free: otherwise the effect of a wrong lever in a turn would count as a
jump of the GNSS error.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from itertools import pairwise

import gtsam
import numpy as np

from graphloc import keys
from graphloc.build import Problem, StartPrior, Stream, with_imu_turned
from graphloc.frames import Array
from graphloc.graph import Constant, SlowProcess
from graphloc.judge.imu_noise import imu_misfit
from graphloc.judge.linearised import Rows, linearised, normal_solver, with_left_out
from graphloc.offsets import Offset, Offsets, Probe
from graphloc.solve.batch import BatchResult

BLOCK_S = 2.0  # length of a sum of residuals; `eval/calibrate` puts these together to 10 s, as errors last; a choice
# Most rounds of choosing weights; they end earlier if the weights, or theta (in sigmas), change by less.
_ROUNDS, _SAME_WEIGHT, _SAME = 6, 0.2, 0.1
# Prior sigma of an offset while weights are chosen: m, rad, s.
_FREE: dict[Offset, float] = {"x": 3.0, "y": 3.0, "yaw": 0.5, "time": 1.0}
_HELD = 1e-6  # sigma, rad or s, of an axis that is held


def offsets_of(result: BatchResult, probe: Probe) -> Offsets | None:
    """Return the information of a solved run on the offsets of its sensors; None where there is none to examine.

    Raises:
        RuntimeError, numpy.linalg.LinAlgError: a state or offset is not determined.
    """
    problem, values, prior = _with_offsets_free(result)
    rows = linearised(problem, values, result.verdicts, prior)
    columns: dict[tuple[str, Offset], Array] = {}
    numbered = {stream.number: stream for stream in problem.streams}
    for stream in problem.streams:
        first = stream if stream.shares is None else numbered.get(stream.shares, stream)
        first = first if first.config.kind == stream.config.kind else stream  # a velocity has a delay of its own
        wanted = tuple(probe.get(stream.config.kind, ()))
        own = _columns(problem, stream, rows, values, result, wanted) if wanted else np.zeros((0, 0))
        for c, what in enumerate(wanted):
            name = _antenna_of(problem, first, probe) if what in ("x", "y") else first.name
            columns[name, what] = own[:, c] + columns.get((name, what), 0.0)
    if not columns:
        return None
    names, B = list(columns), np.column_stack(list(columns.values()))
    weak = np.array([1.0 / _FREE[what] for _, what in names])
    fresh = rows.weighed()
    theta = np.zeros(len(names))
    for n in range(_ROUNDS):
        (root, J, b), before = fresh, theta
        own = root[:, None] * B
        solve = normal_solver(J)
        left = own - J @ solve(J.T @ own)
        r = b - J @ solve(J.T @ b)
        cov = np.linalg.inv(left.T @ left + np.diag(weak**2))
        theta = cov @ (left.T @ r)
        r_free = r - left @ theta
        fresh = rows.weighed(r_free / root)
        moved = float((np.abs(theta - before) / np.sqrt(np.diagonal(cov))).max())
        if moved < _SAME if n else np.abs(fresh.root**2 - root**2).max() < _SAME_WEIGHT:
            break
    gradient, curvature = _in_blocks(rows, left, r)
    gyroscope, accelerometer = imu_misfit(rows.J, root, rows.b - B @ theta, (J, r_free, solve), rows.states - 1)
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
    """Return the sensor whose lever arm a stream shares as another output of one antenna; else its own name.

    That is the first sensor mounted at the same place whose kind comes before its own in `probe`. Fixes and velocities
    of one antenna, both configured where it is not, confirm each other: examined one at a time, neither could leave.
    Two sensors of one kind are two antennas.
    """
    kinds = list(probe)
    before = [kind for kind in kinds[: kinds.index(stream.config.kind)] if "x" in probe[kind]]
    place = np.asarray(stream.mount.translation())
    there = [s for s in problem.streams if np.array_equal(np.asarray(s.mount.translation()), place)]
    return next((s.name for kind in before for s in there if s.config.kind == kind), stream.name)


def _in_blocks(rows: Rows, left: Array, r: Array) -> tuple[Array, Array]:
    """Return left'r (n, k) and left'left (n, k, k) of each of n blocks of time."""
    block = (rows.stamps_ns - rows.stamps_ns.min()) // round(BLOCK_S * 1e9)
    order = np.argsort(block, kind="stable")
    edges = np.searchsorted(block[order], np.arange(int(block.max()) + 2))
    parts = [order[a:b] for a, b in pairwise(edges)]
    return np.array([left[p].T @ r[p] for p in parts]), np.array([left[p].T @ left[p] for p in parts])


def _with_offsets_free(result: BatchResult) -> tuple[Problem, gtsam.Values, StartPrior]:
    """Return the problem with nothing that absorbs an offset, and with the slow errors that were left out.

    Offsets of mounts and stamps that are states, and that of the IMU's mount, are as configured. Values and prior are
    returned to match.
    """
    problem, values = with_left_out(result.problem, result.values)
    prior = result.prior
    if problem.imu_turn_rad.any():
        prior = prior.with_imu_turned(-problem.imu_turn_rad)
        problem = with_imu_turned(problem, values, -problem.imu_turn_rad)
    streams = []
    for stream in problem.streams:
        slow = stream.slow
        if slow is not None and (held := {slow.mount_yaw, slow.late} - {None}):
            slow = _without(held, problem, stream, slow, values)
        streams.append(replace(stream, slow=slow, constants=_surveyed(stream)))
    return replace(problem, streams=tuple(streams)), values, prior


def _surveyed(stream: Stream) -> tuple[Constant, ...]:
    """Return the constants of a stream that correct no setting; the others are zero: as configured."""
    return tuple(constant for constant in stream.constants if not constant.corrects)


def _without(
    axes: Collection[int | None], problem: Problem, stream: Stream, slow: SlowProcess, values: gtsam.Values
) -> SlowProcess | None:
    """Return a slow state with some axes (yaw of a mount, a delay) held as configured, in `values`, too.

    None if it has no other axes.
    """
    if len(slow.axes) == len(axes):
        return None
    held = np.array([k in axes for k in range(len(slow.axes))])
    for j in range(len(problem.timeline.slow_stamps_ns)):
        key = keys.slow(stream.number, j)
        values.update(key, np.where(held, 0.0, values.atVector(key)))
    return replace(slow, sigma=np.where(held, _HELD, slow.sigma))


def _columns(
    problem: Problem,
    stream: Stream,
    rows: Rows,
    values: gtsam.Values,
    result: BatchResult,
    wanted: tuple[Offset, ...],
) -> Array:
    """Return B (rows, wanted) of one sensor."""
    used = rows.used(stream)
    if not used:
        return np.zeros((len(rows.b), len(wanted)))
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
    return rows.moved(stream, used, shift)
