"""Frames, time, trajectories and the ledger: laws that hold for any input."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyproj import Geod, Transformer
from scipy.spatial.transform import Rotation
from scipy.stats import norm

from graphloc.errors import GraphlocError
from graphloc.frames import (
    FRAMES,
    Datum,
    Geodetic,
    heading_deg_from_yaw,
    rotation_from_rpy_deg,
    rpy_from_rotation,
    wrap_angle,
    yaw_from_heading_deg,
)
from graphloc.ledger import Ledger, LedgerRow, Outcome
from graphloc.measurements import GnssPosition, PoseFix, PoseMode
from graphloc.signals.series import integral, interpolated, rms, robust_sigma, runs
from graphloc.time import NS_PER_S, seconds_between, seconds_since, utc_text
from graphloc.trajectory import Trajectory

latitudes, longitudes = st.floats(-80.0, 80.0), st.floats(-180.0, 180.0)
metres, angles = st.floats(-5000.0, 5000.0), st.floats(-20.0, 20.0)


@given(latitudes, longitudes, metres, metres, st.floats(-50.0, 50.0))
@settings(max_examples=50, deadline=None)
def test_geodetic_and_back(lat: float, lon: float, e: float, n: float, u: float) -> None:
    datum = Datum(Geodetic(lat, lon, 12.0))
    there = datum.geodetic_from_enu(np.array([[e, n, u]]))
    back = datum.enu_from_geodetic(there[:, 0], there[:, 1], there[:, 2])
    np.testing.assert_allclose(back, [[e, n, u]], atol=1e-6)


@given(latitudes, longitudes, st.floats(0.0, 360.0), st.floats(10.0, 2000.0))
@settings(max_examples=50, deadline=None)
def test_enu_agrees_with_the_geodesic(lat: float, lon: float, azimuth: float, distance: float) -> None:
    """East and north against pyproj's geodesic: within the 1e-7 d^2/R that curvature makes of it."""
    lon2, lat2, _ = Geod(ellps="WGS84").fwd(lon, lat, azimuth, distance)
    e, n, _ = Datum(Geodetic(lat, lon, 0.0)).enu_from_geodetic(np.array([lat2]), np.array([lon2]), np.zeros(1))[0]
    assert np.hypot(e, n) == pytest.approx(distance, abs=1e-3)
    assert wrap_angle(np.arctan2(e, n) - np.radians(azimuth)) == pytest.approx(0.0, abs=2e-3)


def test_enu_agrees_with_earth_centred_axes() -> None:
    """Up is along the ellipsoid's normal: 100 m higher is 100 m up and nothing else, by ECEF differences."""
    lat, lon = 59.3, 18.1
    ecef = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    rise = np.subtract(ecef.transform(lon, lat, 120.0), ecef.transform(lon, lat, 20.0))
    normal = [np.cos(np.radians(lat)) * np.cos(np.radians(lon)), np.cos(np.radians(lat)) * np.sin(np.radians(lon))]
    assert rise[:2] / 100.0 == pytest.approx(normal, abs=1e-9)
    enu = Datum(Geodetic(lat, lon, 20.0)).enu_from_geodetic(np.array([lat]), np.array([lon]), np.array([120.0]))
    np.testing.assert_allclose(enu, [[0.0, 0.0, 100.0]], atol=1e-6)


def test_compass_points() -> None:
    assert np.degrees(yaw_from_heading_deg(np.array([0.0, 90.0, 180.0, 270.0]))) == pytest.approx([90, 0, -90, 180])
    assert heading_deg_from_yaw(np.radians([0.0, 90.0, -90.0, 180.0])) == pytest.approx([90, 0, 180, 270])


@given(st.floats(0.0, 359.99))
def test_heading_and_back(heading: float) -> None:
    back = float(heading_deg_from_yaw(yaw_from_heading_deg(heading)))
    assert abs(wrap_angle(np.radians(back - heading))) < 1e-9


@given(angles)
def test_wrapping_keeps_the_direction(angle: float) -> None:
    wrapped = float(wrap_angle(angle))
    assert -np.pi < wrapped <= np.pi
    assert np.cos(wrapped) == pytest.approx(np.cos(angle), abs=1e-9)
    assert np.sin(wrapped) == pytest.approx(np.sin(angle), abs=1e-9)


@given(st.floats(-179.0, 179.0), st.floats(-85.0, 85.0), st.floats(-179.0, 179.0))
def test_roll_pitch_yaw_and_back(roll: float, pitch: float, yaw: float) -> None:
    R = rotation_from_rpy_deg(np.array([roll, pitch, yaw]))
    np.testing.assert_allclose(R, Rotation.from_euler("ZYX", [yaw, pitch, roll], degrees=True).as_matrix(), atol=1e-12)
    again = np.degrees(rpy_from_rotation(R[None])[0])
    np.testing.assert_allclose(np.abs(wrap_angle(np.radians(again - [roll, pitch, yaw]))), 0.0, atol=1e-6)


@pytest.mark.parametrize(("latitude", "expected"), [(0.0, 9.7803267715), (45.0, 9.806199), (90.0, 9.8321863685)])
def test_gravity_of_grs80(latitude: float, expected: float) -> None:
    """Moritz, Geodetic Reference System 1980: at the equator, at 45 deg and at the pole."""
    assert Datum(Geodetic(latitude, 10.0, 0.0)).gravity_mps2 == pytest.approx(expected, abs=2e-6)
    assert Datum(Geodetic(latitude, 10.0, 1000.0)).gravity_mps2 == pytest.approx(expected - 3.086e-3, abs=2e-6)


@given(st.integers(0, 2**62), st.integers(1, 10**15))
def test_time_differences_are_exact_to_the_nanosecond(start: int, step: int) -> None:
    assert seconds_between(start, start + step) == step / NS_PER_S
    assert seconds_since(start, np.array([start, start + step]))[1] == pytest.approx(step / NS_PER_S, rel=1e-15)


def test_utc_text() -> None:
    assert utc_text(1432235497988949113) == "2015-05-21T19:11:37.988949113Z"
    assert utc_text(2**63 - 1).startswith("2262-04-11T23:47:16.")


def circle(count: int = 50) -> Trajectory:
    """A circle of 10 m at 0.1 rad/s, 1 s apart."""
    t = np.arange(count) * 1.0
    a = 0.1 * t
    position = np.column_stack([10 * np.cos(a), 10 * np.sin(a), np.zeros(count)])
    velocity = np.column_stack([-np.sin(a), np.cos(a), np.zeros(count)])
    rotation = Rotation.from_rotvec(np.column_stack([0 * a, 0 * a, a + np.pi / 2])).as_matrix()
    return Trajectory(
        stamps_ns=(t * 1e9).astype(np.int64), p_world_m=position, R_world_body=rotation, v_world_mps=velocity
    )


def test_interpolation_follows_the_circle() -> None:
    stamps = np.arange(300_000_000, 48_000_000_000, 777_000_000, dtype=np.int64)
    there = circle().at(stamps)
    a = 0.1 * stamps * 1e-9
    np.testing.assert_allclose(there.p_world_m[:, :2], 10 * np.column_stack([np.cos(a), np.sin(a)]), atol=1e-5)
    np.testing.assert_allclose(wrap_angle(there.yaw_rad - a - np.pi / 2), 0.0, atol=1e-9)


def test_columns_over_time() -> None:
    at, columns = np.array([0.0, 1.0, 3.0]), np.array([[0.0, 1.0], [2.0, 1.0], [6.0, -1.0]])
    between = interpolated(np.array([-1.0, 0.5, 2.0, 9.0]), at, columns)
    np.testing.assert_allclose(between, [[0.0, 1.0], [1.0, 1.0], [4.0, 0.0], [6.0, -1.0]])
    # Trapezia of a straight line are exact: 2 t has the integral t^2; of a row of one value, that of a constant.
    np.testing.assert_allclose(integral(at, columns), [[0.0, 0.0], [1.0, 1.0], [9.0, 1.0]])
    np.testing.assert_allclose(integral(at, 1j * columns[:, 0]), [0.0, 1j, 9j])
    assert rms(np.array([[4.0, 0.0], [-2.0, 0.0]])) == pytest.approx(5.0**0.5)


def test_a_robust_sigma_is_that_of_most_about_zero() -> None:
    off = np.random.default_rng(1).normal(0.0, [0.5, 2.0], (20_001, 2))
    off[:500] = 1e6
    share = 0.5 / (1.0 - 500 / 20_001)  # of the others, smaller than the median size
    more = norm.ppf(0.5 + 0.5 * share) / norm.ppf(0.75)
    np.testing.assert_allclose(robust_sigma(off), [0.5 * more, 2.0 * more], rtol=0.025)
    assert robust_sigma(np.full(9, -3.0)) == pytest.approx(3.0 / norm.ppf(0.75), rel=1e-4)


@pytest.mark.parametrize(
    ("there", "expected"),
    [("0110010", [[1, 3], [5, 6]]), ("111", [[0, 3]]), ("1001", [[0, 1], [3, 4]]), ("00", []), ("", [])],
)
def test_runs_of_true_values(there: str, expected: list[list[int]]) -> None:
    assert runs(np.array([c == "1" for c in there], dtype=bool)).tolist() == expected


def test_a_trajectory_covers_no_gap_and_no_outside() -> None:
    whole = circle()
    hole = (np.arange(len(whole)) >= 10) & (np.arange(len(whole)) < 20)
    holed = whole.where(~hole)
    asked = np.array([-1, 0, 5_500_000_000, 15_000_000_000, 25_500_000_000, 49_000_000_000, 49_000_000_001])
    assert holed.covers(asked).tolist() == [False, True, True, False, True, True, False]
    with pytest.raises(ValueError, match="outside"):
        whole.at(np.array([60_000_000_000]))


def test_stamps_must_increase() -> None:
    with pytest.raises(ValueError, match="increase"):
        Trajectory(stamps_ns=np.array([1, 1]), p_world_m=np.zeros((2, 3)), R_world_body=np.tile(np.eye(3), (2, 1, 1)))


def row(seq: int, outcome: Outcome = Outcome.USED, count: int = 1) -> LedgerRow:
    return LedgerRow(seq=seq, stamp_ns=0, sensor="gnss", topic="/fix", outcome=outcome, count=count)


def test_a_message_is_entered_once() -> None:
    ledger = Ledger([row(0), row(1, Outcome.REJECTED)])
    with pytest.raises(GraphlocError, match="twice"):
        ledger.add(row(1))
    assert ledger.counts() == {"gnss": {"rejected": 1, "used": 1}}


def test_rows_of_whole_topics_count_all_their_messages() -> None:
    assert len(Ledger([row(0), row(-1, Outcome.IGNORED, count=40), row(-1, Outcome.IGNORED, count=2)])) == 43


def test_the_drawn_frames_are_the_ones_in_the_code() -> None:
    rows = (Path(__file__).parent.parent / "docs/frames.md").read_text().splitlines()
    for frame in FRAMES:
        assert f"| {frame.name} | {frame.axes} | {frame.origin} |" in rows


@pytest.mark.parametrize(("off", "refused"), [(0.9e-6, False), (1.2e-6, True), (-1.2e-6, True)])
def test_a_covariance_is_symmetric_to_a_millionth(off: float, refused: bool) -> None:
    """Above or below its diagonal, whichever is the larger; digits that a message lost are none."""
    for row, column in ((0, 2), (2, 0)):
        cov = np.full((3, 3), 10.0) + 40.0 * np.eye(3)
        cov[row, column] *= 1.0 + off
        fix: dict[str, Any] = {
            "stamp_ns": 1,
            "sensor": "gnss",
            "seq": 0,
            "position": Geodetic(57.7, 11.7, 0.0),
            "cov_enu_m2": cov,
        }
        if refused:
            with pytest.raises(ValueError, match="not symmetric positive definite"):
                GnssPosition(**fix)
        else:
            GnssPosition(**fix)


@pytest.mark.parametrize("news", [-0.1, 1.1, np.nan])
def test_news_is_a_share(news: float) -> None:
    mode = PoseMode(value=np.zeros(1), cov=np.eye(1))
    with pytest.raises(ValueError, match="news must be in"):
        PoseFix(stamp_ns=0, sensor="given", seq=0, axes=("x",), modes=(mode,), news=news)
