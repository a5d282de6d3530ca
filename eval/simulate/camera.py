# SPDX-License-Identifier: Apache-2.0
"""A camera in a harbour: takes grey images in any of Digerud's conditions."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np

from graphloc.eval.simulate._lens import Image, digitise, draw_drops, exposure, through_lens
from graphloc.eval.simulate._light import Light, Picture, Pose, View, project, tag_in_world
from graphloc.eval.simulate._run import SimulatedRun
from graphloc.eval.simulate.scene import Scene
from graphloc.eval.simulate.weather import WEATHER
from graphloc.frames import Array

_SUN_OFF_DEG = 10.0  # 1 sigma of the azimuth of the low sun about that of the tags


@dataclass(frozen=True, slots=True, eq=False)
class Shot:
    """An image, with truth that only a simulator has.

    Attributes:
        pixels: (rows, columns). exposure_ms, gain: of the image. blur_px: motion during the exposure.
    """

    pixels: Image
    exposure_ms: float
    gain: float
    blur_px: float


class Camera:
    """Takes images along a run. An image depends only on its time and number, not on earlier ones."""

    def __init__(self, name: str, scene: Scene, run: SimulatedRun) -> None:
        assert run.harbour is not None  # or there were no scene
        harbour, weather, seed = run.harbour, WEATHER[run.scenario.condition], run.seed
        config = run.rig.cameras[name]
        self._own_seed = [seed, 17, zlib.crc32(name.encode())]  # no two cameras share noise or drops
        rng = np.random.default_rng([*self._own_seed, 0])
        self.config, self._harbour, self._scene, self._motion = config, harbour, scene, run.motion
        self._light = Light(config, harbour, scene, weather)
        self._drops = draw_drops(rng, config, run.scenario.duration_s) if weather.drops else ()
        self._stray = weather.stray
        self._noise = rng.standard_normal((config.height_px + 256, config.width_px + 256), dtype=np.float32)
        self._sun: Array | None = None
        if weather.sun_elevation_deg is not None:
            facing = harbour.config.tags[0].facing_deg if harbour.config.tags else 180.0
            off_deg = np.random.default_rng([seed, 18]).normal(0.0, _SUN_OFF_DEG)  # one sun for all cameras
            azimuth = np.radians(facing + 180.0 + off_deg)
            up = np.radians(weather.sun_elevation_deg)
            self._sun = np.array([np.cos(up) * np.sin(azimuth), np.cos(up) * np.cos(azimuth), np.sin(up)])

    def pose(self, t_s: float) -> Pose:
        """Return the camera's true position (3,) m and rotation (3, 3) in world."""
        p, R, _ = (v[0] for v in self._motion.pose(np.array([t_s])))
        mount = self.config.mount
        return p + R @ mount.t_body_sensor_m, R @ mount.R_body_sensor

    def tag_poses(self, t_s: float) -> dict[int, Pose]:
        """Return the true pose of each tag in camera: position (3,) m and rotation (3, 3), by number."""
        p, R = self.pose(t_s)
        found = {}
        for tag in self._harbour.config.tags:
            at, turned = tag_in_world(tag, self._harbour, self._scene, t_s)
            found[tag.number] = (R.T @ (at - p), R.T @ turned)
        return found

    def radiance(self, t_s: float) -> Picture:
        """Return the radiance (rows, columns) at the lens, in units of `weather`."""
        return self._light.radiance(View(self.pose(t_s), t_s, self._sun))

    def take(self, t_s: float, number: int) -> Shot:
        """Take image `number` at t_s, the middle of its exposure."""
        picture = self.radiance(t_s)
        ms, gain = exposure(picture, self.config)
        moved = self._moved_px(t_s, ms * 1e-3)
        picture = through_lens(picture, self.config, self._stray, self._drops, t_s, moved)
        i, j = np.random.default_rng([*self._own_seed, 1, number]).integers(0, 256, 2)
        rows, columns = picture.shape
        pixels = digitise(picture, self.config, (ms, gain), self._noise[i : i + rows, j : j + columns])
        return Shot(pixels, ms, gain, float(np.hypot(*moved)))

    def _moved_px(self, t_s: float, exposed_s: float) -> Array:
        """Return the motion (2,), px, of the nearest tag in view, or of a point 20 m ahead, during an exposure."""
        seen = [p for p, _ in self.tag_poses(t_s).values() if self._light.sees(p)]
        target = min(seen, key=lambda p: float(p @ p)) if seen else np.array([0.0, 0.0, 20.0])
        p, R = self.pose(t_s)
        at = p + R @ target
        ends = []
        for t in (t_s - 0.5 * exposed_s, t_s + 0.5 * exposed_s):
            p, R = self.pose(t)
            ends.append(project(self.config, (R.T @ (at - p))[None])[0])
        return np.asarray(ends[1] - ends[0])
