# SPDX-License-Identifier: Apache-2.0
"""A file to go on from after a kill: written whole or not at all."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from graphloc.frames import Array, Datum, Geodetic
from graphloc.measurements import ImuSample
from graphloc.online._anchor import Anchor
from graphloc.solve._solution import NO_NOISE

_VERSION = 1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Snapshot:
    """What the online mode is built anew from.

    Attributes:
        vessel: its name. anchor: the newest state. imu: the sample at it or before.
        datum: origin of world. heights_m: of each sensor that the configuration makes itself, what it says.
        agreed_ns: when each absolute sensor last agreed. noise_scale: of the IMU.
        doubt: why the pose cannot be called good.
        p_odom_m, R_odom_body: (3,), (3, 3) pose of the body in odom.
    """

    vessel: str
    anchor: Anchor
    imu: ImuSample
    datum: Datum
    heights_m: Mapping[str, float]
    agreed_ns: Mapping[str, int]
    noise_scale: float
    doubt: str
    p_odom_m: Array
    R_odom_body: Array

    def write(self, path: Path) -> None:
        """Replace the file at once: a kill leaves the old one or the new one.

        Raises:
            OSError: it cannot be written.
        """
        raw = {
            "version": _VERSION,
            "vessel": self.vessel,
            "datum": list(self.datum.origin),
            "anchor": self.anchor.as_dict(),
            "imu": [self.imu.stamp_ns, *self.imu.accel_mps2.tolist(), *self.imu.gyro_radps.tolist()],
            "heights_m": dict(self.heights_m),
            "noise_scale": self.noise_scale,
            "doubt": self.doubt,
            "agreed_ns": dict(self.agreed_ns),
            "odom": [self.p_odom_m.tolist(), self.R_odom_body.tolist()],
        }
        part = path.with_name(path.name + ".part")
        with part.open("w", encoding="utf-8") as stream:
            json.dump(raw, stream)  # no fsync: a kill loses nothing, and a card may take a second for it
        part.replace(path)

    @classmethod
    def read(cls, path: Path, sensor: str) -> Snapshot:
        """Return what a file holds; `sensor`: name of the IMU.

        Raises:
            OSError, KeyError, TypeError, ValueError: it cannot be read, or is damaged.
        """
        raw = json.loads(path.read_text(encoding="utf-8"))
        if raw["version"] != _VERSION:
            raise ValueError("it is of another version")
        stamp, *six = raw["imu"]
        p, R = (np.array(raw["odom"][n], dtype=np.float64).reshape(shape) for n, shape in ((0, 3), (1, (3, 3))))
        heights_m = {str(n): float(h) for n, h in raw["heights_m"].items()}
        scale = float(raw["noise_scale"])
        datum = Datum(Geodetic(*(float(v) for v in raw["datum"])))
        numbers = np.concatenate([p, R.ravel(), datum.origin, list(heights_m.values()), [scale]])
        if not np.isfinite(numbers).all() or np.abs(R @ R.T - np.eye(3)).max() > 1e-3:
            raise ValueError("it is damaged")
        return cls(
            vessel=str(raw["vessel"]),
            anchor=Anchor.from_dict(raw["anchor"]),
            imu=ImuSample(stamp_ns=int(stamp), sensor=sensor, seq=-1, accel_mps2=six[:3], gyro_radps=six[3:]),
            datum=datum,
            heights_m=heights_m,
            agreed_ns={str(n): int(s) for n, s in raw["agreed_ns"].items()},
            noise_scale=float(np.clip(scale, 1.0, NO_NOISE)),
            doubt=str(raw["doubt"]),
            p_odom_m=p,
            R_odom_body=R,
        )
