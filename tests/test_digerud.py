"""Digerud's filter against a scalar one written here, and his pose of one tag against synthetic sightings."""

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from graphloc.config import AprilTagConfig, VesselConfig
from graphloc.eval import digerud
from graphloc.eval.digerud import losses, run_digerud, single_tag_pose
from graphloc.eval.ekf import FilterResult
from graphloc.frames import Array
from graphloc.ledger import Ledger, Outcome
from graphloc.measurements import TagMode, TagSighting
from graphloc.recording import Recording
from graphloc.trajectory import Trajectory

HALF_M = 0.206
SQUARE = HALF_M * np.array([(-1.0, 0.0, 1.0), (1.0, 0.0, 1.0), (1.0, 0.0, -1.0), (-1.0, 0.0, -1.0)])  # faces south
HIS = ("36h11", 227)
AIM = np.array([0.4, 0.0, 0.2])  # beside the tag
LEVER, R_BODY_CAMERA = np.array([0.8, 0.1, 0.5]), np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def looking(p: Array, at: Array, roll_deg: float = 0.0) -> Array:
    """R_world_camera of a camera at p whose axis goes through `at`; x right, y down."""
    z = (at - p) / np.linalg.norm(at - p)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    level = np.column_stack([x, np.cross(z, x), z])
    return np.asarray(level @ Rotation.from_euler("z", roll_deg, degrees=True).as_matrix())


def sighting(
    seq: int,
    t_s: float,
    p: Array,
    R: Array | None = None,
    *,
    tags: Sequence[tuple[int, float]] = ((227, 0.0),),
    noise: Array | None = None,
    camera: str = "bow",
) -> TagSighting:
    """Tags of (id, east of the origin) seen by a camera at p, which also is its only mode."""
    R = looking(p, AIM) if R is None else R
    points = np.vstack([SQUARE + np.array([east, 0.0, 0.0]) for _, east in tags])
    there = (points - p) @ R
    return TagSighting(
        stamp_ns=round(t_s * 1e9), sensor="tags", seq=seq, camera=camera, frame="world",
        numbers=tuple(n for n, _ in tags), families=("36h11",) * len(tags), points_m=points, pivot_m=np.zeros(3),
        rays=there[:, :2] / there[:, 2:] + (0.0 if noise is None else noise), cov=1e-7 * np.eye(2 * len(points)),
        t_body_camera_m=LEVER, R_body_camera=R_BODY_CAMERA,
        modes=(TagMode(p_world_camera_m=p, R_world_camera=R, cov=np.eye(6), probability=1.0),),
    )  # fmt: skip


def run(
    sightings: Sequence[TagSighting],
    *,
    enabled: bool = True,
    truth: Trajectory | None = None,
) -> FilterResult | None:
    config = VesselConfig(sensors={"tags": AprilTagConfig(enabled=enabled)})
    recording = Recording(source="(test)", imu=None, measurements=tuple(sightings), truth=truth)
    return run_digerud(recording, config)


def ran(sightings: Sequence[TagSighting], truth: Trajectory | None = None) -> FilterResult:
    result = run(sightings, truth=truth)
    assert result is not None
    return result


def camera_track(result: FilterResult) -> Array:
    return np.asarray(result.trajectory.p_world_m + result.trajectory.R_world_body @ LEVER)


@pytest.fixture
def exact(monkeypatch: pytest.MonkeyPatch) -> None:
    """The filter alone: the pose of a tag is the sighting's mode, to the last digit."""

    def told(m: TagSighting, _tag: tuple[str, int]) -> tuple[Array, Array]:
        return m.modes[0].p_world_camera_m, m.modes[0].R_world_camera

    monkeypatch.setattr(digerud, "single_tag_pose", told)


SOUTH = np.array([0.0, -10.0, 0.0])  # ahead of the tag


def south(east_m: float) -> Array:
    """Ten metres off the tag, and so much to the east."""
    return np.array([east_m, -10.0, 0.0])


def scalar(z: Array, dt: Sequence[float], gate: float = np.inf) -> tuple[Array, Array, Array, Array]:
    """One axis of app. B in scalars: position, velocity, variance of position, what was taken."""
    x, v, a, b, c = float(z[0]), 0.0, 1.0, 0.0, 1.0  # P = [[a, b], [b, c]]
    out = []
    for value, step in zip(z, dt, strict=True):
        taken = abs(value - x) < gate
        x = x + step * v
        a, b, c = a + 2 * step * b + step**2 * c + 1.0, b + step * c, c + 1.0
        if taken:
            r, s = value - x, a + 11.0
            x, v = x + a / s * r, v + b / s * r
            a, b, c = a - a * a / s, b - a * b / s, c - b * b / s
        out.append((x, v, a, taken))
    p, velocity, variance, all_taken = np.array(out).T
    return p, velocity, variance, all_taken.astype(bool)


@pytest.mark.usefixtures("exact")
def test_two_steps_by_hand() -> None:
    """P0 = I. First: a = 1 + 0.04^2 + 1 = 2.0016, s = 13.0016, r = 0, so a = 2.0016 * 11 / s = 1.69346,
    b = 0.04 * 11 / s = 0.033842, c = 2 - 0.04^2 / s = 1.999877. Second, 1 m on: a = 1.69346 + 0.08 * 0.033842
    + 0.0016 * 1.999877 + 1 = 2.69937, s = 13.69937, gain 0.197043.
    """
    track = ran([sighting(0, 0.0, SOUTH), sighting(1, 1 / 15, south(1.0))])
    assert [row.nis for row in track.ledger] == pytest.approx([0.0, 1.0 / 13.69937], abs=1e-6)
    assert camera_track(track)[:, 0] == pytest.approx([0.0, 0.197043], abs=1e-6)
    assert camera_track(track)[:, 1] == pytest.approx([-10.0, -10.0])
    assert track.trajectory.cov is not None
    assert track.trajectory.cov[:, 0, 0] == pytest.approx([1.69346, 2.69937 * 11 / 13.69937], abs=1e-4)


@pytest.mark.usefixtures("exact")
def test_agrees_with_a_scalar_filter_and_knows_no_time() -> None:
    """The step is 0.04 s whatever time passes; so the velocity is none."""
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.uniform(0.05, 0.4, 60))
    z = SOUTH + np.column_stack([0.5 * t, 0.3 * t, 0.0 * t]) + rng.normal(0.0, 0.2, (60, 3))
    track = ran([sighting(k, t[k], z[k]) for k in range(60)])
    assert {row.outcome for row in track.ledger} == {Outcome.USED}
    assert track.trajectory.cov is not None
    assert track.trajectory.v_world_mps is None
    for k in range(3):
        p, _, variance, _ = scalar(z[:, k], [0.04] * 60)
        assert camera_track(track)[:, k] == pytest.approx(p, abs=1e-9)
        assert track.trajectory.cov[:, k, k] == pytest.approx(variance, abs=1e-9)


@pytest.mark.usefixtures("exact")
@pytest.mark.parametrize(("step_m", "outcome"), [(2.0, Outcome.REJECTED), (np.nextafter(2.0, 0.0), Outcome.USED)])
def test_gate_is_open_below_two_metres(step_m: float, outcome: Outcome) -> None:
    """The print: norm < 2. The state is at 0 exactly after a first pose at 0."""
    result = ran([sighting(0, 0.0, south(0.0)), sighting(1, 0.1, south(step_m))])
    second = list(result.ledger)[1]
    assert second.outcome is outcome
    assert second.residual_m == step_m
    assert second.reason == ("" if outcome is Outcome.USED else "outside the 2 m gate")


@pytest.mark.usefixtures("exact")
def test_gate_looks_at_the_state_before_prediction() -> None:
    """A pose behind a state that moves ahead: less than 2 m from where it was, and more from where it will be."""
    z = np.linspace(0.0, 8.7, 30)
    p, v, _, taken = scalar(z, [0.04] * 30)
    behind = p[-1] - 2.0 + 0.02 * v[-1]
    assert taken.all()
    assert p[-1] + 0.04 * v[-1] - behind > 2.0 + 1e-3
    result = ran([sighting(k, 0.1 * k, south(east_m)) for k, east_m in enumerate([*z, behind])])
    assert [row.outcome for row in result.ledger] == [Outcome.USED] * 31


@pytest.mark.usefixtures("exact")
def test_a_turned_world_turns_the_track() -> None:
    """Why the filter may run in world, though he has the camera in the tag's frame."""
    rng = np.random.default_rng(1)
    z = SOUTH + np.cumsum(rng.normal(0.0, 0.9, (80, 3)), axis=0)
    turn = Rotation.from_rotvec([0.4, -1.1, 2.0]).as_matrix()
    R = looking(SOUTH, AIM)
    one = ran([sighting(k, 0.1 * k, z[k], R) for k in range(80)])
    other = ran([sighting(k, 0.1 * k, turn @ z[k], turn @ R) for k in range(80)])
    assert one.ledger.counts() == other.ledger.counts()
    assert set(one.ledger.counts()["tags"]) == {"used", "rejected"}
    assert other.trajectory.p_world_m == pytest.approx(one.trajectory.p_world_m @ turn.T)


@pytest.mark.usefixtures("exact")
def test_body_is_by_the_attitude_of_the_last_pose_taken() -> None:
    """A camera 0.8 m ahead of the body, looking ahead: north, then east; a third pose, looking south, is refused."""
    headings = {
        "north": np.array([0.0, 1.0, 0.0]),
        "east": np.array([1.0, 0.0, 0.0]),
        "south": np.array([0.0, -1.0, 0.0]),
    }
    looks = [looking(np.zeros(3), to) for to in headings.values()]
    places = [SOUTH, SOUTH, south(3.0)]
    track = ran([sighting(k, 0.1 * k, places[k], looks[k]) for k in range(3)]).trajectory
    assert np.degrees(track.yaw_rad) == pytest.approx([90.0, 0.0, 0.0])
    # Port is west when heading north, north when heading east.
    assert track.p_world_m[0] == pytest.approx(SOUTH - [-0.1, 0.8, 0.5])
    assert track.p_world_m[1] == pytest.approx(SOUTH - [0.8, 0.1, 0.5])
    assert track.p_world_m[2] == pytest.approx(track.p_world_m[1])


VIEWS = {
    "oblique": np.array([5.0, -6.0, 1.0]),
    "near": np.array([0.3, -1.2, 0.2]),
    "far": np.array([-9.0, -12.0, 2.0]),
}


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("tag", [0, 2])
def test_pose_of_one_tag_alone(view: str, tag: int) -> None:
    p = VIEWS[view]
    R = looking(p, np.array([0.4, 0.0, 0.1]), roll_deg=7.0)
    noise = np.full((12, 2), 0.01)
    noise[4 * tag : 4 * tag + 4] = 0.0  # the others are off by 10 px, which must not matter
    m = sighting(0, 0.0, p, R, tags=[(5, -1.5), (227, 0.0), (9, 1.5)], noise=noise)
    pose = single_tag_pose(m, m.tags[tag])
    assert pose is not None
    assert pose[0] == pytest.approx(p, abs=1e-3)
    assert pose[1] == pytest.approx(R, abs=1e-3)


def test_frontal_pose_is_loose_across_only() -> None:
    """Straight ahead the tilt shows to second order only: 0.1 px at 4 m are 1 cm of range, but decimetres sideways."""
    rng = np.random.default_rng(0)
    p = np.array([0.0, -4.0, 0.0])
    poses = [single_tag_pose(sighting(0, 0.0, p, noise=rng.normal(0.0, 1e-4, (4, 2))), HIS) for _ in range(20)]
    places = np.array([pose[0] for pose in poses if pose is not None])
    assert len(places) == 20
    assert np.abs(np.linalg.norm(places, axis=1) - 4.0).max() < 0.01
    assert 0.1 < np.hypot(places[:, 0], places[:, 2]).max() < 1.0


def test_no_pose_where_the_solver_has_none() -> None:
    """Corners on one point; and straight ahead without any noise, where OpenCV divides by zero."""
    p = np.array([0.0, -4.0, 0.0])
    rays = sighting(0, 0.0, p).rays
    assert single_tag_pose(sighting(0, 0.0, p, noise=rays[:1] - rays), HIS) is None
    assert single_tag_pose(sighting(0, 0.0, p), HIS) is None


@pytest.mark.parametrize("east_m", [0.0, 1e-6, 1e-3, 0.04, 0.2])
@pytest.mark.parametrize("aim", [(0.0, 0.0, 0.0), (0.3, 0.0, 0.0), (0.0, 0.0, 0.2)])
def test_without_noise_a_frontal_pose_is_right_or_none(east_m: float, aim: tuple[float, float, float]) -> None:
    p = np.array([east_m, -4.0, 0.0])
    pose = single_tag_pose(sighting(0, 0.0, p, looking(p, np.array(aim))), HIS)
    assert pose is None or abs(np.linalg.norm(pose[0]) - np.linalg.norm(p)) < 0.01


def test_of_both_poses_the_better_one_is_taken() -> None:
    """Both minima by another solver; 14 m off, 0.3 px: the flipped one is better now and then, and then it is taken."""
    rng = np.random.default_rng(3)
    p = np.array([3.0, -14.0, 0.5])
    mirrored = p * [-1.0, 1.0, -1.0]
    flips = 0
    for k in range(30):
        m = sighting(k, 0.0, p, noise=rng.normal(0.0, 0.3 / 1069.38, (4, 2)))

        def misfit(v: Array, m: TagSighting = m) -> Array:
            there = (m.points_m - v[:3]) @ Rotation.from_rotvec(v[3:]).as_matrix()
            return np.asarray(1e3 * (there[:, :2] / there[:, 2:] - m.rays)).ravel()

        starts = [np.concatenate([q, Rotation.from_matrix(looking(q, AIM)).as_rotvec()]) for q in (p, mirrored)]
        minima = [least_squares(misfit, start, x_scale="jac", xtol=1e-12) for start in starts]
        best = min(minima, key=lambda minimum: float(minimum.cost))
        pose = single_tag_pose(m, HIS)
        assert pose is not None
        ours = np.concatenate([pose[0], Rotation.from_matrix(pose[1]).as_rotvec()])
        assert 0.5 * np.sum(misfit(ours) ** 2) <= best.cost + 1e-6
        flips += np.linalg.norm(pose[0] - mirrored) < np.linalg.norm(pose[0] - p)
    assert 3 <= flips <= 20


def _approach(first: str) -> tuple[FilterResult, Trajectory]:
    """20 s from 18 m to 5 m off the tag, at 15 Hz, 0.02 px; the first sighting is that of the right or flipped place."""
    rng = np.random.default_rng(0)
    t = np.arange(0.0, 20.0, 1 / 15)
    p = np.column_stack([6.0 - 0.15 * t, -17.0 + 0.65 * t, 0.5 + 0.0 * t])
    seen = p.copy()
    if first == "flipped":
        seen[0] *= [-1.0, 1.0, 1.0]
    noise = rng.normal(0.0, 0.02 / 1069.38, (len(t), 4, 2))
    R = np.array([looking(q, AIM) @ R_BODY_CAMERA.T for q in p])
    truth = Trajectory(stamps_ns=np.rint(t * 1e9).astype(np.int64), p_world_m=p - R @ LEVER, R_world_body=R)
    return ran([sighting(k, t[k], seen[k], noise=noise[k]) for k in range(len(t))], truth=truth), truth


def test_flipped_start_locks_the_truth_out_for_ever() -> None:
    """D sec. 4.4: right poses 6 to 12 m from a state that nothing moves."""
    result, truth = _approach("flipped")
    assert [row.outcome for row in result.ledger] == [Outcome.USED] + [Outcome.REJECTED] * 299
    assert camera_track(result) == pytest.approx(np.tile(camera_track(result)[0], (300, 1)))
    found = losses(result, truth)
    assert found.at_end
    assert found.lost_s == pytest.approx(20.0)
    # 6 m east mirrored at the tag: 12 m off, to what 0.02 px do. Sightings every 1/15 s: the second to the 300th are 298 steps apart.
    begun = re.match(r"it started on a pose (\d+\.\d) m off", result.why)
    assert begun is not None
    assert float(begun[1]) == pytest.approx(12.0, abs=0.3)
    dropped = re.search(
        r"Of 300 sightings of its one tag it rejected 299 \(for up to 20 s .*\), (\d+) of them right to 2 m", result.why
    )
    assert dropped is not None
    assert int(dropped[1]) > 250  # 0.02 px: nearly all are
    assert "it accepted 1, 1 of them farther off" in result.why


def test_right_start_keeps_it() -> None:
    result, truth = _approach("right")
    assert result.ledger.counts()["tags"].get("used", 0) > 250
    found = losses(result, truth)
    assert not found.at_end
    assert found.lost_s < 1.0


def test_losses_by_hand() -> None:
    """Off by 3 m for the first 4 s and the last 2 s of 20: lost for 6 s, not at the end; by 2.5 m for the last 5: it is."""
    stamps = np.arange(0, 20 * 10**9, 10**8, dtype=np.int64)
    truth = Trajectory(stamps_ns=stamps, p_world_m=np.zeros((200, 3)), R_world_body=np.tile(np.eye(3), (200, 1, 1)))

    def of(off: Array) -> digerud.Losses:
        p = np.column_stack([0.0 * off, off, 0.0 * off])
        track = Trajectory(stamps_ns=stamps, p_world_m=p, R_world_body=truth.R_world_body)
        return losses(FilterResult(name="x", trajectory=track, ledger=Ledger()), truth)

    t = stamps * 1e-9
    some = of(np.where((t < 4.0) | (t >= 18.0), 3.0, 1.9))
    assert not some.at_end
    assert some.lost_s == pytest.approx(6.0)
    assert of(np.where(t >= 14.9, -2.5, 0.0)).at_end
    assert not of(np.where(t >= 15.05, -2.5, 0.0)).at_end


def test_every_sighting_is_in_the_ledger() -> None:
    """The tag that is seen most is his; other tags, other cameras, and corners on one point are not used, and said to be."""
    p = np.array([3.0, -8.0, 0.5])
    seen = [sighting(k, 0.1 * k, p, tags=[(9, 1.5), (227, 0.0)][k % 2 :]) for k in range(6)]
    seen.append(sighting(6, 0.6, p, tags=[(9, 1.5)]))
    seen.append(sighting(7, 0.7, p, camera="stern"))
    point = sighting(8, 0.8, p)
    seen.append(sighting(8, 0.8, p, noise=point.rays[:1] - point.rays))
    result = ran(seen)
    assert [row.seq for row in result.ledger] == list(range(9))
    assert [row.reason for row in result.ledger][:6] == [""] * 6
    assert [row.reason for row in result.ledger][6:] == [
        "not of the one tag and camera that it uses",
        "not of the one tag and camera that it uses",
        "no pose from its corners",
    ]
    assert len(result.trajectory) == 6


def test_one_id_in_two_families_is_two_tags() -> None:
    """One alone, then both, the one of no account with corners that are 10 px off."""
    p = np.array([3.0, -8.0, 0.5])
    alone = [replace(sighting(k, 0.1 * k, p), families=("25h9",)) for k in range(3)]
    noise = np.zeros((8, 2))
    noise[:4] = 0.01
    pair = [(227, 1.5), (227, 0.0)]
    both = [replace(sighting(k, 0.1 * k, p, tags=pair, noise=noise), families=("25h9", "36h11")) for k in range(3, 7)]
    his = [sighting(k, 0.1 * k, p) for k in range(7, 12)]
    result = ran([*alone, *both, *his])
    assert result.ledger.counts()["tags"] == {"rejected": 3, "used": 9}
    assert camera_track(result) == pytest.approx(np.tile(p, (9, 1)), abs=1e-3)


def test_no_track_without_two_sightings() -> None:
    p = np.array([3.0, -8.0, 0.5])
    assert run([]) is None
    assert run([sighting(0, 0.0, p)]) is None
    assert run([sighting(0, 0.0, p), sighting(1, 0.1, p)], enabled=False) is None


def test_two_sightings_at_one_stamp_are_one_place_of_the_track() -> None:
    p = np.array([3.0, -8.0, 0.5])
    result = ran([sighting(k, 0.1 * (k // 2), p) for k in range(6)])
    assert len(result.trajectory) == 3
    assert len(result.ledger) == 6
