"""Conformance of every row of the sensor table, from the table (style rule 27)."""

from dataclasses import replace
from typing import Any, Literal, cast

import gtsam
import numpy as np
import pytest

from graphloc.config import KernelConfig
from graphloc.factors import KINDS, SENSORS
from graphloc.frames import Datum, Geodetic
from graphloc.graph import Attachment, Decision, FeltMotion, Sensor
from graphloc.linear import factors_of
from graphloc.measurements import AXES, CompassHeading, TagSighting
from graphloc.row_check import away, slopes
from tests.measurement_models import Camera, Situation, less, model, sensed

DATUM = Datum(Geodetic(59.3, 18.1, 20.0))
RNG = np.random.default_rng(3)


def config_of(row: Sensor) -> Any:
    """Defaults; tags that stand in world and ride on a dock, and poses of USBL, so that they have slow states; a Doppler log in a current, its mount unknown."""
    if row.kind == "pose":
        axes, slow_error = ["x", "y", "z", "yaw"], {"sigma_m": 1.0, "sigma_deg": 2.0}
        return row.config.model_validate({"kind": row.kind, "axes": axes, "slow_error": slow_error})
    if row.kind == "body_velocity":
        unknown = {"mount_sigma_m": 1.0, "mount_sigma_deg": 2.0}
        return row.config.model_validate({"kind": row.kind, "axes": ["x", "y", "z"], "through": "water", **unknown})
    if row.kind != "apriltag":
        return row.config(kind=row.kind)
    tags = [
        {"id": n, "size_m": 0.4, "frame": frame, "xyz_m": [5.0, n, 1.0], "facing_deg": 180.0}
        for n, frame in enumerate(("pier", "world"))
    ]
    return row.config.model_validate({"kind": "apriltag", "survey": {"tags": tags, "docks": [{"name": "pier"}]}})


def attachment(row: Sensor, config: object, *, tilt: float = 0.1, far_m: float = 50.0, slow: bool = True) -> Attachment:
    process = row.slow(config) if slow else None
    yaw = RNG.uniform(-3, 3)
    return Attachment(
        pose_key=1,
        velocity_key=2,
        slow_key=None if process is None else 3,
        leaf_keys=(4, 5),
        T_world_body=gtsam.Pose3(
            gtsam.Rot3.RzRyRx(RNG.uniform(-tilt, tilt), RNG.uniform(-tilt, tilt), yaw), RNG.uniform(-far_m, far_m, 3)
        ),
        v_world_mps=RNG.normal(0, 2, 3),
        T_state_sensor=gtsam.Pose3(gtsam.Rot3.RzRyRx(0.02, -0.03, 0.4), np.array([-1.5, 0.4, 2.2])),
        carried_m=np.array([0.3, -0.2, 0.05]),
        dv_world_mps=np.array([0.1, -0.05, 0.02]),
        gyro_radps=np.array([0.02, -0.01, 0.2]),
        lever_m=np.array([-1.5, 0.4, 2.2]),
        slow_value=None if process is None else RNG.normal(0, 0.1, len(process.sigma)),
        datum=DATUM,
    )


def values_of(at: Attachment, guesses: tuple[tuple[int, Any], ...]) -> gtsam.Values:
    values = gtsam.Values()
    values.insert(at.pose_key, at.T_world_body)
    values.insert(at.velocity_key, at.v_world_mps)
    if at.slow_key is not None:
        values.insert(at.slow_key, np.array(at.slow_value))
    for key, value in (*at.constants, *guesses):
        values.insert(key, value)
    return values


_POSES = {"slow_error": {"sigma_m": 1.0, "sigma_deg": 2.0}}
_RECEIVER = ({"stamp_sigma_s": 0.1, "mount_sigma_m": 1.0}, {"mount_sigma_m": 1.0})
SETTINGS: dict[str, tuple[dict[str, Any], ...]] = {
    "gnss": (*_RECEIVER, {}),
    "gnss_velocity": _RECEIVER,
    "pose": (_POSES, {"axes": AXES, "slow_error": {"sigma_m": 1.0}}),
}
"""With all that a sensor may be off by; and with less, where its state or factor is another then."""
CASES = [
    pytest.param(row, settings, slow, id=f"{row.kind}{n or ''}-{'slow' if slow else 'plain'}")
    for row in SENSORS
    for n, settings in enumerate(SETTINGS.get(row.kind, ({},)))
    for slow in (True, False)
    if not slow or row.slow(config_of(row)) is not None
]
NOT_OF_VELOCITY = {"gnss", "aerial"}
"""A delay makes them depend on it, which their factors do not say (see their docstrings)."""


def under_way(row: Sensor, settings: dict[str, Any], *, slow: bool) -> tuple[Any, Attachment]:
    """Configuration and attachment: between two states, off by all that it may be off by.

    A heading without roll and pitch is of a level vessel: else ZYX yaw and a rotation about the world's z, which poses take for the
    same, differ by the tilt times the other axes.
    """
    config = row.config.model_validate({**config_of(row).model_dump(), **settings})
    level = hasattr(config, "axes") and "yaw" in config.axes and "roll" not in config.axes
    at = attachment(row, config, tilt=0.0 if level else 0.2, slow=slow)
    turned = gtsam.Rot3.Yaw(0.4) if level else gtsam.Rot3.RzRyRx(0.05, -0.08, 0.4)
    many = np.tile([0.1, -0.15, 0.2], 10)
    constants = tuple((6 + k, many[: len(c.sigma)]) for k, c in enumerate(row.constants(config)))
    felt = FeltMotion(np.array([0.8, -0.5, 9.9]), np.array([0.1, 0.3, -0.2]), np.array([0.0, 0.0, -9.81]))
    place = gtsam.Pose3(turned, at.lever_m + np.array([0.3, -0.1, 0.05]))
    slow_value = None if at.slow_value is None else many[: len(at.slow_value)]
    return config, replace(at, T_state_sensor=place, slow_value=slow_value, constants=constants, felt=felt)


@pytest.mark.parametrize(("row", "settings", "slow"), CASES)
def test_a_residual_is_the_model_less_the_measurement(row: Sensor, settings: dict[str, Any], slow: bool) -> None:
    """By `tests.measurement_models`; of tags it is by what the camera misses a mode."""
    config, truth = under_way(row, settings, slow=slow)
    m, z = sensed(row, config, truth)
    for at in (truth, away(truth, 0.03)):
        if isinstance(m, TagSighting):
            expected = Camera.of(Situation.of(row, config, at), m).off_mode(m, 0)
        else:
            expected = less(m, model(row, m, config, at), z)
        (residual,) = row.residuals(m, config, at)
        np.testing.assert_allclose(residual.raw, expected, atol=1e-7)
    told = config if not isinstance(m, TagSighting) else config_of(row)  # the ideal camera is as its mount says
    at = attachment(row, told, slow=slow)
    for residual in row.residuals(row.ideal(at, told), told, at):
        np.testing.assert_allclose(residual.raw, 0.0, atol=1e-7)


@pytest.mark.parametrize(("row", "settings", "slow"), CASES)
def test_the_jacobians_are_those_of_the_residual(row: Sensor, settings: dict[str, Any], slow: bool) -> None:
    """By which predictions are judged and linear factors made; None: no part in it."""
    config, at = under_way(row, settings, slow=slow)
    m, _ = sensed(row, config, at)
    (residual,) = row.residuals(m, config, at)
    told = {at.pose_key: residual.jacobian()}
    if residual.velocity_jacobian is not None:
        told[at.velocity_key] = residual.velocity_jacobian()
    if residual.slow_jacobian is not None and at.slow_key is not None:
        told[at.slow_key] = residual.slow_jacobian()
    told |= zip((key for key, _ in at.constants), residual.constant_jacobians(), strict=False)
    for key, expected in slopes(lambda there: row.residuals(m, config, there)[0].raw, at).items():
        if key != at.velocity_key or row.kind not in NOT_OF_VELOCITY:
            np.testing.assert_allclose(
                told.get(key, np.zeros_like(expected)), expected, atol=5e-5, err_msg=f"state {key}"
            )


@pytest.mark.parametrize(("row", "settings", "slow"), CASES)
def test_factors_say_what_the_model_says(row: Sensor, settings: dict[str, Any], slow: bool) -> None:
    """Native or linear, theirs is the normal equation of the model's slopes, near the truth; leaves eliminated."""
    config, truth = under_way(row, settings, slow=slow)
    m, z = sensed(row, config, truth)
    at = away(truth, 1e-4)
    update = factors_of(row, m, config, at, Decision())
    graph, values = gtsam.NonlinearFactorGraph(), values_of(at, update.guesses)
    for factor in update.factors:
        graph.add(factor)
    by_state = slopes(lambda there: less(m, model(row, m, config, there), z), at)
    found = sorted(set(by_state) & set(map(int, graph.keyVector())))
    for key in set(by_state) - set(found):
        assert (key == at.velocity_key and row.kind in NOT_OF_VELOCITY) or np.abs(by_state[key]).max() < 1e-9
    ordering = gtsam.Ordering()
    for key in found:
        ordering.push_back(key)
    told = graph.linearize(values).marginal(found, gtsam.EliminateQR).augmentedHessian(ordering)
    cov = m.cov if isinstance(m, TagSighting) else row.residuals(m, config, at)[0].cov
    whole = np.column_stack([*(by_state[key] for key in found), -less(m, model(row, m, config, at), z)])
    expected = whole.T @ np.linalg.solve(cov, whole)
    scale = np.sqrt(np.diagonal(expected))
    # At least a share of the largest: native factors hold what is not measured to 1 km.
    scale = np.maximum(scale, np.append(np.full(len(scale) - 1, 0.05), 1e-5) * scale[:-1].max())
    np.testing.assert_allclose(told / np.outer(scale, scale), expected / np.outer(scale, scale), atol=2e-3)


def test_one_metre_east_of_a_fix_is_one_metre_of_residual() -> None:
    row = next(r for r in SENSORS if r.kind == "gnss")
    config = row.config(kind="gnss")
    at = attachment(row, config)
    m = row.ideal(at, config)
    east = gtsam.Pose3(at.T_world_body.rotation(), at.T_world_body.translation() + np.array([1.0, 0.0, 0.0]))
    residual = row.residuals(m, config, replace(at, T_world_body=east))[0]
    assert np.allclose(residual.raw, [1.0, 0.0, 0.0], atol=1e-6)
    assert residual.nis() == pytest.approx(1.0 / 0.25, rel=1e-3)  # 0.5 m sigma, by `ideal`


def test_compass_sign_and_wrap() -> None:
    row = next(r for r in SENSORS if r.kind == "compass")
    config = row.config(kind="compass")
    at = replace(attachment(row, config, tilt=0.0, slow=False), T_state_sensor=gtsam.Pose3())
    at = replace(at, T_world_body=gtsam.Pose3(gtsam.Rot3.Yaw(np.pi - 0.01), np.zeros(3)), carried_m=np.zeros(3))
    m = replace(cast(CompassHeading, row.ideal(at, config)), yaw_rad=-np.pi + 0.01)  # 0.02 rad further, across the wrap
    assert row.residuals(m, config, at)[0].raw[0] == pytest.approx(-0.02)


def test_a_compass_reads_what_a_deviation_table_says() -> None:
    """Heading 030 deg, offset 2 deg, B, C, D, E 3, -1, 0.5, 0.25, off by 0.7 for now: read by hand."""
    row = next(r for r in SENSORS if r.kind == "compass")
    config = row.config(kind="compass")
    coefficients = np.radians([2.0, 3.0, -1.0, 0.5, 0.25, 0.7])
    at = replace(attachment(row, config, tilt=0.0), T_state_sensor=gtsam.Pose3(), slow_value=coefficients)
    at = replace(at, T_world_body=gtsam.Pose3(gtsam.Rot3.Yaw(np.radians(60.0)), np.zeros(3)))
    read = float(cast(CompassHeading, row.ideal(at, config)).yaw_rad)
    deviation = 3.0 * 0.5 - 1.0 * np.sqrt(0.75) + 0.5 * np.sqrt(0.75) + 0.25 * 0.5
    assert np.degrees(read) == pytest.approx(60.0 + 2.0 + deviation + 0.7)


@pytest.mark.parametrize(
    ("sigmas", "axes"),
    [
        ({}, ("yaw", "B", "C", "D", "E", "wander")),
        ({"wander": 0.0}, ("yaw", "B", "C", "D", "E")),
        ({"deviation": 0.0}, ("yaw", "wander")),
        ({"mount_offset": 0.0}, ("yaw", "B", "C", "D", "E", "wander")),  # calibrated, but iron may turn it
        ({"mount_offset": 0.0, "deviation": 0.0, "wander": 0.0}, ("yaw",)),
    ],
)
def test_a_compass_errs_as_configured(sigmas: dict[str, float], axes: tuple[str, ...]) -> None:
    """Mount offset, deviation and wander go with their own sigmas; only the wander passes."""
    row = next(r for r in SENSORS if r.kind == "compass")
    config = row.config(kind="compass").model_copy(update={f"{n}_sigma_deg": value for n, value in sigmas.items()})
    assert row.slow is not None
    process = row.slow(config)
    assert process is not None
    assert process.axes == axes
    assert process.stepped == ("yaw",)
    assert process.sigma[0] == pytest.approx(np.radians(sigmas.get("mount_offset", 1.0) or 0.1))
    assert np.isfinite(process.time_constant_s).tolist() == [axis == "wander" for axis in axes]
    at = replace(attachment(row, config), slow_value=np.zeros(len(axes)))
    off = replace(at, slow_value=np.radians([3.0 * (axis == "wander") for axis in axes]))
    read = [cast(CompassHeading, row.ideal(a, config)).yaw_rad for a in (at, off)]
    assert np.degrees(read[1] - read[0]) == pytest.approx(3.0 if "wander" in axes else 0.0)


@pytest.mark.parametrize("weight", [1.0, 0.25])
def test_weight_scales_the_information(weight: float) -> None:
    row = next(r for r in SENSORS if r.kind == "pose")
    config = row.config(kind="pose")
    at = attachment(row, config, tilt=0.0)
    m = row.ideal(at, config)
    factor = factors_of(row, m, config, at, Decision(weight=weight)).factors[0]
    values = gtsam.Values()
    moved = gtsam.Pose3(at.T_world_body.rotation(), at.T_world_body.translation() + np.array([0.3, 0.0, 0.0]))
    values.insert(1, moved)
    assert factor.error(values) == pytest.approx(0.5 * weight, rel=1e-3)  # 0.3 m is one sigma, by `ideal`


def test_pose_leaves_unmeasured_axes_free() -> None:
    """A planar match says nothing of z, roll and pitch: 1 m and 3 deg there cost nothing."""
    row = next(r for r in SENSORS if r.kind == "pose")
    config = row.config(kind="pose")
    at = replace(attachment(row, config, tilt=0.0), T_state_sensor=gtsam.Pose3())
    m = row.ideal(at, config)
    factor = factors_of(row, m, config, at, Decision()).factors[0]
    values = gtsam.Values()
    turned = at.T_world_body.compose(gtsam.Pose3(gtsam.Rot3.RzRyRx(0.05, 0.05, 0.0), np.array([0.0, 0.0, 1.0])))
    values.insert(1, turned)
    assert factor.error(values) < 1e-2


@pytest.mark.parametrize("kind", ["none", "cauchy"])
def test_a_fix_tells_a_solver_that_goes_on_the_same(kind: Literal["none", "cauchy"]) -> None:
    """Its leaves eliminated, the native factors of a fix are the linear one, to the looseness of their ties (5 mm of 0.5 m)."""
    row = next(r for r in SENSORS if r.kind == "gnss")
    config = row.config(kind="gnss")
    at = attachment(row, config)
    m = row.ideal(at, config)
    assert at.slow_value is not None
    at = replace(at, slow_value=at.slow_value + np.array([0.4, -0.3, 0.2]))  # a residual
    told = []
    for solver in (None, at.T_world_body):
        update = factors_of(row, m, config, replace(at, T_solver=solver), Decision(kernel=KernelConfig(kind=kind)))
        assert bool(update.guesses) == (solver is not None)
        graph = gtsam.NonlinearFactorGraph()
        for factor in update.factors:
            graph.add(factor)
        linear = graph.linearize(values_of(at, update.guesses)).marginal([1, 3], gtsam.EliminateQR)
        order = gtsam.Ordering()
        for key in (1, 3):
            order.push_back(key)
        told.append(linear.augmentedHessian(order))
    assert np.linalg.norm(told[0] - told[1]) < 1e-3 * np.linalg.norm(told[0])


def test_kernel_bounds_the_error_of_an_outlier() -> None:
    row = next(r for r in SENSORS if r.kind == "gnss")
    config = row.config(kind="gnss")
    at = attachment(row, config, slow=False)
    m = row.ideal(at, config)
    far = gtsam.Pose3(at.T_world_body.rotation(), at.T_world_body.translation() + np.array([50.0, 0.0, 0.0]))
    values = gtsam.Values()
    values.insert(1, far)
    plain, cauchy = (
        factors_of(row, m, config, at, Decision(kernel=KernelConfig(kind=kind))).factors[0].error(values)
        for kind in ("none", "cauchy")
    )
    assert plain == pytest.approx(0.5 * (50.0 / 0.5) ** 2, rel=1e-3)
    assert cauchy < 0.01 * plain


def test_every_kind_has_its_config() -> None:
    assert set(KINDS) == {"imu", *(row.kind for row in SENSORS)}
    for config in (KINDS["imu"](kind="imu"), *(config_of(row) for row in SENSORS)):
        assert type(config) is KINDS[config.kind]
        assert type(config).model_validate(config.model_dump(mode="json")) == config


@pytest.mark.parametrize("row", SENSORS, ids=lambda r: r.kind)
def test_hints_say_what_the_state_says(row: Sensor) -> None:
    """A noise-free measurement's hint is the state's own, as far as it tells; lever arms aside."""
    config = config_of(row)
    at = attachment(row, config, tilt=0.0, slow=False)
    at = replace(
        at,
        T_state_sensor=gtsam.Pose3(gtsam.Rot3.Yaw(0.4), np.zeros(3)),
        lever_m=np.zeros(3),
        dv_world_mps=np.zeros(3),
        carried_m=np.zeros(3),
    )
    hint = row.hint(row.ideal(at, config), 0.4, DATUM)
    truth = at.T_world_body.translation()
    told = np.isfinite(hint.p_world_m)
    np.testing.assert_allclose(hint.p_world_m[told], truth[told], atol=1e-3)  # the sea falls 0.4 mm off at 70 m
    assert np.isfinite(hint.p_sigma_m[told]).all()
    if np.isfinite(hint.yaw_rad):
        # A heading counts from north where the vessel is, which lies up to 1.3e-5 rad off the datum's at 50 m east of it.
        north_rad = truth[0] / 6.37e6 * np.tan(np.radians(DATUM.origin.latitude_deg)) if row.kind == "compass" else 0.0
        off_rad = hint.yaw_rad - at.T_world_body.rotation().yaw() + north_rad
        assert np.angle(np.exp(1j * off_rad)) == pytest.approx(0.0, abs=1e-8)
    if np.isfinite(hint.v_world_mps).all():
        np.testing.assert_allclose(DATUM.local_axes(truth) @ hint.v_world_mps, at.v_world_mps, atol=1e-9)
    says = {"gnss": told.all(), "pose": np.isfinite(hint.yaw_rad), "compass": np.isfinite(hint.yaw_rad)}
    assert says.get(row.kind, True)


def test_a_factor_in_the_solvers_tangent_says_nothing_of_where_vessel_and_dock_are() -> None:
    """Shifted together, a vessel and the dock that it sees look the same - also to a solver that turns shifts otherwise."""
    row = next(r for r in SENSORS if r.kind == "apriltag")
    config = config_of(row)
    at = attachment(row, config)
    turned = at.T_world_body.compose(gtsam.Pose3(gtsam.Rot3.RzRyRx(0.02, -0.03, 0.05), np.array([0.3, -0.2, 0.1])))
    seen = row.ideal(at, config)
    plain, written = (factors_of(row, seen, config, a, Decision()) for a in (at, replace(at, T_solver=turned)))
    here = values_of(at, plain.guesses)
    for one, other in zip(plain.factors, written.factors, strict=True):
        assert other.error(here) == pytest.approx(one.error(here), abs=1e-6)
    there = gtsam.Values(here)
    there.update(at.pose_key, turned)
    east = np.array([1.0, 0.0, 0.0])
    shift = {
        at.pose_key: np.concatenate([np.zeros(3), turned.rotation().matrix().T @ east]),
        3: np.concatenate([east, np.zeros(4)]),
        at.leaf_keys[0]: np.concatenate([east, np.zeros(4)]),
    }
    moved = [np.hstack([shift[key] for key in map(int, f.keys())]) for f in written.factors]
    for factor, step in zip(written.factors, moved, strict=True):
        assert np.abs(factor.linearize(there).jacobian()[0] @ step).max() < 1e-6
    stale = [np.abs(f.linearize(there).jacobian()[0] @ s).max() for f, s in zip(plain.factors, moved, strict=True)]
    assert max(stale) > 1.0  # sigmas a metre, of each sighting
