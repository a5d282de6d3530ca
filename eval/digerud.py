# SPDX-License-Identifier: Apache-2.0
"""Digerud's Kalman filter (D app. B), the baseline on docking runs: one tag, one pose of it, a 2 m gate.

State x, vx, y, vy, z, vz of the camera; at each sighting k of the tag, with z_k the position by its pose:

    |z_k - H x_(k-1)| < 2 m:   predict, then update with R = 11 I      x- = F x,  P- = F P F' + Q
    otherwise:                 predict only                            Q = I, the default of the library pykalman
    start:                     x_0 = (z_1, at rest), P_0 = I, and z_1 is then filtered like the others

The gate compares z with the state before prediction, as printed in app. B (sec. 2.6 compares it with the predicted
state). Only a pose near the state passes the gate. If z_1 is the flipped pose, right poses are dropped until the state,
which only flipped poses then move, comes within 2 m of them. At close range it may (sec. 4.5), otherwise it never does
(sec. 4.4).

D's camera position is in the tag's frame; here it is in world, with docks at rest. Since Q, R, P_0 and the gate are
equal on every axis, this is the same filter, rotated. A moving dock is not modelled: the vessel's position in world
moves with it.

The pose: sec. 2.7.4 names `cv2.solvePnP` (Levenberg-Marquardt), app. A calls swatbotics' `detection_pose`. The two
descend from the homography's pose to a nearby minimum of the reprojection error, without choosing between the two
minima. Here the two minima are found and the lower one is used. At 5-25 m and 0.3 px it is the flipped one as often as
with `cv2.solvePnP`, within 1 % of sightings (400 draws at each of 18 positions).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import groupby

import cv2
import numpy as np

from graphloc.config import VesselConfig
from graphloc.eval.docking import END_S, LOST_M
from graphloc.eval.ekf import FilterResult, filter_row
from graphloc.eval.metrics import errors
from graphloc.frames import Array
from graphloc.ledger import Ledger, Outcome
from graphloc.measurements import TagSighting
from graphloc.recording import Recording
from graphloc.time import NS_PER_S, seconds_between
from graphloc.trajectory import Trajectory

_H = np.kron(np.eye(3), [1.0, 0.0])  # (3, 6): takes x, y, z of x, vx, y, vy, z, vz
_DT_S, _GATE_M = 0.04, 2.0  # as printed; the step is the same for every sighting, however much time has passed
_R = 11.0 * np.eye(3)  # of the measured position, m^2
_FOCAL_PX = 1069.38  # of D's camera; OpenCV refines too little where it is given rays instead of pixels
# 1 sigma of the attitude by a pose at about 10 m that is not flipped; the filter has no attitude of its own.
_ATTITUDE_RAD = float(np.radians(10.0))


def run_digerud(recording: Recording, config: VesselConfig) -> FilterResult | None:
    """Run the filter; None if its tag was sighted less than twice, which makes no track.

    The track is of the body at the sightings' stamps, with the attitude of the last accepted pose (sigma 10 deg about
    each axis), so a flipped pose turns the vessel. It has no velocity: the filter's own assumes 0.04 s between
    sightings, and would distort the interpolation. The covariance is the filter's, of the camera. The tag is the one
    seen most often (D's: 227), by the camera that sees it most.

    Args:
        recording: sightings of enabled sensors are used; those of other tags get rows in the ledger.
        config: which sensors are enabled.
    """
    sightings = [
        m
        for m in recording.measurements
        if isinstance(m, TagSighting) and (sensor := config.sensors.get(m.sensor)) is not None and sensor.enabled
    ]
    seen = Counter((m.sensor, m.camera, tag) for m in sightings for tag in m.tags)
    if not seen:
        return None
    chosen = seen.most_common(1)[0][0]
    own_tag = chosen[2]
    ledger = Ledger()
    off_m: dict[int, float] = {}
    out: dict[int, tuple[_State, Array]] = {}
    state: _State | None = None
    for m in sightings:
        if (m.sensor, m.camera, own_tag) != chosen or own_tag not in m.tags:
            ledger.add(filter_row(m, recording, None, "not of the one tag and camera that it uses"))
            continue
        pose = single_tag_pose(m, own_tag)
        if pose is None:
            ledger.add(filter_row(m, recording, None, "no pose from its corners"))
            continue
        p_world_camera, R_world_camera = pose
        R_world_body = R_world_camera @ m.R_body_camera.T
        if state is None:
            state = _State(m.stamp_ns, _H.T @ p_world_camera, np.eye(6), R_world_body)
        away_m = float(np.linalg.norm(p_world_camera - _H @ state.x))
        taken = away_m < _GATE_M
        state, nis = _filtered(state, m.stamp_ns, p_world_camera, R_world_body if taken else None)
        refused = "" if taken else f"outside the {_GATE_M:g} m gate"
        ledger.add(filter_row(m, recording, nis, refused, away_m))
        off_m[m.seq] = _off_m(p_world_camera, m, recording.truth)
        # Of two sightings at one stamp, the state after the second is kept
        out[m.stamp_ns] = (state, m.t_body_camera_m)
    if len(out) < 2:
        return None
    return FilterResult(name="Digerud KF", trajectory=_track(out), ledger=ledger, why=_why(ledger, off_m))


def _off_m(p_world_camera: Array, m: TagSighting, truth: Trajectory | None) -> float:
    """Return the error (m) of a camera position: against truth, else against the likeliest pose of all tags in view."""
    there, at = m.modes[0].p_world_camera_m, np.array([m.stamp_ns])
    if truth is not None and truth.headed and truth.covers(at)[0]:
        true = truth.at(at)
        there = true.p_world_m[0] + true.R_world_body[0] @ m.t_body_camera_m
    return float(np.linalg.norm(p_world_camera - there))


def _why(ledger: Ledger, off_m: Mapping[int, float]) -> str:
    """Return what the gate did: how many poses it dropped, how long in a row, how many right ones; and the first pose.

    Args:
        ledger: of the sightings. off_m: by arrival number, error of the pose (`_off_m`).
    """
    tried = [row for row in ledger if row.seq in off_m]
    dropped = [row for row in tried if row.outcome is Outcome.REJECTED]
    if not dropped:
        return ""
    shut = [list(rows) for refused, rows in groupby(tried, key=lambda row: row.outcome is Outcome.REJECTED) if refused]
    longest = max(shut, key=lambda rows: rows[-1].stamp_ns - rows[0].stamp_ns)
    lasted_s = seconds_between(longest[0].stamp_ns, longest[-1].stamp_ns)
    right = sum(off_m[row.seq] < _GATE_M for row in dropped)
    wrong = sum(off_m[row.seq] >= _GATE_M for row in tried if row.outcome is Outcome.USED)
    return (
        f"it started on a pose {off_m[tried[0].seq]:.1f} m off, and its gate accepts only poses within {_GATE_M:g} m of its own "
        f"estimate. Of {len(tried)} sightings of its one tag it rejected {len(dropped)} (for up to {lasted_s:.0f} s without a break), "
        f"{right} of them right to {_GATE_M:g} m; it accepted {len(tried) - len(dropped)}, {wrong} of them farther off than that, as "
        "a flipped pose is"
    )


def single_tag_pose(m: TagSighting, tag: tuple[str, int]) -> tuple[Array, Array] | None:
    """Return p_world_camera (3,) m and R_world_camera (3, 3) by one tag alone: the better of its two poses.

    Infinitesimal plane-based pose estimation gives two poses; Levenberg-Marquardt brings each to its minimum of the
    reprojection error, all corners weighing the same. The tag's dock is taken at rest. None if the solver finds no
    pose, as for corners on a line.
    """
    first = 4 * m.tags.index(tag)
    corners, pixels = m.points_m[first : first + 4], m.rays[first : first + 4] * _FOCAL_PX
    # Axes x right, y down, z into the print. With z towards the camera, some frontal tags without noise come out wrong.
    right, down = corners[1] - corners[0], corners[3] - corners[0]
    axes = np.column_stack([right, down, np.cross(right, down)])
    R_world_tag = axes / np.linalg.norm(axes, axis=0)
    middle = corners.mean(axis=0)
    square = (corners - middle) @ R_world_tag
    K = np.diag([_FOCAL_PX, _FOCAL_PX, 1.0])
    found = []
    for turn, shift in zip(*cv2.solvePnPGeneric(square, pixels, K, None, flags=cv2.SOLVEPNP_IPPE)[1:3], strict=True):
        turn, shift = cv2.solvePnPRefineLM(square, pixels, K, None, turn, shift)
        R_camera_tag, t = cv2.Rodrigues(turn)[0], shift[:, 0]
        there = square @ R_camera_tag.T + t
        misfit = float(np.sum((_FOCAL_PX * there[:, :2] / there[:, 2:] - pixels) ** 2))
        if np.isfinite(misfit):
            found.append((misfit, R_camera_tag, t))
    if not found:
        return None
    _, R_camera_tag, t = min(found, key=lambda pose: pose[0])
    R_world_camera = R_world_tag @ R_camera_tag.T
    return middle - R_world_camera @ t, R_world_camera


@dataclass(frozen=True, slots=True, eq=False)
class _State:
    """x (6,), P (6, 6) at a stamp, and the attitude (3, 3) of the last accepted pose."""

    stamp_ns: int
    x: Array
    P: Array
    R_world_body: Array


def _filtered(before: _State, stamp_ns: int, z: Array, R_world_body: Array | None) -> tuple[_State, float]:
    """Return the state after a sighting, and the NIS of its position z (3,).

    Args:
        before: the last state. R_world_body: (3, 3) by the pose; None: the gate has dropped it.
    """
    F = np.kron(np.eye(3), [[1.0, _DT_S], [0.0, 1.0]])
    x, P = F @ before.x, F @ before.P @ F.T + np.eye(6)
    r, S = z - _H @ x, _H @ P @ _H.T + _R
    nis = float(r @ np.linalg.solve(S, r))
    if R_world_body is None:
        return _State(stamp_ns, x, P, before.R_world_body), nis
    K = np.linalg.solve(S, _H @ P).T
    return _State(stamp_ns, x + K @ r, P - K @ _H @ P, R_world_body), nis


def _track(out: dict[int, tuple[_State, Array]]) -> Trajectory:
    """Return the track of the body from states and lever arms (3,)."""
    states = [state for state, _ in out.values()]
    x, R = np.array([s.x for s in states]), np.array([s.R_world_body for s in states])
    cov = np.zeros((len(out), 6, 6))
    cov[:, :3, :3] = _H @ np.array([s.P for s in states]) @ _H.T
    cov[:, [3, 4, 5], [3, 4, 5]] = _ATTITUDE_RAD**2
    return Trajectory(
        stamps_ns=np.array(list(out), dtype=np.int64),
        p_world_m=x[:, ::2] - np.einsum("nij,nj->ni", R, np.array([lever for _, lever in out.values()])),
        R_world_body=R,
        cov=cov,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Losses:
    """How a filter lost the vessel.

    Attributes:
        at_end: whether it is more than 2 m off, horizontally, throughout the last 5 s.
        lost_s: time with a horizontal error above 2 m.
    """

    at_end: bool
    lost_s: float


def losses(result: FilterResult, truth: Trajectory) -> Losses:
    """Return the losses of a filter against truth, at the truth's stamps that it covers.

    Raises:
        NoCommonTimeError: the filter covers none of the truth's stamps.
    """
    found = errors(result.trajectory, truth)
    stamps, off = found.stamps_ns, found.horizontal_m > LOST_M
    step_s = float(np.median(np.diff(truth.stamps_ns))) / NS_PER_S
    return Losses(
        at_end=bool(off[stamps > stamps[-1] - round(END_S * NS_PER_S)].all()),
        lost_s=float(off.sum()) * step_s,
    )
