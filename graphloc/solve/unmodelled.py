# SPDX-License-Identifier: Apache-2.0
"""What the slow errors that are left out of a solved run (`Stream.left_out`) do to its attitude and velocity.

Nothing tells such an error d from motion, so the estimate follows it: in position by all of it, in heading and velocity
as far as the IMU lets it. In the linearised run J dx = b the fixes contain B d, so the estimate is off by

    dx = (J'J)^-1 J'B d

Its covariance is that of a consider parameter (Schmidt 1966), with d drawn from its process.
"""

from __future__ import annotations

import numpy as np

from graphloc import keys
from graphloc.build import Stream
from graphloc.frames import Array
from graphloc.graph import SlowProcess
from graphloc.judge.covariances import Unmodelled, untold_errors
from graphloc.judge.linearised import linearised, normal_solver
from graphloc.solve.batch import BatchResult
from graphloc.time import NS_PER_S

_DRAWS, _AT_ONCE = 64, 16  # a sigma from 64 draws is good to 9 %; so many at once, for memory


def unmodelled(result: BatchResult) -> Unmodelled | None:
    """Return what left-out slow errors add to the covariances; None if no slow error is left out.

    Raises:
        RuntimeError: a state is not determined.
    """
    problem, values = result.problem, result.values
    if all(stream.left_out is None for stream in problem.streams):
        return None
    rows = linearised(problem, values, result.verdicts, result.prior)
    untold = untold_errors(problem.streams)
    followed = [
        (untold[stream.name], stream, used) for stream in problem.streams
        if stream.name in untold and (used := rows.used(stream))  # else all its fixes were rejected
    ]  # fmt: skip
    root, J, _ = rows.weighed()
    solve, rng, n = normal_solver(J), np.random.default_rng(0), rows.states
    R = np.array([values.atPose3(keys.pose(k)).rotation().matrix() for k in range(n)])
    found = Unmodelled(np.zeros((n, 3, 3)), np.zeros((n, 3, 3)))
    for _ in range(_DRAWS // _AT_ONCE):
        off = np.zeros((len(rows.b), _AT_ONCE))
        for slow, stream, used in followed:
            shift = np.zeros((len(used), 9, _AT_ONCE))
            shift[:, 3:6] = np.einsum("nji,njd->nid", R[stream.state[used]], _drawn(slow, stream, used, rng))
            off += rows.moved(stream, used, shift)
        dx = solve(J.T @ (root[:, None] * off))
        turned = R @ dx[rows.first_pose :].reshape(n, 6, _AT_ONCE)[:, :3]
        faster = dx[rows.first_velocity : rows.first_pose].reshape(n, 3, _AT_ONCE)
        for cov, part in zip(found, (turned, faster), strict=True):
            cov += part @ part.transpose(0, 2, 1) / _DRAWS
    if not all(np.isfinite(cov).all() for cov in found):
        raise RuntimeError("not finite")
    return found


def _drawn(slow: SlowProcess, stream: Stream, used: list[int], rng: np.random.Generator) -> Array:
    """Return draws (M, 3, draws) of a slow error, east, north and up in m, at M measurements of its receiver."""
    t = np.array([stream.measurements[i].stamp_ns for i in used]) / NS_PER_S
    d = rng.standard_normal((len(used), len(slow.sigma), _AT_ONCE))
    d[0] *= slow.sigma[:, None]
    for k, dt_s in enumerate(np.diff(t), 1):
        kept, walk = slow.after(dt_s)
        d[k] = kept[:, None] * d[k - 1] + np.sqrt(walk)[:, None] * d[k]
    return d
