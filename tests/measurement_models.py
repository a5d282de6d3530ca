"""What each kind of sensor would measure without noise, written anew from docs/measurement-models.md: nothing here is of `factors/`.

All are functions of a `Situation`; each returns z (k,) in the units of the measurement.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from graphloc.frames import Array, Geodetic
from graphloc.graph import Attachment, FeltMotion, Sensor
from graphloc.measurements import (
    BodyVelocity,
    CompassHeading,
    GnssPosition,
    GnssVelocity,
    HeightPrior,
    Measurement,
    PoseFix,
    TagSighting,
)

_EARTH_M = 6_371_000.0


class Situation(NamedTuple):
    """Where the vessel is and how it moves, with symbols of docs/measurement-models.md.

    Attributes:
        R, p, v: of body in world, p and v at the measurement. omega: body rate. felt: by the IMU.
        l: lever arm. l_then, M: place and rotation of the sensor, turned as at the measurement, seen from the body at the state.
        off: slow state by the names and in the units of outputs, constants by the key that they are added to; 0 where there is none.
        of_tags: (6,) survey error of each tag. latitude_rad: of the datum.
    """

    R: Array
    p: Array
    v: Array
    omega: Array
    l: Array
    l_then: Array
    M: Array
    felt: FeltMotion
    off: defaultdict[str, float]
    of_tags: tuple[Array, ...]
    latitude_rad: float

    @classmethod
    def of(cls, row: Sensor, config: Any, at: Attachment) -> Situation:
        """What an attachment says, with what its sensor is off by."""
        off: defaultdict[str, float] = defaultdict(float)
        process = row.slow(config)
        if process is not None and at.slow_value is not None:
            off |= zip(process.axes, (process.scale * at.slow_value).tolist(), strict=True)
        values = tuple(value for _, value in at.constants)
        for constant, value in zip(row.constants(config), values, strict=False):
            off |= zip(constant.corrects, value.tolist(), strict=bool(constant.corrects))
        assert at.felt is not None
        return cls(
            at.T_world_body.rotation().matrix(), at.T_world_body.translation() + at.carried_m, at.v_world_mps + at.dv_world_mps, at.gyro_radps,
            at.lever_m, at.T_state_sensor.translation(), at.T_state_sensor.rotation().matrix(), at.felt, off, values,
            np.radians(at.datum.origin.latitude_deg),
        )  # fmt: skip

    def offs(self, *names: str) -> Array:
        """Return some of what the sensor is off by."""
        return np.array([self.off[name] for name in names])

    @property
    def o(self) -> Array:
        """How far off its mount a receiver's antenna is, body axes."""
        return self.M @ self.offs("mount.xyz_m[0]", "mount.xyz_m[1]", "mount.xyz_m[2]")

    @property
    def convergence(self) -> float:
        """By what north there lies counter-clockwise of the datum's."""
        return float(self.p[0] / _EARTH_M * np.tan(self.latitude_rad + self.p[1] / _EARTH_M))

    def u(self, o: Array) -> Array:
        """Velocity of the sensor."""
        return self.v + self.R @ np.cross(self.omega, self.l + o)


def gnss(s: Situation, config: Any) -> Array:
    d, tau = s.offs("east", "north", "up"), s.off["time_offset_s"]
    return np.asarray(s.p + s.R @ (s.l_then + s.o) + s.u(s.o) * tau + d)


def gnss_velocity(s: Situation, config: Any) -> Array:
    force, alpha, g = s.felt
    arm, w = s.l + s.o, s.omega
    a_o = s.R @ (force + np.cross(alpha, arm) + np.cross(w, np.cross(w, arm))) + g
    x, y, _ = s.p / _EARTH_M
    L = Rotation.from_rotvec([-y, x, s.convergence]).as_matrix()
    return np.asarray(L.T @ (s.u(s.o) + a_o * s.off["time_offset_s"]) + s.offs("east", "north", "up"))


def body_velocity(s: Situation, config: Any) -> Array:
    c = np.append(s.offs("current east", "current north"), 0.0)
    turned = s.M @ Rotation.from_euler("z", s.off["yaw"], degrees=True).as_matrix()
    swing = np.cross(s.omega, s.l + s.M @ s.offs("mount x", "mount y", "mount z"))
    z = (1.0 + s.off["scale"] / 100.0) * turned.T @ (s.R.T @ (s.v - c) + swing)
    return np.asarray(z[["xyz".index(axis) for axis in config.axes]])


def compass(s: Situation, config: Any) -> Array:
    y = _rpy(s.R @ s.M)[2] - s.convergence
    h = np.pi / 2.0 - y
    shares = [1.0, np.sin(h), np.cos(h), np.sin(2.0 * h), np.cos(2.0 * h), 1.0]
    return np.array([y + np.radians(shares @ s.offs("yaw", "B", "C", "D", "E", "wander"))])


def pose(s: Situation, config: Any) -> Array:
    d = [*s.offs("east", "north", "up"), 0.0, 0.0, np.radians(s.off["yaw"])]
    z = np.concatenate([s.p + s.R @ s.l_then, _rpy(s.R @ s.M)]) + d
    return np.asarray(z[[("x", "y", "z", "roll", "pitch", "yaw").index(axis) for axis in config.axes]])


def aerial(s: Situation, config: Any) -> Array:
    x, y, _ = s.p + s.R @ s.l_then
    u = np.append(s.u(np.zeros(3))[:2], (s.R @ s.omega)[2])
    d = [*s.offs("east", "north"), np.radians(s.off["yaw"])]
    return np.asarray(np.array([x, y, _rpy(s.R @ s.M)[2]]) + u * s.off["late"] + d)


def height(s: Situation, config: Any) -> Array:
    x, y, up = s.p + s.R @ s.l_then
    return np.array([up + (x**2 + y**2) / (2.0 * _EARTH_M) - s.off["up"]])


MODELS: dict[str, Callable[[Situation, Any], Array]] = {
    f.__name__: f for f in (gnss, gnss_velocity, body_velocity, compass, pose, aerial, height)
}


def _rpy(R: Array) -> Array:
    return Rotation.from_matrix(R).as_euler("xyz")


def sensed(row: Sensor, config: Any, at: Attachment) -> tuple[Measurement, Array]:
    """Return what a sensor measures where it is, and z of that: of tags the corners (8 K,), and that pose as the one mode."""
    m = row.ideal(at, config)
    if isinstance(m, TagSighting):
        p, R = Camera.of(Situation.of(row, config, at), m).at_rest()
        mode = replace(m.modes[0], p_world_camera_m=p, R_world_camera=R)
        m = replace(m, modes=(mode,), cov=np.eye(8) * 1e-4, px=2e-4)
    z = model(row, m, config, at)
    match m:
        case GnssPosition():
            return replace(m, position=Geodetic(*at.datum.geodetic_from_enu(z)[0])), z
        case GnssVelocity():
            return replace(m, v_enu_mps=z), z
        case BodyVelocity():
            return replace(m, value=z), z
        case CompassHeading():
            return replace(m, yaw_rad=float(z[0])), z
        case HeightPrior():
            return replace(m, height_m=float(z[0])), z
        case PoseFix():
            return replace(m, modes=(replace(m.modes[0], value=z),)), z
        case TagSighting():
            return replace(m, rays=z.reshape(-1, 2)), z
    raise NotImplementedError(row.kind)


def model(row: Sensor, m: Measurement, config: Any, at: Attachment) -> Array:
    """Return z by the model."""
    s = Situation.of(row, config, at)
    return corners(s, m) if isinstance(m, TagSighting) else MODELS[row.kind](s, config)


def less(m: Measurement, z: Array, other: Array) -> Array:
    """Return z - other (k,); angles of a whole attitude as the rotation from the other one, about world's axes."""
    apart = z - other
    axes = getattr(m, "axes", ())
    if "roll" in axes:
        one, two = (Rotation.from_euler("xyz", value[-3:]) for value in (z, other))
        apart[-3:] = (one * two.inv()).as_rotvec()
    elif "yaw" in axes or hasattr(m, "yaw_rad"):
        apart[-1] = np.angle(np.exp(1j * apart[-1]))
    return np.asarray(apart)


class Camera(NamedTuple):
    """Where a camera is, p_c and R_c, and how the dock of its tags moved: d, turned by T, about c."""

    p_c: Array
    R_c: Array
    d: Array
    T: Array
    c: Array

    @classmethod
    def of(cls, s: Situation, m: TagSighting) -> Camera:
        """The camera of a sighting."""
        late, R = s.off[f"{m.camera} late"], s.R @ s.M
        rate = R @ s.omega
        u = np.radians(s.offs(*(f"{m.camera} mount {axis}" for axis in ("roll", "pitch", "yaw"))))
        d = s.offs(*(f"{m.frame} {axis}" for axis in ("east", "north", "up")))
        theta = np.radians(s.offs(*(f"{m.frame} {axis}" for axis in ("roll", "pitch", "yaw"))))
        arm = s.R @ (s.l_then + s.M @ m.t_body_camera_m)
        return cls(
            s.p + arm - late * (s.v + np.cross(rate, arm)),
            _turn(-late * rate) @ R @ _turn(u) @ m.R_body_camera,
            d,
            _turn(theta),
            m.pivot_m,
        )

    def at_rest(self) -> tuple[Array, Array]:
        """Return the place and attitude that explain what it sees of tags that are taken to be at rest."""
        return self.c + self.T.T @ (self.p_c - self.c - self.d), self.T.T @ self.R_c

    def off_mode(self, m: TagSighting, k: int) -> Array:
        """Return by what the camera misses a mode, (6,): its place if its attitude is right, and that attitude."""
        middle, mode = m.points_m.mean(axis=0), m.modes[k]
        toward = self.R_c @ mode.R_world_camera.T @ (middle - mode.p_world_camera_m)
        attitude = Rotation.from_matrix(self.R_c @ (self.T @ mode.R_world_camera).T).as_rotvec()
        return np.concatenate([self.p_c + toward - (self.c + self.d + self.T @ (middle - self.c)), attitude])


def corners(s: Situation, m: TagSighting) -> Array:
    """Return where the corners of tags are seen, rays (8 K,)."""
    camera, found = Camera.of(s, m), []
    for tag, number in enumerate(m.numbers):
        S, e = m.points_m[4 * tag : 4 * tag + 4], s.of_tags[number]
        rest = S + e[:3] + np.cross(e[3:], S - S.mean(axis=0))
        P = camera.c + camera.d + (rest - camera.c) @ camera.T.T
        x, y, z = ((P - camera.p_c) @ camera.R_c).T
        found.append(_wider(np.column_stack([x / z, y / z]), s.off["outwards"] * m.px))
    return np.concatenate(found).ravel()


def _wider(rays: Array, by: float) -> Array:
    """Return where the edges of a quadrangle (4, 2) meet after a shift outwards."""
    ends = np.column_stack([rays, np.ones(4)])
    lines = np.cross(ends, np.roll(ends, -1, axis=0))
    lines /= np.linalg.norm(lines[:, :2], axis=1, keepdims=True)
    lines[:, 2] += by * np.sign(lines @ np.append(rays.mean(axis=0), 1.0))
    meet = np.cross(np.roll(lines, 1, axis=0), lines)
    return np.asarray(meet[:, :2] / meet[:, 2:])


def _turn(rotation: Array) -> Array:
    return np.asarray(Rotation.from_rotvec(rotation).as_matrix())
