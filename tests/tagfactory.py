"""Tags seen by cameras, without images: true corners on true rays, with noise; and whole docking runs of these."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
from scipy.spatial.transform import Rotation

from graphloc.config import AprilTagConfig, CameraConfig
from graphloc.eval.simulate import SimulatedRun
from graphloc.eval.simulate._light import tag_in_world
from graphloc.eval.simulate.docks import survey as surveyed
from graphloc.eval.simulate.scene import Scene, scene_of
from graphloc.frames import Array
from graphloc.frontends.tags.bundles import Seeing, SeenTag, sightings_of
from graphloc.measurements import TagMode, TagSighting
from graphloc.survey import Survey

SIZE_M = 0.412  # Digerud's
SIGMA = 0.15 / 1000.0  # of a ray, rad: 0.15 px at a focal length of 1000 px
# Top-left, top-right, bottom-right, bottom-left of the print; x right, y up.
UNIT = np.array([(-0.5, 0.5, 0.0), (0.5, 0.5, 0.0), (0.5, -0.5, 0.0), (-0.5, -0.5, 0.0)])
FACES_SOUTH = np.array([(1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)])  # tag to world: x east, y up, z south
LOOKS_NORTH = np.array([(1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0)])  # camera to world: x east, y down, z north
AHEAD = np.array([(0.0, 0.0, 1.0), (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0)])  # camera to body: looks over the bow


def rays_of(points_m: Array, p_m: Array, R: Array) -> Array:
    """Rays (N, 2) from a camera at p_m, R (to world) to points (N, 3)."""
    there = (points_m - p_m) @ R
    return np.asarray(there[:, :2] / there[:, 2:])


def degrees_between(a: Array, b: Array) -> float:
    return float(np.degrees(Rotation.from_matrix(a @ b.T).magnitude()))


def nearest_mode(modes: tuple[TagMode, ...], R_world_camera: Array) -> int:
    return int(np.argmin([degrees_between(np.asarray(m.R_world_camera), R_world_camera) for m in modes]))


def random_view(
    rng: np.random.Generator, *, range_m: float | None = None, oblique_deg: float | None = None, aside: bool = True
) -> tuple[Array, Array, Array]:
    """Corners (4, 3) of a tag anywhere in world, and a camera p (3,), R (3, 3) that sees it: rolled, and off its axis."""
    far = rng.uniform(1.0, 30.0) if range_m is None else range_m
    oblique = np.radians(rng.uniform(0.0, 75.0) if oblique_deg is None else oblique_deg)
    sight = np.array([*(rng.uniform(-0.5, 0.5, 2) if aside else (0.0, 0.0)), 1.0])
    sight /= np.linalg.norm(sight)
    x = np.cross([0.0, -1.0, 0.0], -sight)
    x /= np.linalg.norm(x)
    frontal = np.column_stack([x, np.cross(-sight, x), -sight])
    toward = rng.uniform(0.0, 2.0 * np.pi)
    tilt = Rotation.from_rotvec(oblique * (np.cos(toward) * frontal[:, 0] + np.sin(toward) * frontal[:, 1])).as_matrix()
    R_camera_tag = tilt @ frontal @ Rotation.from_rotvec([0.0, 0.0, rng.uniform(-np.pi, np.pi)]).as_matrix()
    R_world_tag, p_tag = Rotation.random(random_state=rng).as_matrix(), rng.uniform(-50.0, 50.0, 3)
    R = R_world_tag @ R_camera_tag.T
    return p_tag + SIZE_M * UNIT @ R_world_tag.T, p_tag - R @ (far * sight), R


def in_world(mode: TagMode, R_world_camera: Array) -> Array:
    """Covariance (6, 6) of a mode: of the camera's place if its attitude is the one given, and of that; world's axes."""
    turn = np.zeros((6, 6))
    turn[:3, :3], turn[3:, 3:] = -R_world_camera, R_world_camera
    return np.asarray(turn @ mode.cov @ turn.T)


def mode_error(mode: TagMode, p_m: Array, R: Array, middle_m: Array) -> Array:
    """Error (6,) of a mode against a camera p_m, R: see the docstring of `factors/apriltag.py`."""
    in_camera = mode.R_world_camera.T @ (middle_m - mode.p_world_camera_m)
    turn = Rotation.from_matrix(R @ mode.R_world_camera.T).as_rotvec()
    return np.concatenate([p_m + R @ in_camera - middle_m, turn])


def survey_of(run: SimulatedRun) -> Survey:
    assert run.harbour is not None
    return Survey.model_validate(surveyed(run.harbour, np.random.default_rng([run.seed, 23])))


@lru_cache(maxsize=4)
def _scene(run: SimulatedRun) -> Scene:
    return scene_of(run)


def sighted(
    run: SimulatedRun,
    *,
    rate_hz: float = 5.0,
    noise_px: float = 0.15,
    farthest_m: float = 25.0,
    only: tuple[int, ...] = (),
    hidden_s: tuple[float, float] = (0.0, 0.0),
    seed: int = 0,
    alone: bool = False,
) -> tuple[SimulatedRun, list[tuple[TagSighting, int]]]:
    """Return a harbour run with the sightings of its camera, and of each sighting which mode is nearest to the truth.

    Args:
        run: in a harbour, with a camera. noise_px: of each corner. farthest_m: tags beyond are not seen.
        only: ids that are seen; empty: all. hidden_s: from, to: nothing is seen. alone: each tag for itself.
    """
    assert run.harbour is not None
    survey, scene, rng = survey_of(run), _scene(run), np.random.default_rng([run.seed, seed, 99])
    camera = run.rig.cameras["camera"]
    focal, centre = np.array(camera.focal_px), np.array(camera.centre_px)
    size = np.array([camera.width_px, camera.height_px])
    t_bc, R_bc = camera.mount.t_body_sensor_m, camera.mount.R_body_sensor
    listed = {tag.id: tag for tag in survey.tags if not only or tag.id in only}
    found: list[tuple[TagSighting, int]] = []
    for t in np.arange(0.3 / rate_hz, run.scenario.duration_s - 0.2, 1.0 / rate_hz):
        if hidden_s[0] <= t < hidden_s[1]:
            continue
        p, R, _ = (v[0] for v in run.motion.pose(np.array([t])))
        p_c, R_c = p + R @ t_bc, R @ R_bc
        seen = []
        for tag in (tag for tag in run.harbour.config.tags if tag.number in listed):
            at, turned = tag_in_world(tag, run.harbour, scene, float(t))
            corners = at + tag.size_m * UNIT @ turned.T
            behind = ((corners - p_c) @ R_c[:, 2]).min() < 0.5
            if behind or np.linalg.norm(at - p_c) > farthest_m or turned[:, 2] @ (p_c - at) < 0.3:
                continue
            px = rays_of(corners, p_c, R_c) * focal + centre
            if px.min() < 5 or (px > size - 5).any():
                continue
            rays = (px + rng.normal(0.0, noise_px, px.shape) - centre) / focal
            seen.append(SeenTag(listed[tag.number], rays, np.eye(8) * (noise_px / focal[0]) ** 2))
        stamp = int(run.truth.stamps_ns[0]) + round(t * 1e9)
        seeing = Seeing(stamp, "tags", "camera", t_bc, R_bc, px=1.0 / float(focal[0]))
        for group in [[s] for s in seen] if alone else [seen]:
            found += [(s, nearest_mode(s.modes, R_c)) for s in sightings_of(group, survey, seeing)[0]]
    first = run.recording.message_count
    numbered = [(replace(s, seq=first + k), right) for k, (s, right) in enumerate(found)]
    config = AprilTagConfig(
        survey=survey, cameras={"camera": CameraConfig(topic="/camera/image_raw", mount=camera.mount)}
    )
    every = sorted([*run.recording.measurements, *(s for s, _ in numbered)], key=lambda m: (m.stamp_ns, m.seq))
    recording = replace(run.recording, measurements=tuple(every), message_count=first + len(numbered))
    sensors = {name: sensor for name, sensor in run.config.sensors.items() if name != "matcher"} | {"tags": config}
    return replace(run, recording=recording, config=run.config.model_copy(update={"sensors": sensors})), numbered
