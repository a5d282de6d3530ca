# SPDX-License-Identifier: Apache-2.0
"""Light that reaches a camera: sky, water, walls and boats at a third of its resolution, tags at full resolution.

Radiance is linear, in units of `weather`. Away from tags it only has to look as cluttered as a harbour. Edges of tags
have to be right to a hundredth of a pixel, so their pixels are the mean of many rays.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from graphloc.errors import ConfigError
from graphloc.eval.simulate.docks import tag_pose
from graphloc.eval.simulate.harbour import Harbour, Tag
from graphloc.eval.simulate.rig import RigCamera
from graphloc.eval.simulate.scene import Rays, Scene
from graphloc.eval.simulate.weather import Weather
from graphloc.frames import Array

Picture = NDArray[np.float32]
Pose = tuple[Array, Array]  # position (3,) m and rotation (3, 3) in world

PLATE = 0.5 / 0.412  # the white plate's width over the tag's (D 3.2.2)
_WHITE, _BLACK = 0.85, 0.05  # of a printed tag
_ALBEDO = {
    "concrete": 0.45, "asphalt": 0.2, "wood": 0.35, "grass": 0.25, "roof": 0.3, "stone": 0.4, "building": 0.5,
    "steel": 0.4, "hull": 0.75, "cabin": 0.5,
}  # fmt: skip
_WALL = 0.6  # share of the sky's light that a wall gets
_SKY, _SUN = 1.2, 3000.0
# Distance from its pixel at which a ray comes back through the lens model, from which that is invalid
_ASTRAY_PX = 0.05
_NEAREST_M = 0.1
_PROUD_M = 0.05  # a tag may lie this far behind the face of its wall
_STEP = 3  # pixels between rays of the background
_GRAIN = 512  # pixels of the tile that surfaces take their grain from


def rays(camera: RigCamera, u_px: Array, v_px: Array) -> Rays:
    """Return directions (N, 3), with z = 1, in camera, of image points (N,), distortion undone."""
    points = np.column_stack([u_px, v_px])[:, None].astype(np.float64)
    if any(camera.distortion):
        # OpenCV's default stops after five steps, a third of a pixel off near the corners.
        until = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-7)
        undo = cv2.fisheye.undistortPoints if camera.model == "equidistant" else cv2.undistortPoints
        flat = undo(points, camera.K, np.array(camera.distortion), criteria=until)[:, 0]
    else:
        flat = (points[:, 0] - camera.K[:2, 2]) / camera.K[[0, 1], [0, 1]]
    return np.column_stack([flat, np.ones(len(flat))]).astype(np.float32)


def project(camera: RigCamera, points_m: Array) -> Array:
    """Return image points (N, 2), px, of points (N, 3) in camera that are in front of it."""
    turn_none = np.zeros(3)
    if camera.model == "equidistant":
        flat, _ = cv2.fisheye.projectPoints(
            points_m[:, None], turn_none, turn_none, camera.K, np.array(camera.distortion)
        )
    else:
        flat, _ = cv2.projectPoints(points_m[:, None], turn_none, turn_none, camera.K, np.array(camera.distortion))
    return np.asarray(flat, dtype=float).reshape(-1, 2)


@lru_cache(maxsize=1024)
def cells(number: int) -> NDArray[np.uint8]:
    """Return the cells (8, 8) of a tag, first row on top, as AprilTag's own images have them; 1 is white.

    OpenCV draws them upside down.
    """
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    return np.asarray(np.rot90(cv2.aruco.generateImageMarker(family, number, 8), 2) > 127, dtype=np.uint8)


@lru_cache(maxsize=1)
def _grain() -> Picture:
    """Return a tile (512, 512) of grain of several sizes, mean 0, that can be repeated seamlessly."""
    rng = np.random.default_rng(3)
    spectrum = np.fft.fft2(rng.normal(size=(_GRAIN, _GRAIN)))
    f = np.hypot(*np.meshgrid(np.fft.fftfreq(_GRAIN), np.fft.fftfreq(_GRAIN)))
    f[0, 0] = np.inf
    tile = np.fft.ifft2(spectrum / np.maximum(f, 0.01)).real
    return np.asarray(tile / tile.std(), dtype=np.float32)


def _grain_at(x_m: Rays, y_m: Rays, cell_m: float) -> Rays:
    i, j = (np.floor(v / cell_m).astype(np.int32) & (_GRAIN - 1) for v in (y_m, x_m))
    return np.asarray(_grain()[i, j])


class View(NamedTuple):
    """A view: the camera's pose in world, the time in s, and the direction (3,) to the sun, or None."""

    pose: Pose
    t_s: float
    sun: Array | None


def tag_in_world(tag: Tag, harbour: Harbour, scene: Scene, t_s: float) -> Pose:
    """Return the true pose of a tag."""
    p, R = tag_pose(tag, harbour)
    for dock in scene.docks:
        if dock.dock.name == tag.dock:
            at, turned = (v[0] for v in dock.pose(np.array([t_s])))
            return np.asarray(at + turned @ p), np.asarray(turned @ R)
    return p, R


class Light:
    """Renders a harbour for one camera."""

    def __init__(self, camera: RigCamera, harbour: Harbour, scene: Scene, weather: Weather) -> None:
        self._camera, self._harbour, self._scene, self._weather = camera, harbour, scene, weather
        self.size = (camera.height_px, camera.width_px)
        self._coarse = (-(-camera.height_px // _STEP), -(-camera.width_px // _STEP))
        v, u = np.meshgrid(*(_STEP * np.arange(n) + 0.5 * (_STEP - 1) for n in self._coarse), indexing="ij")
        self._rays = rays(camera, u.ravel(), v.ravel())
        there = project(camera, self._rays.astype(float))
        astray = float(np.abs(there - np.column_stack([u.ravel(), v.ravel()])).max())
        if not astray < _ASTRAY_PX:
            raise ConfigError(
                f"a camera's distortion {camera.distortion} ({camera.model}) folds the image: no ray leads to some of its "
                "pixels; calibrate it over the whole image, or give a smaller one"
            )
        self._length = np.linalg.norm(self._rays, axis=1)
        self._low, self._high = self._rays[:, :2].min(axis=0), self._rays[:, :2].max(axis=0)
        in_body = self._rays @ camera.mount.R_body_sensor.T.astype(np.float32)
        own = scene.own_range_m(camera.mount.t_body_sensor_m.astype(np.float32), in_body)
        self._own = np.isfinite(own)
        self._albedo = np.array([_ALBEDO[s] for s in scene.surfaces] or [0.0], dtype=np.float32)
        self._windows = np.array([s == "building" for s in scene.surfaces] or [False])

    def radiance(self, view: View) -> Picture:
        """Return the radiance (rows, columns) that reaches the lens."""
        coarse = self._background(view).reshape(self._coarse)
        fine = cv2.resize(coarse, None, fx=_STEP, fy=_STEP, interpolation=cv2.INTER_LINEAR)
        picture = np.array(fine[: self.size[0], : self.size[1]], dtype=np.float32)
        p, _ = view.pose
        placed = [(tag, tag_in_world(tag, self._harbour, self._scene, view.t_s)) for tag in self._harbour.config.tags]
        for tag, pose in sorted(placed, key=lambda item: -float(np.linalg.norm(item[1][0] - p))):  # the nearest last
            self._tag(picture, tag, pose, view)
        return picture

    def sees(self, p_m: Array) -> bool:
        """Return whether a point (3,) in camera is in its view: the lens model is invalid outside."""
        if p_m[2] < _NEAREST_M:
            return False
        flat = p_m[:2] / p_m[2]
        return bool(((flat > self._low) & (flat < self._high)).all())

    def _through_air(self, radiance: Rays, away_m: Rays) -> Rays:
        if self._weather.fog_per_m == 0.0:
            return radiance
        kept = np.exp(-self._weather.fog_per_m * away_m)
        return np.asarray(radiance * kept + 0.75 * self._weather.daylight * (1.0 - kept), dtype=np.float32)

    def _background(self, view: View) -> Rays:
        p, R = view.pose
        ahead = self._rays @ R.T.astype(np.float32)
        hit = self._scene.cast(p.astype(np.float32), ahead, view.t_s)
        slope = ahead[:, 2] / self._length
        to_water = self._scene.water_range(p[2], ahead[:, 2])
        solid = np.isfinite(hit.range_m) & (hit.range_m < to_water)
        water = ~solid & np.isfinite(to_water)
        sky = ~solid & ~water
        out = np.empty(len(ahead), dtype=np.float32)
        out[sky] = self._sky(ahead[sky], self._length[sky], view.sun)
        away = (to_water[water] * self._length[water]).astype(np.float32)
        at = p.astype(np.float32) + ahead[water] * to_water[water, None].astype(np.float32)
        out[water] = self._through_air(self._water(at, -slope[water], ahead[water], away, view), away)
        (k,) = np.nonzero(solid)
        away = hit.range_m[k] * self._length[k]
        at = p.astype(np.float32) + ahead[k] * hit.range_m[k, None]
        out[k] = self._through_air(self._solid(at, hit.surface[k], hit.normal[k], away, view.sun), away)
        out[self._own] = 0.4 * self._weather.daylight
        return out

    def _sky(self, ahead: Rays, length: Rays, sun: Array | None) -> Rays:
        weather = self._weather
        if weather.fog_per_m > 0.0:
            return np.full(len(ahead), 0.75 * weather.daylight, dtype=np.float32)
        up = ahead[:, 2] / length
        clouds = _grain_at(ahead[:, 0] / length + 2.0, ahead[:, 1] / length + 3.0 * up, 0.01)
        found = weather.daylight * _SKY * (1.0 + 0.06 * clouds) * (1.0 - 0.3 * up)
        if sun is not None:
            off = np.arccos(np.clip(ahead @ sun.astype(np.float32) / length, -1.0, 1.0))
            found = found + 2.0 * np.exp(-((off / 0.15) ** 2)) + np.where(off < 0.006, _SUN, 0.0)
        return np.asarray(found, dtype=np.float32)

    def _water(self, at: Rays, steep: Rays, ahead: Rays, away: Rays, view: View) -> Rays:
        t = view.t_s
        ripples = _grain_at(at[:, 0] + 0.4 * t, at[:, 1] + 0.2 * t, 0.06) + _grain_at(
            at[:, 0] - 0.2 * t, at[:, 1] + 0.5 * t, 0.017
        )
        ripples *= 1.0 / (1.0 + away / 15.0)
        mirrored = 0.02 + 0.98 * (1.0 - np.minimum(steep + 0.12, 1.0)) ** 5
        found = self._weather.daylight * (0.05 + _SKY * mirrored * (0.8 + 0.25 * ripples))
        if view.sun is not None:  # glitter: facets that happen to throw the sun into the camera
            back = (ahead * np.array([1.0, 1.0, -1.0], dtype=np.float32)) @ view.sun.astype(np.float32)
            off = np.arccos(np.clip(back / np.linalg.norm(ahead, axis=1), -1.0, 1.0))
            found = found + 40.0 * np.exp(-((off / 0.18) ** 2)) * np.maximum(ripples, 0.0) ** 3
        return np.asarray(np.maximum(found, 0.0), dtype=np.float32)

    def _solid(self, at: Rays, surface: NDArray[np.int32], normal: Rays, away: Rays, sun: Array | None) -> Rays:
        flat = np.abs(normal[:, 2]) > 0.5
        along = np.where(flat, at[:, 0], at[:, 0] * normal[:, 1] - at[:, 1] * normal[:, 0])
        up = np.where(flat, at[:, 1], at[:, 2])
        fade = 1.0 / (1.0 + away / 20.0)
        grain = 1.0 + 0.14 * _grain_at(along, up, 0.15) + 0.16 * fade * _grain_at(along, up, 0.02)
        albedo = self._albedo[surface] * np.clip(grain, 0.2, 2.0)
        pane = self._windows[surface] & ~flat & (np.mod(along, 3.0) < 1.4) & (np.mod(up, 3.0) > 1.0)
        albedo = np.where(pane & (np.mod(up, 3.0) < 2.4), 0.08, albedo)
        wet = ~flat & (at[:, 2] < self._scene.tide_m + 0.25)
        albedo = np.where(wet, 0.4 * albedo, albedo)
        light = self._weather.daylight * np.where(flat, 1.0, self._on_walls(sun))
        return np.asarray(albedo * light + self._lamps(at), dtype=np.float32)

    def _on_walls(self, sun: Array | None) -> float:
        return _WALL if sun is None else 0.5 * _WALL  # with the sun behind it, a wall lies in its own shade

    def _lamps(self, at: Rays) -> Rays | float:
        """Return the light of the harbour's lamps at a point: one every 30 m, 6 m high."""
        if not self._weather.lamps:
            return 0.0
        off2 = (np.mod(at[:, 0], 30.0) - 15.0) ** 2 + (np.mod(at[:, 1], 30.0) - 15.0) ** 2 + (at[:, 2] - 6.0) ** 2
        return np.asarray(0.05 / (1.0 + off2), dtype=np.float32)

    def _tag(self, picture: Picture, tag: Tag, pose: Pose, view: View) -> None:
        (p, R), (at, turned) = view.pose, pose
        t_camera_tag, R_camera_tag = R.T @ (at - p), R.T @ turned
        half = 0.5 * PLATE * tag.size_m
        rim = np.concatenate([np.linspace(-half, half, 9), np.full(9, half)])  # edges bend in a lens
        square = np.column_stack([np.concatenate([rim, -rim]), np.concatenate([rim[::-1], -rim[::-1]])])
        corners = t_camera_tag + square @ R_camera_tag[:, :2].T
        if corners[:, 2].min() < _NEAREST_M or R_camera_tag[:, 2] @ t_camera_tag >= 0.0:
            return  # behind the camera, or seen from behind
        flat = corners[:, :2] / corners[:, 2:]
        if (flat.max(axis=0) < self._low).any() or (flat.min(axis=0) > self._high).any():
            return  # outside its view
        within = np.column_stack([np.clip(flat, self._low, self._high), np.ones(len(flat))])
        seen = project(self._camera, within)
        low = np.maximum(np.floor(seen.min(axis=0)).astype(int) - 1, 0)
        high = np.minimum(np.ceil(seen.max(axis=0)).astype(int) + 2, self.size[::-1])
        if (high <= low).any() or (low + 1 >= self.size[::-1]).any():
            return
        width, rows = high - low
        fine = int(np.clip(600 // max(width, rows), 1, 8))  # rays a pixel, each way
        inner = (np.arange(fine) + 0.5) / fine - 0.5
        v, u = np.meshgrid(
            (low[1] + np.arange(rows)[:, None] + inner).ravel(), (low[0] + np.arange(width)[:, None] + inner).ravel(),
            indexing="ij",
        )  # fmt: skip
        ahead = rays(self._camera, u.ravel(), v.ravel()).astype(float) @ R_camera_tag
        across = t_camera_tag @ R_camera_tag
        on_plate = ahead[:, :2] * (across[2] / ahead[:, 2])[:, None] - across[:2]
        covered, albedo = _print(tag, on_plate)
        glow = self._weather.tag_glow * (albedo > 0.5)
        light = albedo * (self._weather.daylight * self._on_walls(view.sun) + self._lamps(at[None].astype(np.float32)))
        distance = float(np.linalg.norm(t_camera_tag))
        shown = self._through_air((light + glow).astype(np.float32), np.full(len(light), distance, dtype=np.float32))

        def mean(values: Array) -> Array:
            return np.asarray(values.reshape(rows, fine, width, fine).mean(axis=(1, 3)))

        free = self._free(view, low, rows, width, (t_camera_tag, R_camera_tag))
        patch = picture[low[1] : high[1], low[0] : high[0]]
        patch[:] = patch * (1.0 - free * mean(covered.astype(float))) + free * mean(np.where(covered, shown, 0.0))

    def _free(self, view: View, low: NDArray[np.int64], rows: int, width: int, T_camera_tag: Pose) -> Array:
        """Return 1 where the line of sight from the camera to a tag's plane is free, else 0, (rows, width)."""
        (p, R), (at, turned) = view.pose, T_camera_tag
        v, u = np.meshgrid(low[1] + np.arange(rows), low[0] + np.arange(width), indexing="ij")
        ahead = rays(self._camera, u.ravel().astype(float), v.ravel().astype(float))
        in_world = ahead @ R.T.astype(np.float32)
        hit = self._scene.cast(p.astype(np.float32), in_world, view.t_s).range_m
        mount = self._camera.mount
        in_body = ahead @ mount.R_body_sensor.T.astype(np.float32)
        own = self._scene.own_range_m(mount.t_body_sensor_m.astype(np.float32), in_body)
        water = self._scene.water_range(p[2], in_world[:, 2])
        reach = (at @ turned[:, 2]) / (ahead @ turned[:, 2])
        length = np.linalg.norm(ahead, axis=1)
        nearest = np.minimum(np.minimum(hit, own), water)
        return np.asarray(((nearest - reach) * length > -_PROUD_M).reshape(rows, width), dtype=np.float64)


def _print(tag: Tag, at_m: Array) -> tuple[NDArray[np.bool_], Array]:
    """Return whether points (N, 2) of a tag's plane lie on its plate, and the albedo at them (N,)."""
    half, cell = 0.5 * PLATE * tag.size_m, tag.size_m / 8.0
    covered = (np.abs(at_m[:, 0]) < half) & (np.abs(at_m[:, 1]) < half)
    printed = np.pad(cells(tag.number), 1, constant_values=1)  # a tag within the white of its plate
    column, row = (np.clip(v / cell + 5.0, 0.0, 9.0).astype(np.intp) for v in (at_m[:, 0], -at_m[:, 1]))
    return covered, np.where(printed[row, column] > 0, _WHITE, _BLACK)
