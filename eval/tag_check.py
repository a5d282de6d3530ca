# SPDX-License-Identifier: Apache-2.0
"""Check the survey of tags, and the mounts and clocks of cameras, by a solved run.

It finds tags that stand elsewhere or face another way, wrong sizes, turned mounts, and late images.
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
_OFF, _ALIKE = 0.04, 0.05  # a ratio of distances means a wrong size if it is off by more, and scatters by less
_ELSEWHERE_M = 0.3
_RANGES = 1.3  # ratio of the farthest to the nearest view, from which a wrong size can be told from a wrong position
_MARGIN = "the black square without its white margin"
# Least delay that is reported; share of the variance of a camera's roll errors that it must explain.
_LATE_S, _LATE_EXPLAINS = 0.03, 0.3
# Least angle by which a mount is wrong; largest scatter of that angle, as a share of it.
_TURNED_DEG, _STEADY = 6.0, 0.5
_TOGETHER_M = 5.0  # least distance by which all tags of a camera stand elsewhere together
_UPSIDE_DOWN = 0.7  # cosine between down on the vessel and up by a tag, from which the tag hangs upside down
# Largest misfit of corners, as a share of a tag's side, if one pose explains several tags: usually 0.03, but 1.5 to 5
# if tags hang upside down.
_FITS = 0.5
# Least ratio of vertical to horizontal of an offset of heights: without its tags, a run is metres off sideways
_UPRIGHT = 3.0
# Least share of a tag's sightings in which the vessel is behind its plane; by how much, as fixes are off by less; and
# how much more than the camera's lever arm the distances by fixes and by the image may differ: else the tag's place is
# wrong, not its facing.
_BEHIND, _BEHIND_M, _PLACE_M = 0.5, 3.0, 5.0
_FACES_DEG = 30.0  # least angle by which a face is turned if the survey's angle follows another convention
# Two distances go together if their difference scatters by less than this share of the scatter of their sum; and one
# explanation is better than another if it leaves less than this share of the distance.
_ALONG = 0.5

Key = tuple[str, tuple[str, int]]  # of a tag: its sensor; its family and id


def suspect_tags(recording: Recording, config: VesselConfig, solution: Solution) -> list[str]:
    """Return a line for each tag most of whose sightings disagree with the run, with a possible explanation."""
    rows = {row.seq: row for row in solution.ledger if row.seq >= 0}
    track = solution.trajectory
    sightings = [m for m in recording.of(TagSighting) if track.covers(np.array([m.stamp_ns]))[0]]
    said_of_mounts = list(_estimated_mounts(sightings, solution))
    # Of what any of these finds: nothing else that tags say can be judged then, mounts included.
    if hanging := _upside_down(sightings, config):
        return hanging
    cameras = {(m.sensor, m.camera) for m in sightings}
    found = {camera: mount_off(solution, *camera).as_matrix() for camera in cameras}
    sightings = [replace(m, R_body_camera=found[m.sensor, m.camera] @ m.R_body_camera) for m in sightings]
    if amiss := (
        _seen_from_behind(sightings, recording, config, solution)
        or _facing_elsewhere(sightings, rows, config, solution)
        or _turned_mounts(sightings, rows, solution)
    ):
        return amiss
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
    """Return a line for each sensor with tags that look upside down, as a vessel hardly heels.

    Tags printed from OpenCV's pictures hang upside down. The track does not show that, as it may follow the tags. If
    one pose explains several tags of an image, the camera is upside down instead: tags that each hang upside down are
    on the wrong side of each other, and no single pose explains them.
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
    """Return, by sensor, the names that its survey gives to some tags."""
    called: dict[str, list[str]] = defaultdict(list)
    for sensor, tag in sorted(found):
        called[sensor].append(config.of_kind("apriltag")[sensor].surveyed.called(*tag))
    return called


def _upright_by_tags(m: TagSighting) -> float:
    """Return the cosine of the angle between up by a camera's mount, if the vessel is level, and up by its tags."""
    return float(m.R_body_camera[2] @ m.modes[0].R_world_camera[2])


def _misfit(m: TagSighting) -> float:
    """Return how far corners are from where the likeliest pose has them, RMS, as a share of the first tag's side."""
    mode = m.modes[0]
    seen = (m.points_m - mode.p_world_camera_m) @ mode.R_world_camera
    off = np.linalg.norm(seen[:, :2] / seen[:, 2:] - m.rays, axis=1)
    return rms(off) / float(np.linalg.norm(m.rays[1] - m.rays[0]))


def _seen_from_behind(
    sightings: list[TagSighting], recording: Recording, config: VesselConfig, solution: Solution
) -> list[str]:
    """Return a line for each sensor with tags that face away from where the fixes have the vessel.

    The track does not show that: it may follow the tags to the other side of the quay.
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
            out = np.cross(corners[1] - corners[0], corners[0] - corners[3])[:2]  # right x up: out of the printed face
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
    """Return whether a tag faces away from the vessel: she is behind its plane, and as far from it as it looks.

    If instead the tag's place or the fixes are wrong, she comes nearer to that place as the tag looks farther away.

    Args:
        seen: (N, 3) of each sighting: distance by the fixes, m; distance by the image, m; 1 if she is clearly behind
            the plane while the two distances about agree, else 0.
    """
    behind = seen[:, 2] > 0.0
    if behind.mean() < _BEHIND:
        return False
    away_m, looks_m, _ = seen[behind].T
    return float(np.std(away_m - looks_m)) < _ALONG * float(np.std(away_m + looks_m))


def _facing_elsewhere(
    sightings: list[TagSighting], rows: Mapping[int, LedgerRow], config: VesselConfig, solution: Solution
) -> list[str]:
    """Return a line for each disbelieved tag that stands where the survey says, but faces another way.

    The survey's angle may follow another convention. A turned camera mount shows a tag elsewhere, too; the cause is the
    one of the two that puts the tag nearer to its surveyed place.
    """
    if not (doubted := _doubted(sightings, rows)):
        return []
    turned = _faces_turned(doubted, solution, _FACES_DEG)
    return [_faces_elsewhere(key, by_deg, config) for key, by_deg in turned.items()]


def _faces_turned(sightings: list[TagSighting], solution: Solution, least_deg: float) -> dict[Key, float]:
    """Return by how much tags are turned about up, deg, by tag.

    Only tags that are turned by `least_deg` or more, and are nearer to their surveyed places so than with a turned
    mount.
    """
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
    """Return how the k-th tag of a sighting is turned from how the survey has it.

    Each tag is taken by itself, as no pose may explain several.

    Args:
        p, R: (3,), (3, 3) pose of body by the run.

    Returns:
        Turn about up, deg; distance (m) of the tag from its surveyed place if its facing is wrong; the same if the
        camera's mount is wrong. None: no pose explains the tag.
    """
    camera, looks = p + R @ m.t_body_camera_m, R @ m.R_body_camera
    corners, own = slice(4 * k, 4 * k + 4), slice(8 * k, 8 * k + 8)
    poses = poses_of(m.points_m[corners], m.rays[corners], m.cov[own, own])
    if not poses:
        return None
    turns = [Rotation.from_matrix(looks @ pose.R).as_rotvec(degrees=True) for pose in poses]
    upright = int(np.argmin([np.hypot(*turn[:2]) for turn in turns]))  # the pose by which the tag stays upright
    pose, middle = poses[upright], m.points_m[corners].mean(axis=0)
    by_facing = camera + looks @ (pose.R @ middle + pose.t_m) - middle
    by_mount = camera + pose.R.T @ pose.t_m
    return float(turns[upright][2]), float(np.linalg.norm(by_facing)), float(np.linalg.norm(by_mount))


def _usual(turns: Rotation) -> tuple[Rotation, float]:
    """Return the mean of N rotations, and the median of their angles to it, deg."""
    usual = turns.mean()
    return usual, float(np.degrees(np.median((usual.inv() * turns).magnitude())))


def _faces_elsewhere(key: Key, turn_deg: float, config: VesselConfig) -> str:
    """Return the line on a tag whose face is turned (deg, counter-clockwise) from how the survey has it."""
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
    """Return the sightings that the run hardly believes, by their ledger rows; none if they are few of all."""
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
    """Return a line, by tag, for tags that all have a wrong size, as their spacing in images does not fit the survey.

    The spacing in units of the tags' size is independent of the track, which may be wrong because of the tags.
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
    """Return a line, by tag, for each tag that the other tags in its images show at another position, while they agree.

    This is independent of the track: a track that follows the wrong tag, with the vessel turned by 13 deg, shows no
    disagreement.
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

    A tag at rest satisfies camera + scale toward = position, wherever it is. So views from several distances determine
    the scale, even if the track has a constant error. Views from a single distance do so only if the tag is at its
    surveyed position.
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
    """Return a line for each camera whose rejected sightings agree on another mount, or another place of the vessel."""
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
        # With the attitude that the sightings agree on: if all tags stand elsewhere, the run's heading may be off as
        # well.
        as_seen = [replace(m, R_body_camera=usual.as_matrix()) for m in doubted]
        offs = np.array([_by_tags(m, B) for m, B in zip(as_seen, R, strict=True)]) - p
        moved = np.median(offs, axis=0)
        moved_m = float(np.linalg.norm(moved))
        elsewhere = moved_m > _TOGETHER_M and np.median(np.abs(offs - moved)) < 0.1 * moved_m
        # A wrong heading neither rolls nor pitches a camera.
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
    """Return a line on tags that all put the vessel elsewhere; if up or down, it suspects the survey's heights."""
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
    """Return the estimated error of a camera's mount, in body axes: `mount_off * mount` is the true mount."""
    slow = solution.slow.get(sensor)
    off_deg = None if slow is None else slow.surest([f"{camera} mount {axis}" for axis in ("roll", "pitch", "yaw")])
    return Rotation.identity() if off_deg is None else Rotation.from_rotvec(off_deg, degrees=True)


def _estimated_mounts(sightings: list[TagSighting], solution: Solution) -> Iterator[str]:
    """Yield a line for each camera whose estimated mount is far from the configured one."""
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
    """Return the other explanation for a turned camera: all tags face another way; `faces`: by how much, deg."""
    turn_deg = float(np.median(list(faces.values())))
    return (
        f"; or, which puts the tags nearer to their places, they all face {abs(turn_deg):.0f} deg further "
        f"{'counter-clockwise' if turn_deg > 0.0 else 'clockwise'} than the survey says (facing_deg, rpy_deg), or the heading is off by as much"
    )


def _by_tags(m: TagSighting, R_world_body: Array) -> Array:
    """Return the position (3,) of body in world by a sighting, with the attitude of the run."""
    toward = R_world_body @ m.R_body_camera @ _in_camera(m)
    return np.asarray(m.points_m.mean(axis=0) - toward - R_world_body @ m.t_body_camera_m)


def _late(sightings: list[TagSighting], solution: Solution) -> Iterator[str]:
    """Yield a line for each camera whose stamps are late or early, by its roll about the optical axis.

    A stamp that is late by d comes with the attitude of d earlier: the roll by the image less that by the run is -d
    times the rate of roll. Tags determine the roll best: to first order, and equally well with either of two poses.
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
