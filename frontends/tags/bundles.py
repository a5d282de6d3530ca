# SPDX-License-Identifier: Apache-2.0
"""Sightings from the tags of one image: tags of one frame together, tags that contradict the others separately."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from graphloc.chi2 import chi2_95
from graphloc.frames import Array, pinhole, skew
from graphloc.frontends.tags.pose import KEPT, PoseOfCamera, modes_of, poses_of
from graphloc.measurements import TagSighting
from graphloc.survey import Survey, TagConfig

# Ratio of the squared error of corners to its expectation by their noise from which a tag contradicts the others.
CONTRADICTS = 6.0


@dataclass(frozen=True, slots=True, eq=False)
class SeenTag:
    """A tag in an image.

    Attributes:
        tag: its entry in the survey. rays, cov: (4, 2) of its corners, and their covariance (8, 8).
        fitted: whether the rays were computed from a pose: they fit it perfectly, which is no evidence for it.
    """

    tag: TagConfig
    rays: Array
    cov: Array
    fitted: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Seeing:
    """An image: its stamp, sensor, camera, and the camera's mount.

    `floor`: least noise of a ray, 1 sigma of an axis. `px`: size of a pixel as a ray.
    """

    stamp_ns: int
    sensor: str
    camera: str
    t_body_camera_m: Array
    R_body_camera: Array
    floor: float = 0.0
    px: float = 0.0


def sightings_of(seen: Sequence[SeenTag], survey: Survey, seeing: Seeing) -> tuple[list[TagSighting], list[int]]:
    """Return the sightings of an image, and the ids of tags that no pose explains."""
    found: list[TagSighting] = []
    lost: list[int] = []
    for frame in survey.frames:
        of_frame = [s for s in seen if s.tag.frame == frame]
        for bundle in _that_fit(of_frame, survey, frame) if of_frame else ():
            if bundle.poses:
                found.append(_sighting(bundle, survey, frame, seeing))
            else:
                lost += [s.tag.id for s in bundle.group]
    return found, lost


class Bundle:
    """Tags of one frame, taken together.

    Attributes:
        group: the K tags. points_m: (4 K, 3) their corners in world, with the frame at rest. rays: (4 K, 2).
        seen_cov: (8 K, 8 K) covariance of the rays by the image. cov: the same with the survey's errors.
        dof: degrees of freedom. poses: of the camera, that explain the rays; empty if none does.
        excess: ratio of the squared error of the best pose to its expectation.
    """

    def __init__(self, group: Sequence[SeenTag], survey: Survey, frame: str) -> None:
        p, R = survey.rest(frame)
        self.group = tuple(group)
        self.points_m = np.vstack([p + s.tag.corners_m @ R.T for s in group])
        self.rays = np.vstack([s.rays for s in group])
        self.seen_cov = self.cov = np.asarray(block_diag(*(s.cov for s in group)))
        self.dof = 8 * len(group) - 6
        self.poses = poses_of(self.points_m, self.rays, self.cov)
        self.excess = np.inf
        if self.poses:
            self.cov = self.cov + self._surveyed(self.poses[0])
            self.poses = self._again()
            self.excess = self.poses[0].squared / self.dof if self.poses else np.inf

    def _again(self) -> list[PoseOfCamera]:
        return poses_of(self.points_m, self.rays, self.cov, [(pose.R, pose.t_m) for pose in self.poses])

    def _surveyed(self, pose: PoseOfCamera) -> Array:
        """Return the survey errors of each tag as a covariance of the rays."""
        there, shares = self.points_m @ pose.R.T + pose.t_m, []
        projected = pinhole(there)[1]
        for k, s in enumerate(self.group):
            corners = there[4 * k : 4 * k + 4]
            arms = corners - corners.mean(axis=0)
            moved = np.array([np.hstack([np.eye(3), -skew(arm)]) for arm in arms])
            J = (projected[4 * k : 4 * k + 4] @ moved).reshape(8, 6)
            variances = np.array([s.tag.sigma_m**2] * 3 + [np.radians(s.tag.sigma_deg) ** 2] * 3)
            shares.append(J * variances @ J.T)
        return np.asarray(block_diag(*shares))

    def doubt(self) -> None:
        """Widen the noise of the corners if no pose fits as expected; then drop poor minima of several tags.

        Corners that do not fit are blurred or partly hidden. With their claimed noise all minima but one would be
        dropped.
        """
        if self.excess > chi2_95(self.dof) / self.dof:
            self.cov, self.seen_cov = self.cov * self.excess, self.seen_cov * self.excess
            self.poses = self._again()
        if len(self.group) > 1:
            self.poses = [pose for pose in self.poses if pose.squared < self.poses[0].squared + KEPT]


def _that_fit(seen: Sequence[SeenTag], survey: Survey, frame: str) -> list[Bundle]:
    """Return groups of tags that one pose explains.

    Three tags or more can show which one is wrong; two cannot, and are separated. Tags that fit no better without each
    other are all blurred: they stay together, and get a larger noise together.
    """
    whole, alone = Bundle(seen, survey, frame), list[Bundle]()
    while len(whole.group) > 1 and whole.excess > CONTRADICTS:
        group = whole.group
        without = [Bundle([*group[:k], *group[k + 1 :]], survey, frame) for k in range(len(group))]
        worst = int(np.argmin([bundle.excess for bundle in without]))
        apart = without[worst].excess if len(group) > 2 else 0.5 * sum(bundle.excess for bundle in without)
        if np.isfinite(apart) and whole.excess <= CONTRADICTS * apart:
            break
        if len(group) == 2:
            return [*alone, *reversed(without)]
        alone.append(Bundle([group[worst]], survey, frame))
        whole = without[worst]
    return [whole, *alone]


def _sighting(bundle: Bundle, survey: Survey, frame: str, seeing: Seeing) -> TagSighting:
    bundle.doubt()
    return TagSighting(
        stamp_ns=seeing.stamp_ns, sensor=seeing.sensor, seq=-1, camera=seeing.camera, frame=frame,
        numbers=tuple(s.tag.id for s in bundle.group), families=tuple(s.tag.family for s in bundle.group),
        points_m=bundle.points_m, pivot_m=survey.rest(frame)[0], rays=bundle.rays,
        cov=0.5 * (bundle.seen_cov + bundle.seen_cov.T) + seeing.floor**2 * np.eye(len(bundle.seen_cov)),
        t_body_camera_m=seeing.t_body_camera_m, R_body_camera=seeing.R_body_camera,
        modes=modes_of(
            bundle.poses, bundle.points_m, bundle.rays, bundle.cov, blind=any(s.fitted for s in bundle.group)
        ),
        px=seeing.px,
    )  # fmt: skip
