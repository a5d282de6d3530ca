# SPDX-License-Identifier: Apache-2.0
"""Decoders: frames, units and uncertainty of each message, worked out by hand."""

from typing import Any

import numpy as np
import pytest

from graphloc.config import CompassConfig, GnssConfig, ImuConfig, PoseConfig, VelocityConfig
from graphloc.frontends._rejections import Rejection
from graphloc.frontends._standard import covariance_translation_first
from graphloc.frontends.decode import DECODERS, ImuReading, usable_covariance
from graphloc.ledger import Outcome
from graphloc.measurements import CompassHeading, GnssPosition, GnssVelocity, PoseFix
from tests.bagfactory import START_NS, Messages

MAKE = Messages(2)
T = START_NS + 7


def decode(msg: Any, config: Any) -> Any:
    return DECODERS[(config.kind, msg.__msgtype__)](msg, T, 5, "sensor", config)


def refused(msg: Any, config: Any, outcome: Outcome, words: str) -> None:
    result = decode(msg, config)
    assert isinstance(result, Rejection)
    assert result.outcome is outcome
    assert words in result.reason


def yaw_quaternion(degrees: float) -> tuple[float, float, float, float]:
    half = np.radians(degrees) / 2.0
    return (0.0, 0.0, float(np.sin(half)), float(np.cos(half)))


def test_imu_units() -> None:
    sample = decode(MAKE.imu(T, accel=(0, 0.5, 1), gyro=(90, 0, 0)), ImuConfig(accel_unit="g", gyro_unit="deg/s"))
    assert isinstance(sample, ImuReading)
    np.testing.assert_allclose(sample.accel_mps2, [0, 4.903325, 9.80665])
    np.testing.assert_allclose(sample.gyro_radps, [1.5707963267948966, 0, 0])


@pytest.mark.parametrize("where", ["accel", "gyro"])
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_imu_not_finite(where: str, bad: float) -> None:
    values = {"accel": (0.0, 0.0, 9.8), "gyro": (0.0, 0.0, 0.0), where: (0.0, bad, 0.0)}
    refused(MAKE.imu(T, accel=values["accel"], gyro=values["gyro"]), ImuConfig(), Outcome.MALFORMED, "NaN")


def test_fix_with_full_and_diagonal_covariance() -> None:
    full = (2.0, 0.5, 0.1, 0.5, 3.0, 0.2, 0.1, 0.2, 4.0)
    known = decode(MAKE.fix(T, covariance=full, covariance_type=3), GnssConfig())
    assert isinstance(known, GnssPosition)
    assert (known.stamp_ns, known.seq, known.sensor) == (T, 5, "sensor")
    np.testing.assert_allclose(known.cov_enu_m2, np.array(full).reshape(3, 3))
    diagonal = decode(MAKE.fix(T, covariance=full, covariance_type=2), GnssConfig())
    np.testing.assert_allclose(diagonal.cov_enu_m2, np.diag([2.0, 3.0, 4.0]))


@pytest.mark.parametrize(
    ("covariance", "kind", "expected"),
    [
        (np.diag([9.0, 9.0, 9.0]), 0, [2.25, 2.25, 16.0]),  # unknown: 1.5 m and 4 m, whatever stands there
        (np.zeros((3, 3)), 2, [2.25, 2.25, 16.0]),
        (np.full((3, 3), np.nan), 3, [2.25, 2.25, 16.0]),
        (np.diag([1.0, 1.0, -1.0]), 2, [1.0, 1.0, 16.0]),
        (np.array([[1.0, 5.0, 0.0], [5.0, 1.0, 0.0], [0.0, 0.0, 1.0]]), 3, [1.0, 1.0, 1.0]),  # not definite
    ],
)
def test_fix_without_usable_covariance(covariance: Any, kind: int, expected: list[float]) -> None:
    fix = decode(MAKE.fix(T, covariance=covariance.ravel(), covariance_type=kind), GnssConfig())
    np.testing.assert_allclose(fix.cov_enu_m2, np.diag(expected))


def test_fixes_that_are_none() -> None:
    refused(MAKE.fix(T, status=-1), GnssConfig(), Outcome.REJECTED, "STATUS_NO_FIX")
    refused(MAKE.fix(T, status=0), GnssConfig(min_status="sbas"), Outcome.REJECTED, "min_status")
    used = decode(MAKE.fix(T, status=-1), GnssConfig(min_status="any"))
    assert used.position == decode(MAKE.fix(T), GnssConfig()).position
    refused(MAKE.fix(T, lat=0, lon=0, status=-1), GnssConfig(min_status="any"), Outcome.REJECTED, "0, 0")
    refused(MAKE.fix(T, lat=0, lon=0), GnssConfig(), Outcome.REJECTED, "0, 0")
    refused(MAKE.fix(T, height=np.inf), GnssConfig(), Outcome.MALFORMED, "height is beyond")
    refused(MAKE.fix(T, lon=np.nan), GnssConfig(), Outcome.MALFORMED, "longitude is NaN")
    refused(MAKE.fix(T, lat=151.2, lon=-33.9), GnssConfig(), Outcome.MALFORMED, "swapped")
    refused(MAKE.fix(T, lon=500.0), GnssConfig(), Outcome.MALFORMED, "longitude")
    assert isinstance(decode(MAKE.fix(T, status=2), GnssConfig(min_status="gbas")), GnssPosition)


def test_a_status_that_the_driver_leaves_out_is_a_fix() -> None:
    """-2 in ROS 2 Jazzy, where it is the default: all fixes of such a driver were rejected as none."""
    assert isinstance(decode(MAKE.fix(T, status=-2), GnssConfig()), GnssPosition)
    refused(MAKE.fix(T, status=-2), GnssConfig(min_status="sbas"), Outcome.REJECTED, "min_status")
    refused(MAKE.fix(T, lat=np.nan, status=-2), GnssConfig(), Outcome.MALFORMED, "NaN")
    refused(MAKE.fix(T, lat=0, lon=0, status=-2), GnssConfig(), Outcome.REJECTED, "0, 0")


@pytest.mark.parametrize(
    ("convention", "in_message_deg", "yaw_deg"),
    [("enu", 30.0, 30.0), ("ned", 0.0, 90.0), ("ned", 90.0, 0.0), ("ned", 45.0, 45.0), ("ned", -100.0, -170.0)],
)
def test_compass_conventions(convention: Any, in_message_deg: float, yaw_deg: float) -> None:
    """North is 90 deg from east; heading 90 (east) is yaw 0; heading -100 is 190 from east, so -170."""
    heading = decode(MAKE.compass(T, yaw_quaternion(in_message_deg)), CompassConfig(convention=convention))
    assert isinstance(heading, CompassHeading)
    assert np.degrees(heading.yaw_rad) == pytest.approx(yaw_deg)
    assert np.degrees(heading.sigma_rad) == pytest.approx(1.5)


def test_compass_with_roll_and_pitch_keeps_the_direction_of_x() -> None:
    """Quaternion of Rz(70 deg) Ry(10 deg) Rx(20 deg), from half angles."""
    (cr, sr), (cp, sp), (cy, sy) = ((np.cos(a), np.sin(a)) for a in np.radians([10.0, 5.0, 35.0]))
    q = (
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )
    assert np.degrees(decode(MAKE.compass(T, q), CompassConfig()).yaw_rad) == pytest.approx(70.0)


def test_compass_with_unknown_roll_and_pitch() -> None:
    nan = float("nan")
    _, _, z, w = yaw_quaternion(-120.0)
    assert np.degrees(decode(MAKE.compass(T, (nan, nan, z, w)), CompassConfig()).yaw_rad) == pytest.approx(-120.0)
    refused(MAKE.compass(T, (nan, nan, nan, nan)), CompassConfig(), Outcome.MALFORMED, "NaN")
    refused(MAKE.compass(T, (0, 0, 0, 0)), CompassConfig(), Outcome.MALFORMED, "unit quaternion")
    up = (0.0, -np.sqrt(0.5), 0.0, np.sqrt(0.5))  # pitched up by 90 deg
    refused(MAKE.compass(T, up), CompassConfig(), Outcome.REJECTED, "up or down")


def test_orientation_of_an_imu_as_compass() -> None:
    cov = np.diag([1.0, 1.0, 0.01]).ravel()
    msg = MAKE.imu(T, orientation=yaw_quaternion(12.0), orientation_covariance=cov)
    assert decode(msg, CompassConfig()).sigma_rad == pytest.approx(0.1)
    assert np.degrees(decode(msg, CompassConfig(use_reported_sigma=False)).sigma_rad) == pytest.approx(1.5)
    zero = MAKE.imu(T, orientation=yaw_quaternion(12.0), orientation_covariance=np.zeros(9))
    assert np.degrees(decode(zero, CompassConfig()).sigma_rad) == pytest.approx(1.5)
    refused(MAKE.imu(T), CompassConfig(), Outcome.REJECTED, "absent")


def test_velocity() -> None:
    cov = np.diag([0.04, 0.09, 0.16, 1.0, 1.0, 1.0])
    v = decode(MAKE.twist(T, (1, 2, 3), cov), VelocityConfig())
    assert isinstance(v, GnssVelocity)
    np.testing.assert_allclose(v.v_enu_mps, [1, 2, 3])
    np.testing.assert_allclose(v.cov_m2ps2, np.diag([0.04, 0.09, 0.16]))
    np.testing.assert_allclose(decode(MAKE.twist(T, (1, 2, 3)), VelocityConfig()).cov_m2ps2, 0.09 * np.eye(3))
    refused(MAKE.twist(T, (np.nan, 0, 0)), VelocityConfig(), Outcome.MALFORMED, "NaN")
    # What a Doppler log writes without a lock is a speed to a receiver: that of a car.
    np.testing.assert_allclose(decode(MAKE.twist(T, (32.768, 1, 0)), VelocityConfig()).v_enu_mps, [32.768, 1, 0])


@pytest.mark.parametrize("up", [0.0, -0.0, np.nan])
def test_a_velocity_whose_up_is_0_is_horizontal(up: float) -> None:
    """As nmea_navsat_driver makes it of RMC, whatever its covariance: no receiver measures exactly 0.

    Taken for measured, a boat in a swell of 0.8 m was 4.7 m off at a bound of 4.6 m, its IMU accused.
    """
    cov = np.diag([0.04, 0.09, 0.0025, 1.0, 1.0, 1.0])
    cov[0, 2] = cov[2, 0] = 0.001
    for msg, own in ((MAKE.twist(T, (1, 2, up), cov), (0.04, 0.09)), (MAKE.twist(T, (1, 2, up)), (0.09, 0.09))):
        v = decode(msg, VelocityConfig())
        assert isinstance(v, GnssVelocity)
        np.testing.assert_allclose(v.v_enu_mps, [1, 2, 0])
        np.testing.assert_allclose(v.cov_m2ps2[:2, :2], np.diag(own))
        assert v.cov_m2ps2[2, 2] > 1e4
        assert not v.cov_m2ps2[2, :2].any()
    ned = decode(MAKE.twist(T, (1, 2, up), cov), VelocityConfig(convention="ned"))
    assert ned.cov_m2ps2[2, 2] > 1e4
    told = decode(MAKE.twist(T, (1, 2, 0.01), np.diag(cov.diagonal())), VelocityConfig())
    assert told.cov_m2ps2[2, 2] == pytest.approx(0.0025)


def test_velocity_in_north_east_down() -> None:
    """East is the second, north the first, up the third turned round; so are the covariances, of north with down too."""
    cov = np.zeros((6, 6))
    cov[:3, :3] = [[0.04, 0.01, 0.02], [0.01, 0.09, 0.03], [0.02, 0.03, 0.16]]
    ned = VelocityConfig(convention="ned")
    for msg in (MAKE.twist(T, (1, 2, 3), cov), MAKE.twist(T, (1, 2, 3))):
        np.testing.assert_allclose(decode(msg, ned).v_enu_mps, [2, 1, -3])
    told = decode(MAKE.twist(T, (1, 2, 3), cov), ned).cov_m2ps2
    np.testing.assert_allclose(told, [[0.09, 0.01, -0.03], [0.01, 0.04, -0.02], [-0.03, -0.02, 0.16]])


def test_pose_axes_and_covariance_order() -> None:
    """ROS: x, y, z, then rotations about x, y, z. Entry (i, j) is 10 i + j off the diagonal, scaled small."""
    cov = np.array([[1e-4 * (10 * min(i, j) + max(i, j)) for j in range(6)] for i in range(6)])
    cov[np.diag_indices(6)] = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    assert covariance_translation_first(cov.ravel())[1, 5] == cov[1, 5]
    msg = MAKE.pose(T, (10, 20, 30), yaw_quaternion(40.0), cov)
    pose = decode(msg, PoseConfig(axes=("x", "y", "yaw")))
    assert isinstance(pose, PoseFix)
    assert pose.axes == ("x", "y", "yaw")
    (mode,) = pose.modes
    assert mode.probability == 1.0
    np.testing.assert_allclose(mode.value, [10, 20, np.radians(40.0)])
    np.testing.assert_allclose(mode.cov, [[1.0, 1e-4, 5e-4], [1e-4, 2.0, 15e-4], [5e-4, 15e-4, 6.0]])
    (height,) = decode(msg, PoseConfig(axes=("z",))).modes
    np.testing.assert_allclose(height.value, [30.0])


def test_pose_without_covariance_or_orientation() -> None:
    (mode,) = decode(MAKE.pose(T, (1, 2, 3)), PoseConfig()).modes
    np.testing.assert_allclose(mode.cov, np.diag([0.09, 0.09, np.radians(2.0) ** 2]))
    blank = MAKE.odometry(T, (1, 2, 3), xyzw=(0, 0, 0, 0))
    refused(blank, PoseConfig(), Outcome.MALFORMED, "quaternion")
    assert isinstance(decode(blank, PoseConfig(axes=("x", "y"))), PoseFix)
    refused(MAKE.pose(T, (np.nan, 0, 0)), PoseConfig(), Outcome.MALFORMED, "NaN")


def test_a_pose_by_motion_capture_and_a_point_of_a_total_station() -> None:
    (mode,) = decode(MAKE.transform(T, (1, 2, 3), yaw_quaternion(40.0)), PoseConfig(axes=("x", "y", "z", "yaw"))).modes
    np.testing.assert_allclose(mode.value, [1, 2, 3, np.radians(40.0)])
    np.testing.assert_allclose(mode.cov, np.diag([0.09, 0.09, 0.09, np.radians(2.0) ** 2]))
    (mode,) = decode(MAKE.point(T, (1, 2, 3)), PoseConfig(axes=("x", "y", "z"))).modes
    np.testing.assert_allclose(mode.value, [1, 2, 3])
    refused(
        MAKE.point(T, (1, 2, 3)), PoseConfig(), Outcome.MALFORMED, "a point has no orientation: set axes: [x, y, z]"
    )


def test_a_replaced_axis_loses_its_correlations() -> None:
    cov = np.array([[1.0, 0.5, 0.5], [0.5, np.nan, 0.5], [0.5, 0.5, 1.0]])
    expected = [[1.0, 0.0, 0.5], [0.0, 7.0, 0.0], [0.5, 0.0, 1.0]]
    np.testing.assert_allclose(usable_covariance(cov, np.full(3, 7.0)), expected)
