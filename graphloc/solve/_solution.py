# SPDX-License-Identifier: Apache-2.0
"""From a solved graph to a `Solution`: world-axes covariances, ledger, health."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graphloc import keys
from graphloc.berths import Berth, BerthTrack, rates, seen_from
from graphloc.build import Judged, Problem, Stream, constant_keys
from graphloc.frames import Array, skew
from graphloc.graph import SlowProcess
from graphloc.ledger import Ledger, LedgerRow, Outcome
from graphloc.measurements import Measurement
from graphloc.position_jumps import LASTS_S, jump_warnings, largest_sigma, why_in_doubt
from graphloc.recording import Recording
from graphloc.solution import Health, SlowEstimate, Solution, SolveStats
from graphloc.solve._batch import BatchResult, expected_cost
from graphloc.solve._decide import Verdict
from graphloc.solve._passes import outliers_cost
from graphloc.time import utc_text
from graphloc.trajectory import Trajectory, bounds_95

AGREES = 0.5  # a weight from which a measurement counts as used, and its sensor as agreeing
_FALSE = 0.05  # a hypothesis below this probability is rejected, not just down-weighted
# Health: DNV asks for 2.5 m at 95 % in port (Digerud); beyond 25 m a pose helps nobody there.
_GOOD_BOUND_M, _LOST_BOUND_M, _LOST_HEADING_DEG = 2.5, 25.0, 45.0
_DEAD_RECKONING_S, _SILENT_S = 5.0, 10.0
_FAR_OFF = 3.0
_TOGETHER_S = 5.0  # refused ones that last as long are said, where as many are false in a row by chance only
_BY_CHANCE = 1e-3
_LEVELS_M = 0.5  # sigma, for levels that may be the usual ones as well: said from there on
_NEAR_BERTH_M = 60.0
NO_NOISE, _NO_FIT = 10.0, 3.0  # no IMU is so much noisier than configured; nor does noise alone cost so much


def make_solution(problem: Problem, recording: Recording, result: BatchResult) -> Solution:
    """Return what the solver hands over."""
    n = len(problem.timeline)
    values, tree, slow_of = result.values, result.tree, problem.timeline.slow_of
    poses = [values.atPose3(keys.pose(k)) for k in range(n)]
    R = np.array([p.rotation().matrix() for p in poses])
    bias = [values.atConstantBias(keys.bias(int(j))) for j in slow_of]
    gyro_bias = np.array([b.gyroscope() for b in bias])
    raw = problem.links.gyro_at(problem.timeline.stamps_ns)
    gyro = raw - gyro_bias @ problem.R_body_imu.T
    # From the IMU's place to the body's origin.
    lever = -problem.t_body_imu_m
    trajectory = Trajectory(
        stamps_ns=problem.timeline.stamps_ns,
        p_world_m=np.array([p.transformFrom(lever) for p in poses]),
        R_world_body=R,
        v_world_mps=np.array([values.atVector(keys.velocity(k)) for k in range(n)])
        + np.einsum("nij,nj->ni", R, np.cross(gyro, lever)),
        cov=np.array([world_covariance(tree.marginalCovariance(keys.pose(k)), R[k], lever) for k in range(n)]),
    )
    assert trajectory.cov is not None
    trajectory.cov[:, :3, :3] += left_out(problem.streams) + result.levels_cov
    since = {s.name: _since_agreed(problem, s, result.verdicts) for s in problem.streams if s.row.absolute}
    stats = _stats(problem, result)
    health, reasons = _health(trajectory, since, _misfits(problem, result, stats))
    ledger = _ledger(problem, recording, result.verdicts)
    return Solution(
        datum=problem.datum,
        trajectory=trajectory,
        v_cov=np.array([tree.marginalCovariance(keys.velocity(k)) for k in range(n)]),
        accel_bias_mps2=np.array([b.accelerometer() for b in bias]),
        gyro_bias_radps=gyro_bias,
        gyro_radps=gyro,
        health=health,
        health_reason=reasons,
        since_agreed_s=since,
        slow={s.name: _slow(problem, s, result) for s in problem.streams if s.slow is not None},
        berths=tuple(_berth_tracks(problem, result, trajectory)),
        ledger=ledger,
        stats=stats,
    )


def _berth_tracks(problem: Problem, result: BatchResult, trajectory: Trajectory) -> Iterator[BerthTrack]:
    """The vessel seen from each berth that is near."""
    for stream in problem.streams:
        for berth in stream.row.berths(stream.config):
            near = np.linalg.norm(trajectory.p_world_m[:, :2] - berth.point_m[:2], axis=1) < _NEAR_BERTH_M
            picked = np.flatnonzero(near)
            if not len(picked):
                continue
            moved = _moved(problem, result, stream, berth, trajectory.stamps_ns[picked])
            value, J = seen_from(berth, trajectory.p_world_m[picked], trajectory.yaw_rad[picked], moved)
            stamps = trajectory.stamps_ns[picked]
            cov = np.array([
                j @ _of_pose_and_berth(problem, result, stream, berth, int(k)) @ j.T for j, k in zip(J, picked, strict=True)
            ])  # fmt: skip
            rate = rates(value, (stamps - stamps[0]) * 1e-9)
            yield BerthTrack(berth=berth, stamps_ns=stamps, value=value, rate=rate, cov=cov)


_IN_PLANE = np.array([0, 1, 2, 5])  # of a berth's motion: its roll and pitch do not show


def _moved(problem: Problem, result: BatchResult, stream: Stream, berth: Berth, stamps: NDArray[np.int64]) -> Array:
    """How a berth has moved (N, 4) at N stamps; between two of its slow nodes it is in between."""
    if berth.moves is None:
        return np.zeros((len(stamps), 4))
    at = problem.timeline.slow_stamps_ns
    nodes = [keys.slow(stream.number, j) for j in range(len(at))]
    held = np.array([np.atleast_1d(result.values.atVector(key))[berth.moves + _IN_PLANE] for key in nodes])
    return np.column_stack([np.interp(stamps, at, column) for column in held.T])


def _of_pose_and_berth(problem: Problem, result: BatchResult, stream: Stream, berth: Berth, k: int) -> Array:
    """Covariance (7, 7) of east, north, yaw of the body and of how the berth has moved: known together, not apart."""
    R = result.values.atPose3(keys.pose(k)).rotation().matrix()
    wanted = [keys.pose(k)]
    if berth.moves is not None:
        wanted.append(keys.slow(stream.number, int(problem.timeline.slow_of[k])))
    joint = np.asarray(result.tree.jointMarginalCovariance(wanted).fullMatrix())
    kept = np.zeros((7, len(joint)))
    kept[:3, :6] = _to_world(R, -problem.t_body_imu_m)[[0, 1, 5]]
    if berth.moves is not None:
        kept[3:, 6 + berth.moves + _IN_PLANE] = np.eye(4)
    return np.asarray(kept @ joint @ kept.T)


def left_out(streams: Sequence[Any]) -> Array:
    """Return the covariance (3, 3) of slow errors that nothing can tell from motion: the position is off by as much."""
    total = np.zeros((3, 3))
    for stream in streams:
        if stream.left_out is not None:
            total += np.diag(stream.left_out.sigma**2)
    if any(s.row.synthetic is not None and getattr(s.config, "height_m", None) is not None for s in streams):
        total[2, 2] = 0.0  # the height is known otherwise; taken from the fixes, it is as far off as they are
    return total


def _far_from_prior(stream: Stream, result: BatchResult) -> tuple[float, str]:
    """How many of its sigmas a constant slow state (a mount's offset) lies from zero, 0 where there is none; which, and where."""
    slow = stream.slow
    if slow is None:
        return 0.0, ""
    value = np.atleast_1d(result.values.atVector(keys.slow(stream.number, 0)))
    far = np.where(np.isfinite(slow.time_constant_s), 0.0, np.abs(value) / slow.sigma)
    k = int(np.argmax(far))
    where = f"{slow.axes[k]} {value[k] * slow.scale[k]:.3g} {slow.units[k]}"
    return float(far[k]), f"its {slow.offset or slow.name} is estimated {far[k]:.1f} sigmas ({where})"


def _misfits(problem: Problem, result: BatchResult, stats: SolveStats) -> list[str]:
    """Why each state cannot be called good; empty where nothing speaks against it."""
    stamps_ns, why = problem.timeline.stamps_ns, ""
    if not result.converged:
        why = "the solver did not converge"
    elif result.noise_scale > NO_NOISE or stats.cost > _NO_FIT * max(stats.expected_cost, 1.0):
        why = "the measurements contradict each other"
    said = [why] * len(stamps_ns)
    for stream in problem.streams:
        if not why and stream.left_out is None and stream.slow is None:  # else the bounds allow for a slow error
            for at_ns in stream.position_jumps[0]:
                for k in np.flatnonzero(np.abs(stamps_ns - at_ns) < LASTS_S * 1e9):
                    said[int(k)] = why_in_doubt(stream.name)
    return said


def world_covariance(cov_body: Any, R: Array, lever_m: Array) -> Array:
    """Turn a body-tangent covariance (rotation first) into x, y, z, rotation, all about the world's axes.

    For the point `lever_m` (body axes) from the state. Only the blocks are rotated: the full adjoint
    would mix yaw times distance from the datum into position.
    """
    turn = _to_world(R, lever_m)
    return np.asarray(turn @ np.asarray(cov_body) @ turn.T)


def _to_world(R: Array, lever_m: Array) -> Array:
    """Return d (place of a point, rotation; world's axes) / d body tangent (6, 6)."""
    turn = np.zeros((6, 6))
    turn[:3, :3] = -R @ skew(lever_m)
    turn[:3, 3:], turn[3:, :3] = R, R
    return turn


def _slow(problem: Problem, stream: Stream, result: BatchResult) -> SlowEstimate:
    process = stream.slow
    assert process is not None
    name = [keys.slow(stream.number, j) for j in range(len(problem.timeline.slow_stamps_ns))]
    value = np.array([np.atleast_1d(result.values.atVector(key)) for key in name])
    sigma = np.array([np.sqrt(np.diagonal(np.atleast_2d(result.tree.marginalCovariance(key)))) for key in name])
    return SlowEstimate(
        name=process.name,
        axes=process.axes,
        units=process.units,
        stamps_ns=problem.timeline.slow_stamps_ns,
        value=value * process.scale,
        sigma=sigma * np.abs(process.scale),
    )


def _since_agreed(problem: Problem, stream: Stream, verdicts: dict[tuple[int, int], Verdict]) -> Array:
    agreed = np.array(
        [m.stamp_ns for i, m in enumerate(stream.measurements) if verdicts[(stream.number, i)].weight >= AGREES],
        dtype=np.int64,
    )
    stamps = problem.timeline.stamps_ns
    if not len(agreed):
        return np.full(len(stamps), np.inf)
    left = np.searchsorted(agreed, stamps, side="right") - 1
    return np.where(left >= 0, (stamps - agreed[np.maximum(left, 0)]) * 1e-9, np.inf)


def _or_until(since: Array, stamps_ns: NDArray[np.int64]) -> Array:
    """Seconds since a sensor agreed, or until it first does: a smoother knows what comes."""
    known = np.flatnonzero(np.isfinite(since))
    if not len(known):
        return since
    first = stamps_ns[known[0]] - int(since[known[0]] * 1e9)
    return np.where(np.isfinite(since), since, (first - stamps_ns) * 1e-9)


def _health(
    trajectory: Trajectory, since: dict[str, Array], misfits: Sequence[str]
) -> tuple[tuple[Health, ...], tuple[str, ...]]:
    assert trajectory.cov is not None
    away = {name: _or_until(s, trajectory.stamps_ns) for name, s in since.items()}
    found = [
        health_of(cov, {name: float(s[k]) for name, s in away.items()}, misfits[k])
        for k, cov in enumerate(trajectory.cov)
    ]
    return tuple(health for health, _ in found), tuple(why for _, why in found)


def health_of(cov: Array, away_s: Mapping[str, float], misfit: str = "") -> tuple[Health, str]:
    """Return how far a pose can be trusted, and why not fully.

    Args:
        cov: (6, 6) as in `Trajectory`. away_s: s to where each absolute sensor agrees.
        misfit: what else speaks against it.
    """
    bound_m, _, heading_deg = (float(v) for v in bounds_95(cov[None])[0])
    silent = [name for name, s in away_s.items() if s > _SILENT_S]
    if bound_m > _LOST_BOUND_M or heading_deg > _LOST_HEADING_DEG:
        return Health.LOST, f"95 % bound {bound_m:.0f} m, heading {heading_deg:.0f} deg"
    if min(away_s.values(), default=np.inf) > _DEAD_RECKONING_S:
        return Health.DEAD_RECKONING, "no absolute position agrees"
    if bound_m > _GOOD_BOUND_M:
        return Health.DEGRADED, f"95 % bound {bound_m:.1f} m"
    if silent:
        return Health.DEGRADED, f"{', '.join(silent)} missing or not agreeing"
    return (Health.DEGRADED, misfit) if misfit else (Health.GOOD, "")


def _ledger(problem: Problem, recording: Recording, verdicts: dict[tuple[int, int], Verdict]) -> Ledger:
    ledger = Ledger(recording.rows)
    for row in problem.rejected:
        if row.seq >= 0:
            ledger.add(row)
    imu_topic = recording.topics.get(problem.imu.sensor, "")
    for seq, stamp in zip(problem.imu.seqs.tolist(), problem.imu.stamps_ns.tolist(), strict=True):
        ledger.add(LedgerRow(seq=seq, stamp_ns=stamp, sensor=problem.imu.sensor, topic=imu_topic, outcome=Outcome.USED))
    for stream in problem.streams:
        for i, m in enumerate(stream.measurements):
            if m.seq >= 0:  # synthetic measurements are configuration, not messages
                topic = recording.topics.get(stream.name, "")
                ledger.add(row_of(stream, m, topic, verdicts[(stream.number, i)]))
    return ledger


def row_of(stream: Judged, m: Measurement, topic: str, verdict: Verdict) -> LedgerRow:
    """Return the row of a measurement that was judged."""
    residual, weight = verdict.residual, verdict.weight
    nis, dof = residual.nis(), len(residual.raw)
    if weight >= AGREES:
        outcome, reason = Outcome.USED, ""
    elif stream.row.false is None and verdict.decision is None:
        outcome, reason = Outcome.REJECTED, "frozen receiver: it repeats one position while the vessel moves"
    elif stream.row.false is not None and weight < _FALSE:
        outcome, reason = Outcome.REJECTED, "judged false: no mode agrees with the rest"
    else:
        outcome, reason = Outcome.DOWN_WEIGHTED, "disagrees with the rest"
    several = stream.row.false is not None
    return LedgerRow(
        seq=m.seq,
        stamp_ns=m.stamp_ns,
        sensor=stream.name,
        topic=topic,
        outcome=outcome,
        weight=weight,
        mode=verdict.mode if several else None,
        mode_probability=verdict.mode_probability if several else None,
        mode_settled=verdict.settled if several else None,
        residual_m=residual.size_m,
        residual_deg=residual.size_deg,
        nis=nis,
        dof=dof,
        reason=reason,
        detail=stream.row.describe(m),
    )


def alone(sensor: str, slow: SlowProcess) -> str:
    """Say what a slow error that nothing can tell from motion does to the bounds."""
    return (
        f"{sensor}: no second sensor can separate its slow error (multipath) from motion; the bounds include "
        f"{slow.sigma[0]:.1f} m (1 sigma) for it; set slow_error.enabled: false if it has none (RTK in the open)"
    )


def disagreeing(sensor: str, weights: Array) -> list[str]:
    """Say where most measurements (N,) of a sensor disagree with the rest: a line, or none."""
    share = float((weights < AGREES).mean()) if len(weights) else 0.0
    if share <= 0.5 or len(weights) <= 10:
        return []
    return [f"{sensor}: {100 * share:.0f} % of its measurements disagree with the rest"]


def refused_together(sensor: str, stamps_ns: NDArray[np.int64], weights: Array, false: Array) -> list[str]:
    """Say where more measurements (N,) in a row are refused than false ones come together by chance: a line, or none.

    Args:
        false: (N,) probability of each that it is false.
    """
    edges = np.flatnonzero(np.diff((weights < AGREES).astype(int), prepend=0, append=0)).reshape(-1, 2)
    chance = np.concatenate([[0.0], np.cumsum(np.log(np.maximum(false, 1e-6)))])
    rows = [
        ((stamps_ns[end - 1] - stamps_ns[begin]) * 1e-9, begin, end)
        for begin, end in edges
        if end - begin < len(weights) and np.log(len(weights)) + chance[end] - chance[begin] < np.log(_BY_CHANCE)
    ]
    lasts_s, begin, end = max(rows, default=(0.0, 0, 0))
    if lasts_s < _TOGETHER_S:
        return []
    since = utc_text(int(stamps_ns[begin]))
    return [
        f"{sensor}: all {end - begin} measurements in the {lasts_s:.0f} s from {since} on are rejected: they or the track are wrong"
    ]


def _stats(problem: Problem, result: BatchResult) -> SolveStats:
    expected = expected_cost(problem, result.verdicts)
    warnings = list(problem.warnings)
    if not result.converged:
        warnings.append("the solver did not converge: the last pass still moved the track by centimetres or more")
    if result.noise_scale > 1.0:
        said = (
            f"IMU noise scaled up {result.noise_scale:.1f} times: as configured, the IMU contradicts the other sensors"
        )
        if result.noise_scale > NO_NOISE:
            cure = "no IMU is that noisy: look for a wrong mount, unit, axis convention, time offset or sensor"
        else:
            cure = (
                "set accel_noise_ug_per_sqrt_hz and gyro_noise_mdps_per_sqrt_hz accordingly, or look for a wrong mount"
            )
            if any(stream.constants for stream in problem.streams):
                cure += ", or for tags on a floating dock that the survey has as fixed"
        warnings.append(f"{said}; {cure}")
    cost = 2.0 * float(result.graph.error(result.values)) - outliers_cost(result.verdicts)
    if expected > 0 and cost > _NO_FIT * expected:
        warnings.append(
            f"the cost is {cost / expected:.1f} times its expectation: noise is configured too small, or a "
            "mount, a unit or a time offset is wrong"
        )
    if (beside_m := largest_sigma(result.levels_cov)) > _LEVELS_M:
        warnings.append(
            "the fixes jump, and no other sensor shows which level is right: the one held longest is taken, "
            f"and the bounds include {beside_m:.1f} m (1 sigma) for the others"
        )
    for stream in problem.streams:
        far, said = _far_from_prior(stream, result)
        if far > _FAR_OFF:
            warnings.append(
                f"{stream.name}: {said} from zero: check its mount and the IMU's, or raise the configured sigma"
            )
        for key, constant in zip(constant_keys(stream), stream.constants, strict=True):
            if result.values.exists(key):
                off = float(np.abs(np.atleast_1d(result.values.atVector(key)) / constant.sigma).max())
                if off > _FAR_OFF:
                    warnings.append(
                        f"{stream.name}: {constant.name} is {off:.1f} sigmas from the survey: survey it again, or raise "
                        "its sigmas"
                    )
        if stream.left_out is not None:
            warnings.append(alone(stream.name, stream.left_out))
        allowed = stream.left_out is not None
        warnings += jump_warnings(stream.name, *stream.position_jumps, allowed=allowed, followed=stream.slow is None)
        weights = np.array([result.verdicts[(stream.number, i)].weight for i in range(len(stream.measurements))])
        warnings += disagreeing(stream.name, weights)
        if stream.row.false is not None:
            stamps_ns = np.array([m.stamp_ns for m in stream.measurements])
            false = np.array([stream.row.false(m, stream.config).probability for m in stream.measurements])
            warnings += refused_together(stream.name, stamps_ns, weights, false)
    return SolveStats(
        passes=result.passes,
        iterations=result.iterations,
        states=len(problem.timeline),
        factors=int(result.graph.size()),
        cost=cost,
        expected_cost=expected,
        converged=result.converged,
        warnings=tuple(warnings),
    )
