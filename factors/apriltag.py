# SPDX-License-Identifier: Apache-2.0
"""AprilTags seen by a camera: their corners are fused; the poses that explain them are its modes.

    z_i = pi(R' (P_i - p)) + w_i,   w_i ~ N(0, C),   pi(x, y, z) = (x, y) / z,   R = R_b Exp(u) M,   at t_i - l
    P_i = c + d + Exp(w) (Q_i - c),   Q_i = S_i + e_k + f_k x (S_i - m_k)
    z_i is seen farther from its tag's middle, as each edge of the tag is seen b px outwards.

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

error of the camera's position, where its attitude is the predicted one, and of its attitude. Not handled: that the swing of a late
camera turns with the body (1 % of the slope at 0.1 s late and 0.2 rad/s); what a delayed sighting tells of the velocity.
"""

from __future__ import annotations

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from graphloc.berths import Berth
from graphloc.config import AprilTagConfig
from graphloc.factors._tag_corners import corner_factors
from graphloc.factors._tag_seen import TagsSeen, middle_at_rest_m, middle_in_camera
from graphloc.factors._tag_states import constants, docks_of, slow
from graphloc.frames import Array, Datum, skew, yaw_from_rotation
from graphloc.graph import Attachment, Decision, FalseModel, GraphUpdate, Hint, Residual, Sensor
from graphloc.linear import linear_factor
from graphloc.measurements import TagMode, TagSighting
from graphloc.survey import WORLD

# Where a false sighting may put the camera: a berth further on, turned as one likes within a quarter of a circle.
FALSE_SPREAD_M, FALSE_SPREAD_RAD = 5.0, float(np.radians(30.0))
# Added to a mode's sigmas where modes are chosen: corners place a camera to millimetres, and an estimate that has yet to settle is
# off by more than that. A false sighting is off by metres.
_TO_DECIDE = np.array([0.05] * 3 + [np.radians(0.5)] * 3)
_AHEAD = (
    0.3  # share of the tags' distance by a mode: where the estimate has a corner nearer, it is not linearised there
)
_BY_A_MODE_RAD = float(np.radians(20.0))  # off a mode's attitude, within which the estimate leads to that mode


def _turned(R: Array) -> Array:
    """Return the map (6, 6) from (tags' middle, rotation) in the camera's axes to (position of the camera, rotation) in world."""
    turn = np.zeros((6, 6))
    turn[:3, :3], turn[3:, 3:] = -R, R
    return turn


def _by_mode(m: TagSighting, config: AprilTagConfig, seen: TagsSeen, mode: TagMode) -> Residual:
    raw, toward = seen.off_mode(mode)

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
        # How edges are seen does not matter for choosing a mode.
        slow_jacobian=slow_jacobian if seen.rides or seen.mounted or seen.timed else None,
        prior=mode.probability * (1.0 - config.false_fraction),
        size_m=float(np.hypot(raw[0], raw[1])),
        size_deg=float(np.degrees(np.linalg.norm(raw[3:]))),
        expected_nis=m.rays.size,
    )


def residuals(m: TagSighting, config: AprilTagConfig, at: Attachment) -> tuple[Residual, ...]:
    """Return predicted - measured (6,), m and rad, for each mode."""
    seen = TagsSeen(m, config, at)
    return tuple(_by_mode(m, config, seen, mode) for mode in m.modes)


def factors(m: TagSighting, config: AprilTagConfig, at: Attachment, decision: Decision) -> GraphUpdate:
    """Return the factors of a sighting: of its corners, or of the chosen mode where the estimate is far from it."""
    seen = TagsSeen(m, config, at)
    corners = seen.corners(m, config, at)
    if not _near(m, seen, decision.mode, corners.toward_m):
        return linear_factor(_by_mode(m, config, seen, m.modes[decision.mode]), at, decision)
    return corner_factors(m, config, at, decision, seen, corners)


def _near(m: TagSighting, seen: TagsSeen, chosen: int, toward: Array) -> bool:
    """Return whether the corners, linearised at the estimate, lead to the chosen mode; toward: (n, 3) corners in the camera."""
    mode = m.modes[chosen]
    off, reach = seen.off_mode(mode)[0], middle_in_camera(seen.middle_at_rest_m, mode)[2]
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
    R, p = T_world_camera.rotation().matrix(), np.asarray(T_world_camera.translation()) + at.carried_m
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
    reach = float(np.linalg.norm(middle_in_camera(middle_at_rest_m(m), mode)))
    return Hint(
        p_world_m=mode.p_world_camera_m - R_world_body @ m.t_body_camera_m,
        p_sigma_m=np.hypot(sigma[:3], reach * float(sigma[5])),
        yaw_rad=float(yaw_from_rotation(R_world_body)) - mount_yaw_rad,
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
