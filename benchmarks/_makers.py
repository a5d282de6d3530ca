# SPDX-License-Identifier: Apache-2.0
"""Bags of a craft whose sensors speak in makers' own messages, as the drivers of SBG, PX4, u-blox, NovAtel and of Doppler logs write them."""

from __future__ import annotations

from typing import Any

import numpy as np
from _odd_bags import START_NS, Change, Craft, Item, stamp
from _vessels import gauss_markov
from scipy.spatial.transform import Rotation

from tests.makers import said

_GEOID_M = 35.0
_SIGMA_MPS, _SIGMA_DEG = 0.05, 0.3  # of a receiver's velocities, and of the headings of two antennas
_SETTLED_S = 20.0  # from which on NovAtel's filter says a place
_CURRENT_MPS = np.array([0.3, -0.2, 0.0])
_GPS_EPOCH_S, _LEAP_S, _WEEK_S = 315_964_800, 18, 604_800


class _Receiver:
    """What a receiver measures at times (N,): places, velocities north, east, down, and headings of two antennas, deg."""

    def __init__(self, craft: Craft, baseline_deg: float = 0.0) -> None:
        odd, rng = craft.odd, craft.rng
        self.t = craft.times(odd.gnss_hz, 0.05)
        self.places = craft.fixes(self.t, odd.sigma_m, odd.slow_m, odd.antenna_m)
        v = craft.motion.pose(self.t)[2] + _SIGMA_MPS * rng.normal(size=(len(self.t), 3))
        self.ned_mps = v[:, [1, 0, 2]] * [1.0, 1.0, -1.0]
        noise = _SIGMA_DEG * rng.normal(size=len(self.t))
        self.heading_deg = (90.0 - np.degrees(craft.yaw(self.t)) + baseline_deg + noise) % 360.0


def _split(items: list[Item]) -> tuple[list[Item], list[tuple[int, Any]]]:
    """Return what is neither of the IMU nor fixes, and the IMU's messages with their recording times."""
    imu = [(log_ns, m) for name, log_ns, m in items if name == "/imu/data"]
    return [item for item in items if item[0] not in ("/imu/data", "/gnss/fix")], imu


def sbg(enu: bool = False) -> Change:
    """An SBG Ellipse with two antennas athwart, RTK: all that its driver writes but standard messages; x, y swapped in `enu`."""

    def change(craft: Craft, items: list[Item]) -> list[Item]:
        make, found = craft.make, _Receiver(craft, baseline_deg=90.0)
        items, imu = _split(items)
        well = dict.fromkeys(("imu_com", "imu_status"), True)
        for log_ns, m in imu:
            values = {"accel": m.linear_acceleration, "gyro": m.angular_velocity, "imu_status": well}
            items.append(("/sbg/imu_data", log_ns, said(make, "sbg_driver/msg/SbgImuData", header=m.header, **values)))

        def turned(ned: Any) -> Any:
            return make.vector((ned[1], ned[0], -ned[2]) if enu else ned)

        off = np.radians(gauss_markov(craft.rng, found.t, 1.0, 60.0, 1)[:, 0])
        valid = dict.fromkeys(("attitude_valid", "heading_valid", "velocity_valid", "position_valid"), True)
        sigmas = make.vector((0.014, 0.014, 0.03))
        logs = craft.recorded(found.t, 0.03)
        for log_ns, at, (lat, lon, height), ned, heading, wrong in zip(
            logs, found.t, found.places, found.ned_mps, found.heading_deg, off, strict=True
        ):
            header = make.header(stamp(at), "imu_link_ned")
            where = {"latitude": lat, "longitude": lon, "altitude": height - _GEOID_M, "undulation": _GEOID_M}
            angle = float(np.radians(heading - 90.0) + wrong)
            items += [
                ("/sbg/gps_pos", log_ns, said(make, "sbg_driver/msg/SbgGpsPos", header=header, status={"type": 7}, position_accuracy=sigmas, **where)),
                ("/sbg/gps_vel", log_ns, said(
                    make, "sbg_driver/msg/SbgGpsVel", header=header, status={"vel_type": 2}, vel=turned(ned), vel_acc=make.vector((0.05, 0.05, 0.05)),
                )),
                ("/sbg/gps_hdt", log_ns, said(
                    make, "sbg_driver/msg/SbgGpsHdt", header=header, status=64,
                    true_heading=(90.0 - heading) % 360.0 if enu else heading, true_heading_acc=_SIGMA_DEG, baseline=1.0,
                )),
                ("/sbg/ekf_euler", log_ns, said(
                    make, "sbg_driver/msg/SbgEkfEuler", header=header, status=valid,
                    angle=make.vector((0.0, 0.0, np.pi / 2.0 - angle if enu else angle)), accuracy=make.vector((0.01, 0.01, 0.01)),
                )),
            ]  # fmt: skip
        return items

    return change


def px4(craft: Craft, items: list[Item]) -> list[Item]:
    """An autopilot over its own bridge, one antenna."""
    make, found = craft.make, _Receiver(craft)
    items, imu = _split(items)
    for log_ns, m in imu:
        at_us = (m.header.stamp.sec * 10**9 + m.header.stamp.nanosec) // 1000
        a, w = m.linear_acceleration, m.angular_velocity
        values = {"accelerometer_m_s2": (a.x, a.y, a.z), "gyro_rad": (w.x, w.y, w.z)}
        items.append(("/fmu/out/sensor_combined", log_ns, said(make, "px4_msgs/msg/SensorCombined", 1, timestamp=at_us, **values)))  # fmt: skip
    logs = craft.recorded(found.t + 0.1, 0.02)
    for log_ns, at, (lat, lon, height), (north, east, down) in zip(
        logs, found.t, found.places, found.ned_mps, strict=True
    ):
        at_us = stamp(at) // 1000
        m = said(
            make, "px4_msgs/msg/SensorGps", 2, timestamp=at_us + 90_000, timestamp_sample=at_us, fix_type=3, eph=1.0, epv=2.0,
            latitude_deg=lat, longitude_deg=lon, altitude_msl_m=height - _GEOID_M, altitude_ellipsoid_m=height,
            vel_n_m_s=north, vel_e_m_s=east, vel_d_m_s=down, vel_ned_valid=True, s_variance_m_s=0.1, heading=float("nan"),
        )  # fmt: skip
        items.append(("/fmu/out/vehicle_gps_position", log_ns, m))
    return items


def ublox(craft: Craft, items: list[Item]) -> list[Item]:
    """A ZED-F9P pair, the base aft: NavPVT and the moving base's heading beside the standard fixes of the same receiver."""
    make, found = craft.make, _Receiver(craft)
    logs = craft.recorded(found.t, 0.08)
    fixes = [(log_ns, m) for name, log_ns, m in items if name == "/gnss/fix"]
    fixes_at = {round((m.header.stamp.sec * 10**9 + m.header.stamp.nanosec - START_NS) * 1e-9, 3): m for _, m in fixes}
    for log_ns, at, (north, east, down), heading in zip(logs, found.t, found.ned_mps, found.heading_deg, strict=True):
        tow = {"i_tow": round((stamp(at) * 1e-9 - _GPS_EPOCH_S + _LEAP_S) % _WEEK_S * 1e3)}
        fix = fixes_at[round(at, 3)]
        pvt = said(
            make, "ublox_msgs/msg/NavPVT", valid=7, fix_type=3, flags=1, lat=round(1e7 * fix.latitude), lon=round(1e7 * fix.longitude),
            height=round(1e3 * fix.altitude), h_msl=round(1e3 * (fix.altitude - _GEOID_M)), h_acc=1000, v_acc=2000,
            vel_n=round(1e3 * north), vel_e=round(1e3 * east), vel_d=round(1e3 * down), s_acc=80, **tow,
        )  # fmt: skip
        relative = said(
            make, "ublox_msgs/msg/NavRELPOSNED9", rel_pos_heading=round(1e5 * heading), acc_heading=round(1e5 * _SIGMA_DEG),
            flags=1 | 4 | 16 | 32 | 256, **tow,
        )  # fmt: skip
        items += [("/ublox/navpvt", log_ns, pvt), ("/ublox/navrelposned", log_ns, relative)]
    return items


def dvl(craft: Craft, items: list[Item]) -> list[Item]:
    """A Doppler log that loses the bottom after a while, and then tracks the water, which moves."""
    make, t = craft.make, craft.times(8.0, 0.03)
    _, R, v = craft.motion.pose(t)
    water = t > 0.6 * craft.odd.seconds
    along = np.einsum("nji,nj->ni", R, v - water[:, None] * _CURRENT_MPS) + 0.02 * craft.rng.normal(size=v.shape)
    for log_ns, at, (ahead, port, up), mode in zip(craft.recorded(t, 0.05), t, along, 1 + water, strict=True):
        m = said(
            make, "marine_acoustic_msgs/msg/Dvl", header=make.header(stamp(at), "dvl_link"), velocity_mode=int(mode), num_good_beams=4,
            beam_velocities_valid=True, velocity=make.vector((ahead, -port, -up)), velocity_covar=4e-4 * np.eye(3).ravel(),
        )  # fmt: skip
        items.append(("/dvl/velocity", log_ns, m))
    return items


def span(craft: Craft, items: list[Item]) -> list[Item]:
    """NovAtel's receiver with its filter: its fixes, the best of both, and the filter's pose, which wanders, in two types."""
    make, found = craft.make, _Receiver(craft)
    items, imu = _split(items)
    items += [("/imu/data", log_ns, m) for log_ns, m in imu]
    slow = craft.fixes(found.t, 0.02, 0.5)
    logs = craft.recorded(found.t, 0.03)
    for log_ns, at, place, own, (north, east, down), heading in zip(
        logs, found.t, found.places, slow, found.ned_mps, found.heading_deg, strict=True
    ):
        header, settled = make.header(stamp(at), "gps"), at > _SETTLED_S
        track = {
            "hor_speed": float(np.hypot(north, east)),
            "trk_gnd": float(np.degrees(np.arctan2(east, north)) % 360.0),
            "ver_speed": -down,
        }
        moving = {"north_velocity": north, "east_velocity": east, "up_velocity": -down}
        turned = make.quat(Rotation.from_euler("z", 90.0 - heading, degrees=True).as_quat())
        told: list[tuple[str, dict[str, Any]]] = [
            ("BESTGNSSPOS", {"pos_type": {"type": 16}, **_oem7_place(place, 1.0)}),
            ("BESTPOS", {"pos_type": {"type": 53}, **_oem7_place(own, 0.1)} if settled else {"pos_type": {"type": 16}, **_oem7_place(place, 1.0)}),
            ("BESTGNSSVEL", {"vel_type": {"type": 8}, **track}),
            ("INSPVAX", {
                "ins_status": {"status": 3 if settled else 1}, "pos_type": {"type": 53}, "latitude": own[0], "longitude": own[1],
                "height": own[2] - _GEOID_M, "undulation": _GEOID_M, "azimuth": heading, "azimuth_stdev": 0.1, **moving,
            }),
        ]  # fmt: skip
        items += [
            (f"/novatel/{kind.lower()}", log_ns, said(make, f"novatel_oem7_msgs/msg/{kind}", header=header, **values))
            for kind, values in told
        ]
        pose = {"position": {"latitude": own[0], "longitude": own[1], "altitude": own[2]}, "orientation": turned}
        items.append(("/geopose", log_ns, said(make, "geographic_msgs/msg/GeoPoseStamped", header=header, pose=pose)))
    return items


def _oem7_place(place: Any, sigma_m: float) -> dict[str, float]:
    return {
        "lat": place[0], "lon": place[1], "hgt": place[2] - _GEOID_M, "undulation": _GEOID_M,
        "lat_stdev": sigma_m, "lon_stdev": sigma_m, "hgt_stdev": 2.0 * sigma_m,
    }  # fmt: skip
