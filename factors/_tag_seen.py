# SPDX-License-Identifier: Apache-2.0
"""A sighting of tags at the linearisation point: where camera, docks and corners are by the estimate, and their derivatives."""

from __future__ import annotations

from typing import NamedTuple

import gtsam
import numpy as np

from graphloc.config import AprilTagConfig
from graphloc.factors._tag_states import SlowRows
from graphloc.frames import Array, skew
from graphloc.graph import Attachment
from graphloc.measurements import TagMode, TagSighting

SurveyError = tuple[int, Array]
"""Key and value (6,) of the constant: position (m) and small rotation (rad) of a tag, about the axes of world."""


class Corners(NamedTuple):
    """The n corners of K tags by the estimate.

    Attributes:
        points_m: (n, 3) in world. arms_m: (n, 3) seen from the dock's pivot, axes of world.
        within_m: (K, 4, 3) seen from the middle of each tag, its dock at rest. toward_m: (n, 3) seen from the camera, its axes.
        survey_errors: of each tag; None where the survey error is not estimated.
    """

    points_m: Array
    arms_m: Array
    within_m: Array
    toward_m: Array
    survey_errors: tuple[SurveyError | None, ...]


class TagsSeen:
    """A sighting at the linearisation point; symbols as in the docstring of `apriltag`.

    Attributes:
        R, p: camera in world.
        middle_m: (3,) mean of the corners in world, their dock where the estimate has it. middle_at_rest_m: the dock at rest.
        body: (6, 6) d (position, rotation about world axes) of the camera / d (body tangent of the state's pose).
        by_mount: (3, 3) d (rotation of the camera) / d u. by_late: (6,) d (position, rotation of the camera) / d l.
        turn: (3, 3) Exp(w) of the dock. by_turn: (3, 3) d (rotation of the dock about world axes) / d w.
        own: rows of the slow state that the sighting depends on, in the order dock (6), mount (3), stamp (1), edge (1).
        rides, mounted, timed, edges: whether each of these four is among them.
        slow: values of these rows. slow_size: length of the whole slow state. moved: (6,) d and w of the dock. edge_px: b.
    """

    def __init__(self, m: TagSighting, config: AprilTagConfig, at: Attachment) -> None:
        self._read_slow_state(m, config, at)
        self._place_camera(m, at)
        self._turn_dock(m)

    def _read_slow_state(self, m: TagSighting, config: AprilTagConfig, at: Attachment) -> None:
        self.slow_size = 0 if at.slow_value is None else len(at.slow_value)
        rows = SlowRows.of(config, m.camera, m.frame, self.slow_size)
        self.rides, self.mounted, self.timed, self.edges = (len(r) > 0 for r in rows)
        self.own = [k for r in rows for k in r]
        self.slow = np.zeros(0)
        if at.slow_value is not None:
            # Interpolated for tags on a dock; else that of the node: such sightings have no leaf.
            self.slow = (_between(at) if self.rides else np.asarray(at.slow_value))[self.own]
        self.moved = self.slow[:6] if self.rides else np.zeros(6)
        self.edge_px = float(self.slow[-1]) if self.edges else 0.0

    def _place_camera(self, m: TagSighting, at: Attachment) -> None:
        T_state_camera = at.T_state_sensor.compose(gtsam.Pose3(gtsam.Rot3(m.R_body_camera), m.t_body_camera_m))
        T_world_camera = at.T_world_body.compose(T_state_camera)
        self.R, self.p = T_world_camera.rotation().matrix(), np.asarray(T_world_camera.translation()) + at.carried_m
        adjoint = np.asarray(T_state_camera.inverse().AdjointMap())
        self.body = np.vstack([self.R @ adjoint[3:], self.R @ adjoint[:3]])
        self.by_mount, self.by_late = np.eye(3), np.zeros(6)
        R_world_body = self.R @ m.R_body_camera.T
        arm = at.T_world_body.rotation().matrix() @ np.asarray(T_state_camera.translation())
        off, late_s = self.slow[6 * self.rides :][:3], self.slow[6 * self.rides + 3 * self.mounted :][: int(self.timed)]
        if self.timed:
            rate = R_world_body @ at.gyro_radps
            self.by_late = -np.concatenate([at.v_world_mps + at.dv_world_mps + skew(rate) @ arm, rate])
            self.p = self.p + self.by_late[:3] * late_s
            R_world_body = gtsam.Rot3.Expmap(self.by_late[3:] * late_s).matrix() @ R_world_body
        if self.mounted:
            self.by_mount = R_world_body @ np.asarray(gtsam.Rot3.ExpmapDerivative(-off))
            R_world_body = R_world_body @ gtsam.Rot3.Expmap(off).matrix()
        self.R = R_world_body @ m.R_body_camera

    def _turn_dock(self, m: TagSighting) -> None:
        self.turn = self.by_turn = np.eye(3)
        if self.rides:
            self.turn = gtsam.Rot3.Expmap(self.moved[3:]).matrix()
            # Exp(w + dw) = Exp(by_turn dw) Exp(w)
            self.by_turn = np.asarray(gtsam.Rot3.ExpmapDerivative(-self.moved[3:]))
        self.middle_at_rest_m = middle_at_rest_m(m)
        self.middle_m = m.pivot_m + self.moved[:3] + (self.middle_at_rest_m - m.pivot_m) @ self.turn.T

    def corners(self, m: TagSighting, config: AprilTagConfig, at: Attachment) -> Corners:
        """Return where the corners are."""
        survey_errors = _survey_errors_of(m, config, at)
        tags = np.array(m.points_m).reshape(-1, 4, 3)
        within = tags - 0.25 * tags.sum(axis=1, keepdims=True)
        for k, error in enumerate(survey_errors):
            if error is not None:
                tags[k] += error[1][:3] + within[k] @ skew(error[1][3:]).T
        arms = (tags.reshape(-1, 3) - m.pivot_m) @ self.turn.T
        points_m = m.pivot_m + self.moved[:3] + arms
        return Corners(points_m, arms, within, (points_m - self.p) @ self.R, survey_errors)

    def off_mode(self, mode: TagMode) -> tuple[Array, Array]:
        """Return the error (6,) of a mode, m and rad, and the tags' middle (3,) from the camera by that mode, in world's axes."""
        toward = self.R @ middle_in_camera(self.middle_at_rest_m, mode)
        rotation = gtsam.Rot3.Logmap(gtsam.Rot3(self.R @ (self.turn @ mode.R_world_camera).T))
        return np.concatenate([self.p + toward - self.middle_m, rotation]), toward

    def placed(self, per_own: Array) -> Array:
        """Return d / d (slow state) (k, n) from d / d (the rows in `own`, or the first of them) (k, up to len(own))."""
        whole = np.zeros((len(per_own), self.slow_size))
        whole[:, self.own[: per_own.shape[1]]] = per_own
        return whole


def _between(at: Attachment) -> Array:
    """Return the slow state at the measurement, interpolated between its node and the next."""
    value = np.asarray(at.slow_value)
    if at.slow_next is None:
        return value
    _, following, share, _ = at.slow_next
    return np.asarray((1.0 - share) * value + share * following)


def _survey_errors_of(m: TagSighting, config: AprilTagConfig, at: Attachment) -> tuple[SurveyError | None, ...]:
    index = {(str(tag.family), tag.id): k for k, tag in enumerate(config.surveyed.tags)}
    found = [index.get(tag) for tag in m.tags]
    return tuple(at.constants[k] if k is not None and k < len(at.constants) else None for k in found)


def middle_at_rest_m(m: TagSighting) -> Array:
    """Return the middle (3,) of the tags, in world, docks at rest."""
    return np.asarray(m.points_m.sum(axis=0) / len(m.points_m))


def middle_in_camera(at_rest_m: Array, mode: TagMode) -> Array:
    """Return the middle (3,) of the tags in the axes of the camera of a mode."""
    return np.asarray(mode.R_world_camera.T @ (at_rest_m - mode.p_world_camera_m))
