# SPDX-License-Identifier: Apache-2.0
"""AprilTags that a camera sees: the corners themselves are fused, the poses that explain them are its modes.

    z_i = pi(R' (P_i(s) - p)) + w_i,   w ~ N(0, C),   pi(x, y, z) = (x, y) / z
    P_i(s) = c + d + Exp(w) (P_i - c + k (P_i - m)),   s = (d, w, k) of the frame that the tags are in

p, R: camera in world; P_i: a corner with its frame at rest; c: what the frame turns about, a dock's origin, or in world
m, the middle of the tags in the image; d: east, north, up; w: a small turn; k: scale. s is a slow state: of a floating
dock its motion, and of either what all sightings err together because the survey does (D has neither): three tags
that hang 0.2 deg forward lift a vessel 20 m away by 7 cm, and 1 cm too much between them puts her 0.1 m farther off.

Four coplanar corners have two poses, and beyond some 20 tag widths these run into each other: one pose's Gaussian is
then no likelihood, and hundreds of sightings of which each is drawn to its nearer mode bend the heading (measured:
docs/decisions/0007). So the factor is the reprojection itself, linearised anew at every pass: where the estimate is
when it lies by the chosen mode, else at that mode. The modes' Gaussians are there to choose by:

    e = (p + (1 + k) R t_m - m(s), Log(R R_m(s)'))    t_m: the tags' middle in the camera of mode m

that is the place that the tags give the camera if its attitude is the predicted one, and that attitude.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from graphloc.berths import Berth
from graphloc.config import AprilTagConfig
from graphloc.factors._linear import linear_update
from graphloc.frames import Array, Datum, skew
from graphloc.graph import Attachment, Decision, FalseModel, GraphUpdate, Hint, Residual, Sensor, SlowProcess
from graphloc.measurements import TagMode, TagSighting
from graphloc.survey import WORLD, DockConfig, Survey, TagConfig

# Where a false sighting may put the camera: a berth further on, turned as one likes within a quarter of a circle.
FALSE_SPREAD_M, FALSE_SPREAD_RAD = 5.0, float(np.radians(30.0))
# Added to a mode's sigmas to decide by: corners place a camera to millimetres, and an estimate that has yet to settle
# is off by more; what is called false is off by metres.
_TO_DECIDE = np.array([0.05] * 3 + [np.radians(0.5)] * 3)
_AHEAD = 0.3  # of a mode's distances: nearer than that the estimate's own are not believed
_BY_A_MODE_RAD = float(np.radians(20.0))
_FREEDOM = ("east", "north", "up", "roll", "pitch", "yaw", "scale")
_SIZE = len(_FREEDOM)
_LEAST_M, _LEAST_RAD = 1e-3, float(np.radians(0.01))
_LEAST_SCALE, _LARGEST_SCALE = 1e-3, 0.02  # a print's, and what corners that fit at all allow for
_TIDE_S = 3600.0
_OTHER_TAGS_S = 120.0  # after about so long other tags are in view, and the survey errs in another way


class _Seen:
    """A sighting as the graph sees it now.

    Attributes:
        R, p: camera in world. points_m: (n, 3) corners where their frame is now. middle_m: of these.
        body: (6, 6) d (place, rotation about the world's axes) of the camera / d tangent of the state.
    """

    def __init__(self, m: TagSighting, config: AprilTagConfig, at: Attachment) -> None:
        T_state_camera = at.T_state_sensor.compose(gtsam.Pose3(gtsam.Rot3(m.R_body_camera), m.t_body_camera_m))
        T_world_camera = at.T_world_body.compose(T_state_camera)
        self.R, self.p = T_world_camera.rotation().matrix(), np.asarray(T_world_camera.translation())
        adjoint = np.asarray(T_state_camera.inverse().AdjointMap())
        self.body = np.vstack([self.R @ adjoint[3:], self.R @ adjoint[:3]])
        self.slow_size = 0 if at.slow_value is None else len(at.slow_value)
        self.first = _SIZE * config.surveyed.frames.index(m.frame) if self.slow_size else 0
        moved = np.zeros(_SIZE)
        if at.slow_value is not None:
            moved = np.asarray(at.slow_value)[self.first : self.first + _SIZE]
        self.turn = np.asarray(Rotation.from_rotvec(moved[3:6]).as_matrix())
        self.by_turn = np.asarray(gtsam.Rot3.ExpmapDerivative(-moved[3:6]))  # Exp(w + dw) = Exp(by_turn dw) Exp(w)
        self.scale = float(moved[6])
        self.spread = (m.points_m - m.points_m.mean(axis=0)) @ self.turn.T
        self.arms = (m.points_m - m.pivot_m) @ self.turn.T + self.scale * self.spread
        self.points_m = m.pivot_m + moved[:3] + self.arms
        self.middle_m = self.points_m.mean(axis=0)

    def placed(self, per_frame: Array) -> Array:
        """Put d / d slow state of the frame (k, 7) where it stands among those of all frames (k, n)."""
        whole = np.zeros((len(per_frame), self.slow_size))
        whole[:, self.first : self.first + _SIZE] = per_frame
        return whole


def _middle_in_camera(m: TagSighting, mode: TagMode) -> Array:
    return np.asarray(mode.R_world_camera.T @ (m.points_m.mean(axis=0) - mode.p_world_camera_m))


def _turned(R: Array) -> Array:
    """Takes (tags' middle seen from the camera, its rotation) in camera's axes to (place of the camera, rotation) in world."""
    turn = np.zeros((6, 6))
    turn[:3, :3], turn[3:, 3:] = -R, R
    return turn


def _by_mode(m: TagSighting, config: AprilTagConfig, seen: _Seen, mode: TagMode) -> Residual:
    toward = (1.0 + seen.scale) * seen.R @ _middle_in_camera(m, mode)
    rotation = Rotation.from_matrix(seen.R @ (seen.turn @ mode.R_world_camera).T).as_rotvec()
    raw = np.concatenate([seen.p + toward - seen.middle_m, rotation])

    def jacobian() -> Array:
        turned = np.eye(6)
        turned[:3, 3:] = -skew(toward)
        return np.asarray(turned @ seen.body)

    def slow_jacobian() -> Array:
        rigid = -np.eye(6)
        rigid[:3, 3:] = skew(seen.arms.mean(axis=0))
        rigid[:, 3:] = rigid[:, 3:] @ seen.by_turn
        by_scale = np.concatenate([toward / (1.0 + seen.scale), np.zeros(3)])
        return seen.placed(np.column_stack([rigid, by_scale]))

    return Residual(
        raw=raw,
        cov=_turned(seen.R) @ mode.cov @ _turned(seen.R).T + np.diag(_TO_DECIDE**2),
        jacobian=jacobian,
        slow_jacobian=slow_jacobian if seen.slow_size else None,
        prior=mode.probability * (1.0 - config.false_fraction),
        size_m=float(np.hypot(raw[0], raw[1])),
        size_deg=float(np.degrees(np.linalg.norm(rotation))),
        rows=m.rays.size,
    )


def residuals(m: TagSighting, config: AprilTagConfig, at: Attachment) -> tuple[Residual, ...]:
    """Residuals predicted - measured (6,) in m and rad, one for each mode."""
    seen = _Seen(m, config, at)
    return tuple(_by_mode(m, config, seen, mode) for mode in m.modes)


def factors(m: TagSighting, config: AprilTagConfig, at: Attachment, decision: Decision) -> GraphUpdate:
    """Return the factor of a sighting: its corners, or the chosen mode where the estimate is far from that."""
    seen = _Seen(m, config, at)
    by_mode = _by_mode(m, config, seen, m.modes[decision.mode])
    toward = (seen.points_m - seen.p) @ seen.R
    if not _near(m, decision.mode, by_mode, toward):
        return linear_update(by_mode, _terms(at, by_mode.jacobian(), by_mode.slow_jacobian), decision)
    x, y, z = toward.T
    flat = np.column_stack([x / z, y / z])
    projected = np.zeros((len(z), 2, 3))  # d flat / d toward
    projected[:, 0, 0] = projected[:, 1, 1] = 1.0 / z
    projected[:, :, 2] = -flat / z[:, None]
    by_point = projected @ seen.R.T  # d flat / d place of the corner
    off = seen.points_m - seen.p
    rotation = np.array([skew(v) for v in off])
    camera = np.concatenate([-by_point, by_point @ rotation], axis=2).reshape(-1, 6)
    swing = np.array([-skew(arm) for arm in seen.arms]) @ seen.by_turn
    by_scale = by_point @ seen.spread[:, :, None]
    by_frame = np.concatenate([by_point, by_point @ swing, by_scale], axis=2).reshape(-1, _SIZE)
    corners = Residual(
        raw=(flat - m.rays).ravel(), cov=m.cov, jacobian=lambda: np.asarray(camera @ seen.body), prior=1.0,
        size_m=None, size_deg=None,
    )  # fmt: skip
    return linear_update(corners, _terms(at, corners.jacobian(), lambda: seen.placed(by_frame)), decision)


def _terms(at: Attachment, jacobian: Array, slow_jacobian: Any) -> list[tuple[int, Any, Array]]:
    terms: list[tuple[int, Any, Array]] = [(at.pose_key, at.T_world_body, jacobian)]
    if at.slow_key is not None:
        terms.append((at.slow_key, np.array(at.slow_value), slow_jacobian()))
    return terms


def _near(m: TagSighting, chosen: int, residual: Residual, toward: Array) -> bool:
    """Whether the corners, linearised at the estimate, lead to the chosen mode."""
    mode = m.modes[chosen]
    reach = _middle_in_camera(m, mode)[2]
    if toward[:, 2].min() < _AHEAD * reach or np.linalg.norm(residual.raw[:3]) > (1.0 - _AHEAD) * reach:
        return False
    if float(np.linalg.norm(residual.raw[3:])) < _BY_A_MODE_RAD:
        return True
    away = [Rotation.from_matrix(other.R_world_camera @ mode.R_world_camera.T).magnitude() for other in m.modes]
    nearest = min((float(a) for k, a in enumerate(away) if k != chosen), default=np.pi)
    return float(np.linalg.norm(residual.raw[3:])) < 0.5 * nearest


def false(m: TagSighting, config: AprilTagConfig) -> FalseModel:
    """Return what is expected of a false sighting."""
    sigmas = np.array([FALSE_SPREAD_M] * 3 + [FALSE_SPREAD_RAD] * 3)
    return FalseModel(probability=config.false_fraction, cov=np.diag(sigmas**2), repeats=config.false_repeats)


def slow(config: AprilTagConfig) -> SlowProcess | None:
    """Return how far each frame of the survey may be from where it is said to be."""
    survey = config.surveyed
    if not survey.frames:
        return None
    parts = [_freedom(survey, frame) for frame in survey.frames]
    return SlowProcess(
        name="tags moved",
        axes=tuple(f"{frame} {axis}" for frame in survey.frames for axis in _FREEDOM),
        units=("m", "m", "m", "deg", "deg", "deg", "%") * len(parts),
        scale=np.tile(np.repeat([1.0, 180.0 / np.pi, 100.0], [3, 3, 1]), len(parts)),
        sigma=np.concatenate([sigma for sigma, _ in parts]),
        time_constant_s=np.concatenate([time for _, time in parts]),
    )


def _freedom(survey: Survey, frame: str) -> tuple[Array, Array]:
    """Sigmas (7,) of a frame's slow state, m and rad, and their time constants (7,), s.

    A dock that swings with period T and RMS s moves at 2 pi s / T; the Markov process that steps as far in 1 s has a
    time constant of T^2 / 2 pi^2. How far it wanders is taken for two sigmas.
    """
    tags = [tag for tag in survey.tags if tag.frame == frame]
    sigma_m, sigma_rad = _usual_sigmas(tags)
    surveyed = np.array([sigma_m] * 3 + [sigma_rad] * 3 + [_scale_sigma(tags)])
    dock: DockConfig | None = None if frame == WORLD else survey.dock(frame)
    if dock is None:
        return surveyed, np.full(_SIZE, _OTHER_TAGS_S)
    turns = np.radians([dock.tilts_deg, dock.tilts_deg, dock.moves_deg])
    moves = np.concatenate([[dock.moves_m, dock.moves_m, dock.rises_m], turns, [0.0]]) / 2.0
    swing_s = max(dock.period_s**2 / (2.0 * np.pi**2), 1.0)
    times = np.array([swing_s, swing_s, _TIDE_S, swing_s, swing_s, swing_s, _OTHER_TAGS_S])
    return np.hypot(surveyed, moves), times


def _scale_sigma(tags: Sequence[TagConfig]) -> float:
    """How well distances between tags that are seen together are known: by the survey's noise over those to the next."""
    place = np.array([tag.xyz_m for tag in tags])
    away = np.linalg.norm(place[:, None] - place[None], axis=2) + np.diag(np.full(len(tags), np.inf))
    nearest = away.min(axis=1)
    apart = float(np.median(nearest[np.isfinite(nearest)])) if np.isfinite(nearest).any() else np.inf
    return float(np.clip(_usual_sigmas(tags)[0] / apart, _LEAST_SCALE, _LARGEST_SCALE))


def ideal(at: Attachment, config: AprilTagConfig) -> TagSighting:
    """Return the sighting that the attachment's estimate would give of a made-up tag 4 m ahead of a camera."""
    survey = config.surveyed
    R_body_camera = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    t_body_camera = np.array([1.0, 0.2, 0.5])
    T_world_camera = at.T_world_body.compose(at.T_state_sensor).compose(
        gtsam.Pose3(gtsam.Rot3(R_body_camera), t_body_camera)
    )
    R, p = T_world_camera.rotation().matrix(), np.asarray(T_world_camera.translation())
    corners = np.array([(-0.2, -0.2, 4.1), (0.2, -0.2, 3.9), (0.2, 0.2, 3.9), (-0.2, 0.2, 4.1)])
    now = p + corners @ R.T
    moved = np.zeros(_SIZE) if at.slow_value is None else np.asarray(at.slow_value)[:_SIZE]
    pivot = now.mean(axis=0) + np.array([2.0, -1.0, 0.5])
    back = np.asarray(Rotation.from_rotvec(-moved[3:6]).as_matrix())
    scaled = pivot + (now - pivot - moved[:3]) @ back.T
    middle = scaled.mean(axis=0)
    mode = TagMode(
        p_world_camera_m=middle - back @ (now.mean(axis=0) - p) / (1.0 + moved[6]), R_world_camera=back @ R,
        cov=np.diag([0.02**2] * 3 + [0.01**2] * 3), probability=1.0,
    )  # fmt: skip
    return TagSighting(
        stamp_ns=0, sensor="apriltag", seq=0, camera="camera", frame=(*survey.frames, WORLD)[0], numbers=(0,),
        points_m=middle + (scaled - middle) / (1.0 + moved[6]), pivot_m=pivot, rays=corners[:, :2] / corners[:, 2:],
        cov=np.eye(8) * 1e-6, t_body_camera_m=t_body_camera, R_body_camera=R_body_camera, modes=(mode,),
    )  # fmt: skip


def hint(m: TagSighting, mount_yaw_rad: float, datum: Datum) -> Hint:
    """Return the body's place and heading by the likeliest mode."""
    mode = m.modes[0]
    R_world_body = mode.R_world_camera @ m.R_body_camera.T
    turn = _turned(mode.R_world_camera)
    sigma = np.sqrt(np.diagonal(turn @ mode.cov @ turn.T))
    reach = float(np.linalg.norm(_middle_in_camera(m, mode)))
    return Hint(
        p_world_m=mode.p_world_camera_m - R_world_body @ m.t_body_camera_m,
        p_sigma_m=np.hypot(sigma[:3], reach * float(sigma[5])),
        yaw_rad=float(np.arctan2(R_world_body[1, 0], R_world_body[0, 0])) - mount_yaw_rad,
        yaw_sigma_rad=float(sigma[5]),
    )


def berths(config: AprilTagConfig) -> tuple[Berth, ...]:
    """Return the berths of the survey; where it lists none, each frame's tags make one."""
    survey, found = config.surveyed, []
    for number, frame in enumerate(survey.frames):
        p, R = survey.rest(frame)
        tags = [tag for tag in survey.tags if tag.frame == frame]
        listed = [(b.name, np.array(b.xyz_m), b.facing_deg) for b in survey.berths if b.frame == frame]
        if not survey.berths:
            out = np.sum([tag.R_frame_tag[:, 2] for tag in tags], axis=0)
            if np.hypot(out[0], out[1]) > 0.5 * len(tags):  # they look the same way, and to the side
                facing = float(np.degrees(np.arctan2(out[0], out[1])))
                listed = [(frame if frame != WORLD else "quay", np.mean([tag.xyz_m for tag in tags], axis=0), facing)]
        for name, xyz_m, facing_deg in listed:
            f = np.radians(facing_deg)
            out = R @ np.array([np.sin(f), np.cos(f), 0.0])
            found.append(
                Berth(
                    name=name,
                    point_m=p + R @ xyz_m,
                    facing_deg=float(np.degrees(np.arctan2(out[0], out[1]))),
                    pivot_m=p if frame != WORLD else R @ xyz_m,
                    moves=_SIZE * number,
                    survey_sigma=_survey_sigma(tags),
                    survey_middle_m=p + R @ np.mean([tag.xyz_m for tag in tags], axis=0),
                )
            )
    return tuple(found)


def _usual_sigmas(tags: Sequence[TagConfig]) -> tuple[float, float]:
    """Sigmas of place (m) and axes (rad) of the tag in the middle; what one is known worse is in its sightings."""
    sigma_m = float(np.median([tag.sigma_m for tag in tags]))
    sigma_rad = float(np.radians(np.median([tag.sigma_deg for tag in tags])))
    return max(sigma_m, _LEAST_M), max(sigma_rad, _LEAST_RAD)


def _survey_sigma(tags: Sequence[TagConfig]) -> Array:
    """How well the tags of a frame together stand to it: east, north, up in m, yaw in rad, 1 sigma (4,)."""
    place = np.array([tag.xyz_m[:2] for tag in tags])
    sigma_m, sigma_rad = _usual_sigmas(tags)
    yaw_rad = (len(tags) / sigma_rad**2 + float(((place - place.mean(axis=0)) ** 2).sum()) / sigma_m**2) ** -0.5
    return np.array([sigma_m / np.sqrt(len(tags))] * 3 + [yaw_rad])


def describe(m: TagSighting) -> str:
    """Return the camera, the tags, and the frame that they are in."""
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
    false=false,
    describe=describe,
    berths=berths,
    one_likelihood=True,
    absolute=True,
    company=True,
    in_world=True,
)
