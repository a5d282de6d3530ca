# SPDX-License-Identifier: Apache-2.0
"""AprilTags seen by a camera: their corners are fused; the poses that explain them are its modes.

    z_i = pi(R' (P_i - p)) + w_i,   w_i ~ N(0, C),   pi(x, y, z) = (x, y) / z,   R = R_b Exp(u) M,   at t_i - l
    P_i = c + d + Exp(w) (Q_i - c),   Q_i = S_i + e_k + f_k x (S_i - m_k)
    seen further out from its tag's middle, by b px at each edge

p, R: camera in world; R_b: body in world; M: the configured mount, u its error; t_i: the stamp, l its delay (u, l: constants of
the run); S_i: a corner as surveyed, its frame at rest; e_k, f_k: survey error of tag k with middle m_k (constants); d, w:
translation and small rotation about c of the floating dock that carries the tag, a slow state (D has neither); b: widening of
the tags' edges by detector, light, print and focal length, a slow state.
Such errors are the same in hundreds of sightings. Modelled as noise of each sighting they would average out, and the bounds
would be too small: three tags that lean forward by 0.2 deg lift a vessel 20 m away by 7 cm in every image; tags 12 px wide
whose edges are off by 0.04 px hold a vessel 35 m away 0.2 m too near.

Four coplanar corners have two poses, which run into each other beyond some 20 tag widths: the Gaussian of one pose is then not
the likelihood, and hundreds of sightings that each choose the nearer mode bend the heading (measured: docs/decisions/0007).
So the factor is the reprojection error, relinearised at every pass: at the estimate where that leads to the chosen mode, else at
the mode. The Gaussians of the modes serve to choose one:

    e = (p + R t_m - m, Log(R (Exp(w) R_m)'))    t_m: the tags' middle in the camera of mode m

the camera's position if its attitude is the predicted one, and that attitude.
"""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from graphloc.berths import Berth
from graphloc.config import AprilTagConfig
from graphloc.factors._tag_states import EDGE_TIME_S, SlowRows, constants, dock_process, docks_of, slow
from graphloc.frames import Array, Datum, pinhole, skew
from graphloc.graph import Attachment, Decision, FalseModel, GraphUpdate, Hint, Residual, Sensor
from graphloc.linear import Term, linear_factor, linear_update, pose_term
from graphloc.measurements import TagMode, TagSighting
from graphloc.survey import WORLD, DockConfig

# Where a false sighting may put the camera: a berth further on, turned as one likes within a quarter of a circle.
FALSE_SPREAD_M, FALSE_SPREAD_RAD = 5.0, float(np.radians(30.0))
# Added to a mode's sigmas to decide by: corners place a camera to millimetres, and an estimate that has yet to settle
# is off by more; what is called false is off by metres.
_TO_DECIDE = np.array([0.05] * 3 + [np.radians(0.5)] * 3)
_AHEAD = 0.3  # of a mode's distances: nearer than that the estimate's own are not believed
_BY_A_MODE_RAD = float(np.radians(20.0))
# Where a sighting stands on a node: m, rad of a dock; rad of a mount; s; px.
_TIE_DOCK, _TIE_MOUNT, _TIE_LATE, _TIE_EDGE = (1e-4,) * 3 + (1e-5,) * 3, (1e-5,) * 3, (1e-5,), (1e-4,)


class _Seen:
    """A sighting at the linearisation point.

    Attributes:
        R, p: camera in world. middle_m: (3,) the tags' middle in world, docks as they are now; middle_at_rest_m: at rest.
        body: (6, 6) d (position, rotation about world axes) of the camera / d tangent of the state.
        by_mount: (3, 3) d that rotation / d u. by_late: (6,) d (position, rotation) / d l. by_turn: (3, 3) of the dock.
        own: rows of the slow state that the sighting depends on, in the order dock (6), mount (3), stamp (1), edge (1).
            Whether each is there: rides, mounted, timed, edges.
        slow: their values; moved: (6,) of the dock; edge_px: b.
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
        if at.slow_value is not None:  # of tags at rest the value at the node before: they have no leaf in between
            self.slow = (_between(at) if self.rides else np.asarray(at.slow_value))[self.own]
        self.moved = self.slow[:6] if self.rides else np.zeros(6)
        self.edge_px = float(self.slow[-1]) if self.edges else 0.0

    def _place_camera(self, m: TagSighting, at: Attachment) -> None:
        T_state_camera = at.T_state_sensor.compose(gtsam.Pose3(gtsam.Rot3(m.R_body_camera), m.t_body_camera_m))
        T_world_camera = at.T_world_body.compose(T_state_camera)
        self.R, self.p = T_world_camera.rotation().matrix(), np.asarray(T_world_camera.translation())
        adjoint = np.asarray(T_state_camera.inverse().AdjointMap())
        self.body = np.vstack([self.R @ adjoint[3:], self.R @ adjoint[:3]])
        self.by_mount, self.by_late = np.eye(3), np.zeros(6)
        R_world_body, arm = self.R @ m.R_body_camera.T, self.p - np.asarray(at.T_world_body.translation())
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
        self.middle_at_rest_m = _middle_at_rest_m(m)
        self.middle_m = m.pivot_m + self.moved[:3] + (self.middle_at_rest_m - m.pivot_m) @ self.turn.T

    def corners(self, m: TagSighting, constants: list[tuple[int, Array] | None]) -> tuple[Array, Array, Array]:
        """Return places in world (n, 3), arms from the dock's pivot (n, 3), and each corner from its tag's middle at rest (K, 4, 3).

        Args:
            constants: of the K tags, see `_constants_of`.
        """
        tags = np.array(m.points_m).reshape(-1, 4, 3)
        within = tags - 0.25 * tags.sum(axis=1, keepdims=True)
        for k, constant in enumerate(constants):
            if constant is not None:
                tags[k] += constant[1][:3] + within[k] @ skew(constant[1][3:]).T
        arms = (tags.reshape(-1, 3) - m.pivot_m) @ self.turn.T
        return m.pivot_m + self.moved[:3] + arms, arms, within

    def placed(self, per_own: Array) -> Array:
        """Put d / d its own rows of the slow state (k, len(own)), or the first of them, where these stand (k, n)."""
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


def _constants_of(m: TagSighting, config: AprilTagConfig, at: Attachment) -> list[tuple[int, Array] | None]:
    """Return key and value of the survey error of each tag; None for tags without one."""
    index = {(str(tag.family), tag.id): k for k, tag in enumerate(config.surveyed.tags)}
    found = [index.get(tag) for tag in m.tags]
    return [at.constants[k] if k is not None and k < len(at.constants) else None for k in found]


def _middle_at_rest_m(m: TagSighting) -> Array:
    return np.asarray(m.points_m.sum(axis=0) / len(m.points_m))


def _middle_in_camera(middle_at_rest_m: Array, mode: TagMode) -> Array:
    return np.asarray(mode.R_world_camera.T @ (middle_at_rest_m - mode.p_world_camera_m))


def _turned(R: Array) -> Array:
    """Return the map (6, 6) from (tags' middle, rotation) in the camera's axes to (position of the camera, rotation) in world."""
    turn = np.zeros((6, 6))
    turn[:3, :3], turn[3:, 3:] = -R, R
    return turn


def _off_mode(seen: _Seen, mode: TagMode) -> tuple[Array, Array]:
    """Return the error (6,) of a mode, m and rad, and the tags' middle (3,) from the camera by that mode, in world's axes."""
    toward = seen.R @ _middle_in_camera(seen.middle_at_rest_m, mode)
    rotation = gtsam.Rot3.Logmap(gtsam.Rot3(seen.R @ (seen.turn @ mode.R_world_camera).T))
    return np.concatenate([seen.p + toward - seen.middle_m, rotation]), toward


def _by_mode(m: TagSighting, config: AprilTagConfig, seen: _Seen, mode: TagMode) -> Residual:
    raw, toward = _off_mode(seen, mode)

    def jacobian() -> Array:
        turned = np.eye(6)
        turned[:3, 3:] = -skew(toward)
        return np.asarray(turned @ seen.body)

    def slow_jacobian() -> Array:
        by_own, turned = [], np.vstack([-skew(toward), np.eye(3)])
        if seen.rides:
            rigid = -np.eye(6)
            rigid[:3, 3:] = skew(seen.middle_m - m.pivot_m - seen.moved[:3])
            rigid[:, 3:] = rigid[:, 3:] @ seen.by_turn
            by_own.append(rigid)
        if seen.mounted:
            by_own.append(turned @ seen.by_mount)
        if seen.timed:
            by_own.append((np.append(seen.by_late[:3], np.zeros(3)) + turned @ seen.by_late[3:])[:, None])
        return seen.placed(np.hstack(by_own))

    return Residual(
        raw=raw,
        cov=_turned(seen.R) @ mode.cov @ _turned(seen.R).T + np.diag(_TO_DECIDE**2),
        jacobian=jacobian,
        # Edges are no matter where modes are chosen.
        slow_jacobian=slow_jacobian if seen.rides or seen.mounted else None,
        prior=mode.probability * (1.0 - config.false_fraction),
        size_m=float(np.hypot(raw[0], raw[1])),
        size_deg=float(np.degrees(np.linalg.norm(raw[3:]))),
        expected_nis=m.rays.size,
    )


def residuals(m: TagSighting, config: AprilTagConfig, at: Attachment) -> tuple[Residual, ...]:
    """Return predicted - measured (6,), m and rad, for each mode."""
    seen = _Seen(m, config, at)
    return tuple(_by_mode(m, config, seen, mode) for mode in m.modes)


def factors(m: TagSighting, config: AprilTagConfig, at: Attachment, decision: Decision) -> GraphUpdate:
    """Return the factors of a sighting: of its corners, or of the chosen mode where the estimate is far from it."""
    seen = _Seen(m, config, at)
    mode = m.modes[decision.mode]
    survey_errors = _constants_of(m, config, at)
    points_m, arms, within = seen.corners(m, survey_errors)
    toward = (points_m - seen.p) @ seen.R
    if not _near(m, seen, decision.mode, toward):
        return linear_factor(_by_mode(m, config, seen, mode), at, decision)
    flat, projected = pinhole(toward)
    by_point = projected @ seen.R.T  # d flat / d place of the corner
    turning = _turning(by_point, points_m - seen.p)
    camera = np.concatenate([-by_point, -turning], axis=2).reshape(-1, 6)
    by_own = []
    if seen.rides:
        swing = _turning(by_point, arms) @ seen.by_turn
        by_own.append(np.concatenate([by_point, swing], axis=2).reshape(-1, 6))
    if seen.mounted:
        by_own.append(-turning.reshape(-1, 3) @ seen.by_mount)
    if seen.timed:
        by_own.append(camera @ seen.by_late[:, None])
    if seen.edges:
        outwards = m.px * _outwards(flat)  # not of the rays: their noise would tell edges from distance
        flat = flat + seen.edge_px * outwards
        by_own.append(outwards.reshape(-1, 1))
    by_slow = np.hstack(by_own) if by_own else np.zeros((m.rays.size, 0))
    raw, by_body = (flat - m.rays).ravel(), pose_term(at, camera @ seen.body)
    at_rest = by_point @ seen.turn  # d flat / d place of the corner, its dock at rest
    by_tag = np.concatenate([at_rest, _turning(at_rest, within.reshape(-1, 3))], axis=2).reshape(-1, 6)
    dock = config.surveyed.dock(m.frame) if seen.rides else None
    tie = None if dock is None else _tie(seen, dock, config, at)
    slow_key, slow_value = (at.slow_key, at.slow_value) if tie is None else (at.leaf_keys[0], seen.slow)
    by_slow = seen.placed(by_slow) if tie is None else by_slow
    found: list[Any] = [] if tie is None else list(tie.factors)
    points = gtsam.Values()
    for k, constant in enumerate(survey_errors):  # GTSAM's linear factors have at most three keys: one for each tag
        own = slice(8 * k, 8 * k + 8)
        corners = Residual(
            raw=raw[own], cov=m.cov[own, own], jacobian=lambda: np.zeros((8, 6)), prior=1.0, size_m=None, size_deg=None
        )
        terms = [by_body._replace(jacobian=by_body.jacobian[own])]
        if seen.own and slow_key is not None:
            terms.append(Term(slow_key, slow_value, by_slow[own]))
        if constant is not None:
            terms.append(Term(constant[0], np.array(constant[1]), by_tag[own]))
        found += linear_update(corners, terms, decision, points).factors
    return GraphUpdate(factors=tuple(found), guesses=() if tie is None else tie.guesses)


def _turning(by_point: Array, arms: Array) -> Array:
    """Return d / d small rotation (n, 2, 3) from d / d points (n, 2, 3), of points at the ends of arms (n, 3)."""
    across = np.zeros((len(arms), 3, 3))  # w x a = -across w; `np.cross` takes 50 us to look at its arguments
    across[:, [2, 0, 1], [1, 2, 0]], across[:, [1, 2, 0], [2, 0, 1]] = arms, -arms
    return -by_point @ across


def _tie(seen: _Seen, dock: DockConfig, config: AprilTagConfig, at: Attachment) -> GraphUpdate:
    """Return the factor and guess of a leaf: the dock's state at the sighting, between two nodes of its Markov process.

    The leaf's covariance is that of the bridge between the nodes. Interpolated rigidly instead, a dock that swings by 0.3 m is off
    by 4 cm, which is 16 px at 2.6 m.
    """
    assert at.slow_key is not None
    n = len(seen.own)
    picked = seen.placed(np.eye(n))
    sigma, time_s = dock_process(dock)
    still = 3 * seen.mounted + seen.timed
    sigma = np.concatenate([sigma, np.zeros(still), [config.edge_sigma_px] * seen.edges])
    time_s = np.concatenate([time_s, np.full(still, np.inf), [EDGE_TIME_S] * seen.edges])
    tie = np.array(_TIE_DOCK + _TIE_MOUNT * seen.mounted + _TIE_LATE * seen.timed + _TIE_EDGE * seen.edges)
    if at.slow_next is None:  # it has gone on by itself
        kept = np.exp(-at.slow_age_s / time_s)
        expected, bridge = kept * np.asarray(at.slow_value)[seen.own], sigma * np.sqrt(1.0 - kept**2)
    else:
        _, _, share, dt_s = at.slow_next
        kept = np.full(n, 1.0 - share)
        expected, bridge = seen.slow, sigma * np.sqrt(2.0 / time_s * dt_s * share * (1.0 - share))
    residual = Residual(
        raw=seen.slow - expected, cov=np.diag(np.maximum(bridge, tie) ** 2), jacobian=lambda: np.zeros((n, 6)), prior=1.0,
        size_m=None, size_deg=None,
    )  # fmt: skip
    terms = [
        Term(at.leaf_keys[0], seen.slow, np.eye(n)),
        Term(at.slow_key, np.array(at.slow_value), -kept[:, None] * picked),
    ]
    if at.slow_next is not None:
        terms.append(Term(at.slow_next[0], np.array(at.slow_next[1]), -share * picked))
    return GraphUpdate(linear_update(residual, terms, Decision()).factors, ((at.leaf_keys[0], seen.slow),))


def _outwards(rays: Array) -> Array:
    """Return how corners (n, 2) move per unit by which the edges of their tags move outwards."""
    tags = rays.reshape(-1, 4, 2)
    along = tags[:, [1, 2, 3, 0]] - tags
    along /= np.maximum(np.hypot(along[..., :1], along[..., 1:]), 1e-12)
    normal = np.stack([along[..., 1], -along[..., 0]], axis=-1)  # clockwise in an image whose y looks down: outwards
    before = normal[:, [3, 0, 1, 2]]
    opened = 1.0 + (before * normal).sum(axis=-1, keepdims=True)  # -1 where an edge turns back on the one before
    return np.asarray(((before + normal) / np.maximum(opened, 0.1)).reshape(-1, 2))


def _near(m: TagSighting, seen: _Seen, chosen: int, toward: Array) -> bool:
    """Return whether the corners, linearised at the estimate, lead to the chosen mode; toward: (n, 3) corners in the camera."""
    mode = m.modes[chosen]
    off, reach = _off_mode(seen, mode)[0], _middle_in_camera(seen.middle_at_rest_m, mode)[2]
    turned = float(np.linalg.norm(off[3:]))
    if toward[:, 2].min() < _AHEAD * reach or np.linalg.norm(off[:3]) > (1.0 - _AHEAD) * reach:
        return False
    if turned < _BY_A_MODE_RAD:
        return True
    away = [Rotation.from_matrix(other.R_world_camera @ mode.R_world_camera.T).magnitude() for other in m.modes]
    nearest = min((float(a) for k, a in enumerate(away) if k != chosen), default=np.pi)
    return turned < 0.5 * nearest


def false(m: TagSighting, config: AprilTagConfig) -> FalseModel:
    """Return the model of a false sighting."""
    sigmas = np.array([FALSE_SPREAD_M] * 3 + [FALSE_SPREAD_RAD] * 3)
    return FalseModel(probability=config.false_fraction, cov=np.diag(sigmas**2), repeats=config.false_repeats)


def ideal(at: Attachment, config: AprilTagConfig) -> TagSighting:
    """Return the noise-free sighting, at the attachment's state, of a tag 4 m in front of a camera."""
    survey = config.surveyed
    R_body_camera = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    t_body_camera = np.array([1.0, 0.2, 0.5])
    T_world_camera = at.T_world_body.compose(at.T_state_sensor).compose(
        gtsam.Pose3(gtsam.Rot3(R_body_camera), t_body_camera)
    )
    docks = docks_of(survey) if at.slow_value is not None else []
    R, p = T_world_camera.rotation().matrix(), np.asarray(T_world_camera.translation())
    corners = np.array([(-0.2, -0.2, 4.1), (0.2, -0.2, 3.9), (0.2, 0.2, 3.9), (-0.2, 0.2, 4.1)])
    now = p + corners @ R.T
    moved = np.asarray(at.slow_value)[:6] if docks else np.zeros(6)
    pivot = now.mean(axis=0) + np.array([2.0, -1.0, 0.5])
    back = np.asarray(Rotation.from_rotvec(-moved[3:]).as_matrix())
    mode = TagMode(
        p_world_camera_m=pivot + back @ (p - pivot - moved[:3]), R_world_camera=back @ R,
        cov=np.diag([0.02**2] * 3 + [0.01**2] * 3), probability=1.0,
    )  # fmt: skip
    return TagSighting(
        stamp_ns=0, sensor="apriltag", seq=0, camera="camera", frame=docks[0] if docks else WORLD, numbers=(0,),
        families=("36h11",), points_m=pivot + (now - pivot - moved[:3]) @ back.T, pivot_m=pivot,
        rays=corners[:, :2] / corners[:, 2:], cov=np.eye(8) * 1e-6, t_body_camera_m=t_body_camera,
        R_body_camera=R_body_camera, modes=(mode,),
    )  # fmt: skip


def hint(m: TagSighting, mount_yaw_rad: float, datum: Datum) -> Hint:
    """Return the position and heading of body by the likeliest mode."""
    mode = m.modes[0]
    R_world_body = mode.R_world_camera @ m.R_body_camera.T
    turn = _turned(mode.R_world_camera)
    sigma = np.sqrt(np.diagonal(turn @ mode.cov @ turn.T))
    reach = float(np.linalg.norm(_middle_in_camera(_middle_at_rest_m(m), mode)))
    return Hint(
        p_world_m=mode.p_world_camera_m - R_world_body @ m.t_body_camera_m,
        p_sigma_m=np.hypot(sigma[:3], reach * float(sigma[5])),
        yaw_rad=float(np.arctan2(R_world_body[1, 0], R_world_body[0, 0])) - mount_yaw_rad,
        yaw_sigma_rad=float(sigma[5]),
    )


def berths(config: AprilTagConfig) -> tuple[Berth, ...]:
    """Return the berths of the survey; if it lists none, one for the tags of each frame."""
    survey, docks, found = config.surveyed, docks_of(config.surveyed), []
    listed = [(b.name, b.frame, np.array(b.xyz_m), b.facing_deg) for b in survey.berths]
    for frame in () if survey.berths else survey.frames:
        tags = [tag for tag in survey.tags if tag.frame == frame]
        out = np.sum([tag.R_frame_tag[:, 2] for tag in tags], axis=0)
        if np.hypot(out[0], out[1]) > 0.5 * len(tags):  # they look the same way, and to the side
            facing = float(np.degrees(np.arctan2(out[0], out[1])))
            middle = np.mean([tag.xyz_m for tag in tags], axis=0)
            listed.append((frame if frame != WORLD else "quay", frame, middle, facing))
    for name, frame, xyz_m, facing_deg in listed:
        if frame != WORLD and frame not in docks:
            continue  # nothing tells where that dock is
        p, R = survey.rest(frame)
        f = np.radians(facing_deg)
        out = R @ np.array([np.sin(f), np.cos(f), 0.0])
        found.append(
            Berth(
                name=name,
                point_m=p + R @ xyz_m,
                facing_deg=float(np.degrees(np.arctan2(out[0], out[1]))),
                pivot_m=p,
                moves=6 * docks.index(frame) if frame in docks else None,
            )
        )
    return tuple(found)


def describe(m: TagSighting) -> str:
    """Return the camera, the tags and their frame in words."""
    numbers = " ".join(str(n) for n in m.numbers)
    return f"{m.camera}: tag{'s' if len(m.numbers) > 1 else ''} {numbers} ({m.frame})"


ROW = Sensor(
    kind="apriltag",
    measurement=TagSighting,
    config=AprilTagConfig,
    residuals=residuals,
    factors=factors,
    ideal=ideal,
    hint=hint,
    slow=slow,
    constants=constants,
    false=false,
    describe=describe,
    berths=berths,
    one_likelihood=True,
    absolute=True,
    company=True,
    in_world=True,
)
