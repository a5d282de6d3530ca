# SPDX-License-Identifier: Apache-2.0
"""From a solved graph to a `Solution`: world-axes covariances, ledger, health."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from graphloc import keys
from graphloc.berths import Berth, BerthTrack, rates, seen_from
from graphloc.build import Problem, Stream, solved_constants
from graphloc.errors import SolveError, in_one_line
from graphloc.frames import Array
from graphloc.graph import TIME_OFFSET, antenna_off_m, corrections
from graphloc.judge.covariances import (
    ANY_HEADING_RAD,
    limit_heading,
    to_world,
    unmodelled_covariance,
    widen_heading,
    world_covariance,
)
from graphloc.judge.health import late_of, of_receivers
from graphloc.judge.ledger import ledger_of
from graphloc.recording import Recording
from graphloc.signals.series import interpolated
from graphloc.solution import SlowEstimate, Solution
from graphloc.solve._doubt import widen_by_doubt
from graphloc.solve._drift import with_drift_taken_back
from graphloc.solve._health import health_over_time, misfits, since_agreed
from graphloc.solve._marginals import marginals
from graphloc.solve.batch import BatchResult
from graphloc.solve.imu_mount import mount_error
from graphloc.solve.unmodelled import unmodelled
from graphloc.solve.warnings import mount_event, mount_warning, stats_of
from graphloc.trajectory import Trajectory

# Distance from a berth within which the track is also given from there; its tags are seen from 25 m. Only outputs
# depend on it.
_NEAR_BERTH_M = 60.0
_SHOWN_RAD = np.radians(15.0)  # 1 sigma, somewhere in the run, below which the motion tells the heading
_TOLD_RAD = np.radians(7.0)  # 1 sigma of a heading for which headings 30 deg off cost 8 nats more, as in `_start`


class _States(NamedTuple):
    """The N states of a solved run, with the arrays of a `Solution`."""

    trajectory: Trajectory
    v_cov: Array
    accel_bias_mps2: Array
    gyro_bias_radps: Array
    gyro_radps: Array
    gyro_cov: Array


def make_solution(
    problem: Problem, recording: Recording, result: BatchResult, stepped: Collection[str] = ()
) -> Solution:
    """Return the solution of a run.

    Args:
        problem: with the noise as configured. recording: what was measured. result: of the solver.
        stepped: as of `misfits`.
    """
    known = result
    result, unsaid = _without_drift(known)
    states = _states_of(problem, result)
    unsaid += _widen(known, states)
    trajectory = states.trajectory
    since = {s.name: since_agreed(problem, s, result.verdicts) for s in problem.streams if s.row.absolute}
    stats = stats_of(problem, result)
    stats = replace(stats, warnings=(*stats.warnings, *unsaid), events=mount_event(result.problem))
    health, reasons = health_over_time(
        trajectory,
        of_receivers(since, problem.config),
        misfits(problem, result, stats, stepped),
        problem.config.output.good_bound_m,
    )
    ledger = ledger_of(problem, recording, result.verdicts)
    corrected = {s.name: corrections(solved_constants(s, result.values), s.mount) for s in problem.streams}
    return Solution(
        datum=problem.datum,
        trajectory=trajectory,
        v_cov=states.v_cov,
        accel_bias_mps2=states.accel_bias_mps2,
        gyro_bias_radps=states.gyro_bias_radps,
        gyro_radps=states.gyro_radps,
        gyro_cov=states.gyro_cov,
        health=health,
        health_reason=reasons,
        since_agreed_s=since,
        slow={s.name: _slow(problem, s, result) for s in problem.streams if s.slow is not None},
        berths=tuple(_berth_tracks(problem, result, trajectory)),
        ledger=ledger,
        stats=stats,
        time_offsets_s={
            **{name: found[TIME_OFFSET] for name, found in corrected.items() if TIME_OFFSET in found},
            **{s.name: late_s for s in problem.streams if (late_s := late_of(s, result.values)) is not None},
        },
        antennas_off_m={
            name: off_m for name, found in corrected.items() if (off_m := antenna_off_m(found)) is not None
        },
    )


def _states_of(problem: Problem, result: BatchResult) -> _States:
    """Return the states, moved from the IMU to the body's origin.

    Their covariance is that of the graph, with that of slow errors that are left out, and of other levels.
    """
    states, values = range(len(problem.timeline)), result.values
    poses = [values.atPose3(keys.pose(k)) for k in states]
    R = np.array([p.rotation().matrix() for p in poses])
    bias = [values.atConstantBias(keys.bias(int(j))) for j in problem.timeline.slow_of]
    gyro_bias = np.array([b.gyroscope() for b in bias])
    links, R_body_imu = result.problem.links, result.problem.R_body_imu
    gyro = links.gyro_at(problem.timeline.stamps_ns) - gyro_bias @ R_body_imu.T
    nodes = range(len(problem.timeline.slow_stamps_ns))
    bias_cov = np.array([R_body_imu @ result.cov[keys.bias(j)][3:, 3:] @ R_body_imu.T for j in nodes])
    white = links.gyro_variance_at(problem.timeline.stamps_ns)[:, None, None] * np.eye(3)
    lever = -problem.t_body_imu_m
    cov = np.array([world_covariance(result.cov[keys.pose(k)], R[k], lever) for k in states])
    cov[:, :3, :3] += unmodelled_covariance(problem.streams) + result.levels_cov
    trajectory = Trajectory(
        stamps_ns=problem.timeline.stamps_ns,
        p_world_m=np.array([p.transformFrom(lever) for p in poses]),
        R_world_body=R,
        v_world_mps=np.array([values.atVector(keys.velocity(k)) for k in states])
        + np.einsum("nij,nj->ni", R, np.cross(gyro, lever)),
        cov=cov,
    )
    return _States(
        trajectory=trajectory,
        v_cov=np.array([result.cov[keys.velocity(k)] for k in states]),
        accel_bias_mps2=np.array([b.accelerometer() for b in bias]),
        gyro_bias_radps=gyro_bias,
        gyro_radps=gyro,
        gyro_cov=white + bias_cov[problem.timeline.slow_of],
    )


def _widen(result: BatchResult, states: _States) -> list[str]:
    """Widen the covariances, in place, by what the graph does not know; return warnings."""
    cov, v_cov = states.trajectory.cov, states.v_cov
    assert cov is not None
    guess = _add_others(result, cov)
    unsaid = [
        *_add_unmodelled(result, cov, v_cov),
        *_add_mount(result, states.trajectory.R_world_body, cov, v_cov),
        *(guess or _add_guess(result, cov)),
        *_add_doubt(result, cov),
    ]
    limit_heading(cov)
    return unsaid


def _add_doubt(result: BatchResult, cov: Array) -> list[str]:
    """Widen position and heading by the doubt about the choice of modes; return warnings, also where that fails."""
    try:
        return widen_by_doubt(result, cov)
    except (SolveError, RuntimeError, np.linalg.LinAlgError, MemoryError) as error:
        return [f"the bounds do not include that believed poses may be false together ({in_one_line(error)})"]


def _without_drift(result: BatchResult) -> tuple[BatchResult, list[str]]:
    """Take back what a left-out drift did to heading and velocity; also return a warning where that fails."""
    try:
        return with_drift_taken_back(result), []
    except (RuntimeError, MemoryError) as error:
        return result, [
            f"heading and velocity follow the slow GNSS error: its effect is not determined ({in_one_line(error)})"
        ]


def _add_unmodelled(result: BatchResult, cov: Array, v_cov: Array) -> list[str]:
    """Add what left-out slow errors do to attitude and velocity; return a warning where that fails."""
    try:
        more = unmodelled(result)
    except RuntimeError as error:
        said = "the bounds of heading and velocity do not include the slow GNSS error: its effect is not determined"
        return [f"{said} ({in_one_line(error)})"]
    if more is not None:
        cov[:, 3:, 3:] += more.rotation
        v_cov += more.velocity
    return []


def _add_mount(result: BatchResult, R: Array, cov: Array, v_cov: Array) -> list[str]:
    """Add what is unknown of the IMU's mount; return a warning where that fails, or where the mount is far off."""
    problem = result.problem
    try:
        found = result.mount or mount_error(problem, result.graph, result.values, result.verdicts, result.prior)
    except (RuntimeError, np.linalg.LinAlgError, MemoryError) as error:
        return [f"the bounds do not include that the IMU's mount may be off ({in_one_line(error)})"]
    if found is None:
        return []
    cov += found.pose_covariance(R, -problem.t_body_imu_m)
    v_cov += found.velocity_covariance()
    return mount_warning(problem, found)


def _add_others(result: BatchResult, cov: Array) -> list[str]:
    """Raise the uncertainty of the heading to what the other headings that explain the motion make it.

    Returns:
        A warning if the heading is a guess.
    """
    # After the first window, turns or a sensor may tell the heading.
    told = (np.arange(len(cov)) > result.begun) & (cov[:, 5, 5] < _TOLD_RAD**2)
    var = np.where(told, 0.0, result.heading_var)
    widen_heading(cov, var)
    sure = np.sqrt(var.min())
    if sure < _SHOWN_RAD:
        return []
    said = f"the heading is a guess: no sensor measures it, and the motion shows it only to {np.degrees(sure):.0f} deg (1 sigma) at best"
    return [
        f"{said}; turn or accelerate more, add a heading sensor, wheels or a log (body_velocity), or set start.heading_deg"
    ]


def _add_guess(result: BatchResult, cov: Array) -> list[str]:
    """State the heading as unknown, and return a warning, where no sensor measures it and the vessel stays in place.

    Nothing is done where waves show the heading. Linearised about the heading that is assumed, the run is as sure as
    its biases allow: to 25 deg.
    """
    if result.headings or float(cov[:, 5, 5].min()) < _SHOWN_RAD**2:
        return []
    widen_heading(cov, cov[:, 5, 5] + ANY_HEADING_RAD**2)
    return [
        "the heading is a guess: no sensor measures it, nor does the motion show it; move, add a heading sensor or set start.heading_deg"
    ]


def _berth_tracks(problem: Problem, result: BatchResult, trajectory: Trajectory) -> Iterator[BerthTrack]:
    """Yield the track of the vessel as seen from each berth that it comes near."""
    for stream in problem.streams:
        for berth in stream.row.berths(stream.config):
            near = np.linalg.norm(trajectory.p_world_m[:, :2] - berth.point_m[:2], axis=1) < _NEAR_BERTH_M
            picked = np.flatnonzero(near)
            if not len(picked):
                continue
            moved = _moved(problem, result, stream, berth, trajectory.stamps_ns[picked])
            value, J = seen_from(berth, trajectory.p_world_m[picked], trajectory.yaw_rad[picked], moved)
            stamps = trajectory.stamps_ns[picked]
            joint = _of_pose_and_berth(problem, result, stream, berth, picked)
            cov = J @ joint @ J.transpose(0, 2, 1)
            rate = rates(value, (stamps - stamps[0]) * 1e-9)
            yield BerthTrack(berth=berth, stamps_ns=stamps, value=value, rate=rate, cov=cov)


_IN_PLANE = np.array([0, 1, 2, 5])  # axes of a berth's motion that are used: roll and pitch do not show


def _moved(problem: Problem, result: BatchResult, stream: Stream, berth: Berth, stamps: NDArray[np.int64]) -> Array:
    """Return how a berth has moved (N, 4), east, north, up, psi, at N stamps, interpolated between slow nodes."""
    if berth.moves is None:
        return np.zeros((len(stamps), 4))
    at = problem.timeline.slow_stamps_ns
    nodes = [keys.slow(stream.number, j) for j in range(len(at))]
    held = np.array([result.values.atVector(key)[berth.moves + _IN_PLANE] for key in nodes])
    return interpolated(stamps, at, held)


def _of_pose_and_berth(
    problem: Problem, result: BatchResult, stream: Stream, berth: Berth, states: NDArray[np.int64]
) -> Array:
    """Return joint covariances (N, 7, 7) of east, north, yaw of the body and of how the berth has moved.

    The two are known together better than each by itself.
    """
    poses = [keys.pose(k) for k in states.tolist()]
    R = [result.values.atPose3(key).rotation().matrix() for key in poses]
    if berth.moves is None:
        joint = np.array([result.cov[key] for key in poses])
    else:
        nodes = problem.timeline.slow_of[states].tolist()
        pairs = [(key, keys.slow(stream.number, j)) for key, j in zip(poses, nodes, strict=True)]
        found = marginals(result.graph, result.values, pairs).joint
        joint = np.array([found[pair] for pair in pairs])
    kept = np.zeros((len(poses), 7, joint.shape[1]))
    kept[:, :3, :6] = [to_world(turn, -problem.t_body_imu_m)[[0, 1, 5]] for turn in R]
    if berth.moves is not None:
        kept[:, 3:, 6 + berth.moves + _IN_PLANE] = np.eye(4)
    return np.asarray(kept @ joint @ kept.transpose(0, 2, 1))


def _slow(problem: Problem, stream: Stream, result: BatchResult) -> SlowEstimate:
    process = stream.slow
    assert process is not None
    name = [keys.slow(stream.number, j) for j in range(len(problem.timeline.slow_stamps_ns))]
    value = np.array([result.values.atVector(key) for key in name])
    sigma = np.array([np.sqrt(np.diagonal(result.cov[key])) for key in name])
    return SlowEstimate(
        name=process.name,
        axes=process.axes,
        units=process.units,
        stamps_ns=problem.timeline.slow_stamps_ns,
        value=value * process.scale,
        sigma=sigma * np.abs(process.scale),
    )
