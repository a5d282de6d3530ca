"""The factor of a sighting: where it leads, what it says of docks, and that it does not bend headings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import gtsam
import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from graphloc import keys
from graphloc.config import AprilTagConfig, CameraConfig
from graphloc.factors.apriltag import ROW, factors
from graphloc.frames import Array, Datum, Geodetic
from graphloc.frontends.tags.pose import modes_of, poses_of
from graphloc.graph import Attachment, Decision
from graphloc.judge.decide import by_hypotheses, predicted
from graphloc.linear import Term, linear_update
from graphloc.measurements import TagSighting
from graphloc.survey import Survey
from tests.tagfactory import AHEAD, FACES_SOUTH, SIGMA, SIZE_M, UNIT, degrees_between, nearest_mode, rays_of

CAMERA_M = np.array([1.5, 0.2, 2.0])  # of the camera in body
MIDDLE_M = np.array([0.0, 0.0, 1.5])
CORNERS_M = MIDDLE_M + SIZE_M * UNIT @ FACES_SOUTH.T
TAG: dict[str, object] = {"id": 7, "size_m": SIZE_M, "xyz_m": [0.0, 0.0, 1.5], "facing_deg": 180.0}
FIXED = AprilTagConfig(survey=Survey.model_validate({"tags": [TAG]}))


def vessel(
    range_m: float, bearing_deg: float, off_deg: float = 0.0, roll_pitch_deg: Sequence[float] | Array = (0.0, 0.0)
) -> Any:
    """Pose of a body whose camera is so far from the tag, so far east of south of it, and looks past it by `off_deg`."""
    b = np.radians(bearing_deg)
    camera = np.array([range_m * np.sin(b), -range_m * np.cos(b), 2.0])
    yaw = float(np.arctan2(-camera[1], -camera[0])) + np.radians(off_deg)
    roll, pitch = np.radians(roll_pitch_deg)
    R = gtsam.Rot3.RzRyRx(roll, pitch, yaw)
    return gtsam.Pose3(R, camera - R.matrix() @ CAMERA_M)


def sighting(
    T: Any, rng: np.random.Generator | None = None, corners_m: Array = CORNERS_M, **changes: Any
) -> TagSighting:
    """What its camera sees of the tag, with noise if `rng` is given."""
    R = T.rotation().matrix()
    rays = rays_of(corners_m, np.asarray(T.translation()) + R @ CAMERA_M, R @ AHEAD)
    rays = rays if rng is None else rays + rng.normal(0.0, SIGMA, (4, 2))
    cov = np.eye(8) * SIGMA**2
    points = changes.pop("points_m", corners_m)
    return TagSighting(
        stamp_ns=0, sensor="tags", seq=0, camera="bow", frame=changes.pop("frame", "world"), numbers=(7,), families=("36h11",), points_m=points,
        pivot_m=changes.pop("pivot_m", MIDDLE_M), rays=rays, cov=cov, t_body_camera_m=CAMERA_M, R_body_camera=AHEAD,
        modes=modes_of(poses_of(points, rays, cov), points, rays, cov),
    )  # fmt: skip


def attached(T: Any, slow_value: Array | None = None) -> Attachment:
    zero = np.zeros(3)
    return Attachment(
        pose_key=1, velocity_key=2, slow_key=None if slow_value is None else 3, leaf_keys=(4, 5), T_world_body=T,
        v_world_mps=zero, T_state_sensor=gtsam.Pose3(), carried_m=zero, dv_world_mps=zero, gyro_radps=zero, lever_m=zero,
        slow_value=slow_value, datum=Datum(Geodetic(59.0, 18.0, 0.0)),
    )  # fmt: skip


def step(factors: Sequence[Any], values: gtsam.Values, keys: Sequence[int] = (1,)) -> gtsam.Values:
    """One Gauss-Newton step by least squares (a far tag is badly conditioned for Cholesky)."""
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        graph.add(factor)
    ordering = gtsam.Ordering()
    for key in keys:
        ordering.push_back(key)
    A, b = graph.linearize(values).jacobian(ordering)
    solution = np.linalg.lstsq(A, b, rcond=None)[0]
    delta, at = gtsam.VectorValues(), 0
    for key in keys:
        size = len(values.atVector(key)) if key != 1 else 6
        delta.insert(key, solution[at : at + size])
        at += size
    return values.retract(delta)


def led_from(T: Any, m: TagSighting, mode: int) -> Any:
    """Where ten re-linearisations lead, with a weak prior (30 m, 90 deg) at the start."""
    prior = gtsam.PriorFactorPose3(1, T, gtsam.noiseModel.Diagonal.Sigmas(np.array([1.5] * 3 + [30.0] * 3)))
    for _ in range(10):
        values = gtsam.Values()
        values.insert(1, T)
        update = factors(m, FIXED, attached(T), Decision(mode=mode))
        T = step([*update.factors, prior], values).atPose3(1)
    return T


def apart(a: Any, b: Any) -> tuple[float, float]:
    """How far two poses are from each other, m and deg."""
    return float(np.linalg.norm(a.translation() - b.translation())), degrees_between(
        a.rotation().matrix(), b.rotation().matrix()
    )


def displaced(T: Any, rng: np.random.Generator, far_m: float = 1.5, turn_deg: float = 8.0) -> Any:
    d, w = rng.normal(size=3), rng.normal(size=3)
    d *= rng.uniform(0.3, 1.0) * far_m / np.linalg.norm(d)
    w *= rng.uniform(0.3, 1.0) * np.radians(turn_deg) / np.linalg.norm(w)
    return gtsam.Pose3(gtsam.Rot3(Rotation.from_rotvec(w).as_matrix() @ T.rotation().matrix()), T.translation() + d)


def of_mode(m: TagSighting, k: int) -> Any:
    """Pose of the body that a mode says."""
    R = m.modes[k].R_world_camera @ AHEAD.T
    return gtsam.Pose3(gtsam.Rot3(R), m.modes[k].p_world_camera_m - R @ CAMERA_M)


@pytest.mark.parametrize("range_m", [3.0, 8.0, 15.0, 25.0])
def test_leads_to_the_truth_and_the_other_mode_to_the_mirrored_pose(range_m: float) -> None:
    """From 1.5 m and 8 deg off; poses 20 deg or more apart, so that the estimate is nearer to its own."""
    rng = np.random.default_rng(int(range_m))
    for _ in range(12):
        bearing = rng.choice([-1.0, 1.0]) * rng.uniform(14.0, 50.0)
        true = vessel(range_m, bearing, rng.uniform(-15.0, 15.0), rng.uniform(-2.0, 2.0, 2))
        m = sighting(true)
        right = nearest_mode(m.modes, true.rotation().matrix() @ AHEAD)
        place, turn = apart(led_from(displaced(true, rng), m, right), true)
        assert place < 0.01 * range_m
        assert turn < 0.1
        mirrored = of_mode(m, 1 - right)
        assert apart(mirrored, true)[1] > 20.0
        place, turn = apart(led_from(displaced(mirrored, rng), m, 1 - right), mirrored)
        assert place < 0.01 * range_m
        assert turn < 0.1


def test_the_other_mode_leads_away_from_the_truth_only_where_the_two_are_far_apart() -> None:
    """Poses within 20 deg of each other are one likelihood: its factor stays in the well where the estimate is."""
    for bearing, stays in ((25.0, False), (8.0, True)):
        true = vessel(8.0, bearing)
        m = sighting(true)
        right = nearest_mode(m.modes, true.rotation().matrix() @ AHEAD)
        mirrored = of_mode(m, 1 - right)
        led = led_from(true, m, 1 - right)
        place, turn = apart(led, true if stays else mirrored)
        assert place < 0.05
        assert turn < 0.5
        assert apart(true, mirrored)[1] == pytest.approx(2.0 * bearing, rel=0.2)


def test_from_where_the_estimate_sees_nothing() -> None:
    """Behind the quay, or turned away: the chosen mode leads, not corners that lie behind the camera."""
    true = vessel(6.0, 30.0)
    m = sighting(true)
    right = nearest_mode(m.modes, true.rotation().matrix() @ AHEAD)
    behind = gtsam.Pose3(true.rotation(), true.translation() + np.array([-2.0, 12.0, 0.0]))
    away = gtsam.Pose3(true.rotation().compose(gtsam.Rot3.Yaw(2.5)), true.translation())
    for start in (behind, away):
        place, turn = apart(led_from(start, m, right), true)
        assert place < 0.02
        assert turn < 0.1


def test_hint_is_the_body_behind_a_mounted_camera() -> None:
    true = vessel(5.0, 35.0, 10.0)
    hint = ROW.hint(sighting(true), 0.0, Datum(Geodetic(59.0, 18.0, 0.0)))
    np.testing.assert_allclose(hint.p_world_m, true.translation(), atol=0.01)
    assert hint.yaw_rad == pytest.approx(true.rotation().yaw(), abs=1e-3)
    # Heading by tilt: 0.1 to 0.5 deg there; it swings a body 5 m off, and that is in its place.
    assert np.radians(0.05) < hint.yaw_sigma_rad < np.radians(1.0)
    assert (np.hypot(*hint.p_sigma_m[:2]) > 4.0 * hint.yaw_sigma_rad).all()


DOCKED = AprilTagConfig(
    survey=Survey.model_validate(
        {
            "tags": [{**TAG, "id": 1, "xyz_m": [30.0, 0.0, 1.5]}, {**TAG, "frame": "pier"}],
            "docks": [{"name": "pier", "xyz_m": [4.0, 3.0, 0.0]}],
        }
    ),
)
PIER_M = np.array([4.0, 3.0, 0.0])
AT_REST_M = CORNERS_M + PIER_M


def moved_sighting(motion: Array, T: Any) -> TagSighting:
    """The tag of a dock that has moved by (d, w) about its origin."""
    now = PIER_M + motion[:3] + (AT_REST_M - PIER_M) @ Rotation.from_rotvec(motion[3:]).as_matrix().T
    return sighting(T, corners_m=now, points_m=AT_REST_M, frame="pier", pivot_m=PIER_M)


MOTION = np.array([0.25, -0.15, 0.4, 0.004, -0.003, 0.05])


def test_tags_of_quay_and_dock_are_judged_together_by_one_prediction() -> None:
    """0.3 m of error of the pose is in both; what the dock has moved is in one."""
    T = vessel(6.0, 5.0)
    seen = [sighting(T), moved_sighting(np.zeros(6), T), sighting(T)]
    ats = [attached(T.retract(np.array([0.0, 0.0, 0.0, 0.3, 0.0, 0.0])), np.zeros(6))] * len(seen)
    found = [ROW.residuals(m, DOCKED, at) for m, at in zip(seen, ats, strict=True)]

    def covariance(_state: int, key: int) -> Array:
        return np.eye(3 if key == keys.velocity(0) else 6) * 0.3**2

    predictions = [predicted(r, at, 0, covariance) for r, at in zip(found, ats, strict=True)]
    stream: Any = SimpleNamespace(row=ROW, config=DOCKED, measurements=seen)
    assert min(v.weight for v in by_hypotheses(stream, [0, 1, 2], ats, found, predictions)) > 0.9


TWO_DOCKS = AprilTagConfig(
    survey=Survey.model_validate(
        {
            "tags": [{**TAG, "id": 1, "frame": "barge"}, {**TAG, "frame": "pier"}],
            "docks": [{"name": "barge"}, {"name": "pier", "xyz_m": [4.0, 3.0, 0.0]}],
        }
    )
)


def test_a_docks_known_motion_explains_what_is_seen() -> None:
    """The first dock has the first six of the slow state, the second the next: it alone counts."""
    near = vessel(7.0, 30.0)
    true = gtsam.Pose3(near.rotation(), near.translation() + PIER_M)
    m = moved_sighting(MOTION, true)
    for other in (np.zeros(6), np.full(6, 0.3)):
        at = attached(true, np.concatenate([other, MOTION]))
        found = ROW.residuals(m, TWO_DOCKS, at)
        right = int(np.argmin([float(r.raw @ r.raw) for r in found]))
        np.testing.assert_allclose(found[right].raw, 0.0, atol=2e-3)
        update = factors(m, TWO_DOCKS, at, Decision(mode=right))
        values = gtsam.Values()
        values.insert(1, true)
        values.insert(3, np.array(at.slow_value))
        for key, value in update.guesses:
            values.insert(key, value)
        assert sum(factor.error(values) for factor in update.factors) < 1e-9
    still = min(float(r.raw @ r.raw) for r in ROW.residuals(m, TWO_DOCKS, attached(true, np.zeros(12))))
    assert still > 0.1**2


@pytest.mark.parametrize("share", [0.0, 0.25, 0.5])
def test_a_dock_is_found_between_two_nodes(share: float) -> None:
    """The next node is held at twice the motion, this one is free: what is seen says where it is."""
    near = vessel(6.0, 30.0)
    true = gtsam.Pose3(near.rotation(), near.translation() + PIER_M)
    m = moved_sighting(MOTION, true)
    slow, following = np.zeros(6), 2.0 * MOTION
    for _ in range(8):
        at = replace(attached(true, slow), slow_next=(6, following, share, 1.0))
        found = ROW.residuals(m, DOCKED, at)
        right = int(np.argmin([float(r.raw @ r.raw) for r in found]))
        update = factors(m, DOCKED, at, Decision(mode=right))
        values = gtsam.Values()
        values.insert(1, true)
        values.insert(3, slow)
        values.insert(6, following)
        for key, value in update.guesses:
            values.insert(key, value)
        known = gtsam.PriorFactorPose3(1, true, gtsam.noiseModel.Isotropic.Sigma(6, 1e-7))
        loose = gtsam.PriorFactorVector(3, np.zeros(6), gtsam.noiseModel.Isotropic.Sigma(6, 30.0))
        held = gtsam.PriorFactorVector(6, following, gtsam.noiseModel.Isotropic.Sigma(6, 1e-7))
        slow = step([*update.factors, known, loose, held], values, (1, 3, 4, 6)).atVector(3)
    np.testing.assert_allclose((1.0 - share) * slow + share * following, MOTION, atol=1e-4)


def test_how_far_a_dock_may_be_from_the_line_between_two_nodes() -> None:
    """A Brownian bridge: half way between nodes a second apart, half a step of the process."""
    near = vessel(6.0, 30.0)
    true = gtsam.Pose3(near.rotation(), near.translation() + PIER_M)
    m = moved_sighting(np.zeros(6), true)
    process = ROW.slow(DOCKED)
    assert process is not None
    at = replace(attached(true, np.zeros(6)), slow_next=(6, np.zeros(6), 0.5, 1.0))
    right = int(np.argmin([float(r.raw @ r.raw) for r in ROW.residuals(m, DOCKED, at)]))
    tie = factors(m, DOCKED, at, Decision(mode=right)).factors[0]
    values = gtsam.Values()
    values.insert(3, np.zeros(6))
    values.insert(4, np.array([0.02, 0.0, 0.0, 0.0, 0.0, 0.0]))
    values.insert(6, np.zeros(6))
    step_m = float(process.sigma[0] * np.sqrt(2.0 / process.time_constant_s[0]))
    assert set(tie.keys()) == {3, 4, 6}
    assert tie.error(values) == pytest.approx(0.5 * (0.02 / (0.5 * step_m)) ** 2, rel=1e-6)


def test_a_dock_goes_on_while_its_next_node_is_not_there_yet() -> None:
    """Online a sighting comes before the node after it: the dock may have stepped as far as the process does by then."""
    near = vessel(6.0, 30.0)
    true = gtsam.Pose3(near.rotation(), near.translation() + PIER_M)
    m = moved_sighting(np.zeros(6), true)
    process = ROW.slow(DOCKED)
    assert process is not None
    at = replace(attached(true, np.zeros(6)), slow_age_s=0.8)
    tie = factors(m, DOCKED, at, Decision()).factors[0]
    values = gtsam.Values()
    values.insert(3, np.zeros(6))
    values.insert(4, np.array([0.02, 0.0, 0.0, 0.0, 0.0, 0.0]))
    keep = np.exp(-0.8 / process.time_constant_s[0])
    step_m = float(process.sigma[0] * np.sqrt(1.0 - keep**2))
    assert set(tie.keys()) == {3, 4}
    assert tie.error(values) == pytest.approx(0.5 * (0.02 / step_m) ** 2, rel=1e-6)
    away = np.array([0.1, -0.05, 0.3, 0.01, 0.0, -0.02])
    back = factors(m, DOCKED, replace(at, slow_value=away), Decision()).factors[0]
    values.update(3, away)
    values.update(4, away * np.exp(-0.8 / process.time_constant_s[:6]))  # it returns to its place at rest
    assert back.error(values) == pytest.approx(0.0, abs=1e-9)


def test_what_the_survey_errs_about_a_tag_is_a_constant() -> None:
    """A tag that hangs elsewhere and askew, by its constant: explained, and found where the vessel is known."""
    true = vessel(6.0, 30.0)
    off = np.array([0.03, -0.02, 0.01, 0.002, -0.001, 0.0015])
    turned = Rotation.from_rotvec(off[3:]).as_matrix()
    now = CORNERS_M.mean(axis=0) + off[:3] + (CORNERS_M - CORNERS_M.mean(axis=0)) @ turned.T
    m = sighting(true, corners_m=now, points_m=CORNERS_M)
    config = AprilTagConfig(survey=Survey.model_validate({"tags": [{**TAG, "sigma_m": 0.05, "sigma_deg": 2.0}]}))
    constant = np.zeros(6)
    for _ in range(8):
        at = replace(attached(true), constants=((6, constant),))
        update = factors(m, config, at, Decision(mode=0))
        values = gtsam.Values()
        values.insert(1, true)
        values.insert(6, constant)
        known = gtsam.PriorFactorPose3(1, true, gtsam.noiseModel.Isotropic.Sigma(6, 1e-7))
        loose = gtsam.PriorFactorVector(6, np.zeros(6), gtsam.noiseModel.Isotropic.Sigma(6, 30.0))
        constant = step([*update.factors, known, loose], values, (1, 6)).atVector(6)
    np.testing.assert_allclose(constant, off, atol=1e-4)  # the turn is taken to first order


def slow_found(
    m: TagSighting,
    config: AprilTagConfig,
    mode: int,
    attach: Callable[[Array], Attachment],
    prior: Array,
    sigmas: Array,
    times: int = 6,
) -> Array:
    """What a sighting says of the slow state where the vessel is known: so many Gauss-Newton steps from the prior."""
    slow = prior
    for _ in range(times):
        at = attach(slow)
        update = factors(m, config, at, Decision(mode=mode))
        values = gtsam.Values()
        values.insert(1, at.T_world_body)
        values.insert(3, slow)
        for key, value in update.guesses:
            values.insert(key, value)
        known = gtsam.PriorFactorPose3(1, at.T_world_body, gtsam.noiseModel.Isotropic.Sigma(6, 1e-7))
        loose = gtsam.PriorFactorVector(3, prior, gtsam.noiseModel.Diagonal.Sigmas(sigmas))
        leaf = [key for key, _ in update.guesses]
        slow = step([*update.factors, known, loose], values, (1, 3, *leaf)).atVector(3)
    return np.asarray(slow)


BOW = {"bow": CameraConfig(topic="/images", stamp_sigma_s=0.0)}


@pytest.mark.parametrize("on_a_dock", [False, True])
def test_what_a_mount_is_off_is_found_where_the_vessel_is_known(on_a_dock: bool) -> None:
    """The camera looks 17 deg elsewhere than its mount says; where the estimate has that, nothing is left to explain."""
    off = np.array([0.03, -0.05, 0.3])
    near = vessel(9.0, 40.0, roll_pitch_deg=(3.0, -2.0))
    true = gtsam.Pose3(near.rotation(), near.translation() + PIER_M) if on_a_dock else near
    given, docks = (DOCKED, MOTION) if on_a_dock else (FIXED, np.zeros(0))
    config = given.model_copy(update={"cameras": {"stern": CameraConfig(topic="/others", stamp_sigma_s=0.0)} | BOW})
    seen = moved_sighting(MOTION, true) if on_a_dock else sighting(true)
    m = replace(seen, R_body_camera=Rotation.from_rotvec(-off).as_matrix() @ seen.R_body_camera)
    mode = nearest_mode(m.modes, true.rotation().matrix() @ AHEAD)
    sigmas = np.concatenate([np.full(len(docks), 1e-7), np.full(6, 30.0), [1e-7]])
    slow = slow_found(m, config, mode, lambda at_slow: attached(true, at_slow), np.append(docks, np.zeros(7)), sigmas)
    np.testing.assert_allclose(slow, np.concatenate([docks, np.zeros(3), off, [0.0]]), atol=1e-4)
    np.testing.assert_allclose(ROW.residuals(m, config, attached(true, slow))[mode].raw, 0.0, atol=5e-3)
    as_given = config.model_copy(update={"cameras": {"bow": BOW["bow"].model_copy(update={"mount_sigma_deg": 0.0})}})
    fixed = ROW.residuals(m, as_given, attached(true, np.append(docks, 0.0)))[mode].raw
    assert np.linalg.norm(fixed[3:]) == pytest.approx(np.linalg.norm(off), abs=1e-2)


def under_way(T: Any, slow_value: Array) -> Attachment:
    """It rolls by 6 deg/s, turns by 3 deg/s, and goes at 2 m/s."""
    at = attached(T, slow_value)
    return replace(
        at,
        v_world_mps=np.array([1.5, 1.0, 0.1]),
        dv_world_mps=np.array([0.2, 0.1, 0.0]),
        gyro_radps=np.radians([6.0, 1.0, 3.0]),
    )


@pytest.mark.parametrize("on_a_dock", [False, True])
def test_by_how_much_stamps_are_late_is_found_where_the_vessel_is_known(on_a_dock: bool) -> None:
    """The image is of 0.2 s before its stamp, and she was where her speed and turning have her then."""
    near = vessel(9.0, 40.0, roll_pitch_deg=(3.0, -2.0))
    then = gtsam.Pose3(near.rotation(), near.translation() + PIER_M) if on_a_dock else near
    given, docks = (DOCKED, MOTION) if on_a_dock else (FIXED, np.zeros(0))
    config = given.model_copy(update={"cameras": {"bow": CameraConfig(topic="/images", mount_sigma_deg=0.0)}})
    m = moved_sighting(MOTION, then) if on_a_dock else sighting(then)
    mode = nearest_mode(m.modes, then.rotation().matrix() @ AHEAD)
    at = under_way(then, np.zeros(0))
    world_radps = then.rotation().matrix() @ at.gyro_radps
    now = gtsam.Pose3(
        gtsam.Rot3.Expmap(0.2 * world_radps).compose(then.rotation()),
        then.translation() + 0.2 * (at.v_world_mps + at.dv_world_mps),
    )
    sigmas = np.concatenate([np.full(len(docks), 1e-7), [30.0, 1e-7]])
    slow = slow_found(m, config, mode, lambda at_slow: under_way(now, at_slow), np.append(docks, np.zeros(2)), sigmas)
    assert slow[-2] == pytest.approx(0.2, abs=0.01)  # to first order


@pytest.mark.parametrize("mount_sigma_deg", [0.0, 1.0])
@pytest.mark.parametrize("on_a_dock", [False, True])
def test_how_a_modes_residual_changes_with_the_slow_state(on_a_dock: bool, mount_sigma_deg: float) -> None:
    true = vessel(9.0, 40.0, roll_pitch_deg=(3.0, -2.0))
    bow = CameraConfig(topic="/images", mount_sigma_deg=mount_sigma_deg)
    config = (DOCKED if on_a_dock else FIXED).model_copy(update={"cameras": {"bow": bow}})
    m = moved_sighting(MOTION, true) if on_a_dock else sighting(true)
    turned = [0.004, -0.002, 0.003] if mount_sigma_deg else []
    slow = np.concatenate([MOTION if on_a_dock else [], turned, [0.01, 0.0]])
    (found, *_) = ROW.residuals(m, config, under_way(true, slow))
    assert found.slow_jacobian is not None
    slopes = found.slow_jacobian()
    for k in range(len(slow)):
        ends = [
            ROW.residuals(m, config, under_way(true, slow + way * np.eye(len(slow))[k]))[0].raw for way in (-1e-6, 1e-6)
        ]
        np.testing.assert_allclose(
            slopes[:, k], (ends[1] - ends[0]) / 2e-6, atol=0.02 * max(1.0, np.abs(slopes[:, k]).max())
        )


def test_slow_states_and_constants() -> None:
    tags = [
        {**TAG, "sigma_m": 0.03, "sigma_deg": 0.5},
        {**TAG, "id": 8, "frame": "pier", "sigma_m": 0.0, "sigma_deg": 0.0},
    ]
    dock = {"name": "pier", "moves_m": 0.6, "moves_deg": 3.0, "rises_m": 2.0, "tilts_deg": 1.0, "period_s": 20.0}
    config = AprilTagConfig(survey=Survey.model_validate({"tags": tags, "docks": [dock]}))
    process = ROW.slow(config)
    assert process is not None
    assert process.axes == (*(f"pier {a}" for a in ("east", "north", "up", "roll", "pitch", "yaw")), "outwards")
    assert process.units == ("m", "m", "m", "deg", "deg", "deg", "px")
    sigmas = np.delete(process.scale * process.sigma, 2)  # up: a test of its own
    np.testing.assert_allclose(sigmas, [0.3, 0.3, 0.5, 0.5, 1.5, config.edge_sigma_px])
    first, second = ROW.constants(config)
    np.testing.assert_allclose(first.sigma, [0.03] * 3 + [np.radians(0.5)] * 3)
    assert (second.sigma > 0.0).all()
    quay = AprilTagConfig(survey=Survey.model_validate({"tags": tags[:1]}))
    assert [c.name for c in ROW.constants(config)] == ["tag 7", "tag 8"]
    twins = AprilTagConfig(survey=Survey.model_validate({"tags": [TAG, {**TAG, "family": "25h9"}]}))
    assert [c.name for c in ROW.constants(twins)] == ["tag 7 (36h11)", "tag 7 (25h9)"]
    alone = ROW.slow(quay)
    assert alone is not None
    assert alone.axes == ("outwards",)
    steady = {
        "stern": CameraConfig(topic="/stern", mount_sigma_deg=0.0),
        "bow": CameraConfig(topic="/bow", mount_sigma_deg=2.0, stamp_sigma_s=0.0),
    }
    mounted = ROW.slow(config.model_copy(update={"cameras": steady}))
    assert mounted is not None
    assert mounted.axes[6:] == ("stern late", "bow mount roll", "bow mount pitch", "bow mount yaw", "outwards")
    assert mounted.units[6:] == ("s", "deg", "deg", "deg", "px")
    np.testing.assert_allclose((mounted.scale * mounted.sigma)[6:10], [0.03, 2.0, 2.0, 2.0])
    assert np.isinf(mounted.time_constant_s).tolist() == [False] * 6 + [True] * 4 + [False]
    assert ROW.slow(quay.model_copy(update={"edge_sigma_px": 0.0})) is None
    assert ROW.slow(AprilTagConfig()) is None


def chain(sigma: float, time_constant_s: float, count: int = 20000) -> Array:
    """A Markov process, a second at a time."""
    keep = np.exp(-1.0 / time_constant_s)
    white = sigma * np.sqrt(1.0 - keep**2) * np.random.default_rng(0).normal(size=count)
    return np.asarray(lfilter([1.0], [1.0, -keep], white))


def of_dock(**keys: float) -> tuple[Array, Array]:
    """Sigma and time constant of the six ways in which a dock moves."""
    tag = {**TAG, "frame": "pier", "sigma_m": 0.0, "sigma_deg": 0.0}
    survey = Survey.model_validate({"tags": [tag], "docks": [{"name": "pier", **keys}]})
    process = ROW.slow(AprilTagConfig(survey=survey))
    assert process is not None
    return process.sigma[:6], process.time_constant_s[:6]


@pytest.mark.parametrize("period_s", [8.0, 25.0, 60.0])
def test_a_dock_steps_as_far_in_a_second_as_a_swing_of_its_period(period_s: float) -> None:
    """Simulated: the Markov chain of `slow`, and a sinusoid of the same RMS; their RMS steps agree."""
    sigmas, times_s = of_dock(moves_m=0.5, tilts_deg=2.0, period_s=period_s, wave_period_s=period_s)
    for axis, half in ((0, 0.25), (3, np.radians(1.0))):
        assert sigmas[axis] == pytest.approx(half)  # half of how far it wanders, or tilts
        swing = half * np.sqrt(2.0) * np.sin(2.0 * np.pi * np.arange(20000) / period_s)
        assert np.diff(chain(sigmas[axis], times_s[axis])).std() == pytest.approx(np.diff(swing).std(), rel=0.06)


def test_a_dock_rises_with_the_tide_and_heaves_with_the_waves() -> None:
    """In a second as far as waves and tide lift it; over a quarter of an hour, as far off as the tide takes it."""
    (*_, sigma, _, _, _), (*_, time_s, _, _, _) = of_dock(rises_m=2.0, heaves_m=0.2, wave_period_s=8.0)
    swing = 0.1 * np.sqrt(2.0) * np.sin(2.0 * np.pi * np.arange(20000) / 8.0)
    both = np.hypot(np.diff(swing).std(), np.diff(chain(1.0, 3600.0)).std())
    assert np.diff(chain(sigma, time_s)).std() == pytest.approx(both, rel=0.06)
    means = chain(sigma, time_s, 900 * 1000).reshape(1000, 900).mean(axis=1)
    assert 0.9 < means.std() < 2.0
    (*_, calm, _, _, _), (*_, calm_s, _, _, _) = of_dock(rises_m=2.0, heaves_m=0.0)
    assert (calm, calm_s) == pytest.approx((1.0, 3600.0))


def heading_off_deg(seed: int, count: int, gaussian: bool, bearing_deg: float = 3.0, range_m: float = 20.0) -> float:
    """Error of the heading by so many noisy images of one pose and a prior of 0.5 deg about the truth.

    `gaussian`: by the Gaussian of the mode that is nearer each time, which is what it would be decided by.
    """
    rng = np.random.default_rng(seed)
    true = vessel(range_m, bearing_deg, 4.0)
    seen = [sighting(true, rng) for _ in range(count)]
    sigmas = np.array([*np.radians([1.0, 1.0, 0.5]), 2.0, 2.0, 2.0])
    prior, T = gtsam.PriorFactorPose3(1, true, gtsam.noiseModel.Diagonal.Sigmas(sigmas)), true
    for _ in range(5):
        at, made = attached(T), list[Any]()
        for m in seen:
            found = ROW.residuals(m, FIXED, at)
            mode = int(np.argmax([r.log_density() for r in found]))
            if gaussian:
                made += linear_update(found[mode], [Term(1, T, found[mode].jacobian())], Decision(mode=mode)).factors
            else:
                made += factors(m, FIXED, at, Decision(mode=mode)).factors
        values = gtsam.Values()
        values.insert(1, T)
        T = step([*made, prior], values).atPose3(1)
    return float(np.degrees(true.rotation().between(T.rotation()).yaw()))


def test_many_sightings_of_a_far_tag_do_not_bend_the_heading() -> None:
    """20 m before a tag, 3 deg off its normal: each image's two poses lie some 10 deg to either side of it."""
    by_corners = [heading_off_deg(seed, 60, False) for seed in range(2)]
    by_modes = [heading_off_deg(seed, 60, True) for seed in range(2)]
    assert np.abs(by_corners).max() < 0.5
    assert abs(np.mean(by_corners)) < 0.3
    assert abs(np.mean(by_modes)) > 0.5


PX = 1.0 / 1000.0


def wider(m: TagSighting, by_px: float) -> TagSighting:
    """The sighting with the edges of its tag further out: where the shifted lines through its corners meet."""
    corners = np.column_stack([m.rays, np.ones(4)])
    lines = np.cross(corners, np.roll(corners, -1, axis=0))
    lines /= np.linalg.norm(lines[:, :2], axis=1, keepdims=True)
    inside = np.append(m.rays.mean(axis=0), 1.0)
    lines[:, 2] += by_px * PX * np.sign(lines @ inside)
    meet = np.cross(np.roll(lines, 1, axis=0), lines)
    return replace(m, rays=meet[:, :2] / meet[:, 2:], px=PX)


@pytest.mark.parametrize("on_a_dock", [False, True])
def test_edges_that_are_seen_too_far_out_explain_a_tag_that_looks_too_large(on_a_dock: bool) -> None:
    near = vessel(9.0, 40.0, roll_pitch_deg=(3.0, -2.0))
    true = gtsam.Pose3(near.rotation(), near.translation() + PIER_M) if on_a_dock else near
    config, docks = (DOCKED, MOTION) if on_a_dock else (FIXED, np.zeros(0))
    m = wider(moved_sighting(MOTION, true) if on_a_dock else sighting(true), 0.3)
    assert np.abs(m.rays - sighting(true).rays).max() > 0.2 * PX or on_a_dock
    mode, sigmas = nearest_mode(m.modes, true.rotation().matrix() @ AHEAD), np.append(np.full(len(docks), 1e-7), 30.0)
    slow = slow_found(m, config, mode, lambda at_slow: attached(true, at_slow), np.append(docks, 0.0), sigmas, times=3)
    assert slow[-1] == pytest.approx(0.3, rel=1e-3)


def test_many_sightings_of_a_far_tag_do_not_make_its_distance_surer_than_its_edges_are() -> None:
    """40 m off it is 10 px wide; 0.05 px at each edge are 1 % of that, and of the distance."""
    rng, true = np.random.default_rng(4), vessel(40.0, 5.0)
    seen = [wider(sighting(true, rng), 0.05) for _ in range(100)]
    nearer = [Decision(mode=nearest_mode(m.modes, true.rotation().matrix() @ AHEAD)) for m in seen]
    attitude = gtsam.PriorFactorPose3(1, true, gtsam.noiseModel.Diagonal.Sigmas(np.array([1e-4] * 3 + [30.0] * 3)))
    edges = gtsam.PriorFactorVector(3, np.zeros(1), gtsam.noiseModel.Isotropic.Sigma(1, FIXED.edge_sigma_px))
    off, sigma = {}, {}
    for slow in (None, np.zeros(1)):
        T, modelled = true, slow is not None
        for _ in range(4):
            values = gtsam.Values()
            values.insert(1, T)
            made = [
                f for m, decision in zip(seen, nearer, strict=True) for f in factors(m, FIXED, attached(T, slow), decision).factors
            ]  # fmt: skip
            if slow is not None:
                values.insert(3, slow)
            now = step([*made, attitude, *[edges] * modelled], values, (1, 3) if modelled else (1,))
            T, slow = now.atPose3(1), now.atVector(3) if modelled else None
        graph, ordering = gtsam.NonlinearFactorGraph(), gtsam.Ordering()
        for factor in [*made, attitude, *[edges] * modelled]:
            graph.add(factor)
        for key in (1, 3) if modelled else (1,):
            ordering.push_back(key)
        A = graph.linearize(values).jacobian(ordering)[0]
        cov = np.linalg.inv(A.T @ A)[3:6, 3:6]
        away = true.rotation().matrix().T @ (CORNERS_M.mean(axis=0) - true.translation())
        away /= np.linalg.norm(away)
        off[modelled] = abs(float(away @ true.rotation().matrix().T @ (T.translation() - true.translation())))
        sigma[modelled] = float(np.sqrt(away @ cov @ away))
    assert off[False] > 0.005 * 40.0
    assert off[False] > 3.0 * sigma[False]
    assert sigma[True] == pytest.approx(2.0 * FIXED.edge_sigma_px * PX * 40.0**2 / SIZE_M, rel=0.3)
    assert off[True] < 2.0 * sigma[True]


def test_a_sighting_says_what_it_is() -> None:
    m = sighting(vessel(5.0, 20.0))
    assert ROW.describe is not None
    assert ROW.describe(m) == "bow: tag 7 (world)"
    two = replace(
        m, numbers=(7, 9), families=("36h11",) * 2, points_m=np.vstack([CORNERS_M, CORNERS_M + 1.0]), rays=np.vstack([m.rays, m.rays]),
        cov=np.eye(16) * 1e-8,
    )  # fmt: skip
    assert ROW.describe(two) == "bow: tags 7 9 (world)"


def test_false_is_wider_than_any_mode_and_as_rare_as_it_is_reported_to_be() -> None:
    m = sighting(vessel(20.0, 10.0))
    assert ROW.false is not None
    model = ROW.false(m, FIXED.model_copy(update={"false_fraction": 0.1, "false_repeats": 0.5}))
    assert (model.probability, model.repeats) == (0.1, 0.5)
    found = ROW.residuals(m, FIXED, attached(vessel(20.0, 10.0)))
    assert all((model.cov.diagonal() > r.cov.diagonal()).all() for r in found)
    assert sum(r.prior for r in found) == pytest.approx(1.0 - FIXED.false_fraction)
