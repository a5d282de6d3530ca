# SPDX-License-Identifier: Apache-2.0
"""Messages of makers' own packages: values worked out by hand, flags, stamps, versions, and what `inspect` drafts of them."""

import re
from collections.abc import Callable
from datetime import datetime
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rosbags.interfaces import Nodetype
from rosbags.typesys import get_types_from_msg
from scipy.spatial.transform import Rotation

from graphloc.config import CompassConfig, GnssConfig, ImuConfig, VelocityConfig, VesselConfig, load_config
from graphloc.frames import wrap_angle
from graphloc.frontends._assess import NO_TRACK, Courses
from graphloc.frontends._assess_compass import compass_report
from graphloc.frontends._assess_velocity import velocity_report
from graphloc.frontends._rejections import Rejection
from graphloc.frontends._reports import EAST_AXES, NORTH_AXES
from graphloc.frontends._topic_data import TopicData
from graphloc.frontends._types import MessageTypes
from graphloc.frontends._vendor_types import VENDOR_TYPES
from graphloc.frontends.decode import DECODERS, ImuReading
from graphloc.frontends.inspect import draft_config, render
from graphloc.frontends.msgtypes import QUATERNION, TWIST, stamp_ns_of
from graphloc.frontends.vendors import VENDORS
from graphloc.ledger import Outcome
from graphloc.measurements import CompassHeading, GnssPosition, GnssVelocity
from tests.bagfactory import START_NS, Item, Messages, S, write_bag
from tests.heldbags import inspect_bag, read_recording
from tests.makers import said
from tests.test_bag import KINDS
from tests.test_inspect import drive, look

ROS2 = Messages(2)
CONFIGS: dict[str, Any] = {
    "imu": ImuConfig(), "gnss": GnssConfig(), "compass": CompassConfig(sigma_deg=7.0), "gnss_velocity": VelocityConfig(),
}  # fmt: skip
SBG, UBX, DGNSS, OEM7, SBF, PX4, GEO, COMM, SPAN, SWRI, KAIST = (
    f"{package}/msg/"
    for package in (
        "sbg_driver", "ublox_msgs", "ublox_ubx_msgs", "novatel_oem7_msgs", "septentrio_gnss_driver", "px4_msgs", "geographic_msgs",
        "gnss_comm", "novatel_msgs", "novatel_gps_msgs", "irp_sen_msgs",
    )
)  # fmt: skip


def vector(x: float, y: float, z: float) -> Any:
    return ROS2.vector((x, y, z))


# A valid message of each kind, from one receiver: 57.5 N, 11.25 W, 41.5 m above the ellipsoid, 35 m less above the sea.
PLACES: dict[str, dict[str, Any]] = {
    SBG + "SbgGpsPos": {
        "status": {"type": 7}, "latitude": 57.5, "longitude": -11.25, "altitude": 6.5, "undulation": 35.0,
        "position_accuracy": vector(0.5, 0.25, 2.0),
    },
    SBG + "SbgEkfNav": {
        "status": {"position_valid": True}, "latitude": 57.5, "longitude": -11.25, "altitude": 6.5, "undulation": 35.0,
        "position_accuracy": vector(0.5, 0.25, 2.0),
    },
    UBX + "NavPVT": {
        "fix_type": 3, "flags": 1 | 0x80, "lat": 575_000_000, "lon": -112_500_000, "height": 41_500, "h_msl": 6_500, "h_acc": 500, "v_acc": 2_000,
    },
    DGNSS + "UBXNavPVT": {
        "gps_fix": {"fix_type": 3}, "gnss_fix_ok": True, "carr_soln": {"status": 2}, "lat": 575_000_000, "lon": -112_500_000,
        "height": 41_500, "hmsl": 6_500, "h_acc": 500, "v_acc": 2_000,
    },
    OEM7 + "BESTPOS": {
        "pos_type": {"type": 50}, "lat": 57.5, "lon": -11.25, "hgt": 6.5, "undulation": 35.0, "lat_stdev": 0.5, "lon_stdev": 0.25, "hgt_stdev": 2.0,
    },
    SBF + "PVTGeodetic": {
        "mode": 4, "latitude": np.radians(57.5), "longitude": np.radians(-11.25), "height": 41.5, "undulation": 35.0,
        "h_accuracy": 141, "v_accuracy": 400,  # cm: twice the RMS of the distance, which is 1.414 sigmas of an axis; two sigmas
    },
    PX4 + "SensorGps": {
        "fix_type": 6, "latitude_deg": 57.5, "longitude_deg": -11.25, "altitude_msl_m": 6.5, "altitude_ellipsoid_m": 41.5, "eph": 0.5, "epv": 2.0,
    },
    OEM7 + "INSPVAX": {
        "ins_status": {"status": 3}, "pos_type": {"type": 56}, "latitude": 57.5, "longitude": -11.25, "height": 6.5, "undulation": 35.0,
        "latitude_stdev": 0.25, "longitude_stdev": 0.5, "height_stdev": 2.0,
    },
    SBF + "INSNavGeod": {
        "gnss_mode": 4, "latitude": np.radians(57.5), "longitude": np.radians(-11.25), "height": 41.5, "undulation": 35.0,
        "latitude_std_dev": 0.5, "longitude_std_dev": 0.25, "height_std_dev": 2.0,
    },
    GEO + "GeoPoseWithCovarianceStamped": {
        "pose": {"pose": {"position": {"latitude": 57.5, "longitude": -11.25, "altitude": 41.5}}, "covariance": np.diag([0.0625, 0.25, 4, 0, 0, 0]).ravel()},
    },
    COMM + "GnssPVTSolnMsg": {
        "fix_type": 3, "valid_fix": True, "carr_soln": 2, "latitude": 57.5, "longitude": -11.25, "altitude": 41.5, "height_msl": 6.5,
        "h_acc": 0.5, "v_acc": 2.0, "p_dop": 1.25,
    },
    SPAN + "BESTPOS": {
        "position_type": 50, "latitude": 57.5, "longitude": -11.25, "altitude": 6.5, "undulation": 35.0,
        "latitude_std": 0.5, "longitude_std": 0.25, "altitude_std": 2.0,
    },
    SPAN + "INSPVAX": {
        "ins_status": 3, "position_type": 56, "latitude": 57.5, "longitude": -11.25, "altitude": 6.5, "undulation": 35.0,
        "latitude_std": 0.25, "longitude_std": 0.5, "altitude_std": 2.0,
    },
    SWRI + "NovatelPosition": {
        "solution_status": "SOL_COMPUTED", "position_type": "NARROW_INT", "lat": 57.5, "lon": -11.25, "height": 6.5, "undulation": 35.0,
        "lat_sigma": 0.5, "lon_sigma": 0.25, "height_sigma": 2.0,
    },
    SWRI + "Inspvax": {
        "ins_status": "INS_SOLUTION_GOOD", "position_type": "INS_RTKFIXED", "latitude": 57.5, "longitude": -11.25, "altitude": 6.5,
        "undulation": 35.0, "latitude_std": 0.25, "longitude_std": 0.5, "altitude_std": 2.0,
    },
    KAIST + "vrs": {
        "fix_state": 4, "latitude": 57.5, "longitude": -11.25, "altitude": 41.5, "horizental_precision": 9.0,
        "lat_std": 0.25, "lon_std": 0.5, "altitude_std": 2.0,
    },
    PX4 + "VehicleGpsPosition": {
        "fix_type": 6, "lat": 575_000_000, "lon": -112_500_000, "alt": 6_500, "alt_ellipsoid": 41_500, "eph": 0.5, "epv": 2.0,
    },
}  # fmt: skip
# 3 m/s to the north, 1 m/s to the west, sinking at 0.5 m/s; a course of 341.565 deg.
VELOCITIES: dict[str, tuple[dict[str, Any], float]] = {
    SBG + "SbgGpsVel": ({"status": {"vel_type": 2}, "vel": vector(3.0, -1.0, 0.5), "vel_acc": vector(0.25, 0.125, 0.25)}, 0.25),
    SBG + "SbgEkfNav": ({"status": {"velocity_valid": True}, "velocity": vector(3.0, -1.0, 0.5), "velocity_accuracy": vector(0.25, 0.25, 0.25)}, 0.25),
    UBX + "NavPVT": ({"fix_type": 3, "flags": 1, "vel_n": 3000, "vel_e": -1000, "vel_d": 500, "s_acc": 250}, 0.25),
    DGNSS + "UBXNavPVT": ({"gps_fix": {"fix_type": 3}, "gnss_fix_ok": True, "vel_n": 3000, "vel_e": -1000, "vel_d": 500, "s_acc": 250}, 0.25),
    OEM7 + "BESTVEL": ({"vel_type": {"type": 8}, "hor_speed": 10.0**0.5, "trk_gnd": 341.565051177078, "ver_speed": -0.5}, 0.3),
    SBF + "PVTGeodetic": ({"mode": 1, "vn": 3.0, "ve": -1.0, "vu": -0.5}, 0.3),
    OEM7 + "INSPVAX": (
        {"ins_status": {"status": 3}, "pos_type": {"type": 56}, "north_velocity": 3.0, "east_velocity": -1.0, "up_velocity": -0.5, "north_velocity_stdev": 0.25, "up_velocity_stdev": 0.25},
        0.25,
    ),
    OEM7 + "INSPVA": ({"status": {"status": 7}, "north_velocity": 3.0, "east_velocity": -1.0, "up_velocity": -0.5}, 0.3),
    SBF + "INSNavGeod": ({"gnss_mode": 1, "vn": 3.0, "ve": -1.0, "vu": -0.5, "vn_std_dev": 0.25, "ve_std_dev": 0.125, "vu_std_dev": 0.25}, 0.25),
    COMM + "GnssPVTSolnMsg": ({"fix_type": 3, "valid_fix": True, "vel_n": 3.0, "vel_e": -1.0, "vel_d": 0.5, "vel_acc": 0.25}, 0.25),
    SPAN + "BESTVEL": ({"position_type": 8, "hor_spd": 10.0**0.5, "trk_gnd": 341.565051177078, "vert_spd": -0.5}, 0.3),
    SPAN + "INSPVAX": (
        {"ins_status": 7, "position_type": 56, "north_velocity": 3.0, "east_velocity": -1.0, "up_velocity": -0.5, "east_velocity_std": 0.25, "up_velocity_std": 0.25},
        0.25,
    ),
    SPAN + "INSPVA": ({"insstatus": 6, "velx": 3.0, "vely": -1.0, "velz": -0.5}, 0.3),
    SWRI + "NovatelVelocity": (
        {"solution_status": "SOL_COMPUTED", "velocity_type": "DOPPLER_VELOCITY", "horizontal_speed": 10.0**0.5, "track_ground": 341.565051177078, "vertical_speed": -0.5},
        0.3,
    ),
    SWRI + "Inspvax": (
        {"ins_status": "INS_ALIGNMENT_COMPLETE", "position_type": "INS_PSRSP", "north_velocity": 3.0, "east_velocity": -1.0, "up_velocity": -0.5, "north_velocity_std": 0.25, "up_velocity_std": 0.25},
        0.25,
    ),
    SWRI + "Inspva": ({"status": "INS_SOLUTION_GOOD", "north_velocity": 3.0, "east_velocity": -1.0, "up_velocity": -0.5}, 0.3),
    PX4 + "SensorGps": ({"fix_type": 3, "vel_ned_valid": True, "vel_n_m_s": 3.0, "vel_e_m_s": -1.0, "vel_d_m_s": 0.5, "s_variance_m_s": 0.25}, 0.25),
}  # fmt: skip
WEST_BY_NORTH = Rotation.from_euler("ZYX", (150.0, 20.0, -10.0), degrees=True)  # in east, north, up
# 300 deg: a bow to the west-north-west; sigma 0.5 deg, or not told.
HEADINGS: dict[str, tuple[dict[str, Any], float]] = {
    SBG + "SbgGpsHdt": ({"status": 64, "true_heading": 300.0, "true_heading_acc": 0.5}, 0.5),
    SBG + "SbgEkfEuler": ({"status": {"heading_valid": True}, "angle": vector(0, 0, np.radians(-60.0)), "accuracy": vector(0, 0, np.radians(0.5))}, 0.5),
    SBG + "SbgEkfQuat": (
        {"status": {"heading_valid": True}, "quaternion": ROS2.quat(Rotation.from_euler("ZYX", (-60.0, 20.0, -10.0), degrees=True).as_quat().tolist()), "accuracy": vector(0, 0, np.radians(0.5))},
        0.5,
    ),
    UBX + "NavRELPOSNED9": ({"flags": 1 | 4 | 16 | 32 | 256, "rel_pos_heading": 30_000_000, "acc_heading": 50_000}, 0.5),
    DGNSS + "UBXNavRelPosNED": (
        {"gnss_fix_ok": True, "rel_pos_valid": True, "rel_pos_heading_valid": True, "is_moving": True, "carr_soln": {"status": 2}, "rel_pos_heading": 30_000_000, "acc_heading": 50_000},
        0.5,
    ),
    OEM7 + "HEADING2": ({"pos_type": {"type": 50}, "heading": 300.0, "heading_stdev": 0.5}, 0.5),
    SBF + "AttEuler": ({"mode": 2, "heading": 300.0}, 7.0),
    OEM7 + "INSPVAX": ({"ins_status": {"status": 6}, "pos_type": {"type": 53}, "azimuth": 300.0, "azimuth_stdev": 0.5}, 0.5),
    OEM7 + "INSPVA": ({"status": {"status": 3}, "azimuth": 300.0}, 7.0),
    SPAN + "INSPVAX": ({"ins_status": 6, "position_type": 53, "azimuth": 300.0, "azimuth_std": 0.5}, 0.5),
    SPAN + "INSPVA": ({"insstatus": 7, "azimuth": 300.0}, 7.0),
    SWRI + "NovatelHeading2": ({"solution_status": "SOL_COMPUTED", "position_type": "NARROW_INT", "heading": 300.0, "heading_sigma": 0.5}, 0.5),
    SWRI + "Inspvax": ({"ins_status": "INS_SOLUTION_FREE", "position_type": "INS_PSRDIFF", "azimuth": 300.0, "azimuth_std": 0.5}, 0.5),
    SWRI + "Inspva": ({"status": "INS_SOLUTION_GOOD", "azimuth": 300.0}, 7.0),
    SBF + "INSNavGeod": ({"gnss_mode": 1, "heading": 300.0, "heading_std_dev": 0.5}, 0.5),
    GEO + "GeoPoseStamped": ({"pose": {"orientation": ROS2.quat(WEST_BY_NORTH.as_quat().tolist())}}, 7.0),
    GEO + "GeoPoseWithCovarianceStamped": (
        {"pose": {"pose": {"orientation": ROS2.quat(WEST_BY_NORTH.as_quat().tolist())}, "covariance": np.diag([0, 0, 0, 1, 1, np.radians(0.5) ** 2]).ravel()}}, 0.5,
    ),
    PX4 + "SensorGps": ({"fix_type": 3, "heading": np.radians(-60.0), "heading_accuracy": np.radians(0.5)}, 0.5),
}  # fmt: skip
KNOWN_AXES = (UBX, DGNSS, OEM7, PX4, GEO, COMM, SPAN, SWRI)


def read(kind: str, msgtype: str, fields: dict[str, Any], *, make: Messages = ROS2, **config: Any) -> Any:
    """Decode a message after it went through bytes; in float32 it lost some digits."""
    msg = said(make, msgtype, **fields)
    raw = make.store.serialize_ros1(msg, msgtype) if make.ros == 1 else make.store.serialize_cdr(msg, msgtype)
    back = (make.store.deserialize_ros1 if make.ros == 1 else make.store.deserialize_cdr)(raw, msgtype)
    return DECODERS[kind, msgtype](back, START_NS, 5, "it", CONFIGS[kind].model_copy(update=config))


@pytest.mark.parametrize("msgtype", PLACES)
def test_a_place_has_the_height_above_the_ellipsoid_and_the_sigma_of_an_axis(msgtype: str) -> None:
    found = read("gnss", msgtype, PLACES[msgtype])
    assert isinstance(found, GnssPosition)
    assert found.position == pytest.approx((57.5, -11.25, 41.5), abs=1e-6)
    np.testing.assert_allclose(np.sqrt(np.diagonal(found.cov_enu_m2)), [0.5, 0.5, 2.0], rtol=5e-3)


@pytest.mark.parametrize("msgtype", PLACES)
def test_a_place_without_an_accuracy_gets_the_default(msgtype: str) -> None:
    silent = {"position_accuracy": vector(0, 0, 0), "h_acc": 0, "v_acc": 0, "lat_stdev": 0.0, "lon_stdev": 0.0, "hgt_stdev": 0.0, "h_accuracy": 65535, "v_accuracy": 65535, "eph": np.nan, "epv": np.nan}  # fmt: skip
    silent |= dict.fromkeys(("latitude_stdev", "longitude_stdev", "height_stdev"), 0.0)
    silent |= dict.fromkeys(
        (
            "latitude_std",
            "longitude_std",
            "altitude_std",
            "lat_sigma",
            "lon_sigma",
            "height_sigma",
            "lat_std",
            "lon_std",
        ),
        0.0,
    )
    silent |= dict.fromkeys(("latitude_std_dev", "longitude_std_dev", "height_std_dev"), -2e10)
    silent["pose"] = {"pose": PLACES[GEO + "GeoPoseWithCovarianceStamped"]["pose"]["pose"], "covariance": -np.ones(36)}
    fields = {name: silent.get(name, value) for name, value in PLACES[msgtype].items()}
    found = read("gnss", msgtype, fields)
    assert np.sqrt(np.diagonal(found.cov_enu_m2)) == pytest.approx([1.5, 1.5, 4.0])


@pytest.mark.parametrize("msgtype", VELOCITIES)
def test_a_velocity_is_turned_to_east_north_up(msgtype: str) -> None:
    fields, sigma = VELOCITIES[msgtype]
    known = msgtype.startswith((*KNOWN_AXES, SBF))
    for convention in ("ned", "enu") if known else ("ned",):
        found = read("gnss_velocity", msgtype, fields, convention=convention)
        assert isinstance(found, GnssVelocity)
        np.testing.assert_allclose(found.v_enu_mps, [-1.0, 3.0, -0.5], atol=1e-6)
        np.testing.assert_allclose(np.sqrt(np.diagonal(found.cov_m2ps2)), [sigma] * 3, rtol=1e-6)
    if not known:  # a driver that is set so says east first
        as_it_is = read("gnss_velocity", msgtype, fields, convention="enu")
        np.testing.assert_allclose(as_it_is.v_enu_mps, [3.0, -1.0, 0.5], atol=1e-6)


def test_an_up_of_exactly_0_is_measured_where_a_receiver_says_so() -> None:
    """Whole mm/s: in calm water one velocity in some tens. In a standard message it is what a driver of NMEA leaves."""
    fields, sigma = VELOCITIES[UBX + "NavPVT"]
    found = read("gnss_velocity", UBX + "NavPVT", {**fields, "vel_d": 0})
    assert found.cov_m2ps2[2, 2] == pytest.approx(sigma**2)


@pytest.mark.parametrize("msgtype", HEADINGS)
def test_a_heading_is_turned_to_a_yaw(msgtype: str) -> None:
    fields, sigma_deg = HEADINGS[msgtype]
    known = msgtype.startswith(KNOWN_AXES)
    for convention, yaw_deg in (("ned", 150.0), ("enu", 150.0 if known else 300.0)):
        found = read("compass", msgtype, fields, convention=convention)
        assert isinstance(found, CompassHeading)
        assert np.degrees(wrap_angle(found.yaw_rad - np.radians(yaw_deg))) == pytest.approx(0.0, abs=1e-4)
        assert np.degrees(found.sigma_rad) == pytest.approx(sigma_deg, rel=1e-5)
    plain = read("compass", msgtype, fields, use_reported_sigma=False)
    assert np.degrees(plain.sigma_rad) == pytest.approx(7.0)


def test_an_imu_keeps_its_axes() -> None:
    sbg = {"imu_status": {"imu_com": True, "imu_status": True}, "accel": vector(1.0, 2.0, -9.5), "gyro": vector(0.25, 0.5, -0.125)}  # fmt: skip
    short = {"imu_status": sbg["imu_status"], "delta_velocity": vector(2.0**20, 2.0**21, -9.5 * 2.0**20), "delta_angle": vector(2.0**24, 2.0**25, -(2.0**23))}  # fmt: skip
    px4 = {"accelerometer_m_s2": (1.0, 2.0, -9.5), "gyro_rad": (0.25, 0.5, -0.125)}
    for msgtype, fields in ((SBG + "SbgImuData", sbg), (SBG + "SbgImuShort", short), (PX4 + "SensorCombined", px4)):
        assert read("imu", msgtype, fields) == ImuReading((1.0, 2.0, -9.5), (0.25, 0.5, -0.125))
    # Counts of a range of 10 000 deg/s in 31 bits.
    fast = {
        "imu_status": {**short["imu_status"], "imu_gyros_use_high_scale": True},
        "delta_angle": vector(0, 0, 2**31 - 1),
    }
    assert np.degrees(read("imu", SBG + "SbgImuShort", fast).gyro_radps[2]) == pytest.approx(10_000.0, rel=1e-6)


INVALID: list[tuple[str, str, dict[str, Any], str]] = [
    ("imu", SBG + "SbgImuData", {"imu_status": {"imu_com": False, "imu_status": True}}, "imu_com"),
    ("imu", SBG + "SbgImuShort", {"imu_status": {"imu_com": True, "imu_status": False}}, "imu_status"),
    ("imu", PX4 + "SensorCombined", {"accelerometer_timestamp_relative": 0x7FFFFFFF}, "absent"),
    ("gnss", SBG + "SbgGpsPos", {"status": {"status": 1, "type": 7}}, "status 1"),
    ("gnss", SBG + "SbgGpsPos", {"status": {"type": 0}}, "none"),
    ("gnss", SBG + "SbgGpsPos", {"status": {"type": 10}}, "set, not measured"),
    ("gnss", SBG + "SbgGpsPos", {"status": {"type": 7, "ifm": 4}}, "jammed"),
    ("gnss", SBG + "SbgGpsPos", {"status": {"type": 7, "spoofing": 4}}, "spoofed"),
    ("gnss", SBG + "SbgEkfNav", {"status": {"position_valid": False}}, "not valid"),
    ("gnss", UBX + "NavPVT", {"flags": 0x80}, "no fix"),
    ("gnss", UBX + "NavPVT", {"fix_type": 1}, "no fix"),
    ("gnss", UBX + "NavPVT", {"h_acc": 0xFFFFFFFF}, "by its accuracy"),
    ("gnss", OEM7 + "BESTPOS", {"sol_status": {"status": 6}}, "status 6"),
    ("gnss", OEM7 + "BESTPOS", {"lat_stdev": float("inf")}, "by its accuracy"),
    ("gnss", OEM7 + "BESTPOS", {"pos_type": {"type": 19}}, "propagated"),
    ("gnss", SBF + "PVTGeodetic", {"error": 1}, "error 1"),
    ("gnss", SBF + "PVTGeodetic", {"mode": 3}, "set, not measured"),
    ("gnss", PX4 + "SensorGps", {"fix_type": 1}, "no fix"),
    ("gnss", PX4 + "SensorGps", {"fix_type": 8}, "no fix"),
    ("gnss_velocity", SBG + "SbgGpsVel", {"status": {"vel_type": 0}}, "no velocity"),
    ("gnss_velocity", UBX + "NavPVT", {"flags": 0}, "no fix"),
    ("gnss_velocity", OEM7 + "BESTVEL", {"sol_status": {"status": 1}}, "no solution"),
    ("gnss_velocity", SBF + "PVTGeodetic", {"vn": -2e10}, "no velocity"),
    ("gnss_velocity", PX4 + "SensorGps", {"vel_ned_valid": False}, "vel_ned_valid"),
    ("compass", SBG + "SbgGpsHdt", {"status": 65}, "status 1"),
    ("compass", SBG + "SbgEkfEuler", {"status": {"heading_valid": False}}, "not valid"),
    ("compass", UBX + "NavRELPOSNED9", {"flags": 1 | 4 | 16 | 256}, "base does not move"),
    ("compass", UBX + "NavRELPOSNED9", {"flags": 1 | 4 | 16 | 32}, "relPosHeadingValid"),
    ("compass", UBX + "NavRELPOSNED9", {"flags": 1 | 4 | 8 | 32 | 256}, "float"),
    ("gnss", DGNSS + "UBXNavPVT", {"gnss_fix_ok": False}, "no fix"),
    ("gnss", DGNSS + "UBXNavPVT", {"invalid_llh": True}, "no fix"),
    ("gnss_velocity", DGNSS + "UBXNavPVT", {"gps_fix": {"fix_type": 5}}, "no fix"),
    ("compass", DGNSS + "UBXNavRelPosNED", {"is_moving": False}, "base does not move"),
    ("compass", DGNSS + "UBXNavRelPosNED", {"rel_pos_heading_valid": False}, "relPosHeadingValid"),
    ("compass", DGNSS + "UBXNavRelPosNED", {"carr_soln": {"status": 1}}, "float"),
    ("compass", OEM7 + "HEADING2", {"pos_type": {"type": 34}}, "float"),
    ("compass", SBF + "AttEuler", {"mode": 1}, "float"),
    ("compass", SBF + "AttEuler", {"error": 1}, "error 1"),
    ("compass", SBF + "AttEuler", {"heading": 90.0 + 2e10}, "no heading"),
    ("compass", PX4 + "SensorGps", {"heading": float("nan")}, "no heading"),
    ("gnss", OEM7 + "INSPVAX", {"ins_status": {"status": 2}}, "ins_status 2"),
    ("gnss", OEM7 + "INSPVAX", {"pos_type": {"type": 0}}, "none"),
    ("gnss_velocity", OEM7 + "INSPVA", {"status": {"status": 1}}, "ins_status 1"),
    ("compass", OEM7 + "INSPVAX", {"ins_status": {"status": 8}}, "ins_status 8"),
    ("gnss", SBF + "INSNavGeod", {"gnss_mode": 0}, "no GNSS in it"),
    ("gnss_velocity", SBF + "INSNavGeod", {"vu": -2e10}, "no velocity"),
    ("gnss_velocity", SBF + "INSNavGeod", {"error": 5}, "error 5"),
    ("compass", SBF + "INSNavGeod", {"heading": 90.0 + 2e10}, "no heading"),
    ("compass", GEO + "GeoPoseStamped", {"pose": {"orientation": ROS2.quat((0, 0, 0, 1))}}, "no orientation"),
    ("compass", GEO + "GeoPoseStamped", {"pose": {}}, "no orientation"),
    ("compass", GEO + "GeoPoseStamped", {"pose": {"orientation": ROS2.quat((0, 0, 0.5, 0.5))}}, "unit quaternion"),
    ("gnss", GEO + "GeoPoseWithCovarianceStamped", {"pose": {"pose": {"position": {"latitude": np.nan}}}}, "NaN"),
    ("gnss", COMM + "GnssPVTSolnMsg", {"valid_fix": False}, "gnssFixOK 0"),
    ("gnss", COMM + "GnssPVTSolnMsg", {"h_acc": 4294967.295}, "by its accuracy"),
    ("gnss_velocity", COMM + "GnssPVTSolnMsg", {"fix_type": 5}, "fix type 5"),
    ("gnss", SPAN + "BESTPOS", {"solution_status": 1}, "status 1"),
    ("gnss", SPAN + "BESTPOS", {"position_type": 1}, "set, not measured"),
    ("gnss_velocity", SPAN + "BESTVEL", {"position_type": 0}, "type none"),
    ("gnss", SPAN + "INSPVAX", {"ins_status": 2}, "ins_status 2"),
    ("compass", SPAN + "INSPVAX", {"position_type": 0}, "type none"),
    ("gnss", SPAN + "INSPVA", {"insstatus": 2}, "ins_status 2"),
    ("gnss", SWRI + "NovatelPosition", {"solution_status": "INSUFFICIENT_OBS"}, "status INSUFFICIENT_OBS, type 50"),
    ("gnss", SWRI + "NovatelPosition", {"position_type": "NONE"}, "type none"),
    ("gnss", SWRI + "NovatelPosition", {"position_type": "OMNISTAR"}, "type OMNISTAR"),
    ("gnss_velocity", SWRI + "NovatelVelocity", {"velocity_type": "PROPOGATED"}, "propagated"),
    ("compass", SWRI + "NovatelHeading2", {"position_type": "NARROW_FLOAT"}, "float"),
    ("gnss", SWRI + "Inspvax", {"ins_status": "INS_ALIGNING"}, "ins_status INS_ALIGNING"),
    ("gnss_velocity", SWRI + "Inspva", {"status": "WAITING_INITIALPOS"}, "ins_status WAITING_INITIALPOS"),
    ("gnss", KAIST + "vrs", {"fix_state": 0}, "fix_state 0"),
]


@pytest.mark.parametrize(("kind", "msgtype", "changed", "why"), INVALID)
def test_what_a_message_says_of_itself_is_believed(kind: str, msgtype: str, changed: dict[str, Any], why: str) -> None:
    good: dict[str, Any] = {
        "gnss": PLACES.get(msgtype), "gnss_velocity": VELOCITIES.get(msgtype, ({}, 0))[0], "compass": HEADINGS.get(msgtype, ({}, 0))[0]
    }.get(kind) or {}  # fmt: skip
    found = read(kind, msgtype, good | changed)
    assert isinstance(found, Rejection)
    assert why in found.reason


@pytest.mark.parametrize(
    ("msgtype", "flat"),
    [
        (UBX + "NavPVT", {"fix_type": 2}),
        (DGNSS + "UBXNavPVT", {"gps_fix": {"fix_type": 2}}),
        (SBF + "PVTGeodetic", {"mode": 4 | 0x80}),
        (PX4 + "SensorGps", {"fix_type": 2}),
        (COMM + "GnssPVTSolnMsg", {"fix_type": 2}),
    ],
)
def test_a_flat_fix_has_no_height(msgtype: str, flat: dict[str, Any]) -> None:
    assert not read("gnss", msgtype, PLACES[msgtype] | flat).has_height


@pytest.mark.parametrize(
    ("msgtype", "changed", "status"),
    [
        (SBG + "SbgGpsPos", {"status": {"type": 2}}, 0), (SBG + "SbgGpsPos", {"status": {"type": 4}}, 1), (SBG + "SbgGpsPos", {}, 2),
        (UBX + "NavPVT", {"flags": 1}, 0), (UBX + "NavPVT", {"flags": 3}, 1), (UBX + "NavPVT", {"flags": 0x41}, 2),
        (DGNSS + "UBXNavPVT", {"carr_soln": {}}, 0), (DGNSS + "UBXNavPVT", {"carr_soln": {}, "diff_soln": True}, 1), (DGNSS + "UBXNavPVT", {}, 2),
        (OEM7 + "BESTPOS", {"pos_type": {"type": 16}}, 0), (OEM7 + "BESTPOS", {"pos_type": {"type": 18}}, 1), (OEM7 + "BESTPOS", {}, 2),
        (SBF + "PVTGeodetic", {"mode": 1}, 0), (SBF + "PVTGeodetic", {"mode": 6}, 1), (SBF + "PVTGeodetic", {"mode": 5}, 2),
        (COMM + "GnssPVTSolnMsg", {"carr_soln": 0}, 0), (COMM + "GnssPVTSolnMsg", {"carr_soln": 0, "diff_soln": True}, 1), (COMM + "GnssPVTSolnMsg", {}, 2),
        (SPAN + "BESTPOS", {"position_type": 16}, 0), (SPAN + "INSPVAX", {"position_type": 54}, 1), (SPAN + "BESTPOS", {}, 2),
        (SWRI + "Inspvax", {"position_type": "INS_PSRSP"}, 0), (SWRI + "NovatelPosition", {"position_type": "WAAS"}, 1), (SWRI + "Inspvax", {}, 2),
        (KAIST + "vrs", {"fix_state": 1}, 0), (KAIST + "vrs", {"fix_state": 2}, 1), (KAIST + "vrs", {}, 2),
        (PX4 + "SensorGps", {"fix_type": 3}, 0), (PX4 + "SensorGps", {"fix_type": 4}, 1), (PX4 + "SensorGps", {}, 2),
    ],
)  # fmt: skip
def test_its_solution_has_the_status_of_a_navsatfix(msgtype: str, changed: dict[str, Any], status: int) -> None:
    for k, wanted in enumerate(("fix", "sbas", "gbas")):
        found = read("gnss", msgtype, PLACES[msgtype] | changed, min_status=wanted)
        assert isinstance(found, GnssPosition) == (status >= k)


@pytest.mark.parametrize("kind", ["gnss", "gnss_velocity", "compass"])
def test_ros_1_names_the_fields_of_ublox_otherwise(kind: str) -> None:
    msgtype = UBX + ("NavRELPOSNED9" if kind == "compass" else "NavPVT")
    fields = {"gnss": PLACES[UBX + "NavPVT"], "gnss_velocity": VELOCITIES[UBX + "NavPVT"][0], "compass": HEADINGS[UBX + "NavRELPOSNED9"][0]}  # fmt: skip
    one, two = (read(kind, msgtype, fields[kind], make=Messages(ros)) for ros in (1, 2))
    assert type(one) is type(two)
    assert repr(one) == repr(two)


def test_older_messages_of_sbg_hold_a_vector() -> None:
    """Latitude, longitude, height; velocities have shorter names since."""
    place = SimpleNamespace(
        status=SimpleNamespace(status=0, type=2), position=vector(57.5, -11.25, 6.5), undulation=35.0, position_accuracy=vector(1, 1, 1)
    )  # fmt: skip
    found = DECODERS["gnss", SBG + "SbgGpsPos"](place, START_NS, 0, "it", GnssConfig())
    assert isinstance(found, GnssPosition)
    assert found.position == pytest.approx((57.5, -11.25, 41.5))
    new = SimpleNamespace(status=SimpleNamespace(vel_status=0, vel_type=2), velocity=vector(1, 2, 3), velocity_accuracy=vector(1, 1, 1))  # fmt: skip
    moving = DECODERS["gnss_velocity", SBG + "SbgGpsVel"](new, START_NS, 0, "it", VelocityConfig())
    assert isinstance(moving, GnssVelocity)


def utc_ns(text: str) -> int:
    return round(datetime.fromisoformat(f"{text}+00:00").timestamp()) * S


def of_gps(utc: int, leap_s: int) -> int:
    """Milliseconds since the last midnight of a Saturday in GPS time."""
    return round(((utc - utc_ns("1980-01-06")) / S + leap_s) % 604_800 * 1000)


@pytest.mark.parametrize(
    ("at", "leap_s", "late_s"),
    [
        (utc_ns("2024-05-08T12:00:01"), 18, 0.1),
        (utc_ns("2016-03-01T07:30:00"), 17, 0.1),
        (utc_ns("2024-05-11T23:59:50"), 18, 15.0),  # of a new week already, and recorded in it
        (utc_ns("2024-05-11T23:59:30"), 18, 40.0),  # of the old week, recorded in the new one
    ],
)
def test_a_time_of_week_is_a_date_by_the_recording_time(at: int, leap_s: int, late_s: float) -> None:
    msg = said(ROS2, UBX + "NavRELPOSNED9", i_tow=of_gps(at, leap_s))
    assert stamp_ns_of(msg, UBX + "NavRELPOSNED9", at + round(late_s * S)) == at


@pytest.mark.parametrize("log_ns", [START_NS, 40 * S], ids=["played again later", "no clock of the computer"])
def test_a_gps_week_is_a_date_by_itself(log_ns: int) -> None:
    """Week 2106 began at 2020-05-17 in GPS time; of week 0, as of a receiver without a clock, the recording time is all there is."""
    at = utc_ns("2020-05-19T03:04:05") + S // 4
    weeks_ms = 2 * 86_400_000 + of_gps(utc_ns("1980-01-06T03:04:05"), 18) + 250
    pvt, pos, vel = COMM + "GnssPVTSolnMsg", SPAN + "BESTPOS", SPAN + "BESTVEL"
    assert stamp_ns_of(said(ROS2, pvt, time={"week": 2106, "tow": weeks_ms / 1000.0}), pvt, log_ns) == at
    header = {"gps_week": 2106, "gps_week_seconds": weeks_ms}
    assert stamp_ns_of(said(ROS2, pos, header=header), pos, log_ns) == at
    assert stamp_ns_of(said(ROS2, vel, header=header, latency=0.25), vel, log_ns) == at - S // 4
    nothing = stamp_ns_of(said(ROS2, pos, header={"gps_week": 0, "gps_week_seconds": weeks_ms}), pos, log_ns)
    assert nothing is not None
    assert abs(nothing - log_ns) <= 302_400 * S


def test_without_a_date_the_recording_time_is_taken() -> None:
    boot = 40 * S
    for valid, log_ns in ((7, boot), (1, START_NS)):  # no clock of the computer; none of the receiver
        msg = said(ROS2, UBX + "NavPVT", i_tow=1000, valid=valid)
        assert stamp_ns_of(msg, UBX + "NavPVT", log_ns) == log_ns


def test_stamps_of_px4_are_when_it_was_sampled_and_those_of_bestvel_lack_its_age() -> None:
    gps, imu = PX4 + "SensorGps", PX4 + "SensorCombined"
    assert stamp_ns_of(said(ROS2, gps, timestamp=5_000_000, timestamp_sample=4_900_000), gps, 7) == 4_900_000_000
    assert stamp_ns_of(said(ROS2, gps, timestamp=5_000_000), gps, 7) == 5 * S
    for none in (0, 2**63):
        assert stamp_ns_of(said(ROS2, imu, timestamp=none), imu, 7) is None
    vel = said(ROS2, OEM7 + "BESTVEL", header=ROS2.header(START_NS), latency=0.25)
    assert stamp_ns_of(vel, OEM7 + "BESTVEL", 7) == START_NS - S // 4
    assert stamp_ns_of(vel, OEM7 + "BESTVEL", 7, recorded=True) == 7
    vel = said(ROS2, SWRI + "NovatelVelocity", header=ROS2.header(START_NS), latency=0.25)
    assert stamp_ns_of(vel, SWRI + "NovatelVelocity", 7) == START_NS - S // 4


def test_a_flag_that_older_versions_lack_changes_nothing() -> None:
    """What follows a bag's flags of the IMU lies where it would lie with one more."""
    new = VENDOR_TYPES[SBG + "SbgImuData"][0]
    old = new.replace("bool imu_gyros_use_high_scale\n", "")
    assert old != new
    for frame in ("", "a", "abcd", "imu_link"):
        make = Messages(2)
        make.register(old, SBG + "SbgImuData")
        fields = {
            "imu_status": {"imu_com": True, "imu_status": True},
            "accel": vector(1, 2, 3),
            "gyro": vector(4, 5, 6),
        }
        msg = said(make, SBG + "SbgImuData", header=make.header(START_NS, frame), **fields)
        raw = bytes(make.store.serialize_cdr(msg, SBG + "SbgImuData"))
        back: Any = MessageTypes("bag", [], [], ros1=False).decode(raw, SBG + "SbgImuData")
        assert (back.accel.x, back.accel.z, back.gyro.x, back.gyro.z) == (1.0, 3.0, 4.0, 6.0)


VERSIONS = [(t, k) for t, versions in VENDOR_TYPES.items() for k in range(len(versions)) if len(versions) > 1]


@pytest.mark.parametrize(("msgtype", "version"), VERSIONS)
def test_a_bag_without_definitions_is_read_in_each_version(msgtype: str, version: int) -> None:
    """ROS 2 Humble writes none into sqlite3."""
    make = Messages(2)
    fields = {
        "SbgGpsPos": PLACES[SBG + "SbgGpsPos"], "SensorGps": PLACES[PX4 + "SensorGps"] | {"heading": 0.5}, "SbgGpsHdt": {"true_heading": 300.0},
        "Inspvax": PLACES[SWRI + "Inspvax"], "SensorCombined": {"accelerometer_m_s2": (1, 2, 3)}, "SbgEkfEuler": {"angle": vector(0, 0, 1)},
        "DVL": {"velocity": vector(1, 2, 3), "fom": 0.25, "velocity_valid": True, "altitude": -1.0, "beams": [{"id": k} for k in range(4)], "form": "json_v3"},
    }.get(msgtype.split("/")[-1], {})  # fmt: skip
    if "int32 lat\n" in VENDOR_TYPES[msgtype][version] and fields:
        fields = PLACES[PX4 + "VehicleGpsPosition"] | {"heading": 0.5}
    for frame in ("", "a", "abcd", "imu_link"):  # what follows is aligned by it
        header = {"header": make.header(START_NS, frame)} if "Header" in VENDOR_TYPES[msgtype][version] else {}
        msg = said(make, msgtype, version, **header, **fields)
        back = MessageTypes("bag", [], [], ros1=False).decode(bytes(make.store.serialize_cdr(msg, msgtype)), msgtype)
        for part in VENDORS[msgtype]:
            assert repr(part.read(back)) == repr(part.read(msg))


Say = Callable[[Messages, int, Any, Any, float], list[Item]]


def _sbg(make: Messages, at: int, fix: Any, v: Any, heading_deg: float, off_deg: float) -> list[Item]:
    header = make.header(at)
    sigmas = make.vector((0.02, 0.02, 0.04))
    pos = said(make, SBG + "SbgGpsPos", header=header, status={"type": 7}, latitude=fix.latitude, longitude=fix.longitude, altitude=fix.altitude, position_accuracy=sigmas)  # fmt: skip
    vel = said(make, SBG + "SbgGpsVel", header=header, status={"vel_type": 2}, vel=make.vector((v[1], v[0], -v[2])), vel_acc=sigmas)  # fmt: skip
    hdt = said(make, SBG + "SbgGpsHdt", header=header, true_heading=heading_deg, true_heading_acc=0.25)
    own = said(make, SBG + "SbgEkfEuler", header=header, status={"heading_valid": True}, angle=make.vector((0, 0, np.radians(heading_deg + off_deg * np.sin(at / S)))))  # fmt: skip
    return [("/sbg/gps_pos", at, pos), ("/sbg/gps_vel", at, vel), ("/sbg/gps_hdt", at, hdt), ("/ins/euler", at, own)]  # fmt: skip


def _px4(make: Messages, at: int, fix: Any, v: Any, heading_deg: float) -> list[Item]:
    gps = said(
        make, PX4 + "SensorGps", timestamp=at // 1000, fix_type=6, latitude_deg=fix.latitude, longitude_deg=fix.longitude,
        altitude_ellipsoid_m=fix.altitude, eph=0.02, epv=0.04, vel_ned_valid=True, vel_n_m_s=v[1], vel_e_m_s=v[0], vel_d_m_s=-v[2],
        heading=np.radians(heading_deg),
    )  # fmt: skip
    return [("/fmu/out/vehicle_gps_position", at, gps)]


def _novatel(make: Messages, at: int, fix: Any, v: Any, heading_deg: float) -> list[Item]:
    header = make.header(at)
    pos = said(make, OEM7 + "BESTPOS", header=header, pos_type={"type": 50}, lat=fix.latitude, lon=fix.longitude, hgt=fix.altitude, lat_stdev=0.02, lon_stdev=0.02, hgt_stdev=0.04)  # fmt: skip
    vel = said(make, OEM7 + "BESTVEL", header=header, vel_type={"type": 8}, hor_speed=float(np.hypot(v[0], v[1])), trk_gnd=np.degrees(np.arctan2(v[0], v[1])) % 360.0, ver_speed=v[2])  # fmt: skip
    heading = said(make, OEM7 + "HEADING2", header=header, pos_type={"type": 50}, heading=heading_deg, heading_stdev=0.25)  # fmt: skip
    return [("/oem7/bestpos", at, pos), ("/oem7/bestvel", at, vel), ("/oem7/heading2", at, heading)]


def _spoken(make: Messages, say: Say, *, beside: bool = False) -> list[Item]:
    """A drive whose receiver speaks a maker's messages; `beside`: and standard ones as well."""
    drawn = drive(make, seconds=60)
    fixes = [(at, m) for topic, at, m in drawn if topic == "/fix"]
    lla = np.array([(m.latitude, m.longitude, m.altitude) for _, m in fixes])
    scale = np.array([111_320.0 * np.cos(np.radians(lla[0, 0])), 111_320.0])
    v = np.column_stack([np.gradient(lla[:, [1, 0]], 0.2, axis=0) * scale, np.gradient(lla[:, 2], 0.2)])
    quaternions = [m.quaternion for topic, _, m in drawn if topic == "/compass"]  # about the down axis, from north
    heading = np.degrees([2.0 * np.arctan2(q.z, q.w) for q in quaternions])
    items = [item for item in drawn if item[0] == "/imu" or (beside and item[0] == "/fix")]
    for (at, fix), moving, angle in zip(fixes, v, heading, strict=True):
        items += say(make, at, fix, moving, float(angle % 360.0))
    return sorted(items, key=lambda item: item[1])


@pytest.mark.parametrize("off_deg", [1.0, 0.0], ids=["wanders", "says the same"])
def test_sbg_says_north_first_and_its_filter_is_no_second_compass(off_deg: float, tmp_path: Path) -> None:
    make = Messages(2)
    say: Say = partial(_sbg, off_deg=off_deg)
    found, config, _ = look(tmp_path, _spoken(make, say), make)
    assert [t.msgtype for t in found.topics if t.topic == "/sbg/gps_pos"] == [SBG + "SbgGpsPos"]
    assert not found.gnss[0].slow_error  # RTK
    (velocity,) = config.of_kind("gnss_velocity").values()
    assert (velocity.convention, velocity.enabled) == ("ned", True)
    used = {c.topic: c for c in config.of_kind("compass").values() if c.enabled}
    assert list(used) == ["/sbg/gps_hdt"]
    assert used["/sbg/gps_hdt"].convention == "ned"
    assert used["/sbg/gps_hdt"].deviation_sigma_deg == 0.0
    recording = read_recording(tmp_path / "run", config)
    kinds = [type(m) for m in recording.measurements]
    assert {kind: kinds.count(kind) for kind in set(kinds)} == dict.fromkeys((GnssPosition, GnssVelocity, CompassHeading), 300)  # fmt: skip


def test_one_message_of_px4_is_three_sensors(tmp_path: Path) -> None:
    make = Messages(2)
    _, config, _ = look(tmp_path, _spoken(make, _px4), make)
    topics = {name: sensor.topic for name, sensor in config.sensors.items() if sensor.enabled and sensor.topic != "/imu"}  # fmt: skip
    assert topics == dict.fromkeys(("gnss", "compass", "gnss_velocity"), "/fmu/out/vehicle_gps_position")
    recording = read_recording(tmp_path / "run", config)
    p = [m.v_enu_mps for m in recording.measurements if isinstance(m, GnssVelocity)]
    assert len(p) == 300


def test_a_px4_without_a_heading_drafts_no_compass(tmp_path: Path) -> None:
    make = Messages(2)
    silent: Say = lambda make, at, fix, v, _: _px4(make, at, fix, v, float("nan"))
    found, config, text = look(tmp_path, _spoken(make, silent), make)
    assert not found.compasses
    assert not config.of_kind("compass")
    assert "left out" not in text


def test_a_receiver_that_says_it_twice_counts_once_and_axes_are_known(tmp_path: Path) -> None:
    make = Messages(2)
    found, config, _ = look(tmp_path, _spoken(make, _novatel, beside=True), make)
    assert sorted(g.topic for g in found.gnss) == ["/fix", "/oem7/bestpos"]
    assert sum(sensor.enabled for sensor in config.of_kind("gnss").values()) == 1
    (compass,) = config.of_kind("compass").values()
    assert (compass.topic, compass.enabled, compass.convention) == ("/oem7/heading2", True, "enu")
    assert compass.deviation_sigma_deg == 0.0  # two antennas, though its topic does not say so
    assert "known by its type" in found.compasses[0].why


@pytest.mark.parametrize(("msgtype", "axes"), [(OEM7 + "BESTVEL", EAST_AXES), (SBG + "SbgGpsVel", NORTH_AXES)])
def test_without_a_track_a_velocity_has_the_axes_of_its_type(msgtype: str, axes: str) -> None:
    """And no other: what looks like speeds along the vessel is one over ground all the same."""
    stream = TopicData("/vel", TWIST, part=VENDORS[msgtype][0])
    assert velocity_report(stream, NO_TRACK, None).axes == axes


@pytest.mark.parametrize(
    ("msgtype", "convention"), [(SBG + "SbgGpsHdt", "ned"), (SBF + "AttEuler", "enu"), (OEM7 + "HEADING2", "enu")]
)
def test_at_rest_a_heading_has_the_convention_that_its_driver_comes_with(msgtype: str, convention: str) -> None:
    """Septentrio's, unlike SBG's, comes set to east, counter-clockwise (`use_ros_axis_orientation`)."""
    stream = TopicData("/heading", QUATERNION, part=VENDORS[msgtype][0])
    for k in range(30):
        stream.add(START_NS + k * S, START_NS + k * S, (0.0, 0.0, 0.5, 0.75**0.5), "bag")
    found = compass_report(stream, None, None)
    assert found is not None
    assert (found.usable, found.convention) == (True, convention)


@pytest.mark.parametrize("baseline_deg", [0.0, 90.0])
@pytest.mark.parametrize("course_deg", [20.0, 45.0, 90.0, 200.0])
@pytest.mark.parametrize(("msgtype", "convention"), [(SBG + "SbgGpsHdt", "ned"), (SBF + "AttEuler", "enu")])
def test_on_a_straight_antennas_are_along_or_athwart(
    msgtype: str, convention: str, course_deg: float, baseline_deg: float
) -> None:
    """Of athwart ones the smaller offset is that of the wrong convention: 40 rather than 90 deg on a course of 20 deg."""
    heading = np.radians(course_deg + baseline_deg)
    stream = TopicData("/heading", QUATERNION, part=VENDORS[msgtype][0])
    for k in range(200):
        angle = heading + 0.02 * np.sin(k)
        half = 0.5 * (angle if convention == "ned" else np.pi / 2.0 - angle)
        stream.add(START_NS + k * S // 5, START_NS + k * S // 5, (0.0, 0.0, np.sin(half), np.cos(half)), "bag")
    course = np.full(200, np.radians(90.0 - course_deg)) + 0.02 * np.cos(np.arange(200))
    found = compass_report(stream, Courses(stream.stamps_ns, course), None)
    assert found is not None
    assert found.convention == convention
    assert found.offset_deg == pytest.approx(-baseline_deg, abs=2.0)


@pytest.mark.parametrize(("kind", "value"), [("string", "x"), ("float64[]", np.ones(2))])
def test_fields_of_other_types_are_no_crash(kind: str, value: Any, tmp_path: Path) -> None:
    """A fork may call its messages the same; a bag that defines them is read as it says."""
    make = Messages(2)
    items: list[Item] = [("/imu", START_NS, make.imu(START_NS))]
    sensors: dict[str, Any] = {"imu": ImuConfig(topic="/imu")}
    ways = (UBX + "NavPVT", OEM7 + "BESTPOS", OEM7 + "BESTVEL", PX4 + "SensorGps")  # of each way to a stamp
    for msgtype in (*ways, OEM7 + "INSPVAX", SBF + "INSNavGeod", GEO + "GeoPoseWithCovarianceStamped"):
        fields = r"(?m)^(?:u?int\d+|float\d+|bool|string)(?:\[\d+\])? (\w+)$"
        make.register(re.sub(fields, rf"{kind} \1", VENDOR_TYPES[msgtype][0]), msgtype)
        items.append((f"/{msgtype}", START_NS, _of_other_fields(make, msgtype, value)))
        own = {
            f"{msgtype} {part.kind}": CONFIGS[part.kind].model_copy(update={"topic": f"/{msgtype}"})
            for part in VENDORS[msgtype]
        }
        sensors |= own
    path = write_bag(tmp_path / "run", make, items, "mcap")
    assert inspect_bag(path)
    recording = read_recording(path, VesselConfig(sensors=sensors))
    unread = {row.sensor: row.outcome for row in recording.rows}
    assert set(unread) >= set(sensors) - {"imu"}
    assert set(unread.values()) <= {Outcome.MALFORMED, Outcome.REJECTED, Outcome.IGNORED}
    assert not recording.measurements


def _of_other_fields(make: Messages, msgtype: str, value: Any) -> Any:
    """Return a message with one value in all fields that are no standard messages."""
    if msgtype == "std_msgs/msg/Header":
        return make.header(START_NS)
    if msgtype.startswith("geometry_msgs"):
        return make.t[msgtype](*[np.nan] * len(make.store.fielddefs[msgtype][1]))
    named = ((name, str(kinds), node) for name, (node, kinds) in make.store.fielddefs[msgtype][1])
    return make.t[msgtype](
        **{
            name: _of_other_fields(make, kinds, value) if node == Nodetype.NAME else value
            for name, kinds, node in named
        }
    )


def test_a_message_of_another_version_is_malformed_and_no_crash() -> None:
    """A field is missing: the type is called the same in another package's fork."""
    found = DECODERS["gnss_velocity", SBG + "SbgGpsVel"]
    with pytest.raises(AttributeError, match="another version"):
        found(SimpleNamespace(status=SimpleNamespace(vel_status=0, vel_type=1)), START_NS, 0, "it", VelocityConfig())
    assert stamp_ns_of(SimpleNamespace(), UBX + "NavPVT", 7) is None
    letters, header = np.zeros(4, dtype=np.uint8), SimpleNamespace(week=2106, gpssec=1000)
    older = SimpleNamespace(header=header, status=letters, pos_type=letters, latitude=57.5, longitude=-11.25, velx=1.0)
    for part in VENDORS[SPAN + "INSPVAX"]:
        with pytest.raises(
            TypeError, match="ins_status or status or insstatus is no number: the message is of another version"
        ):
            part.read(older)
    assert stamp_ns_of(older, SPAN + "INSPVAX", START_NS) == utc_ns("2020-05-16T23:59:43")


def test_inspect_names_the_type_whose_definition_is_another_one(tmp_path: Path) -> None:
    """A fork calls the velocities otherwise; and a message that was cut short. It was said that they 'cannot be decoded', and no more."""
    make, msgtype = Messages(2), OEM7 + "BESTVEL"
    fork = "std_msgs/Header header\nint32 sol_status\nint32 vel_type\nfloat64 hor_speed_kmh\nfloat64 trk_gnd\nfloat64 ver_speed\n"
    make.store.register(get_types_from_msg(fork, msgtype))
    items: list[Item] = []
    for k in range(20):
        at = START_NS + k * S // 10
        msg = make.t[msgtype](
            header=make.header(at), sol_status=0, vel_type=8, hor_speed_kmh=3.6, trk_gnd=0.0, ver_speed=0.0
        )
        items.append(("/bestvel", at, msg))
    found = inspect_bag(write_bag(tmp_path / "run", make, items, "mcap"))
    (line,) = (line for line in render(found).splitlines() if "cannot be decoded" in line)
    assert line.startswith(
        f"/bestvel: 20 messages cannot be decoded as {msgtype} (by its definition in the bag it is another version"
    )
    assert "hor_speed or hor_spd or horizontal_speed" in line


def test_an_inspva_is_a_place_above_the_ellipsoid_without_an_accuracy() -> None:
    found = read("gnss", SPAN + "INSPVA", {"insstatus": 3, "latitude": 57.5, "longitude": -11.25, "altitude": 41.5})
    assert found.position == pytest.approx((57.5, -11.25, 41.5))
    assert np.sqrt(np.diagonal(found.cov_enu_m2)) == pytest.approx([1.5, 1.5, 4.0])


def test_a_point_is_a_place_without_an_accuracy() -> None:
    place = {"latitude": 57.5, "longitude": -11.25, "altitude": 41.5}
    found = read("gnss", GEO + "GeoPointStamped", {"position": place})
    assert found.position == pytest.approx((57.5, -11.25, 41.5))
    assert np.sqrt(np.diagonal(found.cov_enu_m2)) == pytest.approx([1.5, 1.5, 4.0])
    assert not read("gnss", GEO + "GeoPointStamped", {"position": place | {"altitude": np.nan}}).has_height
    assert read("gnss", GEO + "GeoPoseStamped", {"pose": {"position": place}}).position == found.position


def _span(make: Messages, at: int, fix: Any, v: Any, heading_deg: float, ins: bool, gnss_only: bool) -> list[Item]:
    """NovAtel's receiver with an IMU: its best place is that of its filter, once it has settled."""
    header = make.header(at)
    place = {"header": header, "lat": fix.latitude, "lon": fix.longitude, "hgt": fix.altitude, "lat_stdev": 0.02, "lon_stdev": 0.02, "hgt_stdev": 0.04}  # fmt: skip
    settled = ins and at > START_NS + 20 * S
    track = {
        "hor_speed": float(np.hypot(v[0], v[1])),
        "trk_gnd": np.degrees(np.arctan2(v[0], v[1])) % 360.0,
        "ver_speed": v[2],
    }
    items = [
        ("/oem7/bestpos", at, said(make, OEM7 + "BESTPOS", pos_type={"type": 56 if settled else 50}, **place)),
        (
            "/oem7/bestvel",
            at,
            said(make, OEM7 + "BESTVEL", header=header, vel_type={"type": 56 if settled else 8}, **track),
        ),
    ]
    if ins:
        values: dict[str, Any] = {"latitude": fix.latitude, "longitude": fix.longitude, "height": fix.altitude, "north_velocity": v[1], "east_velocity": v[0], "up_velocity": v[2], "azimuth": heading_deg}  # fmt: skip
        state: dict[str, Any] = {
            "ins_status": {"status": 3 if settled else 1},
            "pos_type": {"type": 56},
            "azimuth_stdev": 0.1,
        }
        items.append(("/oem7/inspvax", at, said(make, OEM7 + "INSPVAX", header=header, **values, **state)))
    if gnss_only:
        items.append(("/oem7/bestgnsspos", at, said(make, OEM7 + "BESTGNSSPOS", pos_type={"type": 50}, **place)))
    return items


@pytest.mark.parametrize("ins", [True, False])
def test_a_filters_place_stands_behind_a_receivers(ins: bool, tmp_path: Path) -> None:
    """Whatever the name of its topic; by the type of its solution, BESTPOS is one or the other."""
    make = Messages(2)
    found, config, text = look(tmp_path, _spoken(make, partial(_span, ins=ins, gnss_only=True)), make)
    (gnss,) = config.of_kind("gnss").values()
    assert gnss.topic == ("/oem7/bestgnsspos" if ins else gnss.topic)
    of_a_filter = " (of a filter)" if ins else ""
    assert {g.topic for g in found.gnss} >= {"/oem7/bestgnsspos", f"/oem7/bestpos{of_a_filter}"}
    assert [v.topic for v in found.velocities if "bestvel" in v.topic] == [f"/oem7/bestvel{of_a_filter}"]
    topics = {sensor.topic for sensor in config.sensors.values()}
    assert topics >= {"/oem7/bestpos", "/oem7/bestgnsspos", "/oem7/bestvel"} | ({"/oem7/inspvax"} if ins else set())
    assert ("by its name, or its messages, a filter's output" in text) == ins


def _urban(make: Messages, at: int, fix: Any, v: Any, heading_deg: float, ahead_s: int) -> list[Item]:
    """A car with a receiver, and an inertial system as its reference; the computer's clock is ahead of UTC."""
    since_ms = (at - ahead_s * S - utc_ns("1980-01-06")) // 1_000_000 + 18_000
    week, tow_ms = divmod(since_ms, 604_800_000)
    pvt = said(
        make, COMM + "GnssPVTSolnMsg", time={"week": week, "tow": tow_ms / 1000.0}, fix_type=3, valid_fix=True, latitude=fix.latitude,
        longitude=fix.longitude, altitude=fix.altitude, h_acc=1.2, v_acc=2.0, vel_n=v[1], vel_e=v[0], vel_d=-v[2], vel_acc=0.25,
    )  # fmt: skip
    header = {"gps_week": week, "gps_week_seconds": tow_ms}
    place = {"position_type": 56, "latitude": fix.latitude, "longitude": fix.longitude, "altitude": fix.altitude, "latitude_std": 0.02, "longitude_std": 0.02, "altitude_std": 0.04}  # fmt: skip
    ins = said(
        make, SPAN + "INSPVAX", header=header, ins_status=3, north_velocity=v[1], east_velocity=v[0], up_velocity=v[2],
        azimuth=heading_deg, azimuth_std=0.1, **place,
    )  # fmt: skip
    best = said(make, SPAN + "BESTPOS", header=header, **place)
    return [
        ("/ublox_driver/receiver_pvt", at, pvt),
        ("/novatel_data/inspvax", at, ins),
        ("/novatel_data/bestpos", at, best),
    ]


@pytest.mark.parametrize("ahead_s", [0, 18])
def test_of_a_car_its_receiver_is_used_and_the_inertial_system_is_named_a_filter(ahead_s: int, tmp_path: Path) -> None:
    make = Messages(1)
    path = write_bag(tmp_path / "run.bag", make, _spoken(make, partial(_urban, ahead_s=ahead_s)), "ros1")
    found = inspect_bag(path)
    text = draft_config(found)
    (tmp_path / "vessel.yaml").write_text(text)
    config = load_config(tmp_path / "vessel.yaml", KINDS)
    used = {(sensor.kind, sensor.topic) for sensor in config.sensors.values() if sensor.enabled}
    assert used == {
        ("imu", "/imu"), ("gnss", "/ublox_driver/receiver_pvt"), ("gnss_velocity", "/ublox_driver/receiver_pvt"),
        ("compass", "/novatel_data/inspvax"),
    }  # fmt: skip
    assert text.count("by its name, or its messages, a filter's output") == 4  # two places, a velocity, a heading
    assert "enabled: false where it is a reference to compare with" in text
    assert "quality" not in text + render(found)  # of NMEA
    offsets = [s.time_offset_s for s in config.sensors.values() if s.kind not in ("imu", "height")]
    assert offsets == pytest.approx([float(ahead_s)] * len(offsets), abs=0.1)
    assert ("18.0 s behind the IMU's, by the recording times: the IMU's is GPS time" in render(found)) == (ahead_s > 0)
    recording = read_recording(path, config)
    kinds = [type(m) for m in recording.measurements]
    assert [kinds.count(kind) for kind in (GnssPosition, GnssVelocity, CompassHeading)] == [300] * 3
    imu = recording.imu
    assert imu is not None
    assert abs(recording.measurements[0].stamp_ns - int(imu.stamps_ns[0])) < 0.1 * S


def test_a_filters_place_alone_is_used_and_says_so(tmp_path: Path) -> None:
    make = Messages(2)
    found, config, text = look(tmp_path, _spoken(make, partial(_span, ins=True, gnss_only=False)), make)
    (gnss,) = config.of_kind("gnss").values()
    assert gnss.topic in ("/oem7/bestpos", "/oem7/inspvax")
    assert {t.topic: t.msgtype for t in found.topics}["/oem7/inspvax"] == OEM7 + "INSPVAX"
    assert all(t.rate_hz for t in found.topics)
    assert f"  topic: {gnss.topic}\n    # guess: by its name, or its messages, a filter's output" in text
    (compass,) = (c for c in config.sensors.values() if c.kind == "compass")
    assert isinstance(compass, CompassConfig)
    assert not compass.use_reported_sigma


def test_one_message_of_a_filter_without_a_stamp_is_no_crash(tmp_path: Path) -> None:
    """Nothing is left of its stream, which is no filter's then."""
    make = Messages(2)
    values: dict[str, Any] = {
        "ins_status": {"status": 3},
        "pos_type": {"type": 56},
        "latitude": 58.0,
        "longitude": 11.0,
    }
    item = ("/ins", START_NS, said(make, OEM7 + "INSPVAX", header=make.header(0), **values))
    found = inspect_bag(write_bag(tmp_path / "run", make, [item], "mcap"))
    assert {t.topic for t in found.topics} == {"/ins", "/ins (heading)"}


@pytest.mark.parametrize("beside", [True, False])
def test_a_geographic_pose_is_a_place_and_a_heading_of_a_filter(beside: bool, tmp_path: Path) -> None:
    def say(make: Messages, at: int, fix: Any, _v: Any, heading_deg: float) -> list[Item]:
        turned = make.quat(Rotation.from_euler("z", 90.0 - heading_deg, degrees=True).as_quat().tolist())
        place = {"latitude": fix.latitude, "longitude": fix.longitude, "altitude": fix.altitude}
        pose = said(make, GEO + "GeoPoseStamped", header=make.header(at), pose={"position": place, "orientation": turned})  # fmt: skip
        far = {"position": {"latitude": 58.0, "longitude": 11.0}}
        return [("/gtsam/geopose", at, pose), ("/setpoint/global", at, said(make, GEO + "GeoPoseStamped", header=make.header(at), pose=far))]  # fmt: skip

    make = Messages(2)
    _, config, text = look(tmp_path, _spoken(make, say, beside=beside), make)
    (gnss,) = config.of_kind("gnss").values()
    assert gnss.topic == ("/fix" if beside else "/gtsam/geopose")
    (compass,) = config.of_kind("compass").values()
    assert (compass.topic, compass.convention, compass.use_reported_sigma) == ("/gtsam/geopose", "enu", False)
    assert "setpoint" not in text
