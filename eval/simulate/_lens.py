# SPDX-License-Identifier: Apache-2.0
"""Effects of lens and sensor: blur, glare, drops, motion, exposure, noise, quantisation to eight bits."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from graphloc.eval.simulate._light import Picture
from graphloc.eval.simulate.rig import RigCamera
from graphloc.frames import Array

Image = NDArray[np.uint8]
_MIDDLE_GREY = 0.2  # mean of an image that the exposure aims at, as a share of white
_GAMMA = 2.2
_LEVELS = 4096
_HALOES = ((6.0, 0.02), (40.0, 0.015), (250.0, 0.01))  # stray light: width in px, share
_LEAST_MOTION_PX = 0.3  # less motion cannot be seen


@dataclass(frozen=True, slots=True)
class Drop:
    """A drop of water on the lens.

    Attributes:
        at, radius: middle and radius, px. from_s, until_s: when it is there. slides: speed down the image, px/s.
    """

    at: tuple[float, float]
    radius: float
    from_s: float
    until_s: float
    slides: float


def draw_drops(rng: np.random.Generator, camera: RigCamera, duration_s: float) -> tuple[Drop, ...]:
    """Draw drops that come and go: three to five on the lens at any time, as wide as a tag nearby."""
    found = []
    for _ in range(max(1, int(duration_s / 2.5))):
        begin = float(rng.uniform(-12.0, duration_s))
        x, y = rng.uniform(0.05, 0.95) * camera.width_px, rng.uniform(0.2, 0.8) * camera.height_px
        radius = float(rng.uniform(0.03, 0.09) * camera.width_px)
        found.append(
            Drop(
                (float(x), float(y)),
                radius,
                begin,
                begin + float(rng.uniform(5.0, 18.0)),
                float(rng.uniform(0.0, 12.0)),
            )
        )
    return tuple(found)


def exposure(picture: Picture, camera: RigCamera) -> tuple[float, float]:
    """Return exposure (ms) and gain that make the mean grey, as far as their limits allow."""
    light = picture[::8, ::8]
    scale = _MIDDLE_GREY / max(float(light.mean()), 1e-9)
    for _ in range(8):  # iterated, as clipped pixels count as white only
        scale *= _MIDDLE_GREY / max(float(np.minimum(light * scale, 1.0).mean()), 1e-9)
    at_gain_1 = scale * camera.full_well / camera.electrons_per_ms
    return min(at_gain_1, camera.longest_ms), float(np.clip(at_gain_1 / camera.longest_ms, 1.0, camera.highest_gain))


def through_lens(
    picture: Picture, camera: RigCamera, stray_times: float, drops: tuple[Drop, ...], t_s: float, motion_px: Array
) -> Picture:
    """Return the light on the sensor: with stray light, drops, blur, and motion (2,) px during the exposure."""
    rows, columns = picture.shape
    kept = 1.0 - stray_times * sum(share for _, share in _HALOES)
    stray: Picture = np.zeros((rows // 4, columns // 4), dtype=np.float32)
    quarter = cv2.resize(picture, stray.shape[::-1], interpolation=cv2.INTER_AREA)
    for width, share in _HALOES:
        step = max(1, int(width / 16.0))
        small = cv2.resize(quarter, None, fx=1.0 / step, fy=1.0 / step, interpolation=cv2.INTER_AREA)
        wide = cv2.GaussianBlur(small, (0, 0), width / 4.0 / step, borderType=cv2.BORDER_REFLECT)
        stray += stray_times * share * cv2.resize(wide, stray.shape[::-1], interpolation=cv2.INTER_LINEAR)
    found = cv2.GaussianBlur(picture, (0, 0), camera.blur_px) if camera.blur_px > 0.0 else picture
    if np.hypot(*motion_px) > _LEAST_MOTION_PX:
        found = cv2.filter2D(found, -1, _streak(motion_px))
    veil = cv2.resize(stray, (columns, rows), interpolation=cv2.INTER_LINEAR)
    light: Picture = np.asarray(cv2.addWeighted(found, kept, veil, 1.0, 0.0), dtype=np.float32)
    for drop in drops:
        if drop.from_s <= t_s < drop.until_s:
            _wet(light, drop, t_s)
    return light


def _streak(motion_px: Array) -> Array:
    """Return the kernel of a straight motion, with sum 1."""
    reach = int(np.ceil(np.abs(motion_px).max() / 2.0)) + 1
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1))
    for x, y in np.linspace(-0.5, 0.5, 64)[:, None] * motion_px + reach:
        i, j = int(y), int(x)
        kernel[i : i + 2, j : j + 2] += np.outer([i + 1 - y, y - i], [j + 1 - x, x - j])
    return np.asarray(kernel / kernel.sum())


def _wet(picture: Picture, drop: Drop, t_s: float) -> None:
    """Add a drop, in which the surroundings appear upside down and out of focus."""
    x, y = drop.at[0], drop.at[1] + drop.slides * (t_s - drop.from_s)
    low = np.maximum(np.floor([x - drop.radius, y - drop.radius]).astype(int), 0)
    high = np.minimum(np.ceil([x + drop.radius, y + drop.radius]).astype(int), picture.shape[::-1])
    width, rows = high - low
    if width < 8 or rows < 8:
        return
    patch = picture[low[1] : high[1], low[0] : high[0]]
    small = cv2.GaussianBlur(cv2.resize(patch, (16, 16), interpolation=cv2.INTER_AREA), (0, 0), 2.0)
    blurred = cv2.resize(cv2.flip(small, -1), (int(width), int(rows)), interpolation=cv2.INTER_LINEAR)
    v, u = np.ogrid[low[1] : high[1], low[0] : high[0]]
    off = np.hypot(u - x, v - y) / drop.radius
    inside = np.clip((1.0 - off) / 0.15, 0.0, 1.0).astype(np.float32)
    patch[:] = patch * (1.0 - inside) + inside * (0.9 * blurred + 0.06 * float(blurred.mean()))


def digitise(picture: Picture, camera: RigCamera, exposed: tuple[float, float], noise: Picture) -> Image:
    """Return the image (rows, columns) of light: shot and read noise, gain, gamma 2.2, eight bits.

    Args:
        noise: (rows, columns) standard normal.
    """
    ms, gain = exposed
    electrons = picture * np.float32(camera.electrons_per_ms * ms)
    spread = cv2.sqrt(electrons + np.float32(camera.read_noise**2))
    level = np.asarray(cv2.add(electrons, cv2.multiply(spread, noise)), dtype=np.float32)
    level *= float(gain / camera.full_well * (_LEVELS - 1))
    return _CODE[np.clip(level, 0.0, _LEVELS - 1, out=level).astype(np.uint16)]


_CODE: Image = np.rint(255.0 * (np.arange(_LEVELS) / (_LEVELS - 1)) ** (1.0 / _GAMMA)).astype(np.uint8)
