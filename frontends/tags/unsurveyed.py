# SPDX-License-Identifier: Apache-2.0
"""Positions of tags that the survey does not list, from the solved track.

    p_tag = p_i + s R_i t_i

p_i, R_i: camera of view i in world; t_i: position, in this camera, of a tag of size 1; s: its size. The equations are
linear in p_tag and s. The attitude starts from the pose that fits most views. Position, attitude and size are refined
on the corners. A tag that is only seen beside tags of one dock is taken to ride on it: p_i, R_i are then relative to
the dock at rest.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from graphloc.frames import Array, rpy_from_rotation, skew
from graphloc.frontends.tags.pose import poses_of
from graphloc.measurements import TagSighting, TagView
from graphloc.signals.series import interpolated
from graphloc.survey import WORLD, DockConfig, Family, Survey, TagConfig
from graphloc.time import seconds_since, stamps_of
from graphloc.trajectory import Trajectory

_FEWEST = 5
_MOST = 60  # most views of a tag: more of them cost time, and share the track's error
_TRIED = 12  # most views whose poses are tried as a start
_UNIT = np.array([(-0.5, 0.5, 0.0), (0.5, 0.5, 0.0), (0.5, -0.5, 0.0), (-0.5, -0.5, 0.0)])
# Largest sigmas of position, attitude and size (as a share) of a tag that counts as surveyed.
_WELL_M, _WELL_RAD, _WELL_SIZE = 1.0, float(np.radians(10.0)), 0.1
_LEAST_SIZE_M = 0.01  # if a tag is seen from one place only, size and distance shrink together
_TRACK_M, _TRACK_RAD = 0.1, float(np.radians(0.3))  # sigmas of a track without covariance
_UNKNOWN = 100.0  # sigma of what nothing tells: m, rad, or share


class _View:
    """A view with its camera in world: position p (3,), axes R (3, 3); rays (4, 2), and their whitening matrix (8, 8).

    A track that is off by 0.1 m shifts all corners of a tag 4 m ahead by 25 px, so its covariance is added to that of
    the rays. Otherwise the nearest views alone would decide, with the track's errors.
    """

    def __init__(self, view: TagView, p_world_body_m: Array, R_world_body: Array, track_cov: Array) -> None:
        self.p_body, self.track_cov = p_world_body_m, track_cov
        self.p = p_world_body_m + R_world_body @ view.t_body_camera_m
        self.R = R_world_body @ view.R_body_camera
        self.rays, self.cov = view.rays, view.cov
        self.whiten = np.linalg.inv(np.linalg.cholesky(view.cov))
        self.poses = poses_of(_UNIT, view.rays, view.cov)  # of a tag of size 1 m, in its own axes

    def doubt_track(self, size_m: float) -> None:
        """Add the track's error (dp, w) to the rays': a point P moves by -R^T (dp + w x (P - p_body)) in the camera."""
        corners = size_m * (_UNIT @ self.poses[0].R.T + self.poses[0].t_m)
        J = np.zeros((8, 6))
        for i, (x, y, z) in enumerate(corners):
            projected = np.array([[1.0 / z, 0.0, -x / z**2], [0.0, 1.0 / z, -y / z**2]]) @ self.R.T
            arm = self.p + self.R @ corners[i] - self.p_body
            J[2 * i : 2 * i + 2] = np.hstack([-projected, projected @ skew(arm)])
        self.whiten = np.linalg.inv(np.linalg.cholesky(self.cov + J @ self.track_cov @ J.T))

    def errors(self, p: Array, R: Array, size_m: float) -> Array:
        there = (p + size_m * _UNIT @ R.T - self.p) @ self.R
        depth = np.maximum(there[:, 2:], 0.05)
        return np.asarray(self.whiten @ (there[:, :2] / depth - self.rays).ravel())


@dataclass(frozen=True, slots=True, eq=False)
class Riding:
    """A dock on which tags ride, and its motion from rest: stamps (M,), `moved` (M, 6), m and small rotations, rad."""

    dock: DockConfig
    stamps_ns: NDArray[np.int64]
    moved: Array

    def seen_from(self, track: Trajectory) -> Trajectory:
        """Return a track relative to the dock at rest; its covariance stays, as if it included the dock's."""
        t, s = (seconds_since(int(track.stamps_ns[0]), stamps) for stamps in (track.stamps_ns, self.stamps_ns))
        moved = interpolated(t, s, self.moved)
        back, pivot = Rotation.from_rotvec(-moved[:, 3:]).as_matrix(), np.array(self.dock.xyz_m)
        return Trajectory(
            stamps_ns=track.stamps_ns,
            p_world_m=pivot + np.einsum("nij,nj->ni", back, track.p_world_m - pivot - moved[:, :3]),
            R_world_body=back @ track.R_world_body,
            cov=track.cov,
        )

    def on_board(self, tag: TagConfig) -> TagConfig:
        """Return a tag in the frame of the dock, from its pose in world with the dock at rest."""
        p, R = Survey(docks=(self.dock,)).rest(self.dock.name)
        return tag.model_copy(
            update={
                "frame": self.dock.name,
                "xyz_m": tuple(round(float(v), 3) for v in R.T @ (np.array(tag.xyz_m) - p)),
                "rpy_deg": _rpy_deg(R.T @ tag.R_frame_tag),
            }
        )


def only_beside(views: Sequence[TagView], sightings: Sequence[TagSighting]) -> dict[tuple[str, int], tuple[str, str]]:
    """Return by (family, id) the sensor and the dock of tags that share images only with tags of this dock."""
    images: dict[tuple[int, str], set[tuple[str, str]]] = defaultdict(set)
    for m in sightings:
        images[(m.stamp_ns, m.camera)].add((m.sensor, m.frame))
    beside: dict[tuple[str, int], set[tuple[str, str]]] = defaultdict(set)
    for v in views:
        beside[(v.family, v.number)] |= images.get((v.stamp_ns, v.camera), set())
    alone = {tag: found.pop() for tag, found in beside.items() if len(found) == 1}
    return {tag: (sensor, frame) for tag, (sensor, frame) in alone.items() if frame != WORLD}


def estimate_tags(
    views: Sequence[TagView],
    track: Trajectory,
    size_m: float | None,
    riding: Mapping[tuple[str, int], Riding] | None = None,
) -> tuple[list[TagConfig], list[str]]:
    """Return the tags that are seen often and well enough, and a line on each other tag.

    Args:
        views: of tags that are not surveyed. track: of the body, with covariance.
        size_m: of these tags; None: it is estimated.
        riding: by (family, id), of tags that ride on a dock; all others are at rest in world.
    """
    found: list[TagConfig] = []
    left: list[str] = []
    for family, number in sorted({(v.family, v.number) for v in views}):
        if family not in get_args(Family):
            left.append(
                f"tag {number} is not in the survey, and of a family ({family or 'not said'}) that it cannot have"
            )
            continue
        own = [v for v in views if (v.family, v.number) == (family, number)]
        stamps = stamps_of(own)
        own = [v for v, covered in zip(own, track.covers(stamps), strict=True) if covered]
        dock = (riding or {}).get((family, number))
        seen_from = track if dock is None else dock.seen_from(track)
        tag = _estimate(own[:: -(-len(own) // _MOST)], seen_from, size_m) if len(own) >= _FEWEST else None
        if tag is None:
            left.append(f"tag {number} ({family}) is not in the survey, and {len(own)} views do not tell where it is")
        else:
            found.append(tag if dock is None else dock.on_board(tag))
    return found, left


def _estimate(own: Sequence[TagView], track: Trajectory, size_m: float | None) -> TagConfig | None:
    """Return a tag from its views; None if they do not tell its pose and size well."""
    ordered = sorted(own, key=lambda v: v.stamp_ns)
    stamps, where = np.unique([v.stamp_ns for v in ordered], return_inverse=True)  # two cameras may see it at one stamp
    at = track.at(stamps)
    views = [v for v in _along(at, ordered, where) if v.poses]
    if len(views) < _FEWEST:
        return None
    place, size = _placed(views, size_m)
    if not size > _LEAST_SIZE_M:
        return None
    for v in views:
        v.doubt_track(size)
    fit = _refined(views, place, size, sized=size_m is not None)
    if fit.sigma_m > _WELL_M or fit.sigma_rad > _WELL_RAD or fit.sigma_size > _WELL_SIZE:
        return None
    sigma_m, sigma_rad = fit.sigma_m, fit.sigma_rad
    if at.cov is not None:  # the track's own error does not average out
        sigma_m = float(np.hypot(sigma_m, np.sqrt(np.median(at.cov[:, :2, :2].trace(axis1=1, axis2=2) / 2.0))))
        sigma_rad = float(np.hypot(sigma_rad, np.sqrt(np.median(at.cov[:, 5, 5]))))
    x, y, z = (round(float(v), 3) for v in fit.place)
    return TagConfig(
        id=own[0].number,
        family=own[0].family,  # type: ignore[arg-type]  # one of the detector's
        size_m=round(fit.size_m, 4) if size_m is None else size_m,
        xyz_m=(x, y, z),
        rpy_deg=_rpy_deg(fit.R),
        sigma_m=round(sigma_m, 3),
        sigma_deg=round(float(np.degrees(sigma_rad)), 2),
    )


def _along(at: Trajectory, ordered: Sequence[TagView], where: NDArray[np.intp]) -> Iterator[_View]:
    """Yield the views with their cameras in world; `where`: index of each view's pose in `at`."""
    unsaid = np.diag([_TRACK_M**2] * 3 + [_TRACK_RAD**2] * 3)
    for view, k in zip(ordered, where.tolist(), strict=True):
        yield _View(view, at.p_world_m[k], at.R_world_body[k], unsaid if at.cov is None else at.cov[k])


class _Refined(NamedTuple):
    """A tag by the corners of all views: position (3,), attitude (3, 3), size, and 1 sigma of each.

    `sigma_size` is relative; 0 if the size is known.
    """

    place: Array
    R: Array
    size_m: float
    sigma_m: float
    sigma_rad: float
    sigma_size: float


def _refined(views: Sequence[_View], place: Array, size_m: float, *, sized: bool) -> _Refined:
    """Return position, attitude and, unless it is known (`sized`), size, refined from `place` (3,) and `size_m`."""
    tried = [v.R @ pose.R for v in views[:: max(1, len(views) // _TRIED)] for pose in v.poses]
    R0 = min(tried, key=lambda R: sum(min(float(e @ e), 1e4) for e in (v.errors(place, R, size_m) for v in views)))

    def tag(x: Array) -> tuple[Array, Array, float]:
        R = Rotation.from_rotvec(x[3:6]).as_matrix() @ R0
        return x[:3], R, size_m if sized else size_m * float(np.exp(x[6]))

    def errors(x: Array) -> Array:
        found = tag(x)
        return np.concatenate([v.errors(*found) for v in views])

    free = 6 if sized else 7
    solved = least_squares(errors, np.concatenate([place, np.zeros(free - 3)]), loss="soft_l1", x_scale="jac")
    misfit = max(2.0 * float(solved.cost) / max(len(solved.fun) - free, 1), 1.0)
    jacobian = np.asarray(solved.jac)
    variances = np.linalg.inv(jacobian.T @ jacobian + np.eye(free) * _UNKNOWN**-2).diagonal() * misfit
    sigma_m, sigma_rad = (float(np.sqrt(own.max())) for own in (variances[:3], variances[3:6]))
    return _Refined(*tag(solved.x), sigma_m, sigma_rad, 0.0 if sized else float(np.sqrt(variances[6])))


def _rpy_deg(R: Array) -> tuple[float, float, float]:
    roll, pitch, yaw = (round(float(v), 2) for v in np.degrees(rpy_from_rotation(R)))
    return roll, pitch, yaw


def _placed(views: Sequence[_View], size_m: float | None) -> tuple[Array, float]:
    """Return position (3,) and size of a tag by the linear equations of all views, solved again without outliers."""
    toward = np.array([v.R @ v.poses[0].t_m for v in views])
    p = np.array([v.p for v in views])
    kept = np.ones(len(views), dtype=bool)
    place, size = np.zeros(3), 0.0
    for _ in range(2):
        n = int(kept.sum())
        if size_m is None:
            A = np.column_stack([np.tile(np.eye(3), (n, 1)), -toward[kept].ravel()])
            solution = np.linalg.lstsq(A, p[kept].ravel(), rcond=None)[0]
            place, size = solution[:3], float(solution[3])
        else:
            place, size = np.median(p[kept] + size_m * toward[kept], axis=0), size_m
        off = np.linalg.norm(p + size * toward - place, axis=1)
        kept = off <= 2.0 * np.median(off) + 1e-9
    return place, size
