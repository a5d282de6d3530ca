# SPDX-License-Identifier: Apache-2.0
"""Start alignment: attitude, heading, position, velocity and gyro bias from the first seconds.

It uses a window, never a single measurement: gyro bias from standstill, or from the difference between headings and integrated
rates; roll and pitch from the mean specific force in a frame propagated by the gyroscope; heading from poses, compass or
course. Where headings disagree, or none is known, there are several candidates, and the solver tries each.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from graphloc.build import Level, Problem
from graphloc.config import STANDARD_GRAVITY_MPS2
from graphloc.errors import SolveError
from graphloc.frames import Array, skew, wrap_angle, yaw_from_heading_deg
from graphloc.graph import Hint
from graphloc.time import duration_ns, utc_text

_STILL_GYRO_RADPS, _STILL_ACCEL_MPS2 = 0.03, 0.3  # spread at standstill, engine running
_STILL_SPEED_MPS = 0.15
_FEWEST_HEADINGS = 4  # of a standstill, that show a turn
_USUAL_SPEED_MPS = 10.0  # 1 sigma, where the speed is unknown
_BLOCK_S, _SWELL_S = 0.5, 10.0
_CARRIED_RAD = np.radians(20.0)  # error by gyro bias, 1 sigma: from later on, a heading is no longer one of the start
_OWN_TILT_RAD = 0.5  # 1 sigma of roll and pitch, without accelerometer data
MOVED_M = 15.0  # travel from which the heading is observable without a heading sensor


@dataclass(frozen=True, slots=True, kw_only=True)
class Start:
    """A start: level attitude without heading, and candidates for the heading.

    Attributes:
        R_level_body: (3, 3) attitude with yaw 0. tilt_sigma_rad: of roll and pitch, where there is no `level`.
        yaws_rad: candidates. yaw_sigma_rad: of each (wide where it is a guess). by_motion: no sensor tells the heading, the motion may.
        p_world_m, p_sigma_m, v_world_mps, v_sigma_mps: (3,) each.
        gyro_bias_radps, gyro_bias_sigma_radps: (3,) in IMU axes.
        window_s: span over which the candidates must be distinguished.
        notes: what the alignment is based on.
    """

    R_level_body: Array
    tilt_sigma_rad: float
    level: Level | None
    yaws_rad: tuple[float, ...]
    yaw_sigma_rad: float
    by_motion: bool
    p_world_m: Array
    p_sigma_m: Array
    v_world_mps: Array
    v_sigma_mps: Array
    gyro_bias_radps: Array
    gyro_bias_sigma_radps: Array
    window_s: float
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class _Track:
    """Positions in world, moved from antenna to body as far as that needs no attitude: t (M,), s; p (M, 3), m; sigma (M, 3), m."""

    t: Array
    p: Array
    sigma: Array


def align(problem: Problem) -> Start:
    """Return the start of a run.

    Raises:
        SolveError: no sensor measures position.
    """
    origin = int(problem.imu.stamps_ns[0])
    window = problem.config.start.window_s
    hints = _hints(problem, origin)
    track, yaws = _track(hints), _yaws(hints)
    if not len(track.t):
        raise SolveError(
            f"no position from {utc_text(origin)} on: no GNSS fix and no pose was accepted; "
            f"check the topics, the status and the stamps with `graphloc inspect`{problem.silent}"
        )
    still = _standstill(problem, track, yaws)
    bias, bias_sigma, notes = _gyro_bias(problem, window, still, yaws)
    early = {name: rows for name, rows in yaws.items() if rows[0, 0] * bias_sigma[2] < _CARRIED_RAD}
    moved_s = _moved_at(track)
    if early or (moved_s is not None and moved_s < min((rows[0, 0] for rows in yaws.values()), default=np.inf)):
        yaws = early
    turn = _turns(problem, max([window, *(rows[0, 0] for rows in yaws.values())]) + 10.0 if yaws else 180.0, bias)
    at_start = still if still is not None and still[0] == 0.0 else None
    R_level, tilt_sigma, level, tilt_note = _level(problem, window, at_start, turn, bias)
    yaws_rad, yaw_sigma_rad, window_s, heading_note = _headings(problem, track, yaws, turn)
    p0, p_sigma, v0, v_sigma = _position_and_velocity(hints, track, at_start)
    return Start(
        R_level_body=R_level,
        tilt_sigma_rad=tilt_sigma,
        level=level,
        yaws_rad=yaws_rad,
        yaw_sigma_rad=yaw_sigma_rad,
        by_motion=problem.config.start.heading_deg is None and not yaws and moved_s is not None,
        p_world_m=p0,
        p_sigma_m=p_sigma,
        v_world_mps=v0,
        v_sigma_mps=v_sigma,
        gyro_bias_radps=problem.R_body_imu.T @ bias,
        gyro_bias_sigma_radps=bias_sigma,
        window_s=window_s,
        notes=(*notes, tilt_note, heading_note),
    )


def _hints(problem: Problem, origin: int) -> dict[str, list[tuple[float, Hint]]]:
    """Return by sensor the hints (position, heading, velocity) of its measurements, with their times, s."""
    found = {}
    for stream in problem.streams:
        R_sensor = stream.mount.rotation().matrix()
        mount_yaw = float(np.arctan2(R_sensor[1, 0], R_sensor[0, 0]))
        found[stream.name] = [
            ((m.stamp_ns - origin) * 1e-9, stream.row.hint(m, mount_yaw, problem.datum)) for m in stream.measurements
        ]
    return found


def _track(hints: dict[str, list[tuple[float, Hint]]]) -> _Track:
    rows = [(t, h) for found in hints.values() for t, h in found if np.isfinite(h.p_world_m[:2]).all()]
    rows.sort(key=lambda row: row[0])
    return _Track(
        np.array([t for t, _ in rows]),
        np.array([h.p_world_m for _, h in rows]).reshape(-1, 3),
        np.array([h.p_sigma_m for _, h in rows]).reshape(-1, 3),
    )


def _yaws(hints: dict[str, list[tuple[float, Hint]]]) -> dict[str, Array]:
    """Return by sensor (M, 3): time (s), yaw of the body (rad), sigma (rad)."""
    rows = {
        name: [(t, h.yaw_rad, h.yaw_sigma_rad) for t, h in found if np.isfinite(h.yaw_rad)]
        for name, found in hints.items()
    }
    return {name: np.array(found) for name, found in rows.items() if found}


def _samples(problem: Problem, start_s: float, stop_s: float) -> tuple[Array, Array, Array]:
    """Return t (M,) s, specific force and rate (M, 3) in body axes over a span."""
    origin = problem.imu.stamps_ns[0]
    lo, hi = np.searchsorted(problem.imu.stamps_ns, [origin + duration_ns(start_s), origin + duration_ns(stop_s)])
    hi = max(int(hi), int(lo) + 2)
    t = (problem.imu.stamps_ns[lo:hi] - origin) * 1e-9
    R = problem.R_body_imu
    return t, problem.imu.accel_mps2[lo:hi] @ R.T, problem.imu.gyro_radps[lo:hi] @ R.T


def _standstill(problem: Problem, track: _Track, yaws: dict[str, Array]) -> tuple[float, float] | None:
    """Return the longest stretch of the run (at least 3 s) without rotation, acceleration or vibration."""
    span = float((problem.imu.stamps_ns[-1] - problem.imu.stamps_ns[0]) * 1e-9)
    t, f, w = _samples(problem, 0.0, span)
    block = np.floor(t).astype(np.int64)
    start = np.searchsorted(block, np.arange(block[-1] + 2))
    quiet = [
        b - a > 3
        and bool((w[a:b].std(axis=0) < _STILL_GYRO_RADPS).all() and (f[a:b].std(axis=0) < _STILL_ACCEL_MPS2).all())
        for a, b in pairwise(start)
    ]
    best: tuple[float, float] | None = None
    edges = np.flatnonzero(np.diff(np.concatenate([[0], np.array(quiet, dtype=int), [0]])))
    for first, last in zip(edges[::2], edges[1::2], strict=True):
        longer = best is None or last - first > best[1] - best[0]
        if last - first >= 3 and longer and _rests(track, yaws, float(first), float(last)):
            best = (float(first), float(last))
    return best


def _rests(track: _Track, yaws: dict[str, Array], first: float, last: float) -> bool:
    """Whether positions and headings confirm that a quiet stretch is standstill, and no steady motion or turn."""
    inside = (track.t >= first) & (track.t <= last)
    if inside.sum() < 4 or np.ptp(track.t[inside]) < 0.5 * (last - first):
        return False
    slope = [_slope(track.t[inside], track.p[inside, i]) for i in range(2)]
    noise = 2.0 * float(np.nanmedian(track.sigma[inside, :2])) / float(np.ptp(track.t[inside]))
    if np.hypot(slope[0], slope[1]) > _STILL_SPEED_MPS + min(noise, 0.3):
        return False
    for rows in yaws.values():
        near = _within(rows, first, last)
        if len(near) >= _FEWEST_HEADINGS:
            noise = 3.0 * float(near[:, 2].mean()) / float(np.ptp(near[:, 0])) / np.sqrt(len(near))
            if abs(_slope(near[:, 0], np.unwrap(near[:, 1]))) > 0.01 + noise:
                return False
    return True


def _within(rows: Array, first: float, last: float) -> Array:
    """Return the headings (M, 3) of a sensor from `first` to `last`, s."""
    return rows[(rows[:, 0] >= first) & (rows[:, 0] <= last)]


def _headed(yaws: dict[str, Array], first: float, last: float) -> bool:
    """Whether a sensor tells the heading through a stretch, and with it any turn."""
    found = (_within(rows, first, last) for rows in yaws.values())
    return any(len(rows) >= _FEWEST_HEADINGS and np.ptp(rows[:, 0]) > 0.5 * (last - first) for rows in found)


def _slope(t: Array, y: Array) -> float:
    """Return the Theil-Sen slope: the median over pairs that are far enough apart."""
    n = len(t)
    i = np.arange(n)
    j = (i + max(n // 2, 1)) % n
    dt = t[j] - t[i]
    use = np.abs(dt) > 1e-3
    return float(np.median((y[j] - y[i])[use] / dt[use])) if use.any() else 0.0


def _gyro_bias(
    problem: Problem, window: float, still: tuple[float, float] | None, yaws: dict[str, Array]
) -> tuple[Array, Array, tuple[str, ...]]:
    """Bias (3,) in body axes and its sigma (3,), rad/s: of each axis from standstill or from motion, whichever tells it better."""
    prior = problem.links.bias_sigmas()[3:]
    t, _, w = _samples(problem, 0.0, window)
    span = float(np.ptp(t))
    mean = w.mean(axis=0)
    bias, sigma = np.zeros(3), np.array(prior)
    rate = None
    for rows in yaws.values():
        near = rows[rows[:, 0] <= window]
        if len(near) >= 8 and np.ptp(near[:, 0]) > 0.5 * window:
            rate = _slope(near[:, 0], np.unwrap(near[:, 1]))
            # A slope from two halves of the window, with allowance for outliers and slow errors of the sensor.
            sigma[2] = min(sigma[2], 0.002 + 0.1 / np.ptp(near[:, 0]))
            bias[2] = mean[2] - rate
            break
    # Roll and pitch return to where they were (to 0.1 rad): the rest of their mean rate is bias.
    turn = abs(rate) if rate is not None else abs(mean[2])
    around = np.hypot(0.1 / span, 0.1 * turn)
    bias[:2] = np.where(around < prior[:2], mean[:2], 0.0)
    sigma[:2] = np.minimum(prior[:2], around)
    if still is not None:
        at_rest, its_sigma = _bias_at_rest(*_samples(problem, *still)[::2], prior, turns=not _headed(yaws, *still))
        better = its_sigma < sigma
        found = np.where(better, at_rest, bias), np.where(better, its_sigma, sigma)
        return *found, (f"gyro bias from {still[1] - still[0]:.0f} s of standstill",)
    if rate is None:
        return bias, sigma, ("gyro bias about the vertical unknown at the start",)
    return bias, sigma, (f"gyro bias from {span:.0f} s of motion and heading",)


def _bias_at_rest(t: Array, w: Array, prior: Array, *, turns: bool) -> tuple[Array, Array]:
    """Return the bias (3,) and its sigma (3,), rad/s, by the rates (M, 3) of a standstill.

    Args:
        prior: (3,) sigma of the bias, rad/s. turns: whether the vessel may turn on the spot, as no heading tells that it does not.
    """
    bias = w.mean(axis=0)
    sigma = np.minimum(w.std(axis=0) / np.sqrt(len(w)) + 3e-4 + _swell(t, w), prior)
    if turns:  # any part of the mean rate is bias, as far as the prior has it
        half = bias[2] / 2.0
        share = prior[2] ** 2 / (prior[2] ** 2 + half**2)
        bias[2], sigma[2] = share * half, np.hypot(sigma[2], np.sqrt(share) * half)
    return bias, sigma


def _swell(t: Array, w: Array) -> Array:
    """Return how far (3,), rad/s, the mean rate of a quiet stretch may be from zero because of slow waves.

    Three quiet seconds are half a period of swell, whose rates do not average out: the mean may be off by as much as means over half
    a second scatter, and by less only where the stretch is longer than wave periods.
    """
    block = np.floor((t - t[0]) / _BLOCK_S).astype(np.int64)
    starts = np.flatnonzero(np.diff(block, prepend=-1))  # a gap may leave blocks empty
    means = np.add.reduceat(w, starts) / np.diff(np.append(starts, len(w)))[:, None]
    return np.asarray(means.std(axis=0) * min(1.0, float(np.sqrt(_SWELL_S / max(t[-1] - t[0], 1e-3)))))


def _turns(problem: Problem, span_s: float, bias: Array) -> Callable[[float], Array]:
    """Return a function t (s) -> R_body0_body(t) (3, 3), integrated from the gyroscope over the beginning of the run."""
    span = float((problem.imu.stamps_ns[-1] - problem.imu.stamps_ns[0]) * 1e-9)
    t, _, w = _samples(problem, 0.0, min(span_s, span))
    R = np.empty((len(t), 3, 3))
    R[0] = np.eye(3)
    steps = Rotation.from_rotvec((0.5 * (w[:-1] + w[1:]) - bias) * np.diff(t)[:, None]).as_matrix()
    for i, step in enumerate(steps):
        R[i + 1] = R[i] @ step
    return lambda s: np.asarray(R[int(np.clip(np.searchsorted(t, s), 0, len(t) - 1))])


def _level(
    problem: Problem,
    window: float,
    still: tuple[float, float] | None,
    turn: Callable[[float], Array],
    bias: Array,
) -> tuple[Array, float, Level | None, str]:
    """Return roll and pitch at the start as R (3, 3) with yaw 0, their sigma, the levelling factor, and a note.

    Args:
        turn: t -> R_body0_body(t), by the gyroscope less its bias (3,), in body axes.
    """
    if problem.config.sensors[problem.imu.sensor].gravity == "removed":
        return np.eye(3), 0.1, None, "roll and pitch unknown (gravity removed by the driver): taken level"
    t, f, _ = _samples(problem, 0.0, still[1] if still else min(window, 10.0))
    span = float(np.ptp(t))  # online, a start comes before ten seconds have
    R = np.array([turn(s) for s in t])
    forces = np.einsum("nij,nj->ni", R, f)
    force = float(np.linalg.norm(forces.mean(axis=0)))
    up = forces.mean(axis=0) / force
    turned = np.cumsum(R[:-1] * np.diff(t)[:, None, None], axis=0)  # by a rate of 1 rad/s about each axis of the body
    by_gyro = np.einsum("nij,njk->ik", [skew(v) for v in forces[1:]], turned) / len(t)
    by_bias = np.hstack([-R.mean(axis=0), by_gyro]) @ np.kron(np.eye(2), problem.R_body_imu) / force
    pitch, roll = np.arctan2(-up[0], np.hypot(up[1], up[2])), np.arctan2(up[1], up[2])
    # Effect of a change of speed on the mean force: 2 m/s over the length of the window.
    sigma = 0.01 if still else float(np.clip(2.0 / STANDARD_GRAVITY_MPS2 / max(span, 1.0), 0.02, 0.1))
    level = Level(
        up=up,
        by_bias=(np.eye(3) - np.outer(up, up)) @ by_bias,
        bias=np.concatenate([np.zeros(3), problem.R_body_imu.T @ bias]),
        sigma_rad=sigma,
    )
    note = f"roll and pitch from {span:.0f} s of specific force"
    return Rotation.from_euler("xyz", [roll, pitch, 0.0]).as_matrix(), _OWN_TILT_RAD, level, note


def _headings(
    problem: Problem, track: _Track, yaws: dict[str, Array], turn: Callable[[float], Array]
) -> tuple[tuple[float, ...], float, float, str]:
    """Return candidates for the yaw at the start, their sigma, the span that distinguishes them, and a note."""
    config = problem.config.start
    candidates: list[float] = []
    sources = []
    if config.heading_deg is not None:
        candidates.append(float(yaw_from_heading_deg(config.heading_deg)))
        sources.append("start.heading_deg")
    for name, rows in yaws.items():
        near = rows[rows[:, 0] <= max(config.window_s, rows[0, 0] + 5.0)]
        at_start = wrap_angle(near[:, 1] - np.array([_turned(turn(s)) for s in near[:, 0]]))
        centre = _circular_median(at_start)
        candidates.append(centre)
        sources.append(f"{name} ({len(near)} readings)")
    window = min(config.window_s, 10.0)
    if candidates:
        apart = [y for i, y in enumerate(candidates) if all(abs(wrap_angle(y - o)) > 0.1 for o in candidates[:i])]
        sigma = np.radians(20.0) if yaws else max(np.radians(config.heading_sigma_deg), 0.1)
        return (
            tuple(apart),
            float(sigma),
            max(window, config.window_s if len(apart) > 1 else 0.0),
            ("heading from " + ", ".join(sources)),
        )
    moved_s = _moved_at(track)
    if moved_s is None:
        return (0.0,), np.pi, window, "heading unknown: no sensor tells it and the vessel does not move"
    course = np.arange(8) * np.pi / 4.0
    return (
        tuple(wrap_angle(np.asarray(course, dtype=np.float64))),
        float(np.radians(60.0)),
        moved_s + 10.0,
        "heading from the motion alone, eight start headings tried",
    )


def _moved_at(track: _Track) -> float | None:
    """Return when (s) the vessel has travelled far enough for a heading from its course; None: never."""
    moved = np.hypot(*(track.p[:, :2] - np.median(track.p[:5, :2], axis=0)).T)
    noise = 5.0 * float(np.nanmedian(track.sigma[:, :2]))
    far = np.flatnonzero(moved > max(MOVED_M, noise))
    return float(track.t[far[0]]) if len(far) else None


def _turned(R: Array) -> float:
    return float(np.arctan2(R[1, 0], R[0, 0]))


def _circular_median(angles: Array) -> float:
    centre = float(np.arctan2(np.median(np.sin(angles)), np.median(np.cos(angles))))
    return float(wrap_angle(centre + np.median(wrap_angle(angles - centre))))


def _position_and_velocity(
    hints: dict[str, list[tuple[float, Hint]]], track: _Track, still: tuple[float, float] | None
) -> tuple[Array, Array, Array, Array]:
    first = track.t[0]
    near = track.t <= first + 3.0
    near[: min(3, len(near))] = True
    p0 = np.array([np.nanmedian(c) if np.isfinite(c).any() else 0.0 for c in track.p[near].T])
    every = [h for found in hints.values() for _, h in found]
    heights = [h.p_world_m[2] for h in every if np.isnan(h.p_world_m[0]) and np.isfinite(h.p_world_m[2])]
    if heights:  # sensors of height alone: the waterline is more certain than GNSS
        p0[2] = heights[0]
    v0, unsure = np.zeros(3), 0.0
    speeds = [h.v_world_mps for h in every if np.isfinite(h.v_world_mps).all()]
    if speeds:
        v0 = np.median(speeds[:5], axis=0)
    elif still is None:
        soon = track.t <= first + 5.0
        soon[: min(4, len(soon))] = True
        slope = np.array([_slope(track.t[soon], track.p[soon, i]) for i in range(2)])
        # Two sightings within a quarter of a second, each a metre off, give the speed to 6 m/s at best.
        noise = float(np.median(np.nan_to_num(track.sigma[soon, :2], nan=5.0))) / max(
            float(np.std(track.t[soon]) * np.sqrt(soon.sum())), 1e-3
        )
        share = _USUAL_SPEED_MPS**2 / (_USUAL_SPEED_MPS**2 + noise**2)
        v0[:2], unsure = share * slope, float(np.sqrt(share)) * noise
    v_sigma = np.full(3, 0.2 if still else float(np.hypot(3.0, unsure)))
    v_sigma[2] = 0.2 if still else 1.0
    # Extrapolated back to the first state in a straight line: the motion before the first position is unknown.
    back_s = max(float(np.median(track.t[near])), 0.0)
    p0[:2] -= v0[:2] * back_s
    sigma = np.full(3, 10.0) + 3.0 * np.nan_to_num(track.sigma[near], nan=5.0).max(axis=0)
    return p0, np.hypot(sigma, v_sigma * back_s), v0, np.hypot(v_sigma, min(back_s, 20.0) * 0.1)


def start_pose(start: Start, yaw_rad: float) -> Any:
    """Return the pose (gtsam.Pose3) of a candidate."""
    R = Rotation.from_euler("z", yaw_rad).as_matrix() @ start.R_level_body
    return gtsam.Pose3(gtsam.Rot3(R), start.p_world_m)
