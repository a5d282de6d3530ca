# SPDX-License-Identifier: Apache-2.0
"""Poses of a camera that explain its view of tags: every minimum of the reprojection error, with its covariance.

The four corners of a tag have two poses, which infinitesimal plane-based pose estimation (IPPE, Collins & Bartoli 2014)
gives; the corners of several tags mostly have one. Each pose is refined to the minimum of the whitened error.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from graphloc.frames import Array
from graphloc.frontends.tags._decode import compiled
from graphloc.frontends.tags._spread import spread
from graphloc.measurements import TagMode

_ROUNDS = 30
_SETTLED = 1e-7  # step, m and rad, from which a minimum is reached
_SAME = 1e-3  # squared normalised distance below which two solutions are one
_NEAREST_M = 0.05
# In sizes of a tag: farther away it is smaller than a pixel; meaningless corners lead there.
_FARTHEST = 2000.0
_TRIED = 4  # most starts that are tried, and most poses that are returned
KEPT = 25.0  # minima whose squared error exceeds that of the best by more are dropped
_UNLIKELIEST = 1e-9
# Prior sigma of a rotation: the range of tilts at which tags are seen. A tag seen from straight ahead does not show its
# tilt to first order, so the curvature at a minimum says nothing of it.
_ANY_TILT_RAD = float(np.radians(40.0))


@dataclass(frozen=True, slots=True, eq=False)
class PoseOfCamera:
    """A minimum of the reprojection error.

    Attributes:
        R, t_m: pose of world in camera: x_camera = R x_world + t. squared: whitened squared error.
        information: (6, 6) of the position of the points' middle in camera, then the rotation about the camera's axes.
    """

    R: Array
    t_m: Array
    squared: float
    information: Array


def poses_of(
    points_m: Array, rays: Array, cov: Array, starts: Sequence[tuple[Array, Array]] = ()
) -> list[PoseOfCamera]:
    """Return the poses that explain the rays, the best first; empty if none does.

    Args:
        points_m: (4 K, 3) corners of K tags, tag by tag, in world. rays: (4 K, 2) of the corners.
        cov: (8 K, 8 K) of the rays. starts: initial (R, t) of world in camera; default: the two poses of each tag.
    """
    whiten = np.linalg.inv(np.linalg.cholesky(cov))
    found: list[PoseOfCamera] = []
    if not starts:
        own = [s for k in range(0, len(points_m), 4) for s in _starts(points_m[k : k + 4], rays[k : k + 4])]
        starts = sorted(own, key=lambda start: _misfit(points_m, rays, whiten, *start))[:_TRIED]
    for start in starts:
        solved = _refine(points_m, rays, whiten, *start)
        if solved is not None and not any(_same(solved, other, points_m) for other in found):
            found.append(solved)
    return sorted(found, key=lambda pose: pose.squared)[:_TRIED]


def _starts(corners_m: Array, rays: Array) -> list[tuple[Array, Array]]:
    """Return the two poses (R, t) of world in camera by one tag."""
    middle = corners_m.mean(axis=0)
    x, y = corners_m[1] - corners_m[0], corners_m[0] - corners_m[3]
    axes = np.column_stack([x / np.linalg.norm(x), y / np.linalg.norm(y), np.zeros(3)])
    axes[:, 2] = np.cross(axes[:, 0], axes[:, 1])
    flat = (corners_m - middle) @ axes
    flat[:, 2] = 0.0
    try:
        _, turns, places, _ = cv2.solvePnPGeneric(flat, rays, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
    except cv2.error:
        return []
    found = [
        (np.asarray(cv2.Rodrigues(turn)[0], dtype=float), np.asarray(place[:, 0], dtype=float))
        for turn, place in zip(turns, places, strict=True)
    ]
    # Near straight ahead IPPE gives one pose only, or one twice; exactly there it gives NaN, or the tag from behind.
    found = [(R, t) for R, t in found if np.isfinite(R).all() and np.isfinite(t).all()]
    found = [(R, t) for R, t in found if t[2] > _NEAREST_M and np.linalg.det(R) > 0.5 and R[:, 2] @ t < 0.0]
    R, t = found[0] if found else _facing(float(np.linalg.norm(x)), rays)
    found = [*(found or [(R, t)]), (_mirrored(R, t), t)]
    return [(R @ axes.T, t - R @ axes.T @ middle) for R, t in found]


def _facing(side_m: float, rays: Array) -> tuple[Array, Array]:
    """Return the frontal pose (R, t) of a tag, rotated about the optical axis as the rays (4, 2) of its corners are."""
    x = 0.5 * (rays[1] + rays[2] - rays[0] - rays[3])
    length = max(float(np.linalg.norm(x)), 1e-9)
    x = x / length if length > 1e-9 else np.array([1.0, 0.0])
    depth = side_m / length
    R = np.array([(x[0], x[1], 0.0), (x[1], -x[0], 0.0), (0.0, 0.0, -1.0)])
    return R, depth * np.array([*rays.mean(axis=0), 1.0])


def _mirrored(R: Array, t: Array) -> Array:
    """Return the attitude of a tag with its normal mirrored at the line of sight."""
    sight, normal = t / np.linalg.norm(t), R[:, 2]
    axis = np.cross(normal, -sight)
    length = float(np.linalg.norm(axis))
    tilt = float(np.arctan2(length, -normal @ sight))
    if length < 1e-3:  # straight ahead: a tilt in any direction
        axis, length, tilt = np.cross(normal, R[:, 0]), 1.0, 0.1
    return np.asarray(Rotation.from_rotvec(2.0 * tilt * axis / length).as_matrix() @ R)


@compiled
def _descended(arms_m, rays, whiten, R, there):  # type: ignore[no-untyped-def]
    """Move R (3, 3) and the middle in camera, there (3,), to a minimum by Levenberg-Marquardt, in place.

    Loops are written out: numba takes seconds to compile numpy's functions.

    Args:
        arms_m: (4 K, 3) points from their middle, in world. rays: (4 K, 2). whiten: (8 K, 8 K).

    Returns:
        The squared error at the minimum, -1 if points are behind the camera at the start; the information (6, 6).
    """
    size = len(whiten)
    raw, r, J, A = np.empty((size, 7)), np.empty(size), np.empty((size, 7)), np.empty((6, 6))
    L, step, turn = np.empty((6, 6)), np.zeros(6), np.zeros((3, 3))
    R_new, there_new = R.copy(), there.copy()
    squared, damping, settled = np.inf, 1e-3, False
    for round_ in range(_ROUNDS + 1):
        ahead = _linearised(arms_m, rays, R_new, there_new, raw)
        if not ahead and round_ == 0:
            return -1.0, A
        after = _squared(whiten, raw, r)
        if round_ == 0 or (ahead and after <= squared):
            _normal_equations(whiten, raw, r, J, A)
            for i in range(3):
                there[i] = there_new[i]
                for k in range(3):
                    R[i, k] = R_new[i, k]
            squared = after
            if round_ > 0:
                damping = max(damping / 5.0, 1e-12)
                settled = True
                for k in range(6):
                    settled = settled and abs(step[k]) < _SETTLED
        else:
            damping *= 8.0
        if settled or round_ == _ROUNDS or damping > 1e9:
            break
        _damped_step(A, J, damping, L, step)
        _rotation(step[3], step[4], step[5], turn)
        for i in range(3):
            there_new[i] = there[i] + step[i]
            for k in range(3):
                R_new[i, k] = turn[i, 0] * R[0, k] + turn[i, 1] * R[1, k] + turn[i, 2] * R[2, k]
    return squared, A


@compiled
def _linearised(arms_m, rays, R, there, raw):  # type: ignore[no-untyped-def]
    """Write the derivatives of the rays at a pose into raw (8 K, 7), their errors into its last column.

    A point has the arm (x, y, z) from the middle, in camera, and the ray (u, v). A shift and a rotation about the
    middle change u by (1, 0, -u) / depth (shift + turn x arm), and v likewise.

    Returns:
        Whether all points are ahead of the camera.
    """
    ahead = True
    for n in range(len(arms_m)):
        x, y, z = 0.0, 0.0, 0.0
        for k in range(3):
            x += R[0, k] * arms_m[n, k]
            y += R[1, k] * arms_m[n, k]
            z += R[2, k] * arms_m[n, k]
        depth = z + there[2]
        ahead = ahead and not depth < _NEAREST_M
        u, v = (x + there[0]) / depth, (y + there[1]) / depth
        i, j = 2 * n, 2 * n + 1
        raw[i, 0], raw[i, 1], raw[i, 2] = 1.0 / depth, 0.0, -u / depth
        raw[j, 0], raw[j, 1], raw[j, 2] = 0.0, 1.0 / depth, -v / depth
        raw[i, 3], raw[i, 4], raw[i, 5], raw[i, 6] = -u * y / depth, (z + u * x) / depth, -y / depth, u - rays[n, 0]
        raw[j, 3], raw[j, 4], raw[j, 5], raw[j, 6] = (-z - v * y) / depth, v * x / depth, x / depth, v - rays[n, 1]
    return ahead


@compiled
def _squared(whiten, raw, r):  # type: ignore[no-untyped-def]
    """Write the whitened errors into r (8 K,), and return the sum of their squares."""
    total = 0.0
    for i in range(len(whiten)):
        r[i] = 0.0
        for k in range(len(whiten)):
            r[i] += whiten[i, k] * raw[k, 6]
        total += r[i] * r[i]
    return total


@compiled
def _normal_equations(whiten, raw, r, J, A):  # type: ignore[no-untyped-def]
    """Write the whitened derivatives into J (8 K, 7), errors into its last column, the information into A (6, 6)."""
    size = len(whiten)
    for i in range(size):
        for k in range(6):
            J[i, k] = 0.0
        for m in range(size):
            for k in range(6):
                J[i, k] += whiten[i, m] * raw[m, k]
        J[i, 6] = r[i]
    for i in range(6):
        for k in range(6):
            A[i, k] = 0.0
            for m in range(size):
                A[i, k] += J[m, i] * J[m, k]


@compiled
def _damped_step(A, J, damping, L, step):  # type: ignore[no-untyped-def]
    """Write the damped step (6,), by Cholesky; NaN, which makes no progress, if A is not positive definite."""
    for i in range(6):
        for j in range(i + 1):
            value = A[i, j] + (damping * A[i, j] + 1e-9 if i == j else 0.0)
            for k in range(j):
                value -= L[i, k] * L[j, k]
            L[i, j] = math.sqrt(value) if i == j else value / L[j, j]
    for i in range(6):
        value = 0.0
        for m in range(len(J)):
            value -= J[m, i] * J[m, 6]
        for k in range(i):
            value -= L[i, k] * step[k]
        step[i] = value / L[i, i]
    for i in range(5, -1, -1):
        value = step[i]
        for k in range(i + 1, 6):
            value -= L[k, i] * step[k]
        step[i] = value / L[i, i]


@compiled
def _rotation(a, b, c, turn):  # type: ignore[no-untyped-def]
    """Write the rotation by a vector (a, b, c), rad, into turn (3, 3), by Rodrigues' formula."""
    angle = math.sqrt(a * a + b * b + c * c)
    sine = math.sin(angle) / angle if angle > 0.0 else 1.0
    rest = (1.0 - math.cos(angle)) / (angle * angle) if angle > 0.0 else 0.5
    turn[0, 0], turn[0, 1], turn[0, 2] = 1.0 - rest * (b * b + c * c), rest * a * b - sine * c, rest * a * c + sine * b
    turn[1, 0], turn[1, 1], turn[1, 2] = rest * a * b + sine * c, 1.0 - rest * (a * a + c * c), rest * b * c - sine * a
    turn[2, 0], turn[2, 1], turn[2, 2] = rest * a * c - sine * b, rest * b * c + sine * a, 1.0 - rest * (a * a + b * b)


def _misfit(points_m: Array, rays: Array, whiten: Array, R: Array, t: Array) -> float:
    there = points_m @ R.T + t
    z = there[:, 2:]
    return np.inf if z.min() < _NEAREST_M else float(np.linalg.norm(whiten @ (there[:, :2] / z - rays).ravel()))


def _refine(points_m: Array, rays: Array, whiten: Array, R: Array, t: Array) -> PoseOfCamera | None:
    """Return the minimum to which an initial pose leads; None if points are behind the camera, or too far away."""
    middle = points_m.mean(axis=0)
    R, there = np.array(R, dtype=float, order="C"), R @ middle + t
    # Writable copies: the loops are compiled for such arrays only.
    squared, information = _descended(points_m - middle, np.array(rays, dtype=float, order="C"), whiten, R, there)
    if squared < 0.0 or there[2] > _FARTHEST * float(np.linalg.norm(points_m[1] - points_m[0])):
        return None
    return PoseOfCamera(R, there - R @ middle, squared, information)


def _same(one: PoseOfCamera, other: PoseOfCamera, points_m: Array) -> bool:
    middle = points_m.mean(axis=0)
    shift = one.R @ middle + one.t_m - other.R @ middle - other.t_m
    turn = Rotation.from_matrix(one.R @ other.R.T).as_rotvec()
    step = np.concatenate([shift, turn])
    return float(step @ one.information @ step) < _SAME or float(np.abs(step).max()) < 1e-5


def modes_of(
    poses: Sequence[PoseOfCamera], points_m: Array, rays: Array, cov: Array, *, blind: bool = False
) -> tuple[TagMode, ...]:
    """Return the poses as modes, the likeliest first.

    Args:
        poses: of `poses_of` with these points_m, rays and cov.
        blind: whether the fit is not used as evidence.
    """
    found = _weighed(poses, points_m, rays, cov)
    logs = np.array([log + (0.5 * pose.squared if blind else 0.0) for (_, log), pose in zip(found, poses, strict=True)])
    shares = np.maximum(np.exp(logs - logs.max()), _UNLIKELIEST)
    shares /= shares.sum()
    modes = []
    for k in np.argsort(-shares):
        R_world_camera, moment = poses[k].R.T, found[k][0].copy()
        moment[:3, 3:], moment[3:, :3] = -moment[:3, 3:], -moment[3:, :3]  # the camera turns opposite to the tags
        modes.append(
            TagMode(
                p_world_camera_m=-R_world_camera @ poses[k].t_m,
                R_world_camera=R_world_camera,
                cov=0.5 * (moment + moment.T),
                probability=float(shares[k]),
            )
        )
    return tuple(modes)


def _weighed(poses: Sequence[PoseOfCamera], points_m: Array, rays: Array, cov: Array) -> list[tuple[Array, float]]:
    """Return covariance (6, 6) and log evidence of each pose: of one tag by a sum over tilts, else by the curvature."""
    tilted = np.diag([0.0] * 3 + [_ANY_TILT_RAD**-2] * 3)
    curved = [np.asarray(np.linalg.inv(pose.information + tilted), dtype=float) for pose in poses]
    if len(points_m) > 4:
        return [
            (c, -0.5 * p.squared + 0.5 * float(np.linalg.slogdet(c)[1])) for p, c in zip(poses, curved, strict=True)
        ]
    whiten = np.linalg.inv(np.linalg.cholesky(cov))
    found = [
        spread(points_m, rays, whiten, p.R, p.t_m, c, [o.R for o in poses if o is not p])
        for p, c in zip(poses, curved, strict=True)
    ]
    # Of a poor minimum (a tag that fills the image) a single tilt of the grid may have all weight: a singular
    # covariance.
    return [(moment + 1e-3 * c, log) for (moment, log), c in zip(found, curved, strict=True)]
