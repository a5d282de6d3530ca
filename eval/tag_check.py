# SPDX-License-Identifier: Apache-2.0
"""Check the survey of tags, and the mounts and clocks of cameras, by a solved run.

It finds tags at another position, those that face another way, wrong sizes, and late images.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from itertools import combinations

import numpy as np
from scipy.spatial.transform import Rotation

from graphloc.config import VesselConfig
from graphloc.frames import Array
from graphloc.frontends.tags.pose import poses_of
from graphloc.ledger import LedgerRow
from graphloc.measurements import GnssPosition, TagSighting, world_from_fixes
from graphloc.recording import Recording
from graphloc.signals.series import interpolated, rms
from graphloc.solution import Solution
from graphloc.time import stamps_of

_FEWEST = 8
_DOUBTED = 0.5  # share of a tag's sightings that disagree with the rest
_OFF, _ALIKE = 0.04, 0.05  # a ratio of distances that is off by more, and does not scatter by as much, is a size
_ELSEWHERE_M = 0.3
_RANGES = 1.3  # of the farthest to the nearest view, from which on a size shows as one
_MARGIN = "the black square without its white margin"
# A stamp that is off by more is said; the share of a camera's errors of roll that it must explain.
_LATE_S, _LATE_EXPLAINS = 0.03, 0.3
# A mount that tags contradict by more, and by the same all the while, is a wrong one.
_TURNED_DEG, _STEADY = 6.0, 0.5
# All tags of a camera elsewhere together.
_TOGETHER_M = 5.0
_UPSIDE_DOWN = 0.7  # cosine of the angle between up and down by a tag
_FITS = 0.5  # of a tag's side, that corners are off at most where one pose explains several: 0.03, and 1.5 to 5 where they hang so
_UPRIGHT = 3.0  # rise over way of an offset of heights; the rest, without tags, is metres off sideways
# Share of the sightings of a tag in which the vessel is behind its plane, by more than a fix is off; and by how much more than the
# camera's lever arm she may be farther from it than it looks: else it is not the facing that is wrong, but the place.
_BEHIND, _BEHIND_M, _PLACE_M = 0.5, 3.0, 5.0
_FACES_DEG = 30.0  # by which a face is turned at least, for an angle of another convention
# Share of what her distance and that which it looks scatter by in sum, up to which their difference scatters.
_ALONG = 0.5

Key = tuple[str, tuple[str, int]]  # of a tag: its sensor; its family and id


def suspect_tags(recording: Recording, config: VesselConfig, solution: Solution) -> list[str]:
    """Return a line for each tag most of whose sightings disagree with the run, with a possible explanation."""
    rows = {row.seq: row for row in solution.ledger if row.seq >= 0}
    track = solution.trajectory
    sightings = [m for m in recording.of(TagSighting) if track.covers(np.array([m.stamp_ns]))[0]]
    said_of_mounts = list(_estimated_mounts(sightings, solution))
    if hanging := _upside_down(sightings, config):  # then nothing else that tags say can be judged
        return hanging
    cameras = {(m.sensor, m.camera) for m in sightings}
    found = {camera: mount_off(solution, *camera).as_matrix() for camera in cameras}
    sightings = [replace(m, R_body_camera=found[m.sensor, m.camera] @ m.R_body_camera) for m in sightings]
    behind = _seen_from_behind(sightings, recording, config, solution)
    if behind:  # then nothing else that tags say can be judged, mounts included
        return behind
    facing = _facing_elsewhere(sightings, rows, config, solution)
    if facing:  # likewise
        return facing
    turned = _turned_mounts(sightings, rows, solution)
    if turned:  # then nothing else that tags say can be judged
        return turned
    images = _by_image(sightings)
    said = _by_spacing(images) | _by_the_others(images)
    by_tag: dict[Key, list[TagSighting]] = defaultdict(list)
    for m in sightings:
        if len(m.numbers) == 1:
            by_tag[_key(m)].append(m)
    for key, own in sorted(by_tag.items()):
        doubted = [] if key in said else _doubted(own, rows)
        if not doubted:
            continue
        why = _explained(doubted, *track.poses_at(stamps_of(doubted)))
        said[key] = f"{len(doubted)} of {len(own)} sightings disagree with the rest; {why}"
    surveys = {name: sensor.surveyed for name, sensor in config.of_kind("apriltag").items()}
    return [
        *said_of_mounts,
        *_late(sightings, solution),
        *(f"{sensor}: {surveys[sensor].called(*tag)}: {line}" for (sensor, tag), line in said.items()),
    ]


def _upside_down(sightings: list[TagSighting], config: VesselConfig) -> list[str]:
    """Return a line for each sensor with tags that look upside down: up is below by them, and a vessel hardly heels.

    Those printed from OpenCV hang so. The track tells nothing of that: it may follow the tags. Where several of an image agree, it is
    the camera that is upside down: tags that hang so have each other on the wrong side, and no pose explains them.
    """
    level: dict[Key, list[float]] = defaultdict(list)
    together: dict[tuple[str, str], list[float]] = defaultdict(list)
    for m in sightings:
        if len(m.tags) > 1 and _misfit(m) < _FITS:
            together[m.sensor, m.camera].append(_upright_by_tags(m))
    turned = {camera for camera, own in together.items() if len(own) >= _FEWEST and np.median(own) < -_UPSIDE_DOWN}
    for m in sightings:
        if (m.sensor, m.camera) not in turned:
            for tag in m.tags:
                level[m.sensor, tag].append(_upright_by_tags(m))
    hanging = [key for key, own in level.items() if len(own) >= _FEWEST and np.median(own) < -_UPSIDE_DOWN]
    return [
        f"{sensor}: {', '.join(tags)}: upside down, unless the camera is: tags printed from OpenCV hang so, and what would be "
        "facing_deg: F is then rpy_deg: [-90, 0, -F]; of a camera, mount.rpy_deg"
        for sensor, tags in _called(hanging, config).items()
    ]


def _called(found: Iterable[Key], config: VesselConfig) -> dict[str, list[str]]:
    """Return what the survey of each sensor calls its tags among these."""
    called: dict[str, list[str]] = defaultdict(list)
    for sensor, tag in sorted(found):
        called[sensor].append(config.of_kind("apriltag")[sensor].surveyed.called(*tag))
    return called


def _upright_by_tags(m: TagSighting) -> float:
    """Return the cosine of the angle between up by a camera's mount, on a level vessel, and up by its tags."""
    return float(m.R_body_camera[2] @ m.modes[0].R_world_camera[2])


def _misfit(m: TagSighting) -> float:
    """Return by how much of the first tag's side corners are off where the likeliest pose has them, RMS."""
    mode = m.modes[0]
    seen = (m.points_m - mode.p_world_camera_m) @ mode.R_world_camera
    off = np.linalg.norm(seen[:, :2] / seen[:, 2:] - m.rays, axis=1)
    return rms(off) / float(np.linalg.norm(m.rays[1] - m.rays[0]))


def _seen_from_behind(
    sightings: list[TagSighting], recording: Recording, config: VesselConfig, solution: Solution
) -> list[str]:
    """Return a line for each sensor with tags that face away from where the fixes have the vessel when she sees them.

    The track tells nothing of that: it may follow the tags, to the other side of the quay.
    """
    fixes = sorted(recording.of(GnssPosition), key=lambda m: m.stamp_ns)
    if len(fixes) < _FEWEST:
        return []
    stamps, places = stamps_of(fixes), world_from_fixes(fixes, solution.datum)[:, :2]
    seen: dict[Key, list[tuple[float, float, bool]]] = defaultdict(list)
    for m in sightings:
        nearest = int(np.argmin(np.abs(stamps - m.stamp_ns)))
        for tag, corners in zip(m.tags, m.points_m.reshape(-1, 4, 3), strict=True):
            away = places[nearest] - corners.mean(axis=0)[:2]
            out = np.cross(corners[1] - corners[0], corners[0] - corners[3])[:2]  # right x up
            before_m = float(away @ out) / max(float(np.linalg.norm(out)), 1e-9)
            away_m, looks_m = float(np.linalg.norm(away)), float(np.linalg.norm(_in_camera(m)))
            as_far = abs(away_m - looks_m) < float(np.linalg.norm(m.t_body_camera_m)) + _PLACE_M
            seen[m.sensor, tag].append((away_m, looks_m, as_far and before_m < -_BEHIND_M))
    behind = [key for key, own in seen.items() if len(own) >= _FEWEST and _faces_away(np.array(own))]
    return [
        f"{sensor}: {', '.join(tags)}: by the fixes they are seen from behind, where no print is: facing_deg (or rpy_deg) is the "
        "other way round"
        for sensor, tags in _called(behind, config).items()
    ]


def _faces_away(seen: Array) -> bool:
    """Return whether a tag faces away from where it is seen: the farther off it looks, the farther is the vessel, behind its plane.

    Behind a tag whose place is wrong, or by fixes that are, she comes nearer to it as it looks farther off.

    Args:
        seen: (N, 3) how far she is from it, and how far it looks, m; whether she is clearly behind its plane, and about as far.
    """
    behind = seen[:, 2] > 0.0
    if behind.mean() < _BEHIND:
        return False
    away_m, looks_m, _ = seen[behind].T
    return float(np.std(away_m - looks_m)) < _ALONG * float(np.std(away_m + looks_m))


def _facing_elsewhere(
    sightings: list[TagSighting], rows: Mapping[int, LedgerRow], config: VesselConfig, solution: Solution
) -> list[str]:
    """Return a line for each refused tag that stands where the survey says and faces another way, as by an angle of another convention.

    A camera's mount that is turned shows the tag elsewhere, too: what puts it nearer to its place is taken for the cause.
    """
    if not (doubted := _doubted(sightings, rows)):
        return []
    turned = _faces_turned(doubted, solution, _FACES_DEG)
    return [_faces_elsewhere(key, by_deg, config) for key, by_deg in turned.items()]


def _faces_turned(sightings: list[TagSighting], solution: Solution, least_deg: float) -> dict[Key, float]:
    """Return by how much tags are turned about up, deg, at least, where that puts them nearer to their places than a mount would."""
    seen: dict[Key, list[tuple[float, float, float]]] = defaultdict(list)
    for m, p, R in zip(sightings, *solution.trajectory.poses_at(stamps_of(sightings)), strict=True):
        for k, tag in enumerate(m.tags):
            if (turned := _turned_about_up(m, k, p, R)) is not None:
                seen[m.sensor, tag].append(turned)
    found_deg = {}
    for key, found in sorted(seen.items()):
        turn_deg, by_facing_m, by_mount_m = np.array(found).T
        usual, scatter_deg = _usual(Rotation.from_euler("z", turn_deg[:, None], degrees=True))
        usual_deg = float(usual.as_rotvec(degrees=True)[2])
        nearer = np.median(by_facing_m) < _ALONG * np.median(by_mount_m)
        if len(found) >= _FEWEST and nearer and abs(usual_deg) > max(least_deg, scatter_deg / _STEADY):
            found_deg[key] = usual_deg
    return found_deg


def _turned_about_up(m: TagSighting, k: int, p: Array, R: Array) -> tuple[float, float, float] | None:
    """Return how the k-th tag of a sighting is turned from how the survey has it, by the run's pose of body p (3,), R (3, 3): about up, deg.

    And how far from its place it looks, m, if its facing is the cause, and if the camera's mount is. By itself, as no pose explains
    several; None where none explains it.
    """
    camera, looks = p + R @ m.t_body_camera_m, R @ m.R_body_camera
    corners, own = slice(4 * k, 4 * k + 4), slice(8 * k, 8 * k + 8)
    poses = poses_of(m.points_m[corners], m.rays[corners], m.cov[own, own])
    if not poses:
        return None
    turns = [Rotation.from_matrix(looks @ pose.R).as_rotvec(degrees=True) for pose in poses]
    upright = int(np.argmin([np.hypot(*turn[:2]) for turn in turns]))  # a tag that stands upright stays so
    pose, middle = poses[upright], m.points_m[corners].mean(axis=0)
    by_facing = camera + looks @ (pose.R @ middle + pose.t_m) - middle
    by_mount = camera + pose.R.T @ pose.t_m
    return float(turns[upright][2]), float(np.linalg.norm(by_facing)), float(np.linalg.norm(by_mount))


def _usual(turns: Rotation) -> tuple[Rotation, float]:
    """Return the mean of rotations (N), and how far from it they are, deg, median."""
    usual = turns.mean()
    return usual, float(np.degrees(np.median((usual.inv() * turns).magnitude())))


def _faces_elsewhere(key: Key, turn_deg: float, config: VesselConfig) -> str:
    """Return the line on a tag whose face is seen turned (deg, counter-clockwise) from how the survey has it."""
    sensor, (family, number) = key
    survey = config.of_kind("apriltag")[sensor].surveyed
    (tag,) = (tag for tag in survey.tags if (tag.family, tag.id) == (family, number))
    would = ""
    if tag.facing_deg is not None:
        would = f": facing_deg {(tag.facing_deg - turn_deg) % 360.0:.0f} instead of {tag.facing_deg:.0f} would do"
    return (
        f"{sensor}: {survey.called(family, number)}: it stands where the survey says, and faces {abs(turn_deg):.0f} deg elsewhere{would} "
        "(from north, or the y axis of its dock, clockwise)"
    )


def _key(m: TagSighting) -> Key:
    """Return sensor and tag of a sighting of one tag."""
    return m.sensor, m.tags[0]


def _by_image(sightings: list[TagSighting]) -> list[list[TagSighting]]:
    """Group sightings by image and frame."""
    images: dict[tuple[str, str, str, int], list[TagSighting]] = defaultdict(list)
    for m in sightings:
        images[(m.sensor, m.camera, m.frame, m.stamp_ns)].append(m)
    return list(images.values())


def _doubted(sightings: list[TagSighting], rows: Mapping[int, LedgerRow]) -> list[TagSighting]:
    """Return those that the run hardly believes, by their rows of the ledger; none where these are few of all."""
    weights = [None if (row := rows.get(m.seq)) is None else row.weight for m in sightings]
    doubted = [m for m, weight in zip(sightings, weights, strict=True) if weight is not None and weight < 0.5]
    return doubted if len(doubted) >= max(_FEWEST, _DOUBTED * len(sightings)) else []


def _size_m(m: TagSighting) -> float:
    return float(np.linalg.norm(m.points_m[1] - m.points_m[0]))


def _in_camera(m: TagSighting) -> Array:
    """Return the tags' middle in camera, by the likeliest pose."""
    mode = m.modes[0]
    return np.asarray(mode.R_world_camera.T @ (m.points_m.mean(axis=0) - mode.p_world_camera_m))


def _by_spacing(images: list[list[TagSighting]]) -> dict[Key, str]:
    """Return a line for tags that all have a wrong size, because no two of an image fit together.

    Their spacing in units of their size is independent of the track, which may be wrong because of them.
    """
    ratios: dict[Key, list[float]] = defaultdict(list)
    size_m: dict[Key, float] = {}
    for own in images:
        for a, b in combinations((m for m in own if len(m.numbers) == 1), 2):
            apart = float(np.linalg.norm(a.points_m.mean(axis=0) - b.points_m.mean(axis=0)))
            ratio = apart / max(float(np.linalg.norm(_in_camera(a) - _in_camera(b))), 1e-6)
            for m in (a, b):
                ratios[_key(m)].append(ratio)
                size_m[_key(m)] = _size_m(m)
    said = {}
    for key, found in sorted(ratios.items()):
        median = float(np.median(found))
        scatter = float(np.median(np.abs(np.array(found) - median)))
        if len(found) >= _FEWEST and abs(median - 1.0) > _OFF and scatter < _ALIKE * median:
            said[key] = (
                f"beside the tags next to it, it looks {median:.2f} times as large as the survey says: "
                f"size_m {size_m[key] * median:.3f} instead of {size_m[key]:.3f} would do ({_MARGIN})"
            )
    return said


def _by_the_others(images: list[list[TagSighting]]) -> dict[Key, str]:
    """Return a line by tag for each that others in its images, which agree, show at another position.

    That is independent of the track: one that follows the wrong tag, with the vessel turned by 13 deg, shows no disagreement.
    """
    shown: dict[Key, list[Array]] = defaultdict(list)
    for own in images:
        most = max(own, key=lambda m: len(m.numbers))
        if len(most.numbers) < 2:
            continue
        camera = most.modes[0]
        for m in (m for m in own if len(m.numbers) == 1):
            place = camera.p_world_camera_m + camera.R_world_camera @ _in_camera(m)
            shown[_key(m)].append(place - m.points_m.mean(axis=0))
    said = {}
    for key, found in sorted(shown.items()):
        moved = np.median(found, axis=0)
        scatter = np.median(np.linalg.norm(np.array(found) - moved, axis=1))
        if len(found) >= _FEWEST and np.linalg.norm(moved) > max(_ELSEWHERE_M, 2.0 * float(scatter)):
            said[key] = (
                f"the tags beside it, which agree, show it {moved[0]:.1f} m east, {moved[1]:.1f} m north, {moved[2]:.1f} m "
                "above its place in the survey"
            )
    return said


def _explained(own: list[TagSighting], p: Array, R: Array) -> str:
    middle = np.array([m.points_m.mean(axis=0) for m in own])
    camera = np.array([a + B @ m.t_body_camera_m for m, a, B in zip(own, p, R, strict=True)])
    toward = np.array([B @ m.R_body_camera @ _in_camera(m) for m, B in zip(own, R, strict=True)])
    size_m = _size_m(own[0])
    scale, sure = _scale(camera, toward, middle)
    if abs(scale - 1.0) > _OFF:
        return (
            f"by its size it is {scale:.2f} times too near: size_m {size_m * scale:.3f} instead of {size_m:.3f} would do "
            f"({_MARGIN}){'' if sure else ', or it stands elsewhere'}"
        )
    moved = np.median(camera + toward - middle, axis=0)
    if float(np.linalg.norm(moved)) > _ELSEWHERE_M:
        return f"they show it {moved[0]:.1f} m east, {moved[1]:.1f} m north, {moved[2]:.1f} m above its place in the survey"
    return "look at its attitude in the survey, and at the camera's mount"


def _scale(camera: Array, toward: Array, middle: Array) -> tuple[float, bool]:
    """Return the ratio of a tag's size to the surveyed one, and whether it is certain.

    A tag at rest satisfies camera + scale toward = position, wherever it is: views from several distances determine the scale,
    even if the track has a constant error. Views from one distance only do so if the tag is at its surveyed position.
    """
    ranges = np.linalg.norm(toward, axis=1)
    if ranges.max() > _RANGES * ranges.min():
        a, b = camera - camera.mean(axis=0), toward - toward.mean(axis=0)
        scale = -float((a * b).sum() / (b * b).sum())
        left, before = float(((a + scale * b) ** 2).sum()), float(((a + b) ** 2).sum())
        return (scale, True) if scale > 0.0 and left < 0.1 * before else (1.0, True)
    ratio = np.linalg.norm(middle - camera, axis=1) / ranges
    median = float(np.median(ratio))
    return (median if float(np.median(np.abs(ratio - median))) < _ALIKE * median else 1.0), False


def _turned_mounts(sightings: list[TagSighting], rows: Mapping[int, LedgerRow], solution: Solution) -> list[str]:
    """Return a line for each camera whose sightings are rejected and agree on another attitude or position on the vessel."""
    lines = []
    track = solution.trajectory
    for sensor, camera in sorted({(m.sensor, m.camera) for m in sightings}):
        own = [m for m in sightings if (m.sensor, m.camera) == (sensor, camera)]
        if not (doubted := _doubted(own, rows)):
            continue
        p, R = track.poses_at(stamps_of(doubted))
        seen = Rotation.from_matrix([B.T @ m.modes[0].R_world_camera for m, B in zip(doubted, R, strict=True)])
        usual, scatter_deg = _usual(seen)
        off_deg = float(np.degrees((usual.inv() * Rotation.from_matrix(doubted[0].R_body_camera)).magnitude()))
        # With the attitude that they agree on: where all stand elsewhere, the heading without them may be off as well.
        as_seen = [replace(m, R_body_camera=usual.as_matrix()) for m in doubted]
        offs = np.array([_by_tags(m, B) for m, B in zip(as_seen, R, strict=True)]) - p
        moved = np.median(offs, axis=0)
        moved_m = float(np.linalg.norm(moved))
        elsewhere = moved_m > _TOGETHER_M and np.median(np.abs(offs - moved)) < 0.1 * moved_m
        # No heading that is off rolls or pitches a camera.
        off_rad = (usual * Rotation.from_matrix(doubted[0].R_body_camera).inv()).as_rotvec()
        rolled = np.degrees(np.hypot(*off_rad[:2])) > _TURNED_DEG
        if (rolled or not elsewhere) and off_deg > _TURNED_DEG and scatter_deg < _STEADY * off_deg:
            faces = _faces_turned(doubted, solution, _TURNED_DEG)
            every = len(faces) == len({(m.sensor, tag) for m in doubted for tag in m.tags})
            lines.append(_looks_elsewhere(sensor, camera, off_deg, usual) + (_or_faces(faces) if every else ""))
        elif elsewhere:
            lines.append(_all_elsewhere(sensor, camera, moved))
    return lines


def _all_elsewhere(sensor: str, camera: str, moved_m: Array) -> str:
    """Return a line on tags that all put the vessel elsewhere; straight up or down it is the heights of their survey."""
    upright = abs(float(moved_m[2])) > _UPRIGHT * float(np.hypot(*moved_m[:2]))
    why = (
        "are the survey's heights above the geoid, or the sea? Those of world are above the ellipsoid, from height_m of `datum`"
        if upright
        else "is `datum` the survey's origin?"
    )
    return (
        f"{sensor}: camera {camera}: its tags all put the vessel {moved_m[0]:.1f} m east, {moved_m[1]:.1f} m north, "
        f"{moved_m[2]:.1f} m above the place that the other sensors give: {why}"
    )


def mount_off(solution: Solution, sensor: str, camera: str) -> Rotation:
    """Return the estimated error of a camera's mount about the body's axes: `mount_off * mount` is the true one."""
    slow = solution.slow.get(sensor)
    off_deg = None if slow is None else slow.surest([f"{camera} mount {axis}" for axis in ("roll", "pitch", "yaw")])
    return Rotation.identity() if off_deg is None else Rotation.from_rotvec(off_deg, degrees=True)


def _estimated_mounts(sightings: list[TagSighting], solution: Solution) -> Iterator[str]:
    """Return a line for each camera whose estimated mount is far from the configured one."""
    given = {(m.sensor, m.camera): m.R_body_camera for m in sightings}
    for (sensor, camera), R_body_camera in sorted(given.items()):
        off = mount_off(solution, sensor, camera)
        off_deg = float(np.degrees(off.magnitude()))
        if off_deg > _TURNED_DEG:
            yield _looks_elsewhere(sensor, camera, off_deg, off * Rotation.from_matrix(R_body_camera))


def _looks_elsewhere(sensor: str, camera: str, off_deg: float, mount: Rotation) -> str:
    rpy = ", ".join(f"{a:.0f}" for a in mount.as_euler("xyz", degrees=True))
    return (
        f"{sensor}: camera {camera}: by its tags its viewing direction is {off_deg:.0f} deg off its mount: rpy_deg "
        f"[{rpy}] would do (of the optical frame: x right, y down, z forward)"
    )


def _or_faces(faces: Mapping[Key, float]) -> str:
    """Return the other explanation for a camera that looks elsewhere: all tags face another way (deg), less than none could be off by."""
    turn_deg = float(np.median(list(faces.values())))
    return (
        f"; or, which puts the tags nearer to their places, they all face {abs(turn_deg):.0f} deg further "
        f"{'counter-clockwise' if turn_deg > 0.0 else 'clockwise'} than the survey says (facing_deg, rpy_deg), or the heading is off by as much"
    )


def _by_tags(m: TagSighting, R_world_body: Array) -> Array:
    """Return the position (3,) of body by a sighting, with the attitude of the run."""
    toward = R_world_body @ m.R_body_camera @ _in_camera(m)
    return np.asarray(m.points_m.mean(axis=0) - toward - R_world_body @ m.t_body_camera_m)


def _late(sightings: list[TagSighting], solution: Solution) -> Iterator[str]:
    """Return a line for each camera whose stamps are late or early, by its roll about the optical axis.

    Stamps that are late by d come with the attitude of d ago: the camera's roll minus the run's is -d times its rate. Tags
    determine the roll best: to first order, and with either of two poses.
    """
    track = solution.trajectory
    by_camera: dict[tuple[str, str], list[TagSighting]] = defaultdict(list)
    for m in sightings:
        by_camera[(m.sensor, m.camera)].append(m)
    for (sensor, camera), own in sorted(by_camera.items()):
        stamps, where = np.unique([m.stamp_ns for m in own], return_inverse=True)
        if len(stamps) < _FEWEST:
            continue
        R = track.at(stamps).R_world_body[where]
        t, of_states = (stamps - stamps[0]) * 1e-9, (track.stamps_ns - stamps[0]) * 1e-9
        w = interpolated(t, of_states, solution.gyro_radps)[where]
        rate = np.array([m.R_body_camera[:, 2] @ turning for m, turning in zip(own, w, strict=True)])
        differs = [(B @ m.R_body_camera).T @ m.modes[0].R_world_camera for m, B in zip(own, R, strict=True)]
        roll = Rotation.from_matrix(np.array(differs)).as_rotvec()[:, 2]
        roll, rate = roll - np.median(roll), rate - np.median(rate)
        late_s = -float((rate * roll).sum() / max(float((rate * rate).sum()), 1e-12))
        left = float(((roll + rate * late_s) ** 2).sum())
        if abs(late_s) > _LATE_S and left < (1.0 - _LATE_EXPLAINS) * float((roll * roll).sum()):
            yield (
                f"{sensor}: camera {camera}: its stamps are {abs(late_s):.2f} s too {'late' if late_s > 0 else 'early'} by how the "
                f"vessel rolls: time_offset_s {-late_s:+.2f} would do, on top of what is set"
            )
