# SPDX-License-Identifier: Apache-2.0
"""AprilTags that a camera sees: the corners themselves are fused, the poses that explain them are its modes.

    z_i = pi(R' (P_i - p)) + w_i,   w_i ~ N(0, C),   pi(x, y, z) = (x, y) / z,   R = R_b Exp(u) M,   at t_i - l
    P_i = c + d + Exp(w) (Q_i - c),   Q_i = S_i + e_k + f_k x (S_i - m_k)
    seen further out from its tag's middle, by b px at each edge

p, R: camera in world; R_b: body in world; M: the camera's mount, which is off by u; t_i: the stamp, late by l; u and l are
constants of the run; S_i: a corner as surveyed, its frame at rest; e_k, f_k: what the survey errs about tag k, its middle m_k,
constants too; d, w: motion and small turn about c of the floating dock that the tag rides on, a slow state (D has neither);
b: what detector, light, print and focal length make tags seem wider than they are, a slow state as well.
Taken for noise of each sighting instead, such errors average out over hundreds of them, and the bounds are too small:
three tags that hang 0.2 deg forward lift a vessel 20 m away by 7 cm in every image; tags 12 px wide whose edges are
off by 0.04 px hold one 35 m away 0.2 m too near.

Four coplanar corners have two poses, and beyond some 20 tag widths these run into each other: one pose's Gaussian is
then no likelihood, and hundreds of sightings of which each is drawn to its nearer mode bend the heading (measured:
docs/decisions/0007). So the factor is the reprojection itself, linearised anew at every pass: where the estimate is
when it lies by the chosen mode, else at that mode. The modes' Gaussians are there to choose by:

    e = (p + R t_m - m, Log(R (Exp(w) R_m)'))    t_m: the tags' middle in the camera of mode m

that is the place that the tags give the camera if its attitude is the predicted one, and that attitude.
"""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np
from scipy.spatial.transform import Rotation

from graphloc.berths import Berth
from graphloc.config import AprilTagConfig
from graphloc.frames import Array, Datum, pinhole, skew
from graphloc.graph import Attachment, Constant, Decision, FalseModel, GraphUpdate, Hint, Residual, Sensor, SlowProcess
from graphloc.linear import Term, linear_update, pose_term
from graphloc.measurements import TagMode, TagSighting
from graphloc.survey import WORLD, DockConfig, Survey

# Where a false sighting may put the camera: a berth further on, turned as one likes within a quarter of a circle.
FALSE_SPREAD_M, FALSE_SPREAD_RAD = 5.0, float(np.radians(30.0))
# Added to a mode's sigmas to decide by: corners place a camera to millimetres, and an estimate that has yet to settle
# is off by more; what is called false is off by metres.
_TO_DECIDE = np.array([0.05] * 3 + [np.radians(0.5)] * 3)
_AHEAD = 0.3  # of a mode's distances: nearer than that the estimate's own are not believed
_BY_A_MODE_RAD = float(np.radians(20.0))
_FREEDOM = ("east", "north", "up", "roll", "pitch", "yaw")
_LEAST_M, _LEAST_RAD = 1e-3, float(np.radians(0.01))
_LEAST = np.repeat([_LEAST_M, _LEAST_RAD], 3)
# Where a sighting stands on a node: m, rad of a dock; rad of a mount; s; px.
_TIE_DOCK, _TIE_MOUNT, _TIE_LATE, _TIE_EDGE = (1e-4,) * 3 + (1e-5,) * 3, (1e-5,) * 3, (1e-5,), (1e-4,)
_TIDE_S = 3600.0
_EDGE_S = 30.0  # range and light change in about that


class _Seen:
    """A sighting as the graph sees it now.

    Attributes:
        R, p: camera in world. points_m: (n, 3) corners where their frame is now. middle_m: of these.
        body: (6, 6) d (place, rotation about the world's axes) of the camera / d tangent of the state. by_mount: (3, 3) d that
            rotation / d u. by_late: (6,) d (place, rotation) / d l. own: rows of the slow state that it knows of: six of its dock, three of
            its camera's mount, one of its stamps, that of the edges, each where it is modelled (rides, mounted, timed, edges).
            slow: their values; moved: (6,) of the dock; edge_px: b.
    """

    def __init__(self, m: TagSighting, config: AprilTagConfig, at: Attachment) -> None:
        docks, cameras = (_docks(config.surveyed), _rows(config)) if at.slow_value is not None else ([], {})
        mount, late = cameras.get(m.camera, (range(0), range(0)))
        self.slow_size = 0 if at.slow_value is None else len(at.slow_value)
        self.rides, self.mounted, self.timed = m.frame in docks, len(mount) > 0, len(late) > 0
        self.edges = self.slow_size > max([6 * len(docks), *(stamps.stop for _, stamps in cameras.values())])
        first = 6 * docks.index(m.frame) if self.rides else 0
        self.own = [*range(first, first + 6 * self.rides), *mount, *late, *[self.slow_size - 1] * self.edges]
        self.slow = np.zeros(0)
        if at.slow_value is not None:  # of tags that stand still: the edges of the node before, no leaf in between
            self.slow = (_between(at) if self.rides else np.asarray(at.slow_value))[self.own]
        T_state_camera = at.T_state_sensor.compose(gtsam.Pose3(gtsam.Rot3(m.R_body_camera), m.t_body_camera_m))
        T_world_camera = at.T_world_body.compose(T_state_camera)
        self.R, self.p = T_world_camera.rotation().matrix(), np.asarray(T_world_camera.translation())
        adjoint = np.asarray(T_state_camera.inverse().AdjointMap())
        self.body = np.vstack([self.R @ adjoint[3:], self.R @ adjoint[:3]])
        self.by_mount, self.by_late = np.eye(3), np.zeros(6)
        R_world_body, arm = self.R @ m.R_body_camera.T, self.p - np.asarray(at.T_world_body.translation())
        off, ago_s = self.slow[6 * self.rides :][:3], self.slow[6 * self.rides + 3 * self.mounted :][: len(late)]
        if self.timed:
            rate = R_world_body @ at.gyro_radps
            self.by_late = -np.concatenate([at.v_world_mps + at.dv_world_mps + skew(rate) @ arm, rate])
            self.p = self.p + self.by_late[:3] * ago_s
            R_world_body = gtsam.Rot3.Expmap(self.by_late[3:] * ago_s).matrix() @ R_world_body
        if self.mounted:
            self.by_mount = R_world_body @ np.asarray(gtsam.Rot3.ExpmapDerivative(-off))
            R_world_body = R_world_body @ gtsam.Rot3.Expmap(off).matrix()
        self.R = R_world_body @ m.R_body_camera
        self.moved = moved = self.slow[:6] if self.rides else np.zeros(6)
        self.edge_px = float(self.slow[-1]) if self.edges else 0.0
        self.turn = self.by_turn = np.eye(3)
        if self.rides:
            self.turn = gtsam.Rot3.Expmap(moved[3:]).matrix()
            self.by_turn = np.asarray(gtsam.Rot3.ExpmapDerivative(-moved[3:]))  # Exp(w + dw) = Exp(by_turn dw) Exp(w)
        self.constants = _constants_of(m, config, at)
        tags = np.array(m.points_m).reshape(-1, 4, 3)
        self.within = tags - tags.mean(axis=1, keepdims=True)  # each corner from its tag's middle
        for k, constant in enumerate(self.constants):
            if constant is not None:
                tags[k] += constant[1][:3] + self.within[k] @ skew(constant[1][3:]).T
        self.arms = (tags.reshape(-1, 3) - m.pivot_m) @ self.turn.T
        self.points_m = m.pivot_m + moved[:3] + self.arms
        self.middle_m = m.pivot_m + moved[:3] + (m.points_m.mean(axis=0) - m.pivot_m) @ self.turn.T

    def placed(self, per_own: Array) -> Array:
        """Put d / d its own rows of the slow state (k, len(own)), or the first of them, where these stand (k, n)."""
        whole = np.zeros((len(per_own), self.slow_size))
        whole[:, self.own[: per_own.shape[1]]] = per_own
        return whole


def _between(at: Attachment) -> Array:
    """The slow state at the measurement, between its node and the next."""
    value = np.asarray(at.slow_value)
    if at.slow_next is None:
        return value
    _, following, share, _ = at.slow_next
    return np.asarray((1.0 - share) * value + share * following)


def _docks(survey: Survey) -> list[str]:
    return [frame for frame in survey.frames if frame != WORLD]


def _rows(config: AprilTagConfig) -> dict[str, tuple[range, range]]:
    """Rows of the slow state, by camera: what its mount is off, and its stamps are late; empty where that is not estimated."""
    found, first = {}, 6 * len(_docks(config.surveyed))
    for name, camera in config.cameras.items():
        stop = first + 3 * (camera.mount_sigma_deg > 0.0)
        found[name] = (range(first, stop), range(stop, stop + (camera.stamp_sigma_s > 0.0)))
        first = found[name][1].stop
    return found


def _constants_of(m: TagSighting, config: AprilTagConfig, at: Attachment) -> list[tuple[int, Array] | None]:
    """Key and estimate of what the survey errs about each tag; None where there is none."""
    index = {(str(tag.family), tag.id): k for k, tag in enumerate(config.surveyed.tags)}
    found = [index.get(tag) for tag in m.tags]
    return [at.constants[k] if k is not None and k < len(at.constants) else None for k in found]


def _middle_in_camera(m: TagSighting, mode: TagMode) -> Array:
    return np.asarray(mode.R_world_camera.T @ (m.points_m.mean(axis=0) - mode.p_world_camera_m))


def _turned(R: Array) -> Array:
    """Takes (tags' middle seen from the camera, its rotation) in camera's axes to (place of the camera, rotation) in world."""
    turn = np.zeros((6, 6))
    turn[:3, :3], turn[3:, 3:] = -R, R
    return turn


def _by_mode(m: TagSighting, config: AprilTagConfig, seen: _Seen, mode: TagMode) -> Residual:
    toward = seen.R @ _middle_in_camera(m, mode)
    rotation = np.asarray(gtsam.Rot3.Logmap(gtsam.Rot3(seen.R @ (seen.turn @ mode.R_world_camera).T)))
    raw = np.concatenate([seen.p + toward - seen.middle_m, rotation])

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
        slow_jacobian=slow_jacobian
        if seen.rides or seen.mounted
        else None,  # edges are no matter where modes are chosen
        prior=mode.probability * (1.0 - config.false_fraction),
        size_m=float(np.hypot(raw[0], raw[1])),
        size_deg=float(np.degrees(np.linalg.norm(rotation))),
        expected_nis=m.rays.size,
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
    flat, projected = pinhole(toward)
    by_point = projected @ seen.R.T  # d flat / d place of the corner
    turning = _turning(by_point, seen.points_m - seen.p)
    camera = np.concatenate([-by_point, -turning], axis=2).reshape(-1, 6)
    by_own = []
    if seen.rides:
        swing = _turning(by_point, seen.arms) @ seen.by_turn
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
    raw, by_body = (flat - m.rays).ravel(), camera @ seen.body
    dock = config.surveyed.dock(m.frame) if seen.rides else None
    tie = None if dock is None else _tie(seen, dock, config, at)
    found: list[Any] = [] if tie is None else list(tie.factors)
    for k, constant in enumerate(seen.constants):  # GTSAM's linear factors have at most three keys: one for each tag
        own = slice(8 * k, 8 * k + 8)
        corners = Residual(
            raw=raw[own], cov=m.cov[own, own], jacobian=lambda: np.zeros((8, 6)), prior=1.0, size_m=None, size_deg=None
        )
        terms = [pose_term(at, by_body[own])]
        if tie is not None:
            terms.append(Term(at.leaf_keys[0], seen.slow, by_slow[own]))
        elif seen.own and at.slow_key is not None:
            terms.append(Term(at.slow_key, np.array(at.slow_value), seen.placed(by_slow[own])))
        if constant is not None:
            at_rest = by_point[4 * k : 4 * k + 4] @ seen.turn
            turned = _turning(at_rest, seen.within[k])
            terms.append(
                Term(constant[0], np.array(constant[1]), np.concatenate([at_rest, turned], axis=2).reshape(8, 6))
            )
        found += linear_update(corners, terms, decision).factors
    return GraphUpdate(factors=tuple(found), guesses=() if tie is None else tie.guesses)


def _turning(by_point: Array, arms: Array) -> Array:
    """Takes d / d places (n, 2, 3) of points to d / d a small turn (n, 2, 3) of the arms (n, 3) that they are at."""
    across = np.zeros((len(arms), 3, 3))  # w x a = -across w; `np.cross` takes 50 us to look at its arguments
    across[:, [2, 0, 1], [1, 2, 0]], across[:, [1, 2, 0], [2, 0, 1]] = arms, -arms
    return -by_point @ across


def _tie(seen: _Seen, dock: DockConfig, config: AprilTagConfig, at: Attachment) -> GraphUpdate:
    """Where the dock is at the sighting, a leaf: between two nodes of its Markov process, as far off as a bridge is.

    Held fast from node to node instead, a dock that swings by 0.3 m is off by 4 cm, 16 px at 2.6 m.
    """
    assert at.slow_key is not None
    n = len(seen.own)
    picked = seen.placed(np.eye(n))
    sigma, time_s = _swing(dock)
    still = 3 * seen.mounted + seen.timed
    sigma = np.concatenate([sigma, np.zeros(still), [config.edge_sigma_px] * seen.edges])
    time_s = np.concatenate([time_s, np.full(still, np.inf), [_EDGE_S] * seen.edges])
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
    """How corners (n, 2) move when each edge of their tags moves out by 1: where the edges meet then."""
    tags = rays.reshape(-1, 4, 2)
    along = np.roll(tags, -1, axis=1) - tags
    along /= np.maximum(np.linalg.norm(along, axis=2, keepdims=True), 1e-12)
    normal = np.stack([along[..., 1], -along[..., 0]], axis=-1)  # clockwise in an image whose y looks down: outwards
    before = np.roll(normal, 1, axis=1)
    opened = 1.0 + (before * normal).sum(axis=-1, keepdims=True)  # -1 where an edge turns back on the one before
    return np.asarray(((before + normal) / np.maximum(opened, 0.1)).reshape(-1, 2))


def _terms(at: Attachment, jacobian: Array, slow_jacobian: Any) -> list[Term]:
    terms = [pose_term(at, jacobian)]
    if at.slow_key is not None and slow_jacobian is not None:
        terms.append(Term(at.slow_key, np.array(at.slow_value), slow_jacobian()))
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


def constants(config: AprilTagConfig) -> tuple[Constant, ...]:
    """Return what the survey may err about each tag: place (m) and axes (rad), in world."""
    return tuple(
        Constant(
            name=config.surveyed.called(tag.family, tag.id),
            sigma=np.repeat([max(tag.sigma_m, _LEAST_M), max(np.radians(tag.sigma_deg), _LEAST_RAD)], 3),
        )
        for tag in config.surveyed.tags
    )


def slow(config: AprilTagConfig) -> SlowProcess | None:
    """Return how the docks that carry tags move, what the cameras' mounts are off, and how far out edges are seen.

    A dock that swings with period T and RMS s moves at 2 pi s / T; the Markov process that steps as far in 1 s has a time
    constant of T^2 / 2 pi^2. How far it wanders is taken for two sigmas. Waves tilt and lift it where they sway the vessel,
    too: what the model denies the dock there, it gives to the camera's mount and stamps (docs/decisions/0007).
    """
    docks = [dock for name in _docks(config.surveyed) if (dock := config.surveyed.dock(name)) is not None]
    cameras = config.cameras if config.surveyed.tags else {}
    edges = [config.edge_sigma_px] if config.edge_sigma_px and config.surveyed.tags else []
    axes = [f"{dock.name} {axis}" for dock in docks for axis in _FREEDOM]
    units = ["m", "m", "m", "deg", "deg", "deg"] * len(docks)
    swings = [_swing(dock) for dock in docks]
    sigma, time_s = ([value for swing in swings for value in swing[k]] for k in (0, 1))
    for name, camera in cameras.items():
        mount, late = 3 * (camera.mount_sigma_deg > 0.0), int(camera.stamp_sigma_s > 0.0)
        axes += [f"{name} mount {axis}" for axis in _FREEDOM[3:]][:mount] + [f"{name} late"] * late
        units += ["deg"] * mount + ["s"] * late
        sigma += [np.radians(camera.mount_sigma_deg)] * mount + [camera.stamp_sigma_s] * late
        time_s += [np.inf] * (mount + late)
    if not axes and not edges:
        return None
    of_cameras = len(axes) > 6 * len(docks)
    return SlowProcess(
        name=" and ".join(["docks moved"] * bool(docks) + ["cameras off"] * of_cameras + ["edges seen"] * len(edges)),
        offset="camera's mount or clock",
        axes=(*axes, *["outwards"] * len(edges)),
        units=(*units, *["px"] * len(edges)),
        scale=np.array([180.0 / np.pi if unit == "deg" else 1.0 for unit in units] + [1.0] * len(edges)),
        sigma=np.array([*sigma, *edges]),
        time_constant_s=np.array([*time_s, *[_EDGE_S] * len(edges)]),
    )


def _swing(dock: DockConfig) -> tuple[Array, Array]:
    """Sigmas (6,) of a dock's motion, m and rad, and their time constants (6,), s."""
    wander_s, wave_s = (max(period_s**2 / (2.0 * np.pi**2), 1.0) for period_s in (dock.period_s, dock.wave_period_s))
    turns = np.radians([dock.tilts_deg, dock.tilts_deg, dock.moves_deg])
    sigma = np.maximum(np.concatenate([[dock.moves_m, dock.moves_m, dock.rises_m], turns]) / 2.0, _LEAST)
    sigma[2], rise_s = _both((sigma[2], _TIDE_S), (dock.heaves_m / 2.0, wave_s))
    return sigma, np.array([wander_s, wander_s, rise_s, wave_s, wave_s, wander_s])


def _both(slow: tuple[float, float], quick: tuple[float, float]) -> tuple[float, float]:
    """Sigma and time constant of one Markov process for the sum of two: steps as far, and averages out as slowly."""
    step = sum(sigma**2 / time_s for sigma, time_s in (slow, quick))
    lasting = sum(sigma**2 * time_s for sigma, time_s in (slow, quick))
    return float((step * lasting) ** 0.25), float(np.sqrt(lasting / step))


def ideal(at: Attachment, config: AprilTagConfig) -> TagSighting:
    """Return the sighting that the attachment's estimate would give of a made-up tag 4 m ahead of a camera."""
    survey = config.surveyed
    R_body_camera = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    t_body_camera = np.array([1.0, 0.2, 0.5])
    T_world_camera = at.T_world_body.compose(at.T_state_sensor).compose(
        gtsam.Pose3(gtsam.Rot3(R_body_camera), t_body_camera)
    )
    docks = _docks(survey) if at.slow_value is not None else []
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
    survey, docks, found = config.surveyed, _docks(config.surveyed), []
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
    constants=constants,
    false=false,
    describe=describe,
    berths=berths,
    one_likelihood=True,
    absolute=True,
    company=True,
    in_world=True,
)
