# SPDX-License-Identifier: Apache-2.0
"""Odd bags through the user's path: inspect, its draft as it stands, smooth, replay; against the truth.

`python benchmarks/odd.py bursts UTM` measures the bags whose names hold one of the words: is the draft right, RMSE and share of the
time inside the 95 % bounds, offline and online.
"""

from __future__ import annotations

import sys
import tempfile
import traceback
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import _makers
import numpy as np
from _odd_bags import DATUM, START_NS, Change, Craft, Item, Odd, stamp, written
from _rows import Row, row
from _vessels import gauss_markov
from pyproj import Transformer
from scipy.spatial.transform import Rotation

from graphloc import app
from graphloc.errors import GraphlocError
from graphloc.eval import report
from graphloc.eval.metrics import TruthMetrics, compare_to_truth
from graphloc.frontends.bag import read_recording
from graphloc.frontends.inspect import draft_config, inspect_bag
from graphloc.replay import replay
from graphloc.solution import Solution
from graphloc.trajectory import Trajectory

_HONEST = 0.85  # share of the time inside the 95 % bounds, at the least


def restamped(stamped: Callable[[int, int], int]) -> Change:
    """Other header stamps of the IMU; `stamped` takes the number of a message and its stamp, ns."""

    def change(craft: Craft, items: list[Item]) -> list[Item]:
        own = [m for name, _, m in items if name == "/imu/data"]
        for k, m in enumerate(own):
            old_ns = m.header.stamp.sec * 10**9 + m.header.stamp.nanosec
            m.header = craft.make.header(stamped(k, old_ns), m.header.frame_id)
        return items

    return change


def off(size_m: float, begin_s: float, end_s: float) -> Change:
    """Fixes that lie off to the north-east for a while."""

    def change(_craft: Craft, items: list[Item]) -> list[Item]:
        for name, log_ns, m in items:
            if name == "/gnss/fix" and stamp(begin_s) < log_ns < stamp(end_s):
                m.latitude += 0.6 * size_m / 111e3
                m.longitude += 0.8 * size_m / 111e3 / np.cos(np.radians(m.latitude))
        return items

    return change


def _jump(size_m: float) -> Change:
    """Fixes that are off for the middle third of the run."""

    def change(craft: Craft, items: list[Item]) -> list[Item]:
        third = craft.odd.seconds / 3.0
        return off(size_m, third, 2.0 * third)(craft, items)

    return change


def velocity_of_receiver(craft: Craft, items: list[Item]) -> list[Item]:
    """A velocity from the receiver, beside its fixes."""
    t = craft.times(craft.odd.gnss_hz, 0.05)
    v = craft.motion.pose(t)[2] + 0.05 * craft.rng.normal(size=(len(t), 3))
    return items + [
        ("/gnss/vel", log_ns, craft.make.twist(stamp(at), v_mps, np.diag([0.0025] * 3 + [1.0] * 3).ravel(), "map"))
        for log_ns, at, v_mps in zip(craft.recorded(t, 0.02), t, v, strict=True)
    ]


_SAYS = {"/gnss/fix": ("latitude", "longitude", "altitude"), "/gnss/vel": ("twist",), "/compass": ("quaternion",)}


def _hang(*topics: str) -> Change:
    """From 45 s on, for 20 s, these repeat what they said last."""

    def change(craft: Craft, items: list[Item]) -> list[Item]:
        items = velocity_of_receiver(craft, items) if "/gnss/vel" in topics else items
        last: dict[str, Any] = {}
        for name, log_ns, m in sorted(items, key=lambda item: item[1]):
            if name not in topics:
                continue
            if stamp(45.0) < log_ns < stamp(65.0):
                for field in _SAYS[name]:
                    setattr(m, field, getattr(last[name], field))
            last[name] = m
        return items

    return change


def _thrice(craft: Craft, items: list[Item]) -> list[Item]:
    """A driver that says each fix three times, under stamps of its own."""
    again = [(log_ns, m, k) for name, log_ns, m in items if name == "/gnss/fix" for k in (1, 2)]
    return items + [
        (
            "/gnss/fix",
            log_ns + k * 66_000_000,
            craft.make.fix(
                m.header.stamp.sec * 10**9 + m.header.stamp.nanosec + k * 66_000_000, m.latitude, m.longitude, m.altitude,
                craft.odd.status, m.position_covariance, m.position_covariance_type,
            ),
        )
        for log_ns, m, k in again
    ]  # fmt: skip


def _held_at_rest(craft: Craft, items: list[Item]) -> list[Item]:
    """A receiver that holds its position while the craft is slower than 0.5 m/s."""
    last = None
    for name, log_ns, m in items:
        if name == "/gnss/fix":
            slow = float(np.linalg.norm(craft.motion.pose(np.array([(log_ns - stamp(0.0)) * 1e-9]))[2])) < 0.5
            if slow and last is not None:
                m.latitude, m.longitude, m.altitude = last
            last = m.latitude, m.longitude, m.altitude
    return items


def _rounded(_craft: Craft, items: list[Item]) -> list[Item]:
    """Positions to five decimals: a metre."""
    for name, _, m in items:
        if name == "/gnss/fix":
            m.latitude, m.longitude = round(m.latitude, 5), round(m.longitude, 5)
    return items


def no_covariance(_craft: Craft, items: list[Item]) -> list[Item]:
    for name, _, m in items:
        if name == "/gnss/fix":
            m.position_covariance = np.full(9, np.nan)
    return items


def _second_receiver(craft: Craft, items: list[Item]) -> list[Item]:
    """One that says more, drifts by metres, and claims nothing."""
    t = craft.times(10.0, 0.03)
    places = craft.fixes(t, 1.0, 3.0)
    return items + [
        ("/cheap/fix", log_ns, craft.make.fix(stamp(at), *place, 0, np.zeros(9), 0, frame="cheap"))
        for log_ns, at, place in zip(craft.recorded(t), t, places, strict=True)
    ]


def _second_drifts(craft: Craft, items: list[Item]) -> list[Item]:
    """A receiver that claims half of what the other does, and drifts by metres within a minute."""
    t = craft.times(5.0, 0.06)
    error = gauss_markov(craft.rng, t, 4.0, 40.0, 3) + 0.3 * craft.rng.normal(size=(len(t), 3))
    places = DATUM.geodetic_from_enu(craft.motion.pose(t)[0] + error * [1.0, 1.0, 1.5])
    cov = 0.25 * np.diag([1.0, 1.0, 4.0]).ravel()
    return items + [
        ("/gnss2/fix", log_ns, craft.make.fix(stamp(at), *place, 0, cov, 2, frame="gnss2"))
        for log_ns, at, place in zip(craft.recorded(t), t, places, strict=True)
    ]


def _late_compass(late_s: float) -> Change:
    """Headings that are stamped and recorded late."""

    def change(craft: Craft, items: list[Item]) -> list[Item]:
        late_ns, said = round(late_s * 1e9), []
        for name, log_ns, m in items:
            if name == "/compass":
                m.header = craft.make.header(m.header.stamp.sec * 10**9 + m.header.stamp.nanosec + late_ns)
            said.append((name, log_ns + late_ns * (name == "/compass"), m))
        return said

    return change


def _mavros(craft: Craft, items: list[Item]) -> list[Item]:
    """What MAVROS says of an autopilot: its IMU with an attitude, the heading again without a stamp, fixes and its filter's places."""
    names = {"/imu/data": "/mavros/imu/data", "/gnss/fix": "/mavros/global_position/raw/fix"}
    items = [(names.get(name, name), log_ns, m) for name, log_ns, m in items]
    own = [m for name, _, m in items if name == "/mavros/imu/data"]
    t = np.array([m.header.stamp.sec * 10**9 + m.header.stamp.nanosec - START_NS for m in own]) * 1e-9
    R = craft.motion.pose(t)[1]
    off = np.radians(4.0 + gauss_markov(craft.rng, t, 1.5, 60.0, 1))
    turned = Rotation.from_euler("z", off) * Rotation.from_matrix(R)
    for m, q in zip(own, turned.as_quat(), strict=True):
        m.orientation, m.orientation_covariance = craft.make.quat(q), np.eye(3).ravel()
    at = craft.times(10.0, 0.03)
    yaw = np.interp(at, t, np.unwrap(turned.as_euler("ZYX")[:, 0]))
    float64 = craft.make.t["std_msgs/msg/Float64"]
    heading = [float64(data=round(float(90.0 - np.degrees(y)) % 360.0, 2)) for y in yaw]
    filtered = DATUM.geodetic_from_enu(craft.motion.pose(at)[0] + gauss_markov(craft.rng, at, 0.8, 60.0, 3))
    fixes = [craft.make.fix(stamp(s), *place, 0, np.eye(3).ravel(), 1) for s, place in zip(at, filtered, strict=True)]
    for topic, said, latency_s in (("compass_hdg", heading, 0.06), ("global", fixes, 0.02)):
        logs = craft.recorded(at, latency_s)
        items += [(f"/mavros/global_position/{topic}", log_ns, m) for log_ns, m in zip(logs, said, strict=True)]
    return items


def _utm(craft: Craft, items: list[Item]) -> list[Item]:
    """Odometry of a receiver in UTM, zone 32 north, instead of fixes."""
    t = craft.times(5.0, 0.03)
    lat, lon, height = craft.fixes(t, 0.02).T
    east, north = Transformer.from_crs(4326, 32632, always_xy=True).transform(lon, lat)
    return [item for item in items if item[0] != "/gnss/fix"] + [
        ("/rtk/odom", log_ns, craft.make.odometry(stamp(at), place))
        for log_ns, at, *place in zip(craft.recorded(t), t, east, north, height, strict=True)
    ]


def _nmea(craft: Craft, items: list[Item]) -> list[Item]:
    """Sentences in strings, minutes to four decimals, instead of fixes."""
    t = craft.times(1.0, 0.05)
    places, v, yaw = craft.fixes(t, craft.odd.sigma_m), craft.motion.pose(t)[2], craft.yaw(t)
    said = [item for item in items if item[0] != "/gnss/fix"]
    for log_ns, at, (lat, lon, height), (east, north, _), angle in zip(
        craft.recorded(t, 0.06), t, places, v, yaw, strict=True
    ):
        clock = f"12{int(at) // 60:02d}{at % 60:05.2f}"
        place = f"{_minutes(lat, 2)},N,{_minutes(lon, 3)},E"
        course, knots = np.degrees(np.arctan2(east, north)) % 360.0, np.hypot(east, north) / 0.514444
        for k, body in enumerate((
            f"GPGGA,{clock},{place},1,09,0.9,{height - 35.0:.1f},M,35.0,M,,",
            f"GPRMC,{clock},A,{place},{knots:.2f},{course:.1f},230924,,,A",
            f"HEHDT,{(90.0 - np.degrees(angle)) % 360.0:.1f},T",
        )):  # fmt: skip
            check = int(np.bitwise_xor.reduce(np.frombuffer(body.encode(), dtype=np.uint8)))
            said.append(("/nmea", log_ns + k * 1_000_000, craft.make.text(f"${body}*{check:02X}")))
    return said


def _minutes(degrees: float, digits: int) -> str:
    return f"{int(degrees):0{digits}d}{60.0 * (degrees % 1.0):07.4f}"


_RTK: dict[str, Any] = {"sigma_m": 0.01, "claims": 0.014, "status": 2}
CASES: dict[str, Odd] = {
    "nothing odd": Odd(),
    "NMEA strings alone, ROS 1": Odd(craft="robot", kind="ros1", change=_nmea, draft=(r"nmea: \[GPGGA\]", r"nmea: \[HEHDT\]")),
    "gravity removed": Odd(craft="boat", accel=lambda a: a - [0.0, 0.0, 9.82], draft=("gravity: removed",)),
    "g and deg/s, sqlite": Odd(
        kind="sqlite3", accel=lambda a: a / 9.80665, gyro=np.degrees, draft=("accel_unit: g", "gyro_unit: deg/s")
    ),
    "IMU's z down, accelerations negated": Odd(
        imu_rpy_deg=(180.0, 0.0, 0.0), accel=np.negative, draft=("gravity: inverted",)
    ),
    "IMU turned by 90 deg": Odd(imu_rpy_deg=(0.0, 0.0, 90.0), draft=(r"0.0, 0.0, 90.0\]",)),
    "covariances NaN": Odd(change=no_covariance),
    "IMU stamps zero": Odd(change=restamped(lambda k, ns: 0), draft=("stamps: recorded",)),
    "IMU stamps from boot": Odd(
        change=restamped(lambda k, ns: ns - START_NS + 5 * 10**9), draft=("time_offset_s",)
    ),
    "IMU in bursts of ten": Odd(
        change=restamped(lambda k, ns: stamp(0.09 + k // 10 / 10.0 + 5e-5 * (k % 10))), **_RTK
    ),
    "IMU clock 800 ppm fast": Odd(seconds=300.0, imu_hz=50.0, gnss_hz=2.0, ppm=800.0, draft=("clock_drift_ppm: [78]",), **_RTK),
    "second receiver, faster and worse": Odd(
        change=_second_receiver, draft=(r"(?s)/gnss/fix\n    mount.*/cheap/fix\n    enabled: false",)
    ),
    "fixes 0.5 s late, car": Odd(late_s=0.5, draft=("time_offset_s: -0.[45]",), **_RTK),
    "fixes 0.5 s late, boat": Odd(craft="boat", late_s=0.5),
    "ferry sideways by up to 40 deg, compass": Odd(craft="ferry", crab_rad=0.7, compass=True, draft=("convention: enu",)),
    "RTK jump of 0.5 m": Odd(change=_jump(0.5), **_RTK),
    "RTK jump of 10 m": Odd(change=_jump(10.0), **_RTK),
    "RTK jump of 100 m": Odd(change=_jump(100.0), **_RTK),
    "receiver hangs for 20 s, car": Odd(change=_hang("/gnss/fix")),
    "receiver hangs for 20 s, ferry, compass": Odd(craft="ferry", compass=True, change=_hang("/gnss/fix")),
    "receiver hangs for 20 s, robot that stands": Odd(craft="robot", change=_hang("/gnss/fix")),
    "receiver hangs for 20 s, velocity too, boat": Odd(craft="boat", change=_hang("/gnss/fix", "/gnss/vel")),
    "compass hangs for 20 s, boat": Odd(craft="boat", compass=True, change=_hang("/compass")),
    "compass hangs for 20 s, car": Odd(compass=True, change=_hang("/compass")),
    "each fix three times": Odd(change=_thrice),
    "position held at rest": Odd(change=_held_at_rest),
    "position held at rest, boat": Odd(craft="boat", compass=True, change=_held_at_rest),
    "positions to a metre": Odd(craft="robot", change=_rounded),
    "MAVROS, IMU at 25 Hz": Odd(
        craft="boat", imu_hz=25.0, change=_mavros,
        draft=(r"raw/fix\n    mount", r"(?s)compass_hdg\n    convention[^\n]*\n    unit[^\n]*\n    enabled: false"),
    ),
    "SBG's own messages": Odd(
        craft="boat", imu_rpy_deg=(180.0, 0.0, 0.0), change=_makers.sbg(),
        draft=(
            r"gps_hdt\n    convention: ned", r"gps_vel[^\n]*\n    convention: ned", r"(?s)ekf_euler\n    convention[^\n]*\n    enabled: false",
            r"rpy_deg: \[0.0, 0.0, -?90.0\]",
        ), **_RTK,
    ),
    "SBG's own messages, ENU, ROS 1": Odd(
        craft="ferry", kind="ros1", imu_rpy_deg=(0.0, 0.0, -90.0), change=_makers.sbg(enu=True),
        draft=("gps_hdt\n    convention: enu", r"gps_vel[^\n]*\n    antenna: gnss", r"0.0, 0.0, -90.0\]\}  # guess: gravity"), **_RTK,
    ),
    "PX4's own messages": Odd(
        craft="boat", kind="sqlite3", imu_rpy_deg=(180.0, 0.0, 0.0), change=_makers.px4, draft=("kind: gnss_velocity",)
    ),
    "u-blox's own messages beside its fixes, ROS 1": Odd(
        craft="boat", kind="ros1", change=_makers.ublox, draft=("(?s)kind: gnss\n.*kind: gnss\n.*enabled: false", "navrelposned"),
    ),
    "NovAtel's filter beside its receiver, ROS 1": Odd(
        craft="boat", kind="ros1", change=_makers.span,
        draft=(
            r"topic: /novatel/bestgnsspos\n    mount", r"/novatel/bestpos\n    enabled: false", r"/geopose\n    enabled: false",
            r"/novatel/bestgnssvel  # guess: a velocity",
        ),
    ),
    "Doppler log that loses the bottom": Odd(
        craft="boat", change=_makers.dvl, draft=(r"rpy_deg: \[180.0, 0.0, 0.0\]", r"(?s)/dvl/velocity\n    enabled.*/dvl/velocity\n    through: water"),
        edit=("enabled: false  # guess: true to fuse it", "enabled: true  # guess: true to fuse it"),
    ),
    "compass 1 s late, car": Odd(compass=True, change=_late_compass(1.0), draft=(r"time_offset_s: -(1.0[0-4]|0.9[6-9])",)),
    "second receiver drifts, claims less": Odd(change=_second_drifts, draft=(r"topic: /gnss/fix\n    mount",)),
    "positions in UTM alone": Odd(change=_utm, draft=("grid: ''",), edit=("grid: ''", "grid: EPSG:32632")),
}  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Found:
    """What came of a bag: whether its draft is right, errors against the truth, or why there is no track.

    Attributes:
        trusted: whether the report says that its offline track can be trusted.
    """

    name: str
    drafted: bool = False
    offline: TruthMetrics | None = None
    online: TruthMetrics | None = None
    trusted: bool = False
    trouble: str = ""
    crashed: bool = False

    def line(self) -> str:
        cells = [f"{self.name:42}", "right" if self.drafted else "WRONG", "trusted" if self.trusted else ""]
        for m in (self.offline, self.online):
            cells.append("-" if m is None else f"{m.position_rmse_m:6.2f} m {100.0 * (m.coverage_95 or 0.0):4.0f} %")
        return "  ".join([*cells, self.trouble])


def measured(name: str) -> Found:
    return walked(Found(name=name), CASES[name])


def walked(found: Found, odd: Odd) -> Found:
    """Return what is known of a bag, with what came of it by the user's path."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            return _walked(found, odd, Path(folder))
        except GraphlocError as error:
            return replace(found, trouble=str(error)[:200])
        except Exception:  # noqa: BLE001 - what no user may see
            return replace(found, trouble=traceback.format_exc(), crashed=True)


def _walked(found: Found, odd: Odd, folder: Path) -> Found:
    bag, craft = written(odd, folder)
    draft = draft_config(inspect_bag(bag))
    found = replace(found, drafted=odd.drafted_well(draft))
    (folder / "vessel.yaml").write_text(draft.replace(*odd.edit) if any(odd.edit) else draft)
    config = app.configured(folder / "vessel.yaml")
    recording = read_recording(bag, config)
    run = app.smooth_recording(recording, config)
    (said,) = report.verdict(app.report_data(run)).tracks
    found = replace(found, offline=_judged(craft, run.solution), trusted=said.trust is report.Trust.YES)
    return replace(found, online=_judged(craft, replay(recording, config).solution))


def _judged(craft: Craft, solution: Solution) -> TruthMetrics:
    """Return the errors of a track of a craft."""
    t = np.arange(0.5, craft.odd.seconds - 0.5, 0.05)
    p, R, v = craft.motion.pose(t)
    p = solution.datum.enu_from_geodetic(*DATUM.geodetic_from_enu(p).T)
    stamps_ns = np.array([stamp(at) for at in t])
    return compare_to_truth(
        solution.trajectory, Trajectory(stamps_ns=stamps_ns, p_world_m=p, R_world_body=R, v_world_mps=v)
    )


def figures(pool: ProcessPoolExecutor) -> list[Row]:
    found = list(pool.map(measured, CASES))
    print("\n".join(f.line() for f in found))
    label = f"{len(found)} odd bags"
    rows = [
        row(
            "A.odd", f"{label}: drafts with the right settings", sum(f.drafted for f in found), "bags", len(found), ">="
        ),
        row("A.odd", f"{label}: tracebacks", sum(f.crashed for f in found), "bags", 0, "<="),
        row("A.odd", f"{label}: no track, offline or online", sum(f.online is None for f in found), "bags", 0, "<="),
    ]
    for way in ("offline", "online"):
        tracks = {f.name: m for f in found if (m := getattr(f, way)) is not None}
        narrow = sum((m.coverage_95 or 0.0) < _HONEST for m in tracks.values())
        rows.append(row("A.odd", f"{label}, {way}: inside the 95 % bounds less than 85 % of the time", narrow, "bags", 0, "<="))  # fmt: skip
        rows += [row("A.odd", f"{name}, {way}: position RMSE", m.position_rmse_m, "m") for name, m in tracks.items()]
    return rows


def main() -> None:
    for name in (n for n in CASES if not sys.argv[1:] or any(word in n for word in sys.argv[1:])):
        print(measured(name).line(), flush=True)


if __name__ == "__main__":
    main()
