"""Poses that explain what a camera sees of tags, and how the tags of one image are taken together."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from graphloc.frames import Array
from graphloc.frontends.tags.bundles import Seeing, SeenTag, sightings_of
from graphloc.frontends.tags.pose import PoseOfCamera, _descended, modes_of, poses_of
from graphloc.measurements import TagMode, TagSighting
from graphloc.survey import Survey
from tests.tagfactory import (
    FACES_SOUTH,
    LOOKS_NORTH,
    SIGMA,
    SIZE_M,
    UNIT,
    degrees_between,
    in_world,
    mode_error,
    nearest_mode,
    random_view,
    rays_of,
)

COV = np.eye(8) * SIGMA**2


def off(pose: PoseOfCamera, p_m: Array, R: Array) -> tuple[float, float]:
    """How far a pose is from a camera: place in m, attitude in deg."""
    place = -pose.R.T @ pose.t_m
    return float(np.linalg.norm(place - p_m)), degrees_between(pose.R.T, R)


def modes(corners_m: Array, rays: Array, cov: Array = COV) -> tuple[TagMode, ...]:
    return modes_of(poses_of(corners_m, rays, cov), corners_m, rays, cov)


def test_the_true_pose_is_among_the_minima() -> None:
    """1 to 30 m, 0 to 75 deg, rolled, off the axis, anywhere in world; the noise-free one to a thousandth of the range."""
    rng = np.random.default_rng(0)
    for _ in range(60):
        corners, p, R = random_view(rng)
        found = [off(pose, p, R) for pose in poses_of(corners, rays_of(corners, p, R), COV)]
        place, turn = min(found, key=lambda each: each[1])
        assert turn < 0.02
        assert place < 4e-4 * float(np.linalg.norm(corners[0] - p)) + 1e-3


def test_the_first_pose_fits_no_worse_than_the_truth() -> None:
    rng = np.random.default_rng(1)
    for _ in range(100):
        corners, p, R = random_view(rng)
        rays = rays_of(corners, p, R) + rng.normal(0.0, SIGMA, (4, 2))
        found = poses_of(corners, rays, COV)
        true = float((((rays_of(corners, p, R) - rays) / SIGMA) ** 2).sum())
        squared = [float((((rays_of(corners, -o.R.T @ o.t_m, o.R.T) - rays) / SIGMA) ** 2).sum()) for o in found]
        np.testing.assert_allclose([o.squared for o in found], squared, rtol=1e-6, atol=1e-6)
        assert squared == sorted(squared)
        assert squared[0] <= true + 1e-6


def test_the_loop_is_compiled_once_whatever_memory_it_is_given() -> None:
    """Rays of a recording may not be written to, and those of a column lie apart: for each kind an image took two seconds longer."""
    rng = np.random.default_rng(1)
    corners, p, R = random_view(rng)
    rays = rays_of(corners, p, R) + rng.normal(0.0, SIGMA, (4, 2))
    kept = rays.copy()
    kept.flags.writeable = False
    starts = [[], [(R.T, -R.T @ p)]]
    for one in (rays, kept, np.asfortranarray(rays)):
        first, second = (poses_of(corners, one, COV, start)[0] for start in starts)
        np.testing.assert_allclose(first.t_m, second.t_m, atol=1e-5)
    assert len(_descended.signatures) == 1


@pytest.mark.parametrize("far_m", [1.0, 4.0, 15.0, 30.0])
@pytest.mark.parametrize("roll_deg", [0.0, 30.0, 45.0, 90.0, 180.0])
def test_exactly_frontal(far_m: float, roll_deg: float) -> None:
    """OpenCV's IPPE gives no rotation at all there, or the tag from behind, where numbers have no noise."""
    corners = SIZE_M * UNIT @ FACES_SOUTH.T
    p, R = np.array([0.0, -far_m, 0.0]), LOOKS_NORTH @ Rotation.from_euler("z", roll_deg, degrees=True).as_matrix()
    found = modes(corners, rays_of(corners, p, R))
    mode = found[nearest_mode(found, R)]
    np.testing.assert_allclose(mode.p_world_camera_m, p, atol=1e-3)
    assert degrees_between(np.asarray(mode.R_world_camera), R) < 0.1
    # Distance comes of size: four corners, each s / sqrt(2) z from the middle, give its share with sigma / 2.
    # Tilts that would show as less distance widen it, at most by half.
    sigma = float(np.sqrt(mode.cov[2, 2]))
    by_size = far_m**2 / SIZE_M * SIGMA / np.sqrt(2.0)
    assert 0.95 * by_size < sigma < 2.0 * by_size


@pytest.mark.parametrize("kind", ["noise", "point", "line", "reversed", "crossed"])
def test_corners_without_sense_are_no_error(kind: str) -> None:
    corners, p = SIZE_M * UNIT @ FACES_SOUTH.T, np.array([0.0, -5.0, 0.0])
    rays = rays_of(corners, p, LOOKS_NORTH)
    rng = np.random.default_rng(2)
    for _ in range(30):
        senseless = {
            "noise": rng.normal(0.0, 0.2, (4, 2)),
            "point": np.full((4, 2), rng.normal()),
            "line": np.outer(np.arange(4.0), rng.normal(0.0, 0.1, 2)),
            "reversed": rays[::-1],
            "crossed": rays[[0, 2, 1, 3]],
        }[kind]
        found = poses_of(corners, senseless, COV)
        if found:
            assert modes_of(found, corners, senseless, COV * max(1.0, found[0].squared / 2.0))


def test_a_tag_that_fills_the_image_is_no_error() -> None:
    """0.3 to 0.4 m: the other minimum misses by thousands of sigmas, and no spread of its tilts can be told."""
    rng = np.random.default_rng(11)
    for _ in range(250):
        corners, p, R = random_view(rng, range_m=float(rng.uniform(0.3, 0.4)))
        if ((corners - p) @ R)[:, 2].min() > 0.06:
            found = modes(corners, rays_of(corners, p, R) + rng.normal(0.0, SIGMA, (4, 2)))
            assert degrees_between(np.asarray(found[0].R_world_camera), R) < 1.0


def brute_minima(corners_m: Array, rays: Array, rng: np.random.Generator) -> list[Array]:
    """Attitudes (3, 3), world to camera, of all minima that 16 random starts lead to."""
    middle, side = corners_m.mean(axis=0), float(np.linalg.norm(corners_m[1] - corners_m[0]))
    x, y = (corners_m[1] - corners_m[0]) / side, (corners_m[0] - corners_m[3]) / side
    flat = (corners_m - middle) @ np.column_stack([x, y, np.cross(x, y)])
    back = np.column_stack([x, y, np.cross(x, y)]).T
    far = side * 1.41 / float(np.linalg.norm(rays[0] - rays[2]))

    def errors(v: Array) -> Array:
        there = flat @ Rotation.from_rotvec(v[3:]).as_matrix().T + v[:3]
        return np.asarray(((there[:, :2] / np.maximum(there[:, 2:], 0.01) - rays) / SIGMA).ravel())

    found: list[Array] = []
    for _ in range(16):
        turned = Rotation.random(random_state=rng).as_matrix()
        if turned[2, 2] > 0.0:  # its face looks away
            turned = turned @ np.diag([1.0, -1.0, -1.0])
        z = far * rng.uniform(0.6, 1.0)
        start = np.concatenate([rays.mean(axis=0) * z, [z], Rotation.from_matrix(turned).as_rotvec()])
        solved = least_squares(errors, start, x_scale=[z / 10.0] * 3 + [0.3] * 3, xtol=1e-11, ftol=1e-13, max_nfev=120)
        R = Rotation.from_rotvec(solved.x[3:]).as_matrix()
        lies_ahead = (flat @ R.T + solved.x[:3])[:, 2].min() > 0.05
        settled = float(np.abs(np.asarray(solved.jac).T @ solved.fun).max()) < 1.0
        if lies_ahead and settled and not any(degrees_between(R @ back, other) < 1.0 for other in found):
            found.append(R @ back)
    return found


def test_no_minimum_is_missed_and_none_is_made_up() -> None:
    rng = np.random.default_rng(5)
    twofold = 0
    for k in range(10):
        corners, p, R = random_view(rng, oblique_deg=None if k % 2 else float(rng.uniform(0.0, 15.0)))
        rays = rays_of(corners, p, R) + rng.normal(0.0, SIGMA, (4, 2))
        ours = [pose.R for pose in poses_of(corners, rays, COV)]
        theirs = brute_minima(corners, rays, rng)
        for one, others in [(R, theirs) for R in ours] + [(R, ours) for R in theirs]:
            assert min(degrees_between(one, other) for other in others) < 2.0
        twofold += len(ours) > 1
    assert twofold >= 6


@cache
def scattered(range_m: float, oblique_deg: float) -> tuple[Array, Array, Array]:
    """Of 40 noisy sightings: errors of the mode nearest to the truth and claimed covariances, in camera's axes; NEES."""
    rng = np.random.default_rng([int(range_m), int(oblique_deg)])
    errors, covs, nees = [], [], []
    for _ in range(40):
        corners, p, R = random_view(rng, range_m=range_m, oblique_deg=oblique_deg, aside=False)
        found = modes(corners, rays_of(corners, p, R) + rng.normal(0.0, SIGMA, (4, 2)))
        mode = found[nearest_mode(found, R)]
        e = mode_error(mode, p, R, corners.mean(axis=0))
        errors.append(np.concatenate([-R.T @ e[:3], R.T @ e[3:]]))
        covs.append(mode.cov)
        nees.append(float(e @ np.linalg.solve(in_world(mode, R), e)))
    return np.array(errors), np.array(covs), np.array(nees)


@pytest.mark.parametrize("range_m", [2.0, 8.0, 20.0])
@pytest.mark.parametrize("oblique_deg", [0.0, 10.0, 30.0, 70.0])
def test_a_modes_covariance_is_what_monte_carlo_shows(range_m: float, oblique_deg: float) -> None:
    """6 degrees of freedom: the mean of 40 draws is 6 +- 0.55, 1 sigma (sqrt(12 / 40))."""
    errors, covs, nees = scattered(range_m, oblique_deg)
    assert 4.5 < nees.mean() < (7.6 if oblique_deg or range_m < 5.0 else 12.0)
    shown, claimed = np.sqrt((errors**2).mean(axis=0)), np.sqrt(covs.mean(axis=0).diagonal())
    # Of a tilt of exactly zero every single image shows one: how much is the extreme of what it may be.
    assert (shown / claimed < (1.35 if oblique_deg or range_m < 5.0 else 1.8)).all()
    assert (shown / claimed > 0.6).all()


def test_a_pose_is_known_worse_from_far_off_and_its_tilt_worse_from_ahead() -> None:
    depth = [np.sqrt(scattered(r, 30.0)[1][:, 2, 2].mean()) for r in (2.0, 8.0, 20.0)]
    assert depth[1] / depth[0] == pytest.approx(16.0, rel=0.2)  # with the square of the range
    assert depth[2] / depth[1] == pytest.approx(6.25, rel=0.2)
    tilt = [np.sqrt(scattered(8.0, o)[1][:, 3:5, 3:5].trace(axis1=1, axis2=2).mean()) for o in (70.0, 30.0, 10.0, 0.0)]
    assert (np.diff(tilt) > 0.0).all()
    assert tilt[-1] > 5.0 * tilt[0]


def test_probabilities_come_true() -> None:
    """Of the sightings that claim 70-90 % for the likelier pose, so many are right; at all ranges where it is in doubt."""
    rng = np.random.default_rng(3)
    claimed, right = [], []
    for k in range(400):
        oblique = float(np.degrees(np.arccos(rng.uniform(np.cos(np.radians(50.0)), 1.0))))
        corners, p, R = random_view(rng, range_m=float(rng.uniform(8.0, 25.0)), oblique_deg=oblique, aside=k % 2 == 0)
        found = modes(corners, rays_of(corners, p, R) + rng.normal(0.0, SIGMA, (4, 2)))
        assert sum(mode.probability for mode in found) == pytest.approx(1.0)
        if len(found) == 2:
            claimed.append(found[0].probability)
            right.append(nearest_mode(found, R) == 0)
    c, r = np.array(claimed), np.array(right)
    for low, high in ((0.5, 0.7), (0.7, 0.9), (0.9, 1.01)):
        inside = (c >= low) & (c < high)
        assert inside.sum() > 40
        spread = np.sqrt((c[inside] * (1.0 - c[inside])).sum()) / inside.sum()
        assert abs(r[inside].mean() - c[inside].mean()) < 3.0 * spread + 0.01, (low, inside.sum())
    doubtful = c < 0.97
    score = (r[doubtful] - c[doubtful]).sum() / np.sqrt((c[doubtful] * (1.0 - c[doubtful])).sum())
    assert abs(score) < 2.0  # sigmas; the squares of the shares give -2.7, their 0.7th powers 3.3


def test_a_blind_mode_is_not_judged_by_its_fit() -> None:
    """Rays that were made of a pose fit that pose perfectly; that it was chosen says nothing."""
    rng = np.random.default_rng(6)
    corners, p, R = random_view(rng, range_m=5.0, oblique_deg=40.0)
    rays = rays_of(corners, p, R)
    found = poses_of(corners, rays, COV)
    judged, blind = (modes_of(found, corners, rays, COV, blind=b) for b in (False, True))
    assert judged[0].probability > 0.999
    assert blind[0].probability < 0.9


SEEING = Seeing(7, "tags", "bow", np.array([1.0, 0.0, 2.0]), LOOKS_NORTH)


def three(
    sigma_m: float = 0.01, sigma_deg: float = 0.3, facing_deg: tuple[float, ...] = (165.0, 180.0, 195.0)
) -> Survey:
    tags = [
        {"id": k, "size_m": SIZE_M, "xyz_m": [1.8 * k - 1.8, 10.0, 1.2], "facing_deg": f, "sigma_m": sigma_m, "sigma_deg": sigma_deg}
        for k, f in enumerate(facing_deg)
    ]  # fmt: skip
    return Survey.model_validate({"tags": tags})


def look(
    survey: Survey,
    rng: np.random.Generator,
    *,
    noise: dict[int, float] | float = 1.0,
    moved: dict[int, Array] | None = None,
    p_m: Array | None = None,
) -> tuple[list[SeenTag], Array, Array]:
    """What a camera some metres south sees of all tags; noise in sigmas, of each id or of all."""
    p = np.array([rng.uniform(-3.0, 3.0), rng.uniform(-5.0, 5.0), 1.8]) if p_m is None else p_m
    R = Rotation.from_euler("z", rng.uniform(-8.0, 8.0), degrees=True).as_matrix() @ LOOKS_NORTH
    seen = []
    for tag in survey.tags:
        at, turned = survey.rest(tag.frame)
        heading = np.radians(float(tag.facing_deg or 0.0))
        axes = np.array(
            [(-np.cos(heading), 0.0, np.sin(heading)), (np.sin(heading), 0.0, np.cos(heading)), (0.0, 1.0, 0.0)]
        )
        corners = (
            at + (np.array(tag.xyz_m) + tag.size_m * UNIT @ axes.T) @ turned.T + (moved or {}).get(tag.id, np.zeros(3))
        )
        size = noise.get(tag.id, 1.0) if isinstance(noise, dict) else noise
        seen.append(SeenTag(tag, rays_of(corners, p, R) + rng.normal(0.0, size * SIGMA, (4, 2)), COV))
    return seen, p, R


def nees_of(sighting: TagSighting, p: Array, R: Array) -> float:
    mode = sighting.modes[nearest_mode(sighting.modes, R)]
    e = mode_error(mode, p, R, sighting.points_m.mean(axis=0))
    return float(e @ np.linalg.solve(in_world(mode, R), e))


def test_three_tags_that_agree_make_one_sighting_with_one_pose() -> None:
    rng, survey = np.random.default_rng(8), three()
    for _ in range(20):
        seen, p, R = look(survey, rng)
        (sighting,), lost = sightings_of(seen, survey, SEEING)
        assert (sighting.numbers, sighting.frame, sighting.stamp_ns, lost) == ((0, 1, 2), "world", 7, [])
        assert len(sighting.modes) == 1
        assert nees_of(sighting, p, R) < 27.9  # 99.99 % of chi2, 6


@pytest.mark.parametrize("which", [0, 1, 2])
def test_the_one_of_three_that_was_moved_is_singled_out(which: int) -> None:
    rng, survey = np.random.default_rng(9), three()
    rest = tuple(k for k in range(3) if k != which)
    for _ in range(8):
        aside = np.array([*rng.normal(0.0, 1.0, 2), 0.3])
        seen, p, R = look(
            survey, rng, moved={which: 0.5 * aside / np.linalg.norm(aside)}, p_m=np.array([0.5, 3.0, 1.8])
        )
        together, alone = sightings_of(seen, survey, SEEING)[0]
        assert (together.numbers, alone.numbers) == (rest, (which,))
        assert nees_of(together, p, R) < 22.5  # 99.9 % of chi2, 6


def test_two_that_contradict_each_other_are_split() -> None:
    rng, whole = np.random.default_rng(10), three()
    survey = Survey(tags=whole.tags[:2])
    seen, _, _ = look(survey, rng, moved={1: np.array([0.5, 0.0, 0.0])}, p_m=np.array([0.0, 4.0, 1.8]))
    assert sorted(s.numbers for s in sightings_of(seen, survey, SEEING)[0]) == [(0,), (1,)]


def test_tags_blurred_alike_stay_together() -> None:
    """1 px on all where 0.15 px is claimed: split, each would be in doubt, and its own blur hardly seen (2 degrees of freedom)."""
    rng, survey = np.random.default_rng(11), three()
    nees = []
    for _ in range(20):
        seen, p, R = look(survey, rng, noise=6.0)
        found = sightings_of(seen, survey, SEEING)[0]
        assert [s.numbers for s in found] == [(0, 1, 2)]
        nees.append(nees_of(found[0], p, R))
    assert np.median(nees) < 8.0


def test_a_pose_that_only_claimed_noise_rules_out_is_kept() -> None:
    """Two tags 22 m off, blurred: by the noise that is claimed, one minimum wins by more than 25; by the true one, it does not."""
    rng = np.random.default_rng(12)
    survey = Survey(tags=three(facing_deg=(180.0, 180.0, 180.0)).tags[:2])
    modes_found = []
    for _ in range(40):
        seen, _, _ = look(survey, rng, noise=6.0, p_m=np.array([0.0, -12.0, 1.8]))
        modes_found += [len(s.modes) for s in sightings_of(seen, survey, SEEING)[0]]
    assert modes_found.count(1) <= 20


def test_a_blurred_tag_widens_the_sighting() -> None:
    rng, survey = np.random.default_rng(13), Survey(tags=three(0.001, 0.05).tags[1:2])
    widths = {}
    for blur in (1.0, 20.0):  # 20: 3 px
        covs = []
        for _ in range(20):
            seen, _, R = look(survey, rng, noise=blur, p_m=np.array([2.5, 5.0, 1.5]))
            (sighting,), _ = sightings_of(seen, survey, SEEING)
            covs.append(sighting.modes[nearest_mode(sighting.modes, R)].cov[2, 2])
        widths[blur] = float(np.sqrt(np.median(covs)))
    assert widths[20.0] > 6.0 * widths[1.0]


def test_what_the_survey_does_not_know_is_in_the_sighting() -> None:
    """0.05 m of each of three tags is 0.05 / sqrt(3) m of the bundle's middle; a perfect survey has none of it."""
    rng = np.random.default_rng(14)
    sigma = {}
    for surveyed_m in (0.0, 0.05):
        survey = three(surveyed_m, 0.0)
        seen, _, _ = look(survey, rng, p_m=np.array([0.0, 2.0, 1.8]))
        (sighting,), _ = sightings_of(seen, survey, SEEING)
        sigma[surveyed_m] = float(np.sqrt(sighting.modes[0].cov[0, 0]))
    assert sigma[0.0] < 0.002
    assert sigma[0.05] == pytest.approx(0.05 / np.sqrt(3.0), rel=0.15)


def test_tags_of_a_dock_and_of_the_world_are_sightings_of_their_own() -> None:
    tags = [
        {"id": 1, "size_m": 0.4, "xyz_m": [-2.0, 10.0, 1.5], "facing_deg": 180.0},
        {"id": 2, "size_m": 0.4, "frame": "pier", "xyz_m": [0.0, 0.0, 1.5], "facing_deg": 170.0},
        {"id": 3, "size_m": 0.4, "frame": "pier", "xyz_m": [0.9, 0.0, 1.5], "facing_deg": 190.0},
    ]
    survey = Survey.model_validate(
        {"tags": tags, "docks": [{"name": "pier", "xyz_m": [1.0, 9.0, 0.0], "rpy_deg": [0.0, 0.0, 10.0]}]}
    )
    seen, _, R = look(survey, np.random.default_rng(15), p_m=np.array([0.0, 0.0, 1.8]))
    found, lost = sightings_of(seen, survey, SEEING)
    assert [(s.frame, s.numbers) for s in found] == [("world", (1,)), ("pier", (2, 3))]
    assert lost == []
    for sighting in found:
        nearest = sighting.modes[nearest_mode(sighting.modes, R)]
        assert degrees_between(np.asarray(nearest.R_world_camera), R) < 3.0
    np.testing.assert_allclose(found[1].pivot_m, [1.0, 9.0, 0.0])


def test_corners_that_no_tag_can_show_are_lost() -> None:
    """A mirrored square: every pose would see it from behind."""
    survey = Survey(tags=three().tags[1:2])
    seen, _, _ = look(survey, np.random.default_rng(16), p_m=np.array([0.0, 4.0, 1.5]))
    mirrored = SeenTag(seen[0].tag, np.zeros((4, 2)), COV)
    found, lost = sightings_of([mirrored], survey, SEEING)
    assert found == [] or found[0].modes
    assert len(found) + len(lost) == 1
