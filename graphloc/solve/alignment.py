# SPDX-License-Identifier: Apache-2.0
"""Start alignment: attitude, heading, position, velocity and gyro bias from the first seconds.

It uses a window, never a single measurement: gyro bias from standstill, or from the difference between headings and
integrated rates; roll and pitch from the mean specific force in a frame propagated by the gyroscope; heading from
poses, compass or course. If headings disagree, or none is known, there are several candidates, and the solver tries
each.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from graphloc.build import Level, Problem
from graphloc.config import STANDARD_GRAVITY_MPS2
from graphloc.errors import SolveError
from graphloc.frames import Array, skew, wrap_angle, yaw_from_heading_deg, yaw_from_rotation
from graphloc.graph import Hint, SlowProcess
from graphloc.solve._standstill import Track, gyro_bias, samples_of, slope_of, standstill
from graphloc.time import utc_text

_USUAL_SPEED_MPS = 10.0  # 1 sigma of the speed, where it is unknown
_CARRIED_RAD = np.radians(20.0)  # 1 sigma by gyro bias, from which a later heading tells nothing of the start
_OWN_TILT_RAD = 0.5  # 1 sigma of roll and pitch, without accelerometer data
# Travel from which the motion may tell the heading, in times of how far positions are off (noise, and drift of their
# slow error).
_MANY = 20.0  # the travel that is waited for, up to `_USUAL_M`
_FEW = 5.0  # the least travel: enough where the vessel never goes farther and nothing else tells the heading
_DRIFT_S = 30.0  # time over which a slow error counts as drift
_LEAST_M = 1.0  # an antenna sways by less
_USUAL_M = 15.0  # more is not waited for, unless `_FEW` asks for it
_LATEST_S = 120.0  # latest time of `_FEW`, where `_MANY` never comes: later, fixes have drifted as far


@dataclass(frozen=True, slots=True, kw_only=True)
class Start:
    """A start: level attitude without heading, and candidates for the heading.

    Attributes:
        R_level_body: (3, 3) attitude with yaw 0. tilt_sigma_rad: sigma of its roll and pitch in the prior on the pose
            (wide beside a `level`).
        level: levelling factor; None: there is none.
        yaws_rad: candidates. yaw_sigma_rad: of each (wide where it is a guess).
        by_motion: whether no sensor tells the heading, but the motion may.
        tried: whether the candidates are only tried, so that they carry no information.
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
    tried: bool
    p_world_m: Array
    p_sigma_m: Array
    v_world_mps: Array
    v_sigma_mps: Array
    gyro_bias_radps: Array
    gyro_bias_sigma_radps: Array
    window_s: float
    notes: tuple[str, ...]

    def near(self, yaw_rad: float) -> Start:
        """Return the start with a single candidate, where its own are only tried and the motion may tell the heading.

        Else it is unchanged.
        """
        if not (self.tried and self.by_motion):
            return self
        note = "heading from the motion alone, one start heading tried"
        return replace(self, yaws_rad=(float(wrap_angle(yaw_rad)),), notes=(*self.notes[:-1], note))


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
    still = standstill(problem, track, yaws)
    bias, bias_sigma, notes = gyro_bias(problem, window, still, yaws)
    yaws, moved_s = _heading_told_by(problem, hints, track, yaws, float(bias_sigma[2]))
    turn = _turns(problem, max([window, *(rows[0, 0] for rows in yaws.values())]) + 10.0 if yaws else 180.0, bias)
    at_start = still if still is not None and still[0] == 0.0 else None
    R_level, tilt_sigma, level, tilt_note = _level(problem, window, at_start, turn, bias)
    yaws_rad, yaw_sigma_rad, window_s, heading_note = _headings(problem, yaws, turn, moved_s)
    p0, p_sigma, v0, v_sigma = _position_and_velocity(hints, track, at_start)
    return Start(
        R_level_body=R_level,
        tilt_sigma_rad=tilt_sigma,
        level=level,
        yaws_rad=yaws_rad,
        yaw_sigma_rad=yaw_sigma_rad,
        by_motion=not yaws and moved_s is not None,
        tried=not yaws and problem.config.start.heading_deg is None,
        p_world_m=p0,
        p_sigma_m=p_sigma,
        v_world_mps=v0,
        v_sigma_mps=v_sigma,
        gyro_bias_radps=problem.R_body_imu.T @ bias,
        gyro_bias_sigma_radps=bias_sigma,
        window_s=window_s,
        notes=(*notes, tilt_note, heading_note),
    )


def _heading_told_by(
    problem: Problem,
    hints: dict[str, list[tuple[float, Hint]]],
    track: Track,
    yaws: dict[str, Array],
    drift_radps: float,
) -> tuple[dict[str, Array], float | None]:
    """Return the headings, by sensor, that tell the heading at the start, and when (s) the motion may tell it.

    The motion may once the vessel has moved far enough; None: it never does. The gyroscope carries late headings back
    to the start, with a bias that is known to `drift_radps`: they are left out where earlier headings, or the motion,
    tell it.
    """
    early = {name: rows for name, rows in yaws.items() if rows[0, 0] * drift_radps < _CARRIED_RAD}
    noises = [(np.array([h.p_sigma_m[:2] for _, h in hints[stream.name]]), stream.row.slow(stream.config))
              for stream in problem.streams if hints[stream.name]]  # fmt: skip
    usual_m, least_m = wanted_travel_m(noises)
    moved_s = _moved_at(track, usual_m)
    if moved_s is None and not yaws and problem.config.start.heading_deg is None:
        soon_s = _moved_at(track, least_m)
        moved_s = soon_s if soon_s is not None and soon_s <= _LATEST_S else None
    if early or (moved_s is not None and moved_s < min((rows[0, 0] for rows in yaws.values()), default=np.inf)):
        yaws = early
    return yaws, moved_s


def _hints(problem: Problem, origin: int) -> dict[str, list[tuple[float, Hint]]]:
    """Return by sensor the hints (position, heading, velocity) of its measurements, with their times, s."""
    found = {}
    for stream in problem.streams:
        mount_yaw = float(yaw_from_rotation(stream.mount.rotation().matrix()))
        found[stream.name] = [
            ((m.stamp_ns - origin) * 1e-9, stream.row.hint(m, mount_yaw, problem.datum)) for m in stream.measurements
        ]
    return found


def _track(hints: dict[str, list[tuple[float, Hint]]]) -> Track:
    rows = [(t, h) for found in hints.values() for t, h in found if np.isfinite(h.p_world_m[:2]).all()]
    rows.sort(key=lambda row: row[0])
    return Track(
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


def _turns(problem: Problem, span_s: float, bias: Array) -> Callable[[float], Array]:
    """Return a function t (s) -> R_body0_body(t) (3, 3), integrated from the gyroscope from the run's begin.

    Args:
        span_s: longest t. bias: (3,) rad/s, body axes.
    """
    span = float((problem.imu.stamps_ns[-1] - problem.imu.stamps_ns[0]) * 1e-9)
    t, _, w = samples_of(problem, 0.0, min(span_s, span))
    R = np.empty((len(t), 3, 3))
    R[0] = np.eye(3)
    steps = Rotation.from_rotvec((0.5 * (w[:-1] + w[1:]) - bias) * np.diff(t)[:, None]).as_matrix()
    for i, step in enumerate(steps):
        R[i + 1] = R[i] @ step
    return lambda s: np.asarray(R[min(int(np.searchsorted(t, s)), len(t) - 1)])


def _level(
    problem: Problem,
    window: float,
    still: tuple[float, float] | None,
    turn: Callable[[float], Array],
    bias: Array,
) -> tuple[Array, float, Level | None, str]:
    """Return roll and pitch at the start as R (3, 3) with yaw 0, their sigma, the levelling factor, and a note.

    Args:
        window: length of the first window, s. still: a standstill (begin, end) at the start, s.
        turn: t -> R_body0_body(t), by the gyroscope less its bias (3,), in body axes.
    """
    if problem.config.sensors[problem.imu.sensor].gravity == "removed":
        return np.eye(3), 0.1, None, "roll and pitch unknown (gravity removed by the driver): taken level"
    t, f, _ = samples_of(problem, 0.0, still[1] if still else min(window, 10.0))
    span = float(np.ptp(t))  # online, the run may be shorter than ten seconds
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
    problem: Problem, yaws: dict[str, Array], turn: Callable[[float], Array], moved_s: float | None
) -> tuple[tuple[float, ...], float, float, str]:
    """Return candidates for the yaw at the start, their sigma, the span (s) that distinguishes them, and a note."""
    config = problem.config.start
    candidates: list[float] = []
    sources = []
    if config.heading_deg is not None:
        candidates.append(float(yaw_from_heading_deg(config.heading_deg)))
        sources.append("start.heading_deg")
    for name, rows in yaws.items():
        near = rows[rows[:, 0] <= max(config.window_s, rows[0, 0] + 5.0)]
        at_start = wrap_angle(near[:, 1] - np.array([yaw_from_rotation(turn(s)) for s in near[:, 0]]))
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
    if moved_s is None:
        return (0.0,), np.pi, window, "heading unknown: no sensor measures it and the vessel does not move"
    course = np.arange(8) * np.pi / 4.0
    return (
        tuple(wrap_angle(np.asarray(course, dtype=np.float64))),
        float(np.radians(60.0)),
        moved_s + 10.0,
        "heading from the motion alone, eight start headings tried",
    )


def wanted_travel_m(noises: Sequence[tuple[Array, SlowProcess | None]]) -> tuple[float, float]:
    """Return the travel, m, from which the motion may tell a heading that no sensor measures, and the least one.

    Positions are off by their noise, and by drift meanwhile. After twenty times that, a course by two positions is good
    to 4 deg. No more than 15 m are waited for, if these are five times or more; and five times are enough for a craft
    that never goes farther, but circles. How well a motion tells the heading is seen once it is solved.

    Args:
        noises: of each sensor, sigma (N, 2) of its positions, m, NaN where it gives none; and its slow error.
    """
    off = []
    for sigma_m, slow in noises:
        drift = 0.0
        if slow is not None and (level := [k for k, axis in enumerate(slow.axes) if axis in ("east", "north")]):
            drift = float(np.sqrt(2.0 * slow.sigma**2 * (1.0 - slow.after(_DRIFT_S)[0]))[level].max())
        off.append(np.hypot(sigma_m, drift))
    off_m = float(np.nanmedian(np.concatenate(off)))
    few_m = max(_FEW * off_m, _LEAST_M)
    return float(max(few_m, min(_MANY * off_m, _USUAL_M))), float(few_m)


def _moved_at(track: Track, wanted_m: float) -> float | None:
    """Return when (s) the vessel has travelled far enough for the motion to tell a heading; None: never."""
    moved = np.hypot(*(track.p[:, :2] - np.median(track.p[:5, :2], axis=0)).T)
    far = np.flatnonzero(moved > wanted_m)
    return float(track.t[far[0]]) if len(far) else None


def _circular_median(angles: Array) -> float:
    centre = float(np.arctan2(np.median(np.sin(angles)), np.median(np.cos(angles))))
    return float(wrap_angle(centre + np.median(wrap_angle(angles - centre))))


def _position_and_velocity(
    hints: dict[str, list[tuple[float, Hint]]], track: Track, still: tuple[float, float] | None
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
        slope = np.array([slope_of(track.t[soon], track.p[soon, i]) for i in range(2)])
        # Two sightings within a quarter of a second, each a metre off, give the speed to 6 m/s at best.
        noise = float(np.median(np.nan_to_num(track.sigma[soon, :2], nan=5.0))) / max(
            float(np.std(track.t[soon]) * np.sqrt(soon.sum())), 1e-3
        )
        share = _USUAL_SPEED_MPS**2 / (_USUAL_SPEED_MPS**2 + noise**2)
        v0[:2], unsure = share * slope, float(np.sqrt(share)) * noise
    v_sigma = np.full(3, 0.2 if still else float(np.hypot(3.0, unsure)))
    v_sigma[2] = 0.2 if still else 1.0
    # Extrapolated back to the first state in a straight line, as the motion before the first position is unknown.
    back_s = max(float(np.median(track.t[near])), 0.0)
    p0[:2] -= v0[:2] * back_s
    sigma = np.full(3, 10.0) + 3.0 * np.nan_to_num(track.sigma[near], nan=5.0).max(axis=0)
    return p0, np.hypot(sigma, v_sigma * back_s), v0, np.hypot(v_sigma, min(back_s, 20.0) * 0.1)


def start_pose(start: Start, yaw_rad: float) -> Any:
    """Return the pose (gtsam.Pose3) of a candidate."""
    R = Rotation.from_euler("z", yaw_rad).as_matrix() @ start.R_level_body
    return gtsam.Pose3(gtsam.Rot3(R), start.p_world_m)
