# SPDX-License-Identifier: Apache-2.0
"""The snapshot file, to resume from after the process was killed: written whole or not at all."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from graphloc.errors import in_one_line
from graphloc.frames import Array, Datum, Geodetic
from graphloc.judge.imu_noise import LARGEST_NOISE_SCALE
from graphloc.measurements import ImuSample
from graphloc.online._anchor import Anchor
from graphloc.online._unmeasured_heading import UnmeasuredHeading
from graphloc.online._unmodelled import ErrorSizes

_VERSION = 13
_EVERY_S = 2.0  # lost where the process is killed: short beside the 20 s for which an IMU gap is bridged; a choice
_MOST_TIMES = 1e4  # factor on a data sheet's noise that no sensor exceeds, not even an IMU on an engine


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Snapshot:
    """What the online mode resumes from.

    Attributes:
        vessel: its name. anchor: the state to resume at. imu: the last IMU sample at or before it.
        datum: origin of world. heights_m: configured heights (m, up in world), by sensor.
        agreed_ns: stamp at which each absolute sensor last agreed.
        noise: factors on the noise of the IMU, on that of its gyroscope, on that of its accelerometer, and on the walk
            of the biases of accelerometers and of gyroscopes. sensor_noise: factors on other sensors' sigmas
            (`SensorNoise.times`).
        heading: how far the heading may be off where no sensor measures it; None: one does, or the motion has confirmed
            it.
        p_odom_m, R_odom_body: (3,), (3, 3) pose of the body in odom.
        clocks_set_ns: by how much the clocks of sensors have been set (`SensorClock`), by sensor.
        settings: by sensor, the settings that slow states and constants in the anchor are added to (`Setup.settings`).
        stepped: names of compasses whose headings have stepped: a compass is off its mount by that.
        unmodelled: sizes of `UnmodelledError`; None where no slow error is left out, and the IMU's mount is known
            exactly.
    """

    vessel: str
    anchor: Anchor
    imu: ImuSample
    datum: Datum
    heights_m: Mapping[str, float]
    agreed_ns: Mapping[str, int]
    noise: tuple[float, ...]
    sensor_noise: Mapping[str, Mapping[str, float]]
    heading: UnmeasuredHeading | None
    p_odom_m: Array
    R_odom_body: Array
    clocks_set_ns: Mapping[str, int]
    settings: Mapping[str, Any]
    unmodelled: ErrorSizes | None
    stepped: frozenset[str] = frozenset()

    def for_settings(self, now: Mapping[str, Any]) -> Snapshot:
        """Return the snapshot without the slow states, constants and clocks of sensors that are set otherwise now.

        A setting that users have corrected, as they were told, would else be corrected twice.

        Args:
            now: the present `Setup.settings`.
        """
        same = {name for name, were in self.settings.items() if were == now.get(name)}
        anchor = replace(
            self.anchor,
            slow={name: known for name, known in self.anchor.slow.items() if name in same},
            constants={of: known for of, known in self.anchor.constants.items() if of[0] in same},
        )
        clocks_set_ns = {name: ns for name, ns in self.clocks_set_ns.items() if name in same}
        return replace(self, anchor=anchor, clocks_set_ns=clocks_set_ns, stepped=self.stepped & same)

    def write(self, path: Path) -> None:
        """Replace the file atomically: if the process is killed, the old file or the new one is left.

        Raises:
            OSError: the file cannot be written.
        """
        raw = {
            "version": _VERSION,
            "vessel": self.vessel,
            "datum": list(self.datum.origin),
            "anchor": self.anchor.as_dict(),
            "imu": [self.imu.stamp_ns, *self.imu.accel_mps2.tolist(), *self.imu.gyro_radps.tolist()],
            "heights_m": dict(self.heights_m),
            "noise": list(self.noise),
            "sensor_noise": {name: dict(times) for name, times in self.sensor_noise.items()},
            "heading": None if self.heading is None else asdict(self.heading),
            "agreed_ns": dict(self.agreed_ns),
            "clocks_set_ns": dict(self.clocks_set_ns),
            "settings": dict(self.settings),
            "stepped": sorted(self.stepped),
            "odom": [self.p_odom_m.tolist(), self.R_odom_body.tolist()],
            "unmodelled": None if self.unmodelled is None else [of.tolist() for of in self.unmodelled],
        }
        part = path.with_name(path.name + ".part")
        with part.open("w", encoding="utf-8") as stream:
            # No fsync: a killed process loses nothing, and a memory card may take a second for it.
            json.dump(raw, stream)
        part.replace(path)

    @classmethod
    def read(cls, path: Path, sensor: str) -> Snapshot:
        """Return the snapshot in a file; `sensor`: name of the IMU.

        Raises:
            OSError, KeyError, TypeError, ValueError: the file cannot be read, or is damaged.
        """
        raw = json.loads(path.read_text(encoding="utf-8"))
        if raw["version"] != _VERSION:
            raise ValueError("written by another version of graphloc")
        stamp, *six = raw["imu"]
        p, R = (np.array(raw["odom"][n], dtype=np.float64).reshape(shape) for n, shape in ((0, 3), (1, (3, 3))))
        sizes = [np.array(of, dtype=np.float64) for of in raw["unmodelled"] or ()]
        found = cls(
            vessel=str(raw["vessel"]),
            anchor=Anchor.from_dict(raw["anchor"]),
            imu=ImuSample(stamp_ns=int(stamp), sensor=sensor, seq=-1, accel_mps2=six[:3], gyro_radps=six[3:]),
            datum=Datum(Geodetic(*(float(v) for v in raw["datum"]))),
            heights_m={str(n): float(h) for n, h in raw["heights_m"].items()},
            agreed_ns={str(n): int(s) for n, s in raw["agreed_ns"].items()},
            noise=tuple(float(times) for times in raw["noise"]),
            sensor_noise={
                str(name): {str(key): float(by) for key, by in times.items()}
                for name, times in raw["sensor_noise"].items()
            },
            heading=None if raw["heading"] is None else UnmeasuredHeading(**raw["heading"]),
            p_odom_m=p,
            R_odom_body=R,
            clocks_set_ns={str(n): int(ns) for n, ns in raw["clocks_set_ns"].items()},
            settings=dict(raw["settings"]),
            stepped=frozenset(map(str, raw["stepped"])),
            unmodelled=ErrorSizes(*sizes) if sizes else None,
        )
        if not found._is_sound():
            raise ValueError("it is damaged")
        return found

    def _is_sound(self) -> bool:
        """Return whether a run can have had these numbers; those of the anchor and the sample are not checked."""
        scale, heading, R = self.noise[0], self.heading, self.R_odom_body
        raised = [*self.noise, *(by for times in self.sensor_noise.values() for by in times.values())]
        numbers = np.concatenate(
            [
                self.p_odom_m,
                R.ravel(),
                self.datum.origin,
                list(self.heights_m.values()),
                raised,
                *(of.ravel() for of in self.unmodelled or ()),
                [] if heading is None else [heading.since_ns, heading.sigma_rad, heading.drift_radps],
            ]
        )
        finite = len(self.noise) == 5 and bool(np.isfinite(numbers).all())
        noise = 1.0 <= min(raised) and scale <= LARGEST_NOISE_SCALE and max(raised) <= _MOST_TIMES
        return finite and noise and bool(np.abs(R @ R.T - np.eye(3)).max() <= 1e-3)


class SnapshotFile:
    """The file that snapshots are written to and read from; `path` None: no file."""

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._written_ns = 0
        self._unwritable = False

    def due(self, at_ns: int) -> bool:
        """Return whether it is time to write a snapshot."""
        return self._path is not None and at_ns - self._written_ns >= _EVERY_S * 1e9

    def restart(self) -> None:
        """Make the next snapshot due at once, even if the clock was set back."""
        self._written_ns = 0

    def write(self, snapshot: Snapshot) -> str:
        """Replace the file; if that fails, return why, the first time in a row only; else empty."""
        assert self._path is not None
        self._written_ns = snapshot.anchor.stamp_ns
        try:
            snapshot.write(self._path)
        except (OSError, ValueError) as error:  # ValueError: a path that is no file's, as that of an empty text
            told, self._unwritable = self._unwritable, True
            why = error.strerror if isinstance(error, OSError) and error.strerror else in_one_line(error)
            return "" if told else f"{self._path}: the snapshot cannot be written ({why})"
        self._unwritable = False
        return ""

    def read(self, vessel: str, imu: str, datum: Datum | None) -> tuple[Snapshot | None, str]:
        """Return the snapshot in the file, or None and why it cannot be used; why is empty where there is no file."""
        path = self._path
        if path is None or not path.exists():
            return None, ""
        try:
            found = Snapshot.read(path, imu)
            if found.vessel != vessel:
                raise ValueError("it is of another vessel")
            if datum is not None and not np.allclose(found.datum.origin, datum.origin, rtol=0.0, atol=1e-9):
                raise ValueError("its origin of world is another one")
        except Exception as error:  # noqa: BLE001 - a file that anything may have written
            return None, f"{path}: the snapshot cannot be used ({in_one_line(error)}): starts without it"
        return found, ""
