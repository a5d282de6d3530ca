# SPDX-License-Identifier: Apache-2.0
"""Bags as strangers record them: a craft of known motion, sensors with odd axes, units, clocks, rates and messages."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from _rows import ROOT
from _vessels import gauss_markov
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from graphloc.eval.simulate._truth import Motion, Waves, make_motion
from graphloc.frames import Array, Datum, Geodetic

sys.path.append(str(ROOT))
from tests.bagfactory import START_NS, Item, Messages, write_bag

DATUM = Datum(Geodetic(57.7, 11.9, 41.0))
_STANDS_S, _RAMP_S = 8.0, 6.0  # at the start
_GYRO_BIAS, _ACCEL_BIAS = np.array([0.002, -0.003, 0.004]), np.array([0.02, -0.03, 0.04])
_GYRO_SIGMA, _ACCEL_SIGMA = 0.0015, 0.02  # of a sample at 100 Hz, rad/s and m/s^2
_SLOW_S = 200.0
Change = Callable[["Craft", list[Item]], list[Item]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Gait:
    """How a kind of craft moves: top speed, m/s, and turn rate, rad/s; how long each lasts, s; waves: roll, rad, and heave, m."""

    speed_mps: float
    speed_s: float
    turn_radps: float
    turn_s: float
    roll_rad: float = 0.01
    heave_m: float = 0.0
    steers: bool = False  # turns only while it goes


GAITS = {
    "car": Gait(speed_mps=12.0, speed_s=8.0, turn_radps=0.35, turn_s=9.0, steers=True),
    "robot": Gait(speed_mps=1.0, speed_s=6.0, turn_radps=0.5, turn_s=8.0, steers=True),
    "boat": Gait(speed_mps=6.0, speed_s=10.0, turn_radps=0.2, turn_s=15.0, roll_rad=0.05, heave_m=0.1),
    "ferry": Gait(speed_mps=4.0, speed_s=15.0, turn_radps=0.06, turn_s=25.0, roll_rad=0.03, heave_m=0.1),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Odd:
    """A bag and what a good draft says of it.

    Attributes:
        sigma_m, slow_m: white and slow error of fixes, each horizontal axis; heights twice. status, claims: of `NavSatFix`;
            claims None: no covariance.
        crab_rad: largest angle between course and heading. imu_rpy_deg, imu_m, antenna_m: mounts in body.
        tf: whether /tf_static has them. accel, gyro: what the driver makes of values (N, 3).
        late_s: by how much fixes are stamped and recorded late. ppm: by how much the IMU's clock runs fast.
        compass: whether there is one, as QuaternionStamped. change: what else is done to the messages.
        draft: regular expressions, each found in a good vessel.yaml. edit: what a user must then replace in it, and by what.
    """

    craft: str = "car"
    seconds: float = 90.0
    seed: int = 1
    kind: str = "mcap"
    imu_hz: float = 100.0
    gnss_hz: float = 5.0
    sigma_m: float = 0.5
    slow_m: float = 0.0
    status: int = 0
    claims: float | None = 1.0
    crab_rad: float = 0.0
    imu_rpy_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    imu_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    antenna_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    tf: bool = False
    accel: Callable[[Array], Array] = lambda a: a
    gyro: Callable[[Array], Array] = lambda w: w
    late_s: float = 0.0
    ppm: float = 0.0
    compass: bool = False
    change: Change | None = None
    draft: tuple[str, ...] = ()
    edit: tuple[str, str] = ("", "")

    def drafted_well(self, draft: str) -> bool:
        return all(re.search(pattern, draft) for pattern in self.draft)


class Craft:
    """A craft on its way: true motion, random numbers, and makers of messages."""

    def __init__(self, odd: Odd) -> None:
        self.odd, self.rng = odd, np.random.default_rng([odd.seed, 41])
        self.make = Messages(1 if odd.kind == "ros1" else 2)
        self.motion = _motion(odd, np.random.default_rng([odd.seed, 42]))

    def times(self, rate_hz: float, after_s: float = 0.0) -> Array:
        return np.arange(after_s, self.odd.seconds, 1.0 / rate_hz)

    def yaw(self, t: Array) -> Array:
        return self.motion.attitude(t)[0][:, 2]

    def fixes(
        self, t: Array, sigma_m: float, slow_m: float = 0.0, lever_m: tuple[float, ...] = (0.0, 0.0, 0.0)
    ) -> Array:
        """Latitude, longitude, height (N, 3) of a receiver."""
        p, R, _ = self.motion.pose(t)
        error = sigma_m * self.rng.normal(size=(len(t), 3)) + gauss_markov(self.rng, t, slow_m, _SLOW_S, 3)
        return DATUM.geodetic_from_enu(p + R @ np.array(lever_m) + error * [1.0, 1.0, 2.0])

    def recorded(self, t: Array, latency_s: float = 0.01) -> list[int]:
        """When messages of times (N,) are recorded, ns: a little later, unevenly."""
        return [stamp(at) for at in t + latency_s + np.abs(self.rng.normal(scale=0.004, size=len(t)))]

    def items(self) -> list[Item]:
        """All messages, by recording time."""
        items = self._imu() + self._fixes()
        if self.odd.compass:
            items += self._compass()
        if self.odd.tf:
            R = Rotation.from_euler("xyz", self.odd.imu_rpy_deg, degrees=True)
            edges = [
                ("base_link", "imu_link", self.odd.imu_m, R.as_quat()),
                ("base_link", "gps", self.odd.antenna_m, (0, 0, 0, 1)),
            ]
            items.append(("/tf_static", START_NS, self.make.transforms(edges)))
        if self.odd.change is not None:
            items = self.odd.change(self, items)
        return sorted(items, key=lambda item: item[1])

    def _imu(self) -> list[Item]:
        t = self.times(self.odd.imu_hz)
        R = Rotation.from_euler("xyz", self.odd.imu_rpy_deg, degrees=True).as_matrix()
        force, rate = self.motion.inertial(t, np.array(self.odd.imu_m), DATUM.gravity_mps2)
        noise = np.sqrt(self.odd.imu_hz / 100.0)
        accel = self.odd.accel(force @ R + _ACCEL_BIAS + noise * _ACCEL_SIGMA * self.rng.normal(size=force.shape))
        gyro = self.odd.gyro(rate @ R + _GYRO_BIAS + noise * _GYRO_SIGMA * self.rng.normal(size=rate.shape))
        own = [stamp(at * (1.0 + 1e-6 * self.odd.ppm)) for at in t]
        return [
            ("/imu/data", log_ns, self.make.imu(own_ns, a, w, frame="imu_link"))
            for log_ns, own_ns, a, w in zip(self.recorded(t, 0.003), own, accel, gyro, strict=True)
        ]

    def _fixes(self) -> list[Item]:
        t = self.times(self.odd.gnss_hz, 0.05)
        places = self.fixes(t, self.odd.sigma_m, self.odd.slow_m, self.odd.antenna_m)
        claims = self.odd.claims
        cov = np.zeros(9) if claims is None else claims**2 * np.diag([1.0, 1.0, 4.0]).ravel()
        late = t + self.odd.late_s
        return [
            ("/gnss/fix", log_ns, self.make.fix(stamp(at), *place, self.odd.status, cov, 0 if claims is None else 2))
            for log_ns, at, place in zip(self.recorded(late, 0.02), late, places, strict=True)
        ]

    def _compass(self) -> list[Item]:
        t = self.times(10.0, 0.02)
        half = (self.yaw(t) + np.radians(0.5) * self.rng.normal(size=len(t))) / 2.0
        return [
            ("/compass", log_ns, self.make.compass(stamp(at), (0, 0, np.sin(h), np.cos(h))))
            for log_ns, at, h in zip(self.recorded(t), t, half, strict=True)
        ]


def stamp(at_s: float) -> int:
    return START_NS + round(at_s * 1e9)


def written(odd: Odd, folder: Path) -> tuple[Path, Craft]:
    """Write the bag into a folder."""
    craft = Craft(odd)
    suffix = ".bag" if odd.kind == "ros1" else ""
    return write_bag(folder / f"run{suffix}", craft.make, craft.items(), odd.kind), craft


def _motion(odd: Odd, rng: np.random.Generator) -> Motion:
    """Speeds and turn rates drawn at random knots, smoothed, after standing a while."""
    gait, step = GAITS[odd.craft], 0.02
    t = np.arange(-2.0, odd.seconds + 2.0, step)

    def drawn(lasts_s: float, values: Callable[[int], Array]) -> Array:
        knots = np.arange(0.0, odd.seconds + 4.0 * lasts_s, lasts_s)
        curve = PchipInterpolator(knots, values(len(knots)))(np.clip(t, 0.0, None))
        return np.asarray(gaussian_filter1d(curve, 0.3 / step))

    def speeds(n: int) -> Array:
        return gait.speed_mps * (0.55 + 0.45 * rng.uniform(-1.0, 1.0, n)) * (rng.uniform(size=n) > 0.12)

    under_way = 0.5 - 0.5 * np.cos(np.pi * np.clip((t - _STANDS_S) / _RAMP_S, 0.0, 1.0))
    speed = under_way * drawn(gait.speed_s, speeds)
    rate = under_way * drawn(gait.turn_s, lambda n: gait.turn_radps * rng.uniform(-1.0, 1.0, n))
    if gait.steers:
        rate = rate * np.clip(speed / (0.3 * gait.speed_mps), 0.0, 1.0)
    crab = drawn(40.0, lambda n: odd.crab_rad * rng.uniform(-1.0, 1.0, n))
    at = lambda values: PchipInterpolator(t, values)
    waves = (
        Waves.jonswap(rng, gait.roll_rad, 4.0),
        Waves.jonswap(rng, 0.6 * gait.roll_rad, 5.0),
        Waves.jonswap(rng, gait.heave_m, 5.0),
    )
    ahead, sway = at(speed * np.cos(crab)), at(speed * np.sin(crab))
    return make_motion(odd.seconds, ahead, at(rate), rng.uniform(-3.0, 3.0), sway, waves, 0.0)
