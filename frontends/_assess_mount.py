# SPDX-License-Identifier: Apache-2.0
"""The mount of an IMU: by tf, gravity and the motion, or by its own orientation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from graphloc.config import STANDARD_GRAVITY_MPS2
from graphloc.frames import Array, rotation_from_rpy_deg, rpy_from_rotation, wrap_angle
from graphloc.frontends._assess import Courses, MeasuredMotion, vec
from graphloc.frontends._mount_yaw import yaw_in_craft
from graphloc.frontends._reports import CompassReport, ImuReport, MountGuess, Vec
from graphloc.frontends._tf import Pose, StaticTree
from graphloc.frontends._turns import Yaws

# Angle between gravity and body z from which a note says so; how near 90 deg gravity or the motion must be off to
# overrule tf; and the coherence that this takes of the motion.
_TILTED_DEG, _QUARTER_DEG, _OVERRULES = 20.0, 20.0, 0.6
_SLIGHTLY_DEG = 3.0  # deviation from a multiple of 90 deg from which it is said
_ASKEW_DEG = 15.0  # deviation from which an IMU sits askew: leeway, or an antenna far ahead, make less
# 1 sigma of the list or trim at which a craft may lie through a recording: as that of a sensor that is drafted in steps
# of 90 deg though gravity is 7 deg off; a choice.
_LISTS_DEG = 5.0
_EITHER = 0.5**0.5  # 1 sigma about one of two angles that are as likely, by how far they are apart
_AHEAD_DEG = 60.0  # yaw within which an unclear motion says that x is ahead rather than astern or aside
_CAMERA = -0.7  # z component of y, levelled, below which the axes are a camera's (y down)
_ON_ITS_HEAD = -0.7  # z component of the upward axis below which a sensor is upside down, however it is tilted


class ImuSamples(NamedTuple):
    """Usable samples of an IMU: frame, stamps (N,), accelerations (N, 3), m/s^2, and angular rates (N, 3), rad/s."""

    frame_id: str
    stamps_ns: NDArray[np.int64]
    accel: Array
    gyro: Array

    def turned(self, R: Array) -> ImuSamples:
        """Return the samples in other axes, to which R (3, 3) takes."""
        return self._replace(accel=self.accel @ R.T, gyro=self.gyro @ R.T)


@dataclass(frozen=True, slots=True, eq=False)
class ImuEvidence:
    """What an IMU is judged by.

    Attributes:
        motions: how the craft moved, by each source, the most accurate first.
        courses: of the fixes; None without fixes. tree: transforms of /tf_static.
        yaws: by topic, of odometry and poses.
    """

    motions: Sequence[MeasuredMotion]
    courses: Courses | None
    tree: StaticTree
    yaws: Mapping[str, Yaws] = field(default_factory=dict)

    def pose_of(self, frame: str | None) -> Pose | None:
        """Return T_body_frame by tf; None where it does not know the frame."""
        return self.tree.resolve(self.tree.body(), frame) if frame in self.tree.frames else None


def mount_guess(samples: ImuSamples, evidence: ImuEvidence) -> MountGuess:
    """Return the IMU's mount in body: from tf, else levelled by gravity and aligned with the motion.

    Some drivers publish in axes of their own, though under the frame of the URDF. Where tf is off by a quarter turn,
    gravity or the motion overrules it. Half a turn about the vertical may be a craft that goes astern, so tf stays.
    """
    motions, pose = evidence.motions, evidence.pose_of(samples.frame_id)
    if pose is None:
        return measured_mount(samples, motions)
    tilt_deg = tilt_of(pose[1], samples.accel)
    if abs(tilt_deg - 90.0) < _QUARTER_DEG:
        return in_place_of(pose, tilt_deg, measured_mount(samples, motions))
    note = "" if tilt_deg < _TILTED_DEG else f"; but then gravity is {tilt_deg:.0f} deg off body z: check it"
    if not note and motions:
        in_body = samples.turned(pose[1])
        turned = yaw_in_craft(in_body.stamps_ns, in_body.accel, in_body.gyro, motions)
        if turned is not None and turned.astray:
            if abs(abs(turned.yaw_deg) - 90.0) < _QUARTER_DEG and turned.coherence > _OVERRULES:
                said = f"not as in tf, since {turned.said}: tf is right only if the craft goes sideways throughout"
                return replace(mount_turned(samples, motions, pose[1], said), xyz_m=vec(pose[0]))
            note = f"; but {turned.said}: check it"
    rpy = vec(np.degrees(rpy_from_rotation(pose[1])))
    return MountGuess(rpy_deg=rpy, tf_frame=samples.frame_id, evidence=f"from tf{note}")


def measured_mount(samples: ImuSamples, motions: Sequence[MeasuredMotion]) -> MountGuess:
    """Return the mount whose roll and pitch are by gravity, and whose yaw is by the motion."""
    up = np.median(samples.accel, axis=0)
    size = float(np.linalg.norm(up))
    if size < 0.5 * STANDARD_GRAVITY_MPS2:
        return mount_turned(samples, motions, np.eye(3), "no gravity to find the level from: taken as level")
    axis = up / size
    snapped = np.zeros(3)
    k = int(np.argmax(np.abs(axis)))
    snapped[k] = np.sign(axis[k])
    aligned = float(axis @ snapped) > np.cos(np.radians(15.0))
    level = levelling(snapped if aligned else axis)
    name = f"{'+' if snapped[k] > 0 else '-'}{'xyz'[k]}"
    said = (
        f"gravity is on {name} of the sensor" if aligned else f"gravity is {np.round(axis, 2).tolist()} in the sensor"
    )
    off_deg = float(np.degrees(np.arccos(np.clip(axis @ snapped, -1.0, 1.0))))
    if not aligned:
        return _perhaps_listing(mount_turned(samples, motions, level, said), axis)
    if off_deg < _SLIGHTLY_DEG:
        return mount_turned(samples, motions, level, said)
    mount = mount_turned(samples, motions, level, f"{said}, {off_deg:.0f} deg off")
    turn = rotation_from_rpy_deg(np.array(mount.rpy_deg)) @ level.T
    roll, pitch, yaw = np.degrees(rpy_from_rotation(turn @ levelling(axis))).tolist()
    square = f"drafted in steps of 90 deg: if the sensor is tilted in the craft, rather than the craft itself, set [{roll:.1f}, {pitch:.1f}, {yaw:.1f}]"
    return replace(mount, evidence=f"{mount.evidence}; {square}", tilt_sigma_deg=off_deg * _EITHER)


def _perhaps_listing(mount: MountGuess, axis: Array) -> MountGuess:
    """Return the mount of a sensor that is levelled by gravity, with the sigmas by a list of the craft meanwhile.

    Gravity does not tell a list from a tilt of the sensor in the craft. Of a sensor that is tilted by p, a list phi about
    the axis ahead makes the levelled mount wrong by phi about that, and by phi tan(p / 2) about the vertical.

    Args:
        axis: (3,) unit vector up in the sensor.
    """
    cosine = float(-axis[2] if axis[2] < _ON_ITS_HEAD else axis[2])
    yaw_sigma_deg = _LISTS_DEG * float(np.sqrt((1.0 - cosine) / (1.0 + cosine)))
    said = f"{mount.evidence}; if the craft listed meanwhile, the mount is as much off"
    return replace(
        mount,
        evidence=said,
        tilt_sigma_deg=_LISTS_DEG,
        yaw_sigma_deg=float(np.hypot(mount.yaw_sigma_deg, yaw_sigma_deg)),
    )


def tilt_of(R_body_imu: Array, accel: Array) -> float:
    """Return the angle of gravity, by accelerations (N, 3) and a mount, to body z, deg; 0 if gravity was removed."""
    up = np.median(accel, axis=0)
    size = float(np.linalg.norm(up))
    return float(np.degrees(np.arccos(np.clip((R_body_imu @ up)[2] / size, -1.0, 1.0)))) if size > 2.0 else 0.0


def in_place_of(pose: tuple[Array, Array], tilt_deg: float, mount: MountGuess) -> MountGuess:
    """Return a measured mount that replaces the one in tf, of which only the position is kept."""
    why = f"not as in tf, by which gravity is {tilt_deg:.0f} deg off body z; {mount.evidence}"
    return replace(mount, xyz_m=vec(pose[0]), evidence=why)


def yawed(yaw_deg: float, R: Array) -> Vec:
    """Return roll, pitch and yaw, deg, rounded to a tenth, of a rotation (3, 3) that is turned about the vertical."""
    turned = Rotation.from_euler("z", yaw_deg, degrees=True).as_matrix() @ R
    return vec(np.round(np.degrees(rpy_from_rotation(turned)), 1) + 0.0)  # + 0.0: no -0.0


def mount_turned(samples: ImuSamples, motions: Sequence[MeasuredMotion], level: Array, said: str) -> MountGuess:
    """Return the mount of a sensor that is levelled by `level` (3, 3), with its yaw by the motion.

    Args:
        said: evidence of the level, in words.
    """
    yaw, sigma, evidence = mount_yaw(samples.turned(level), motions)
    told = yaw is not None
    if yaw is None:
        ahead = level[:, 2] if level[2, 1] < _CAMERA else np.array([1.0, 0.0, 0.0])
        yaw = float(np.degrees(np.arctan2(-ahead[1], ahead[0]))) + 0.0
        evidence += f": taken as {yaw:.0f}" + ("" if yaw == 0.0 else ", z ahead and y down as in a camera's axes")
    rpy = yawed(yaw, level)
    return MountGuess(rpy_deg=rpy, tf_frame=None, evidence=f"{said}; {evidence}", yaw_told=told, yaw_sigma_deg=sigma)


def turned_as_its_heading(imu: ImuReport, compasses: Sequence[CompassReport]) -> ImuReport:
    """Return the report with the mount's yaw by the IMU's own orientation, where nothing else tells it.

    The orientation must be along the course or opposite to it. One a quarter turn off it tells nothing: so are headings
    that count from north, or that are in other axes than the driver names.
    """
    own = next((c for c in compasses if c.topic == imu.topic and (c.ahead or c.backwards)), None)
    if own is None or imu.mount.yaw_told:
        return imu
    R = rotation_from_rpy_deg(np.array(imu.mount.rpy_deg))
    x_deg = 0.0 if own.mount else float(np.degrees(np.arctan2(R[1, 0], R[0, 0])))
    quarters = round(((180.0 if own.backwards else 0.0) - x_deg) / 90.0) % 4
    if quarters == 0:
        return imu
    turned = "half a turn" if quarters == 2 else "a quarter turn"
    said = f"{imu.mount.evidence}, but {turned} off that, as its orientation is {own.offset_deg:+.0f} deg off the GNSS course"
    return replace(imu, mount=replace(imu.mount, rpy_deg=yawed(90.0 * quarters, R), evidence=said, yaw_told=True))


def levelling(axis: Array) -> Array:
    """Return the smallest rotation (3, 3) that takes a unit vector to +z.

    Of a sensor upside down, it follows half a turn about x, so that x stays ahead. Near -z the axis of the smallest
    rotation is arbitrary: of a sensor upside down and tilted a little forward, x would point astern.
    """
    turned = np.diag([1.0, -1.0, -1.0]) if axis[2] < _ON_ITS_HEAD else np.eye(3)
    up, z = turned @ axis, np.array([0.0, 0.0, 1.0])
    cross = np.cross(up, z)
    sine = float(np.linalg.norm(cross))
    if sine < 1e-9:
        return turned
    angle = float(np.arctan2(sine, up[2]))
    return np.asarray(Rotation.from_rotvec(angle * cross / sine).as_matrix() @ turned)


def mount_yaw(levelled: ImuSamples, motions: Sequence[MeasuredMotion]) -> tuple[float | None, float, str]:
    """Return the yaw of a levelled IMU by the motion, its sigma, and the evidence in words.

    Returns:
        The yaw, deg: a multiple of 90 unless the motion clearly contradicts it; None where nothing tells it. Its 1
        sigma, deg, if it may be no multiple of 90; else 0. The evidence.
    """
    if not motions:
        return None, 0.0, "no motion to find its yaw from"
    found = yaw_in_craft(levelled.stamps_ns, levelled.accel, levelled.gyro, motions)
    if found is None:
        return None, 0.0, "too little motion to find its yaw from"
    quarter = 90.0 * round(found.yaw_deg / 90.0)
    stays = found.hints and abs(found.yaw_deg) < _AHEAD_DEG
    if not found.clear and (found.likely or stays):
        yaw = float(np.degrees(wrap_angle(np.radians(quarter)))) + 0.0 if found.likely else 0.0
        said = f"yaw by the motion of {found.source}: {found.yaw_deg:z.0f} deg, but not clearly (coherence {found.coherence:.2f})"
        return yaw, 0.0, f"{said}: taken as {yaw:.0f}"
    if not found.clear:
        return None, 0.0, f"motion of {found.source} does not show its yaw (coherence {found.coherence:.2f})"
    off_deg = abs(found.yaw_deg - quarter)
    turned = off_deg > max(_ASKEW_DEG, 4.0 * found.sigma_deg)
    askew = turned and not found.one_way
    yaw = float(np.degrees(wrap_angle(np.radians(round(found.yaw_deg) if askew else quarter)))) + 0.0
    said = f"yaw by the motion of {found.source}: {found.yaw_deg:z.0f} deg (coherence {found.coherence:.2f})"
    if turned and found.one_way:
        said += (
            f", taken as {yaw:.0f}: she goes one way, so leeway or a current may set her by that; where she is not set sideways, as "
            f"on wheels, set {found.yaw_deg:.0f}"
        )
        return yaw, off_deg * _EITHER, said
    if not askew and off_deg > max(_SLIGHTLY_DEG, 4.0 * found.sigma_deg):
        said += f", taken as {yaw:.0f}, since leeway makes a few degrees: where she is not set sideways, as on wheels, set {found.yaw_deg:.0f}"
        return yaw, off_deg * _EITHER, said
    return yaw, found.error_deg if askew else 0.0, said
