# SPDX-License-Identifier: Apache-2.0
"""Doppler logs in their own messages: what each says, what it is through, and what `inspect` drafts."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from graphloc.config import BodyVelocityConfig, VesselConfig
from graphloc.errors import InputError
from graphloc.frontends._rejections import Rejection
from graphloc.frontends.decode import DECODERS
from graphloc.ledger import Outcome
from graphloc.measurements import BodyVelocity
from tests.bagfactory import START_NS, Item, Messages, S
from tests.heldbags import hold_bag, read_recording
from tests.makers import said
from tests.test_inspect import drive, look

WATERLINKED = ("dvl_msgs/msg/DVL", "waterlinked_a50_ros_driver/msg/DVL")
GENERAL = ("marine_acoustic_msgs/msg/Dvl", "acoustic_msgs/msg/Dvl")
MAKE = Messages(2)
COVARIANCE = np.array([0.04, 0.01, 0.0, 0.01, 0.09, 0.0, 0.0, 0.0, 0.16])


def fields(make: Messages, msgtype: str, v: Any = (1.5, -0.25, 0.125), through: int = 1) -> dict[str, Any]:
    """A valid message: ahead, to port, rising slowly or sinking, as its z is down."""
    if msgtype in WATERLINKED:
        return {"velocity": make.vector(v), "fom": 0.25, "velocity_valid": True, "altitude": 4.5, "beams": [{"id": k} for k in range(4)]}  # fmt: skip
    return {"velocity": make.vector(v), "velocity_mode": through, "velocity_covar": COVARIANCE, "num_good_beams": 4, "beam_velocities_valid": True}  # fmt: skip


def read(msgtype: str, version: int = 0, changed: Any = None, **config: Any) -> Any:
    msg = said(MAKE, msgtype, version, **(fields(MAKE, msgtype) | (changed or {})))
    raw = MAKE.store.serialize_cdr(msg, msgtype)
    sensor = BodyVelocityConfig.model_validate({"topic": "/dvl", "axes": ["x", "y", "z"], **config})
    return DECODERS["body_velocity", msgtype](MAKE.store.deserialize_cdr(raw, msgtype), START_NS, 5, "dvl", sensor)


@pytest.mark.parametrize("msgtype", [*WATERLINKED, *GENERAL])
def test_it_is_a_velocity_along_its_own_axes(msgtype: str) -> None:
    found = read(msgtype)
    assert isinstance(found, BodyVelocity)
    np.testing.assert_array_equal(found.value, [1.5, -0.25, 0.125])
    stated = COVARIANCE.reshape(3, 3) if msgtype in GENERAL else 0.25**2 * np.eye(3)
    np.testing.assert_allclose(found.cov, stated)
    assert read(msgtype, axes=["x"]).value.tolist() == [1.5]


def test_a_covariance_beside_the_figure_of_merit_is_taken() -> None:
    found = read(WATERLINKED[0], changed={"covariance": COVARIANCE})
    np.testing.assert_allclose(found.cov, COVARIANCE.reshape(3, 3))


@pytest.mark.parametrize("unknown", [-np.ones(9), np.zeros(9)])
def test_a_covariance_that_is_not_known_is_the_default(unknown: Any) -> None:
    found = read(GENERAL[0], changed={"velocity_covar": unknown}, sigma_mps=0.5)
    np.testing.assert_allclose(found.cov, 0.25 * np.eye(3))


@pytest.mark.parametrize(
    ("msgtype", "changed", "why"),
    [
        (WATERLINKED[0], {"velocity_valid": False}, "velocity_valid false"),
        (WATERLINKED[1], {"velocity_valid": False}, "velocity_valid false"),
        (GENERAL[0], {"num_good_beams": 2}, "2 good beams"),
        (GENERAL[0], {"num_good_beams": 0, "beam_velocities_valid": False, "velocity": MAKE.vector((0, 0, 0))}, "0 good beams"),
        (GENERAL[0], {"velocity": MAKE.vector((np.nan, 0, 0))}, "NaN"),
        (WATERLINKED[0], {"velocity": MAKE.vector((np.nan, 0, 0))}, "NaN"),
    ],
)  # fmt: skip
def test_no_lock_is_no_velocity(msgtype: str, changed: dict[str, Any], why: str) -> None:
    found = read(msgtype, changed=changed)
    assert isinstance(found, Rejection)
    assert why in found.reason


def test_an_instrument_that_tells_a_velocity_alone_is_read() -> None:
    """It fills in neither the number of beams nor their flags."""
    assert isinstance(read(GENERAL[0], changed={"num_good_beams": 0, "beam_velocities_valid": False}), BodyVelocity)


@pytest.mark.parametrize("through", ["ground", "water"])
def test_each_sensor_reads_what_is_through_its_own(through: str) -> None:
    """A log that loses the bottom tracks the water: a velocity through it is no velocity over ground."""
    for mode, name in ((1, "ground"), (2, "water")):
        found = read(GENERAL[0], changed={"velocity_mode": mode}, through=through)
        assert isinstance(found, BodyVelocity) == (name == through)
        if name != through:
            assert found == Rejection(Outcome.IGNORED, f"its velocity is through the {name}, and through is {through}")
    assert isinstance(read(GENERAL[0], changed={"velocity_mode": 0}, through=through), BodyVelocity)  # not told
    assert isinstance(read(WATERLINKED[0], through=through), BodyVelocity)


def logs_of(config: VesselConfig) -> list[BodyVelocityConfig]:
    """Return the Doppler logs, which are drafted switched off."""
    return [sensor for sensor in config.sensors.values() if isinstance(sensor, BodyVelocityConfig)]


def driven(
    make: Messages, msgtype: str, water: slice = slice(0), sign: float = 1.0, frame: str = "dvl", drift_mps: float = 0.0
) -> list[Item]:
    """A drive with a Doppler log in place of wheels; some of its messages are through water. It may drift, ever faster, to port."""
    items: list[Item] = []
    logs = [(at, m) for topic, at, m in drive(make) if topic == "/wheel/odom"]
    through = np.ones(len(logs), dtype=int)
    through[water] = 2
    for k, ((at, m), mode) in enumerate(zip(logs, through.tolist(), strict=True)):
        bad = {"num_good_beams": 1} if k == 0 and mode == 2 else {}
        v = (sign * m.twist.twist.linear.x, drift_mps * k / len(logs), 0.0)
        items.append(
            ("/dvl", at, said(make, msgtype, header=make.header(at, frame), **(fields(make, msgtype, v, mode) | bad)))
        )
    return sorted([*(item for item in drive(make) if item[0] != "/wheel/odom"), *items], key=lambda item: item[1])


@pytest.mark.parametrize("msgtype", [WATERLINKED[0], GENERAL[0]])
def test_it_is_drafted_with_its_z_down(msgtype: str, tmp_path: Path) -> None:
    make = Messages(2)
    found, config, text = look(tmp_path, driven(make, msgtype), make)
    (log,) = logs_of(config)
    assert (log.topic, log.through, log.axes, log.enabled) == ("/dvl", "ground", ("x", "y", "z"), False)
    assert log.mount.rpy_deg == (180.0, 0.0, 0.0)
    assert "a Doppler log's, by its type; differs from the GNSS track by 0.0" in text
    assert "m/s RMS beyond the fixes' noise" in text
    assert [t.msgtype for t in found.topics if t.topic == "/dvl"] == [msgtype]
    sensors = {name: s.model_copy(update={"enabled": True}) for name, s in config.sensors.items() if s.kind in ("imu", "body_velocity")}  # fmt: skip
    recording = read_recording(tmp_path / "run", config.model_copy(update={"sensors": sensors}))
    assert len(recording.measurements) == 400


def test_astern_throughout_is_a_log_that_looks_aft(tmp_path: Path) -> None:
    make = Messages(2)
    _, config, text = look(tmp_path, driven(make, GENERAL[0], sign=-1.0), make)
    (log,) = logs_of(config)
    assert log.mount.rpy_deg == (180.0, 0.0, 180.0)
    assert "goes astern nearly all the time" in text


@pytest.mark.parametrize("water", [slice(200, 400), slice(None)])
def test_what_is_through_water_is_a_sensor_of_its_own(water: slice, tmp_path: Path) -> None:
    make = Messages(2)
    _, config, _ = look(tmp_path, driven(make, GENERAL[0], water), make)
    logs = {log.through: log.topic for log in logs_of(config)}
    assert logs == dict.fromkeys(("ground", "water") if water.start else ("water",), "/dvl")


@pytest.mark.parametrize("msgtype", [WATERLINKED[0], GENERAL[0]])
def test_two_sensors_read_one_topic_where_it_says_through_what(msgtype: str, tmp_path: Path) -> None:
    """Of the other types each message would count twice."""
    make = Messages(2)
    items = [("/dvl", at, said(make, msgtype, header=make.header(at), **fields(make, msgtype, through=mode))) for mode, at in ((1, START_NS), (2, START_NS + S))]  # fmt: skip
    path = hold_bag(tmp_path / "run", make, items)
    sensors = {through: BodyVelocityConfig(topic="/dvl", through=through) for through in ("ground", "water")}
    config = VesselConfig(sensors=sensors)
    if msgtype in WATERLINKED:
        with pytest.raises(
            InputError,
            match=r"sensors\.water and sensors\.ground read /dvl over ground and through water; dvl_msgs/DVL does not say",
        ):
            read_recording(path, config)
        return
    recording = read_recording(path, config)
    assert [(m.sensor, m.stamp_ns - START_NS) for m in recording.measurements] == [("ground", 0), ("water", S)]
    assert {(row.sensor, row.outcome) for row in recording.rows} == {
        ("ground", Outcome.IGNORED),
        ("water", Outcome.IGNORED),
    }


@pytest.mark.parametrize("down", [True, False])
def test_a_frame_of_tf_whose_z_is_up_is_not_the_logs(down: bool, tmp_path: Path) -> None:
    """Drivers name `dvl_link`, which a robot's model draws with z up as all its links."""
    make = Messages(2)
    turned = Rotation.from_euler("ZX", [30.0, 180.0 if down else 0.0], degrees=True)
    edges = [("base_link", "imu_link", (0, 0, 0), (0, 0, 0, 1)), ("base_link", "dvl", (1.0, 0.5, -0.75), turned.as_quat().tolist())]  # fmt: skip
    items = [("/tf_static", START_NS, make.transforms(edges)), *driven(make, GENERAL[0])]
    _, config, _ = look(tmp_path, items, make)
    (log,) = logs_of(config)
    if down:
        assert log.mount.tf_frame == "dvl"
        return
    wanted = Rotation.from_euler("ZX", [30.0, 180.0], degrees=True).as_matrix()
    np.testing.assert_allclose(log.mount.R_body_sensor, wanted, atol=1e-3)
    assert log.mount.xyz_m == (1.0, 0.5, -0.75)


def test_one_that_may_sit_at_45_deg_tells_how_the_imu_sits_only_where_nothing_else_moves(tmp_path: Path) -> None:
    make = Messages(2)
    for name, without, source in (("both", "", "/fix"), ("alone", "/fix", "/dvl")):
        (tmp_path / name).mkdir()
        items = [item for item in driven(make, GENERAL[0]) if item[0] != without]
        found, _, _ = look(tmp_path / name, items, make)
        assert f"yaw by the motion of {source}:" in found.imus[0].mount.evidence


def test_tf_turns_what_it_says_to_ahead(tmp_path: Path) -> None:
    """It sits at 90 deg: ahead is its y, and what it drifts by in x is none."""
    make = Messages(2)
    turned = Rotation.from_euler("ZX", [90.0, 180.0], degrees=True)
    items = [item for item in driven(make, GENERAL[0], drift_mps=9.0) if item[0] != "/fix"]
    for topic, _, m in items:
        if topic == "/dvl":
            x, y, z = turned.inv().apply([m.velocity.x, m.velocity.y, 0.0])
            m.velocity = make.vector((x, y, z))
    edges = [("base_link", "dvl", (0, 0, 0), turned.as_quat().tolist())]
    found, _, _ = look(tmp_path, [("/tf_static", START_NS, make.transforms(edges)), *items], make)
    evidence = found.imus[0].mount.evidence
    assert "yaw by the motion of /dvl: 0 deg" in evidence.replace("-0 deg", "0 deg")
    assert float(evidence.partition("coherence ")[2].partition(")")[0]) > 0.95


@pytest.mark.parametrize(("yaw_deg", "axes"), [(90.0, ("x", "y")), (45.0, ("x", "y")), (0.0, ("x",))])
def test_a_twist_in_the_axes_of_a_log_is_turned_by_tf(yaw_deg: float, axes: tuple[str, ...], tmp_path: Path) -> None:
    """Judged by its own x it was 'no velocity of the craft' at 90 deg, drafted by x alone at 45, and gave the IMU a wrong yaw."""
    make = Messages(2)
    turned = Rotation.from_euler("ZX", [yaw_deg, 180.0], degrees=True)
    items: list[Item] = []
    for topic, at, m in drive(make, seconds=90):
        if topic == "/wheel/odom":
            v = turned.inv().apply([m.twist.twist.linear.x, 0.0, 0.0])
            topic, m = "/dvl/twist", make.twist(at, v.tolist(), frame="dvl_link")
        items.append((topic, at, m))
    edges = [("base_link", "dvl_link", (0, 0, 0), turned.as_quat().tolist())]
    found, config, text = look(tmp_path, [("/tf_static", START_NS, make.transforms(edges)), *items], make)
    (log,) = logs_of(config)
    assert (log.topic, log.mount.tf_frame, log.axes) == ("/dvl/twist", "dvl_link", axes)
    assert "differs from the GNSS track by 0.0" in found.velocities[0].why
    assert "no velocity of the craft" not in text
    assert found.imus[0].mount.rpy_deg == pytest.approx((0.0, 0.0, 0.0), abs=0.5)


def test_one_that_never_locked_is_no_crash(tmp_path: Path) -> None:
    make = Messages(2)
    items = [*drive(make, seconds=9)]
    for k in range(20):
        at = START_NS + 9 * S + k * S // 5
        items.append(("/dvl", at, said(make, WATERLINKED[0], header=make.header(at), altitude=-1.0)))
    _, config, _ = look(tmp_path, items, make)
    assert all(not log.enabled for log in logs_of(config))
