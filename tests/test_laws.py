# SPDX-License-Identifier: Apache-2.0
"""Laws that hold for any input (style.md, rule 28): of conversions, and of whole runs that are turned, moved, split or shuffled.

Expectations are derived here, from the definitions and not from the code's own helpers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from graphloc import app
from graphloc.config import parse_config
from graphloc.eval.simulate import Scenario, SimulatedRun, simulate
from graphloc.factors import KINDS
from graphloc.frames import Datum, Geodetic, heading_deg_from_yaw, rotation_from_rpy_deg, rpy_from_rotation, wrap_angle
from graphloc.frontends._standard import covariance_translation_first, yaw_of_x_axis
from graphloc.frontends._tf import StaticTree
from graphloc.frontends.bag import read_recording
from graphloc.frontends.decode import DECODERS, ImuReading, usable_covariance
from graphloc.frontends.msgtypes import IMU
from graphloc.judge.covariances import world_covariance
from graphloc.measurements import GnssPosition, ImuSeries, Measurement, PoseFix
from graphloc.recording import Recording
from graphloc.solve._standstill import Track
from graphloc.solve.alignment import _position_and_velocity
from graphloc.time import duration_ns
from graphloc.trajectory import Trajectory
from tests.bagfactory import Messages, still_run, write_bag

Array = NDArray[np.float64]
MAKE = Messages(2)
FEW = settings(max_examples=60, deadline=None)

unit = st.floats(-1.0, 1.0)
axis = st.tuples(unit, unit, unit).filter(lambda v: 1e-3 < np.linalg.norm(v))
# Regimes of a turn: none, near none, any, near half a turn and past it.
turn = st.one_of(
    st.just(0.0), st.floats(-1e-7, 1e-7), st.floats(-3.0, 3.0), st.floats(np.pi - 1e-6, np.pi + 1e-6), st.just(np.pi)
)
near, far = st.floats(-50.0, 50.0), st.floats(-1e5, 1e5)


def rodrigues(about: Sequence[float] | Array, angle: float) -> Array:
    """exp(angle [a]x), from its definition."""
    a = np.array(about) / np.linalg.norm(about)
    K = np.array([[0.0, -a[2], a[1]], [a[2], 0.0, -a[0]], [-a[1], a[0], 0.0]])
    return np.asarray(np.eye(3) + np.sin(angle) * K + (1.0 - np.cos(angle)) * K @ K)


rotations = st.builds(rodrigues, axis, turn)
poses = st.tuples(st.tuples(far, far, near).map(np.array), rotations)


def matrix(pose: tuple[Array, Array]) -> Array:
    made = np.eye(4)
    made[:3, :3], made[:3, 3] = pose[1], pose[0]
    return made


# poses and their chains


@given(st.lists(poses, min_size=1, max_size=4), st.lists(st.booleans(), min_size=4, max_size=4))
@FEW
def test_a_chain_of_transforms_is_the_product_and_back_is_its_inverse(
    chain: list[tuple[Array, Array]], upward: list[bool]
) -> None:
    """Also where edges are given from the child's side: T_b_a = inv(T_a_b)."""
    tree, product = StaticTree(), np.eye(4)
    for k, (pose, up) in enumerate(zip(chain, upward, strict=False)):
        pose = (np.clip(pose[0], -9e3, 9e3), pose[1])
        T = matrix(pose)
        product = product @ (np.linalg.inv(T) if up else T)
        names = (f"f{k + 1}", f"f{k}") if up else (f"f{k}", f"f{k + 1}")
        tree.add(MAKE.transforms([(*names, tuple(pose[0]), tuple(Rotation.from_matrix(pose[1]).as_quat()))]))
    there, back = tree.resolve("f0", f"f{len(chain)}"), tree.resolve(f"f{len(chain)}", "f0")
    assert there is not None
    assert back is not None
    np.testing.assert_allclose(matrix(there), product, atol=1e-6)
    np.testing.assert_allclose(matrix(back) @ matrix(there), np.eye(4), atol=1e-6)
    np.testing.assert_allclose(matrix(tree.resolve("f0", "f0") or there), np.eye(4), atol=0)


@given(
    st.floats(-180.0, 180.0),
    st.floats(-90.0, 90.0) | st.sampled_from([-90.0, 90.0, 89.99999999]),
    st.floats(-180.0, 180.0),
)
@FEW
def test_roll_pitch_yaw_by_its_definition_and_back(roll: float, pitch: float, yaw: float) -> None:
    """R = Rz Ry Rx; and the angles that come back give the same R, at +-90 deg of pitch as well."""
    r, p, y = np.radians([roll, pitch, yaw])
    expected = rodrigues((0, 0, 1), y) @ rodrigues((0, 1, 0), p) @ rodrigues((1, 0, 0), r)
    R = rotation_from_rpy_deg(np.array([roll, pitch, yaw]))
    np.testing.assert_allclose(R, expected, atol=1e-12)
    np.testing.assert_allclose(rotation_from_rpy_deg(np.degrees(rpy_from_rotation(R))), expected, atol=1e-7)


@given(rotations, st.floats(0.95, 1.05))
@FEW
def test_yaw_of_a_quaternion_is_where_its_x_axis_points(R: Array, scale: float) -> None:
    if np.hypot(R[0, 0], R[1, 0]) < 0.15:
        return  # x up or down: refused
    q = scale * Rotation.from_matrix(R).as_quat()
    for sign in (1.0, -1.0):  # q and -q are one rotation
        yaw = yaw_of_x_axis(*(sign * q).tolist())
        assert isinstance(yaw, float)
        assert float(wrap_angle(yaw - np.arctan2(R[1, 0], R[0, 0]))) == pytest.approx(0.0, abs=1e-6)


@given(st.one_of(st.floats(-720.0, 720.0), st.floats(359.999, 360.001), st.floats(-1e-6, 1e-6)))
@FEW
def test_a_heading_is_the_bearing_of_its_direction(yaw_deg: float) -> None:
    """Bearing atan2(east, north) of (cos yaw, sin yaw), in [0, 360)."""
    yaw = np.radians(yaw_deg)
    heading = float(heading_deg_from_yaw(yaw))
    assert 0.0 <= heading < 360.0
    expected = np.degrees(np.arctan2(np.cos(yaw), np.sin(yaw)))
    assert abs((heading - expected + 180.0) % 360.0 - 180.0) < 1e-6


# places


@given(st.floats(84.0, 89.999) | st.floats(-89.999, -84.0), st.floats(-180.0, 180.0), near, near, near)
@FEW
def test_places_near_the_poles_come_back(lat: float, lon: float, e: float, n: float, u: float) -> None:
    datum = Datum(Geodetic(lat, lon, 3.0))
    there = datum.geodetic_from_enu(np.array([[e, n, u]]))
    back = datum.enu_from_geodetic(there[:, 0], there[:, 1], there[:, 2])
    np.testing.assert_allclose(back, [[e, n, u]], atol=1e-6)


@given(st.floats(-89.0, 89.0), st.floats(-180.0, 180.0), st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))
@FEW
def test_two_datums_tell_of_one_distance(lat: float, lon: float, dlat: float, dlon: float) -> None:
    """ENU is a rigid frame: how far two places are apart does not depend on where its origin is, 100 km off or not."""
    rng = np.random.default_rng(0)
    places = np.column_stack([lat + rng.normal(0, 0.01, 5), lon + rng.normal(0, 0.01, 5), rng.normal(0, 50.0, 5)])
    places[:, 0] = np.clip(places[:, 0], -89.9, 89.9)
    apart = []
    for origin in (Geodetic(lat, lon, 0.0), Geodetic(float(np.clip(lat + dlat, -89.9, 89.9)), lon + dlon, 100.0)):
        p = Datum(origin).enu_from_geodetic(*places.T)
        apart.append(np.linalg.norm(p[:, None] - p[None], axis=2))
    np.testing.assert_allclose(apart[0], apart[1], atol=1e-5)


# covariances


@st.composite
def covariances(draw: st.DrawFn) -> Array:
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    A = rng.normal(size=(6, 6)) * 10.0 ** rng.uniform(-3, 2, 6)[:, None]
    return np.asarray(A @ A.T + 1e-9 * np.eye(6))


@given(covariances())
@FEW
def test_a_ros_covariance_keeps_its_order(cov: Array) -> None:
    """Row-major, x y z then rotations; one that is usable is not touched."""
    read = covariance_translation_first(cov.ravel().tolist())
    np.testing.assert_array_equal(read, cov)
    if np.linalg.eigvalsh(cov).min() > 1e-8 * cov.diagonal().min():
        np.testing.assert_allclose(usable_covariance(cov, np.ones(6)), cov, rtol=1e-12)


@given(covariances(), rotations, st.tuples(near, near, near).map(np.array))
@FEW
def test_a_covariance_in_world_is_that_of_what_is_moved(cov: Array, R: Array, lever: Array) -> None:
    """World p' = p + R v + R skew(-l)... by finite differences: x -> (place of a point l in body, small turns in world)."""
    J = np.zeros((6, 6))
    step = 1e-6
    for k in range(6):
        for sign in (1.0, -1.0):
            d = np.zeros(6)
            d[k] = sign * step
            angle = float(np.linalg.norm(d[:3]))
            turned = R @ rodrigues(d[:3], angle) if angle else R
            moved = R @ d[3:] + turned @ lever
            w = turned @ R.T  # small turn about world's axes
            J[:, k] += sign * np.r_[moved, w[2, 1] - w[1, 2], w[0, 2] - w[2, 0], w[1, 0] - w[0, 1]] / np.r_[
                [2 * step] * 3, [4 * step] * 3
            ]  # fmt: skip
    expected = J @ cov @ J.T
    np.testing.assert_allclose(
        world_covariance(cov, R, lever), expected, rtol=1e-4, atol=1e-5 * float(np.abs(expected).max())
    )


# tracks


@given(st.lists(st.integers(1, 10**10), min_size=3, max_size=8), poses, st.integers(0, 2**62))
@FEW
def test_a_track_that_is_moved_is_interpolated_to_what_is_moved(
    steps: list[int], by: tuple[Array, Array], later_ns: int
) -> None:
    """Interpolation commutes with a turn and a shift of world, and with a shift of time; steps of 1 ns included."""
    rng = np.random.default_rng(len(steps))
    stamps = np.cumsum(np.array(steps, dtype=np.int64))
    p, R = rng.normal(0, 30, (len(steps), 3)), Rotation.random(len(steps), rng=rng).as_matrix()
    plain = Trajectory(stamps_ns=stamps, p_world_m=p, R_world_body=R)
    t, C = by
    moved = Trajectory(stamps_ns=stamps + later_ns, p_world_m=p @ C.T + t, R_world_body=C @ R)
    at = np.unique(rng.integers(stamps[0], stamps[-1] + 1, 5))
    a, b = plain.at(at), moved.at(at + later_ns)
    np.testing.assert_allclose(b.p_world_m, a.p_world_m @ C.T + t, atol=1e-6)
    np.testing.assert_allclose(b.R_world_body, C @ a.R_world_body, atol=1e-6)
    assert (a.stamps_ns + later_ns == b.stamps_ns).all()


# whole runs


@pytest.fixture(scope="module")
def run() -> SimulatedRun:
    scenario = Scenario(duration_s=12.0, noise="clean", false_fraction=0.0, imu_hz=50.0, gnss_hz=2.0, compass_hz=2.0)
    return simulate(replace(scenario, pose_hz=1.0), 4)


@pytest.fixture(scope="module")
def plain(run: SimulatedRun) -> Trajectory:
    return solved(run, run.recording)


def solved(run: SimulatedRun, recording: Recording) -> Trajectory:
    return app.smooth_recording(recording, run.config).solution.trajectory


def changed(run: SimulatedRun, measurements: Sequence[Measurement], imu: ImuSeries | None = None) -> Recording:
    return replace(run.recording, measurements=tuple(measurements), imu=imu or run.recording.imu)


def test_time_shifted_is_the_estimate_shifted(run: SimulatedRun, plain: Trajectory) -> None:
    """To the last bit but one: nothing but differences of stamps may count. A day, and 1 ns so that no rounding hides."""
    later = 86_400_000_000_001
    imu = run.recording.imu
    assert imu is not None
    moved = replace(imu, stamps_ns=imu.stamps_ns + later)
    recording = changed(run, [replace(m, stamp_ns=m.stamp_ns + later) for m in run.recording.measurements], moved)
    track = solved(run, replace(recording, truth=None))
    np.testing.assert_array_equal(track.stamps_ns, plain.stamps_ns + later)
    np.testing.assert_allclose(track.p_world_m, plain.p_world_m, atol=1e-6)
    np.testing.assert_allclose(track.R_world_body, plain.R_world_body, atol=1e-7)


def test_arrival_order_at_one_stamp_does_not_matter(run: SimulatedRun, plain: Trajectory) -> None:
    """Measurements of one stamp in the other order, with the arrival numbers that this gives."""
    at_one: dict[int, list[Measurement]] = {}
    for m in run.recording.measurements:
        at_one.setdefault(m.stamp_ns, []).append(m)
    assert max(map(len, at_one.values())) > 1
    turned: list[Measurement] = []
    for group in at_one.values():
        seqs = sorted(m.seq for m in group)
        turned += [replace(m, seq=seq) for m, seq in zip(reversed(group), seqs, strict=True)]
    track = solved(run, changed(run, turned))
    np.testing.assert_allclose(track.p_world_m, plain.p_world_m, atol=1e-6)
    np.testing.assert_allclose(track.R_world_body, plain.R_world_body, atol=1e-7)


def test_world_turned_is_the_estimate_turned_with_its_covariance(run: SimulatedRun, plain: Trajectory) -> None:
    """All measurements turned by 137 deg about the datum; fixes as they are on the turned Earth."""
    angle = np.radians(137.0)
    C = rodrigues((0, 0, 1), angle)
    datum = run.config.datum
    assert datum is not None
    to_enu = Datum(datum.geodetic)

    def turned(m: Measurement) -> Measurement:
        if isinstance(m, GnssPosition):
            p = to_enu.enu_from_geodetic(*(np.array([v]) for v in m.position)) @ C.T
            (lla,) = to_enu.geodetic_from_enu(p).tolist()
            return replace(m, position=Geodetic(*lla), cov_enu_m2=C @ m.cov_enu_m2 @ C.T)
        if isinstance(m, PoseFix):
            x, y, yaw = m.modes[0].value
            value = np.array([*(C[:2, :2] @ (x, y)), yaw + angle])
            D = np.eye(3)
            D[:2, :2] = C[:2, :2]
            return replace(m, modes=(replace(m.modes[0], value=value, cov=D @ m.modes[0].cov @ D.T),))
        return replace(m, yaw_rad=float(wrap_angle(m.yaw_rad + angle)))  # type: ignore[call-arg, attr-defined]

    track = solved(run, replace(changed(run, [turned(m) for m in run.recording.measurements]), truth=None))
    np.testing.assert_allclose(track.p_world_m, plain.p_world_m @ C.T, atol=0.02)
    np.testing.assert_allclose(track.R_world_body, C @ plain.R_world_body, atol=2e-3)
    assert track.cov is not None
    assert plain.cov is not None
    D = np.kron(np.eye(2), C)
    np.testing.assert_allclose(
        np.diagonal(track.cov, axis1=1, axis2=2), np.diagonal(D @ plain.cov @ D.T, axis1=1, axis2=2), rtol=0.1
    )


def test_a_bag_in_parts_is_the_bag(tmp_path: Path) -> None:
    """Cut anywhere, given in any order: the same measurements, the same account."""
    config = parse_config({"sensors": {"imu": {"topic": "/imu"}, "gnss": {"topic": "/fix"}}}, KINDS, "test")
    items = still_run(MAKE, 6.0)
    whole = read_recording(write_bag(tmp_path / "whole", MAKE, items), config)
    for n, cuts in enumerate([(1, 299), (100, 101), (150, 330)]):
        parts = [items[: cuts[0]], items[cuts[0] : cuts[1]], items[cuts[1] :]]
        paths = [write_bag(tmp_path / f"{n}-{k}", MAKE, part) for k, part in enumerate(parts) if part]
        split = read_recording(paths[::-1], config)
        assert split.message_count == whole.message_count
        assert split.imu is not None
        assert whole.imu is not None
        np.testing.assert_array_equal(split.imu.stamps_ns, whole.imu.stamps_ns)
        np.testing.assert_array_equal(split.imu.accel_mps2, whole.imu.accel_mps2)
        assert [m.stamp_ns for m in split.measurements] == [m.stamp_ns for m in whole.measurements]
        assert split.rows == whole.rows


@given(st.floats(-1e9, 1e9))
@FEW
def test_a_duration_in_ns_is_the_nearest(duration_s: float) -> None:
    assert abs(duration_ns(duration_s) - duration_s * 1e9) <= 0.5 + abs(duration_s * 1e9) * 2**-52


@given(st.sampled_from(["m/s^2", "g"]), st.sampled_from(["rad/s", "deg/s"]), st.tuples(near, near, near))
@settings(max_examples=10, deadline=None)
def test_units_of_an_imu_do_not_change_what_it_says(
    accel_unit: str, gyro_unit: str, said: tuple[float, float, float]
) -> None:
    """The same motion written in g and deg/s, and read so: 9.80665 m/s^2, pi / 180."""
    config = KINDS["imu"].model_validate({"kind": "imu", "accel_unit": accel_unit, "gyro_unit": gyro_unit})
    a, w = np.array(said), np.array(said[::-1]) / 60.0
    force, rate = a / (9.80665 if accel_unit == "g" else 1.0), w * (180.0 / np.pi if gyro_unit == "deg/s" else 1.0)
    sample = DECODERS["imu", IMU](MAKE.imu(1, force.tolist(), rate.tolist()), 1, 0, "imu", config)
    assert isinstance(sample, ImuReading)
    np.testing.assert_allclose(sample.accel_mps2, a, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(sample.gyro_radps, w, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    ("every_s", "count", "sigma_m"), [(0.25, 2, 1.5), (1.0, 4, 3.0), (0.1, 30, 2.0), (0.0, 1, 2.0)]
)
def test_the_speed_at_the_start_is_as_sure_as_the_positions_say(every_s: float, count: int, sigma_m: float) -> None:
    """Two sightings a quarter of a second apart, each 1.5 m off, differ by 8 m/s: stated to 3, that bent whole starts."""
    rng, true = np.random.default_rng(11), np.array([5.0, -1.0])
    squared = []
    for _ in range(200):
        t = np.asarray(10.0 + every_s * np.arange(count), dtype=np.float64)
        p = np.column_stack([t[:, None] * true + rng.normal(0.0, sigma_m, (count, 2)), np.zeros(count)])
        track = Track(t, p, np.full((count, 3), sigma_m))
        _, _, v, sigma = _position_and_velocity({}, track, None)
        squared.append(((v[:2] - true) / sigma[:2]) ** 2)
    assert np.mean(squared) < 1.2
