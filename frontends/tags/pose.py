# SPDX-License-Identifier: Apache-2.0
"""Poses of a camera that explain its view of tags: every minimum of the reprojection error, with its covariance.

The four corners of a tag have two poses (infinitesimal plane-based pose estimation, Collins & Bartoli 2014, gives both); those of
several tags together mostly have one. Each is refined to the minimum of the whitened error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from graphloc.frames import Array
from graphloc.frontends.tags._spread import spread
from graphloc.measurements import TagMode

_ROUNDS = 30
_SETTLED = 1e-7  # step, m and rad
_SAME = 1e-3  # normalised distance of two solutions that are one
_NEAREST_M = 0.05
_FARTHEST = 2000.0  # sizes of a tag: it is less than a pixel there, and corners without sense lead there
_TRIED = 4  # starts, of several tags
KEPT = 25.0  # a minimum whose squared error is larger by that is none
_UNLIKELIEST = 1e-9
# Where a tag is seen from straight ahead its tilt does not show to first order, and a minimum's curvature says
# nothing of it: what all tilts that one sees a tag under say instead.
_ANY_TILT_RAD = float(np.radians(40.0))


@dataclass(frozen=True, slots=True, eq=False)
class PoseOfCamera:
    """A minimum of the reprojection error.

    Attributes:
        R, t_m: world in camera: x_camera = R x_world + t. squared: whitened squared error.
        information: (6, 6) of (position of the points' middle in camera, rotation about camera's axes).
    """

    R: Array
    t_m: Array
    squared: float
    information: Array


def poses_of(
    points_m: Array, rays: Array, cov: Array, starts: Sequence[tuple[Array, Array]] = ()
) -> list[PoseOfCamera]:
    """Return the poses that explain the rays, best first; none if nothing does.

    Args:
        points_m: (4 K, 3) corners of K tags in turn, in world. rays: (4 K, 2) their rays.
        cov: (8 K, 8 K) of the rays. starts: initial (R, t), world in camera; default: each tag's own two poses.
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
    """Return both poses (R, t), world in camera, by one tag."""
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
    # IPPE gives one alone, or the same twice, where it meets a tag from straight ahead; and exactly there numbers
    # that are none, or the tag from behind.
    found = [(R, t) for R, t in found if np.isfinite(R).all() and np.isfinite(t).all()]
    found = [(R, t) for R, t in found if t[2] > _NEAREST_M and np.linalg.det(R) > 0.5 and R[:, 2] @ t < 0.0]
    R, t = found[0] if found else _facing(float(np.linalg.norm(x)), rays)
    found = [*(found or [(R, t)]), (_mirrored(R, t), t)]
    return [(R @ axes.T, t - R @ axes.T @ middle) for R, t in found]


def _facing(side_m: float, rays: Array) -> tuple[Array, Array]:
    """Return the frontal pose (R, t) of a tag, rotated as the rays (4, 2) of its corners are."""
    x = 0.5 * (rays[1] + rays[2] - rays[0] - rays[3])
    length = max(float(np.linalg.norm(x)), 1e-9)
    x = x / length if length > 1e-9 else np.array([1.0, 0.0])
    depth = side_m / length
    R = np.array([(x[0], x[1], 0.0), (x[1], -x[0], 0.0), (0.0, 0.0, -1.0)])
    return R, depth * np.array([*rays.mean(axis=0), 1.0])


def _mirrored(R: Array, t: Array) -> Array:
    """Return the attitude whose normal is mirrored at the line of sight."""
    sight, normal = t / np.linalg.norm(t), R[:, 2]
    axis = np.cross(normal, -sight)
    length = float(np.linalg.norm(axis))
    tilt = float(np.arctan2(length, -normal @ sight))
    if length < 1e-3:  # straight ahead: either way
        axis, length, tilt = np.cross(normal, R[:, 0]), 1.0, 0.1
    return np.asarray(Rotation.from_rotvec(2.0 * tilt * axis / length).as_matrix() @ R)


def _errors(arms_m: Array, rays: Array, R: Array, middle_m: Array) -> Array | None:
    """Return the errors (8 K,) of points at arms `arms_m` (4 K, 3, in world) from a middle (3,) in camera; None if behind it."""
    there = arms_m @ R.T + middle_m
    z = there[:, 2:]
    return None if z.min() < _NEAREST_M else (there[:, :2] / z - rays).ravel()


def _jacobian(arms_m: Array, R: Array, middle_m: Array) -> Array:
    """Return the derivative (8 K, 6) of these errors by a shift and a rotation about the points' middle, in camera.

    With the arm a in camera, and the ray u, v at depth z: d u = (1, 0, -u) / z (shift + turn x a), and so for v.
    """
    x, y, z = arms = R @ arms_m.T
    u, v, depth = arms + middle_m[:, None]
    u, v = u / depth, v / depth
    J = np.zeros((len(arms_m), 2, 6))
    J[:, 0, 0] = J[:, 1, 1] = 1.0
    J[:, 0, 2], J[:, 1, 2] = -u, -v
    J[:, 0, 3], J[:, 0, 4], J[:, 0, 5] = -u * y, z + u * x, -y
    J[:, 1, 3], J[:, 1, 4], J[:, 1, 5] = -z - v * y, v * x, x
    J /= depth[:, None, None]
    return J.reshape(-1, 6)


def _misfit(points_m: Array, rays: Array, whiten: Array, R: Array, t: Array) -> float:
    r = _errors(points_m, rays, R, t)
    return np.inf if r is None else float(np.linalg.norm(whiten @ r))


def _refine(points_m: Array, rays: Array, whiten: Array, R: Array, t: Array) -> PoseOfCamera | None:
    """Levenberg-Marquardt from an initial pose."""
    middle = points_m.mean(axis=0)
    arms, there = points_m - middle, R @ middle + t
    now = _errors(arms, rays, R, there)
    if now is None:
        return None
    r, J, damping = whiten @ now, whiten @ _jacobian(arms, R, there), 1e-3
    for _ in range(_ROUNDS):
        A = J.T @ J
        A.flat[::7] += damping * A.flat[::7] + 1e-9
        step = np.linalg.solve(A, -J.T @ r)
        R_new, there_new = cv2.Rodrigues(step[3:])[0] @ R, there + step[:3]
        after = _errors(arms, rays, R_new, there_new)
        whitened = None if after is None else whiten @ after
        if whitened is not None and float(whitened @ whitened) <= float(r @ r):
            R, there, r, J = R_new, there_new, whitened, whiten @ _jacobian(arms, R_new, there_new)
            damping = max(damping / 5.0, 1e-12)
            if np.abs(step).max() < _SETTLED:
                break
        else:
            damping *= 8.0
            if damping > 1e9:
                break
    if there[2] > _FARTHEST * float(np.linalg.norm(points_m[1] - points_m[0])):
        return None
    return PoseOfCamera(R, there - R @ middle, float(r @ r), J.T @ J)


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
        poses: by `poses_of`, of the same points_m, rays and cov.
        blind: do not use the fit as evidence.
    """
    found = _weighed(poses, points_m, rays, cov)
    logs = np.array([log + (0.5 * pose.squared if blind else 0.0) for (_, log), pose in zip(found, poses, strict=True)])
    shares = np.maximum(np.exp(logs - logs.max()), _UNLIKELIEST)
    shares /= shares.sum()
    modes = []
    for k in np.argsort(-shares):
        R_world_camera, moment = poses[k].R.T, found[k][0].copy()
        moment[:3, 3:], moment[3:, :3] = -moment[:3, 3:], -moment[3:, :3]  # the camera turns as the tags turn back
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
    """Return covariance (6, 6) and log evidence of each pose: summed over tilts for one tag, by the curvature for several."""
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
    # A hopeless minimum (of a tag that fills the image) may weigh one tilt of the grid alone: no covariance.
    return [(moment + 1e-3 * c, log) for (moment, log), c in zip(found, curved, strict=True)]
