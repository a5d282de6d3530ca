# SPDX-License-Identifier: Apache-2.0
"""Every number of the run folder, from a solution made by hand in which no two numbers are alike."""

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation

from graphloc import outputs
from graphloc.config import VesselConfig, parse_config
from graphloc.factors import KINDS
from graphloc.frames import Datum, Geodetic
from graphloc.ledger import Ledger, LedgerRow, Outcome
from graphloc.solution import Cause, Health, HealthReason, SlowEstimate, Solution, SolveStats
from graphloc.trajectory import Trajectory

START_NS = 1_700_000_000_000_000_005  # a fraction that a float, or a missing zero, would lose
ROLL, PITCH, YAW = 0.10, -0.05, 2.0  # rad; starboard down, bow up, from east
V = np.array([1.5, -0.7, 0.2])
COV = np.diag([0.04, 0.09, 0.25, 1e-4, 4e-4, 9e-4])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(tmp_path_factory.mktemp("outputs"), Geodetic(57.7, 11.9, 40.0))


def written(out: Path, origin: Geodetic) -> Path:
    n = 21
    stamps = START_NS + 100_000_000 * np.arange(n, dtype=np.int64)
    R = Rotation.from_euler("ZYX", [YAW, PITCH, ROLL]).as_matrix()
    p = np.array([100.0, -40.0, 3.0]) + np.arange(n)[:, None] * V * 0.1
    cov = np.tile(COV, (n, 1, 1))
    cov[18, 5, 5], cov[19, 0, 0] = 1.0, 11.0**2  # heading and place are lost: 95 % bounds of 112 deg and 27 m
    solution = Solution(
        datum=Datum(origin),
        trajectory=Trajectory(
            stamps_ns=stamps,
            p_world_m=p,
            R_world_body=np.tile(R, (n, 1, 1)),
            v_world_mps=np.tile(V, (n, 1)),
            cov=cov,
        ),
        v_cov=np.tile(np.diag([0.01, 0.02, 0.03]), (n, 1, 1)),
        accel_bias_mps2=np.zeros((n, 3)),
        gyro_bias_radps=np.zeros((n, 3)),
        gyro_radps=np.tile([0.01, 0.02, 0.03], (n, 1)),
        gyro_cov=np.tile(np.diag([1e-5, 2e-5, 3e-5]), (n, 1, 1)),
        health=(Health.GOOD,) * 18 + (Health.LOST, Health.LOST, Health.DEGRADED),
        health_reason=(
            *(HealthReason(),) * 18,
            *(HealthReason("nothing", Cause.HEADING), HealthReason("nothing", Cause.BOUND)),
            HealthReason("gnss missing", Cause.SENSORS, ("gnss",)),
        ),
        since_agreed_s={"gnss": np.asarray(np.arange(n) * 0.5, dtype=np.float64)},
        slow={
            "gnss": SlowEstimate(
                name="GNSS error",
                axes=("east", "north", "up"),
                units=("m", "m", "m"),
                stamps_ns=stamps[:1],
                value=np.array([[0.5, -0.6, 0.7]]),
                sigma=np.array([[0.1, 0.2, 0.3]]),
            )
        },
        berths=(),
        ledger=Ledger(
            [
                LedgerRow(
                    seq=7, stamp_ns=START_NS, sensor="gnss", topic="/fix", outcome=Outcome.REJECTED, weight=0.25,
                    residual_m=1.5, nis=9.0, dof=3, reason="far, far away",
                )
            ]
        ),
        stats=SolveStats(passes=1, iterations=2, states=n, factors=4, cost=5.0, expected_cost=6.0, converged=True),
    )  # fmt: skip
    outputs.write_run(out, solution, VesselConfig(), inputs={"a.bag": "00"}, command="test", metrics={})
    return out


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def test_solution_csv(folder: Path) -> None:
    row = rows_of(folder / "solution.csv")[10]
    assert int(row["stamp_ns"]) == START_NS + 1_000_000_000
    assert row["utc"].startswith("2023-11-14T22:13:21.000000005")  # 1.7e9 s is 2023-11-14 22:13:20
    # From true north there, which lies east / (6393446 m cos(latitude)) sin(latitude) counter-clockwise of the datum's.
    heading = 90.0 - np.degrees(YAW) + np.degrees((100.0 + V[0]) / 6393446.0 * np.tan(np.radians(57.7)))
    expected = {
        "east_m": 100.0 + V[0], "north_m": -40.0 + V[1], "up_m": 3.0 + V[2],
        "heading_deg": heading % 360.0, "roll_deg": np.degrees(ROLL), "pitch_deg": np.degrees(PITCH),
        "v_east_mps": V[0], "v_north_mps": V[1], "v_up_mps": V[2],
        # 95 % of chi-square with two degrees of freedom is 5.991, with one 3.841; the larger axis is north.
        "bound95_horizontal_m": np.sqrt(5.991 * 0.09), "bound95_height_m": np.sqrt(3.841 * 0.25),
        "bound95_heading_deg": np.degrees(np.sqrt(3.841 * 9e-4)), "since_agreed_gnss_s": 5.0,
    }  # fmt: skip
    for name, value in expected.items():
        assert float(row[name]) == pytest.approx(value, abs=1e-3 if name != "heading_deg" else 1e-4), name
    # 1 deg of latitude is 111.4 km there, 1 deg of longitude that times cos(57.7 deg), give or take 0.5 %.
    assert float(row["latitude_deg"]) - 57.7 == pytest.approx((-40.0 + V[1]) / 111_400.0, rel=0.01)
    assert float(row["longitude_deg"]) - 11.9 == pytest.approx((100.0 + V[0]) / 59_600.0, rel=0.01)
    assert float(row["height_m"]) == pytest.approx(43.0 + V[2], abs=0.01)
    assert (row["health"], rows_of(folder / "solution.csv")[20]["health_reason"]) == ("good", "gnss missing")


def test_ten_rows_a_second_though_states_move_onto_stamps(folder: Path) -> None:
    """21 states 0.1 s apart give 21 rows; `floor` would drop one where a state moved 1 ns early."""
    assert len(rows_of(folder / "solution.csv")) == 21
    moved = START_NS + np.array([0, 130, 170, 310, 420, 480, 610], dtype=np.int64) * 1_000_000
    picked = outputs.thinned(moved, 10.0)
    assert picked.tolist() == [0, 1, 2, 3, 4, 5, 6]


def test_tum_keeps_nanoseconds_and_zeros(folder: Path) -> None:
    stamp, *values = (folder / "solution.tum").read_text().splitlines()[0].split()
    assert stamp == "1700000000.000000005"
    np.testing.assert_allclose([float(v) for v in values[:3]], [100.0, -40.0, 3.0])
    x, y, z, w = (float(v) for v in values[3:])
    # Body x in world, written out: cos(pitch) cos(yaw), cos(pitch) sin(yaw), -sin(pitch).
    forward = [1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)]
    np.testing.assert_allclose(
        forward, [np.cos(PITCH) * np.cos(YAW), np.cos(PITCH) * np.sin(YAW), -np.sin(PITCH)], atol=1e-8
    )


def test_the_bag_is_as_nav_msgs_has_it(folder: Path) -> None:
    """Pose in the header's frame, twist in the child's."""
    messages: dict[str, Any] = {}
    status: list[int] = []
    with AnyReader([folder / "solution_bag"]) as reader:
        for connection, stamp, raw in reader.messages():
            message: Any = reader.deserialize(raw, connection.msgtype)
            messages.setdefault(connection.topic, (stamp, message))
            if connection.topic == "/graphloc/fix":
                status.append(message.status.status)
    stamp, odometry = messages["/graphloc/odometry"]
    assert stamp == START_NS
    assert odometry.header.stamp.sec * 10**9 + odometry.header.stamp.nanosec == START_NS
    assert (odometry.header.frame_id, odometry.child_frame_id) == ("map", "base_link")
    along = np.cos(PITCH) * np.cos(YAW) * V[0] + np.cos(PITCH) * np.sin(YAW) * V[1] - np.sin(PITCH) * V[2]
    assert odometry.twist.twist.linear.x == pytest.approx(along)
    assert odometry.twist.twist.angular.z == pytest.approx(0.03)
    np.testing.assert_allclose(np.diagonal(odometry.pose.covariance.reshape(6, 6)), np.diagonal(COV))
    twist = odometry.twist.covariance.reshape(6, 6)
    np.testing.assert_allclose(np.diagonal(twist)[3:], [1e-5, 2e-5, 3e-5])  # zeros there say that the rate is exact
    assert np.trace(twist[:3, :3]) == pytest.approx(0.01 + 0.02 + 0.03)
    assert status == [0] * 19 + [-1, 0]
    _, fix = messages["/graphloc/fix"]
    assert fix.latitude == pytest.approx(57.7 - 40.0 / 111_400.0, abs=1e-5)
    assert fix.position_covariance[4] == pytest.approx(0.09)


def test_ledger_and_slow_states(folder: Path) -> None:
    (row,) = rows_of(folder / "ledger.csv")
    assert (row["outcome"], row["reason"], float(row["weight"])) == ("rejected", "far, far away", 0.25)
    assert (row["seq"], row["topic"], float(row["residual_m"]), float(row["nis"])) == ("7", "/fix", 1.5, 9.0)
    slow = {r["axis"]: (float(r["value"]), float(r["sigma"])) for r in rows_of(folder / "slow.csv")}
    assert slow == {"east": (0.5, 0.1), "north": (-0.6, 0.2), "up": (0.7, 0.3)}


def test_geojson_is_longitude_first(folder: Path) -> None:
    line = json.loads((folder / "track.geojson").read_text())["features"][0]["geometry"]["coordinates"]
    assert line[0][0] == pytest.approx(11.9, abs=0.01)
    assert line[0][1] == pytest.approx(57.7, abs=0.01)
    assert line[0][2] == pytest.approx(43.0, abs=0.01)


def test_geojson_is_cut_at_the_date_line(tmp_path: Path) -> None:
    """101.5 m east of a datum that lies 101.5 m west of it; as one line it led once around the globe."""
    per_m = np.degrees(1.0 / (6_378_137.0 * np.cos(np.radians(-16.8))))
    folder = written(tmp_path, Geodetic(-16.8, 180.0 - 101.5 * per_m, 40.0))
    geometry = json.loads((folder / "track.geojson").read_text())["features"][0]["geometry"]
    assert geometry["type"] == "MultiLineString"
    west, east = (np.array(part) for part in geometry["coordinates"])
    assert np.all((west[:, 0] > 179.9) & (west[:, 0] <= 180.0))
    assert np.all((east[:, 0] < -179.9) & (east[:, 0] >= -180.0))
    assert (west[-1, 0], east[0, 0]) == (180.0, -180.0)
    assert west[-1, 1:].tolist() == east[0, 1:].tolist()
    east[:, 0] += 360.0
    slope = np.diff(np.vstack([west, east[1:]])[:, :2], axis=0)
    np.testing.assert_allclose(slope[:, 1], slope[0, 1] / slope[0, 0] * slope[:, 0], atol=3e-9)  # it goes straight on


def test_a_configuration_names_the_files_that_a_run_is_made_of() -> None:
    """Of sensors that are switched on; each once."""
    sensors = {
        "quay": {"kind": "aerial", "image": "harbour.tif", "vector": "quays.geojson"},
        "moored": {"kind": "aerial", "image": "other.tif", "enabled": False},
        "tags": {"kind": "apriltag", "survey": "tags.yaml"},
    }
    raw = {"sensors": sensors, "truth_file": "truth.tum", "output": {"map_image": "harbour.tif"}}
    config = parse_config({**raw, "datum": {"latitude_deg": 57.7, "longitude_deg": 11.9}}, KINDS, "vessel.yaml")
    assert config.files == ("harbour.tif", "quays.geojson", "tags.yaml", "truth.tum")
