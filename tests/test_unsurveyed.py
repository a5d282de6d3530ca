"""Tags that the survey does not list, placed by a track that is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from graphloc.frames import Array
from graphloc.frontends.tags.unsurveyed import estimate_tags, only_beside
from graphloc.measurements import TagMode, TagSighting, TagView
from graphloc.survey import TagConfig
from graphloc.trajectory import Trajectory
from tests.tagfactory import AHEAD, FACES_SOUTH, SIGMA, SIZE_M, UNIT, degrees_between, rays_of

CAMERA_M = np.array([1.5, 0.2, 2.0])
PLACE_M = np.array([30.0, -12.0, 1.5])
STEP_NS = 100_000_000


def passing(kind: str, n: int = 60) -> tuple[Array, Array]:
    """Poses p (N, 3), R (N, 3, 3) of a body whose camera looks at the tag: along an arc, straight at it, at rest."""
    t = np.linspace(0.0, 1.0, n)
    rng = np.random.default_rng(1)
    far = np.full(n, 8.0) if kind == "rest" else 25.0 - 21.0 * t
    bearing = np.radians({"arc": -40.0 + 80.0 * t, "straight": np.full(n, 5.0), "rest": np.full(n, 20.0)}[kind])
    camera = PLACE_M + np.column_stack([far * np.sin(bearing), -far * np.cos(bearing), np.full(n, 0.5)])
    yaw = np.arctan2(*(PLACE_M - camera)[:, [1, 0]].T) + np.radians(rng.uniform(-5.0, 5.0, n))
    R = Rotation.from_euler("ZYX", np.column_stack([yaw, np.radians(rng.uniform(-2.0, 2.0, (n, 2)))])).as_matrix()
    return camera - R @ CAMERA_M, R


def views_of(
    p: Array, R: Array, rng: np.random.Generator, *, place_m: Array = PLACE_M, number: int = 77
) -> list[TagView]:
    corners = place_m + SIZE_M * UNIT @ FACES_SOUTH.T
    return [
        TagView(
            stamp_ns=k * STEP_NS, camera="bow", family="36h11", number=number, cov=np.eye(8) * SIGMA**2, t_body_camera_m=CAMERA_M,
            rays=rays_of(corners, p[k] + R[k] @ CAMERA_M, R[k] @ AHEAD) + rng.normal(0.0, SIGMA, (4, 2)),
            R_body_camera=AHEAD,
        )
        for k in range(len(p))
    ]  # fmt: skip


def track_of(p: Array, R: Array, cov: Array | None = None) -> Trajectory:
    stamps = np.arange(len(p), dtype=np.int64) * STEP_NS
    return Trajectory(stamps_ns=stamps, p_world_m=p, R_world_body=R, cov=cov)


def claimed(n: int, sigma_m: float, sigma_deg: float) -> Array:
    return np.tile(np.diag([sigma_m**2] * 3 + [np.radians(sigma_deg) ** 2] * 3), (n, 1, 1))


def off(tag: TagConfig, place_m: Array = PLACE_M) -> tuple[float, float, float]:
    """Errors of place in m, attitude in deg, size as a share."""
    return (
        float(np.linalg.norm(np.array(tag.xyz_m) - place_m)),
        degrees_between(tag.R_frame_tag, FACES_SOUTH),
        abs(tag.size_m / SIZE_M - 1.0),
    )


@pytest.mark.parametrize("kind", ["arc", "straight"])
@pytest.mark.parametrize("size_m", [None, SIZE_M])
def test_a_known_track_places_a_tag(kind: str, size_m: float | None) -> None:
    p, R = passing(kind)
    for seed in range(2):
        views = views_of(p, R, np.random.default_rng(seed))
        (tag,), left = estimate_tags(views, track_of(p, R, claimed(60, 0.01, 0.05)), size_m)
        place, turn, size = off(tag)
        assert (tag.id, tag.family, tag.frame, left) == (77, "36h11", "world", [])
        assert place < 0.03
        assert turn < 1.0
        assert size < 0.02
        if size_m is not None:
            assert tag.size_m == size_m


@pytest.mark.parametrize("kind", ["arc", "straight"])
@pytest.mark.parametrize("says_so", [True, False])
def test_a_track_that_is_off_by_0_1_m_at_each_pose(kind: str, says_so: bool) -> None:
    """Near views shift by 25 px: by their noise alone they would decide, 2.7 m off on a straight approach (measured)."""
    p, R = passing(kind)
    for seed in range(3):
        rng = np.random.default_rng(seed)
        views = views_of(p, R, rng)
        turns = Rotation.from_rotvec(np.radians(rng.normal(0.0, 0.2, (60, 3)))).as_matrix()
        cov = claimed(60, 0.1, 0.2) if says_so else None
        (tag,), _ = estimate_tags(views, track_of(p + rng.normal(0.0, 0.1, p.shape), turns @ R, cov), None)
        place, turn, size = off(tag)
        assert place < 0.15
        assert turn < 2.0
        assert size < 0.02
        assert place < 4.0 * np.sqrt(3.0) * tag.sigma_m
        assert turn < 5.0 * max(tag.sigma_deg, 0.2)


def test_a_track_that_is_off_as_a_whole_takes_the_tag_along_and_says_so() -> None:
    p, R = passing("arc")
    shift = np.array([0.4, -0.3, 0.0])
    (tag,), _ = estimate_tags(
        views_of(p, R, np.random.default_rng(0)), track_of(p + shift, R, claimed(60, 0.35, 0.1)), None
    )
    assert off(tag, PLACE_M + shift)[0] < 0.05
    assert tag.sigma_m > 0.3


def test_standing_still_tells_a_tags_place_by_its_size_alone() -> None:
    p, R = passing("rest")
    for noise_m in (0.0, 0.02):
        for seed in range(4):
            rng = np.random.default_rng(seed)
            views, track = views_of(p, R, rng), track_of(p + rng.normal(0.0, noise_m, p.shape), R)
            found, (line,) = estimate_tags(views, track, None)
            assert found == []
            assert line == "tag 77 (36h11) is not in the survey, and 60 views do not tell where it is"
            (tag,), left = estimate_tags(views, track, SIZE_M)
            assert off(tag)[0] < 0.1
            assert left == []


def test_a_metre_of_motion_does_not_tell_a_size_where_the_track_is_off_by_half_of_it() -> None:
    p, R = passing("rest")
    p = p + np.linspace(0.0, 1.0, 60)[:, None] * R[0, :, 0]
    for seed in range(4):
        rng = np.random.default_rng(seed)
        off_m = rng.normal(0.0, 0.3, p.shape) * [1.0, 1.0, 0.1]
        found, (line,) = estimate_tags(views_of(p, R, rng), track_of(p + off_m, R, claimed(60, 0.5, 0.1)), None)
        assert found == []
        assert "60 views do not tell where it is" in line


def test_too_few_views_or_none_on_the_track() -> None:
    p, R = passing("arc")
    views = views_of(p, R, np.random.default_rng(0))
    found, (line,) = estimate_tags(views[:4], track_of(p, R), None)
    assert found == []
    assert "4 views do not tell" in line
    late = Trajectory(stamps_ns=track_of(p, R).stamps_ns + 10**12, p_world_m=p, R_world_body=R)
    found, (line,) = estimate_tags(views, late, None)
    assert found == []
    assert "0 views do not tell" in line
    assert estimate_tags([], track_of(p, R), None) == ([], [])


def test_most_views_fit_the_flipped_pose_better() -> None:
    """Each fits both poses about as well, and most fit the wrong one; but a flipped tag would turn as one goes by."""
    p, R = passing("arc")
    rng = np.random.default_rng(3)
    corners = PLACE_M + SIZE_M * UNIT @ FACES_SOUTH.T
    views = []
    for k, view in enumerate(views_of(p, R, rng)):
        camera, axes = p[k] + R[k] @ CAMERA_M, R[k] @ AHEAD
        sight = PLACE_M - camera
        sight /= np.linalg.norm(sight)
        normal = FACES_SOUTH[:, 2]
        mirrored = Rotation.from_rotvec(
            2.0 * np.arccos(np.clip(-normal @ sight, -1.0, 1.0)) * _unit(np.cross(normal, -sight))
        ).as_matrix()
        flipped = PLACE_M + (corners - PLACE_M) @ mirrored.T
        share = 0.6 if k % 3 else 0.0  # of the way to the corners of the flipped tag
        rays = (1.0 - share) * view.rays + share * (rays_of(flipped, camera, axes) + rng.normal(0.0, SIGMA, (4, 2)))
        views.append(_with_rays(view, rays))
    (tag,), _ = estimate_tags(views, track_of(p, R, claimed(60, 0.02, 0.1)), SIZE_M)
    assert off(tag)[0] < 0.1
    assert off(tag)[1] < 6.0


def _unit(v: Array) -> Array:
    return np.asarray(v / max(float(np.linalg.norm(v)), 1e-9))


def _with_rays(view: TagView, rays: Array) -> TagView:
    return TagView(
        stamp_ns=view.stamp_ns, camera=view.camera, family=view.family, number=view.number, rays=rays, cov=view.cov,
        t_body_camera_m=view.t_body_camera_m, R_body_camera=view.R_body_camera,
    )  # fmt: skip


def test_a_view_that_was_misread_does_not_move_the_tag() -> None:
    p, R = passing("arc")
    rng = np.random.default_rng(4)
    views = views_of(p, R, rng)
    for k in (10, 30, 50):
        views[k] = _with_rays(views[k], views[k].rays + rng.normal(0.0, 0.1, 2))
    (tag,), _ = estimate_tags(views, track_of(p, R, claimed(60, 0.02, 0.1)), SIZE_M)
    assert off(tag)[0] < 0.05
    assert off(tag)[1] < 1.0


def test_tags_of_several_ids_and_families_in_any_order() -> None:
    p, R = passing("arc")
    other_m = PLACE_M + np.array([1.5, 0.0, 0.2])
    rng = np.random.default_rng(5)
    views = [*views_of(p, R, rng), *views_of(p, R, rng, place_m=other_m, number=5), *views_of(p, R, rng, number=9)[:3]]
    order = rng.permutation(len(views))
    found, left = estimate_tags([views[k] for k in order], track_of(p, R), SIZE_M)
    assert [tag.id for tag in found] == [5, 77]
    assert off(found[0], other_m)[0] < 0.05
    assert off(found[1])[0] < 0.05
    assert left == ["tag 9 (36h11) is not in the survey, and 3 views do not tell where it is"]


def test_what_is_estimated_can_be_written_and_read() -> None:
    p, R = passing("arc")
    (tag,), _ = estimate_tags(views_of(p, R, np.random.default_rng(6)), track_of(p, R), None)
    assert TagConfig.model_validate(tag.model_dump(mode="json", exclude_none=True)) == tag


def test_of_very_many_views_some_are_enough() -> None:
    """400 views: every seventh is used; place and size as good as of 60."""
    p, R = passing("arc", 400)
    (tag,), _ = estimate_tags(views_of(p, R, np.random.default_rng(7)), track_of(p, R, claimed(400, 0.02, 0.1)), None)
    assert off(tag)[0] < 0.05
    assert off(tag)[2] < 0.01


@pytest.mark.parametrize("family", ["", "Standard41h12"])
def test_a_family_that_no_survey_can_have_is_reported(family: str) -> None:
    """ROS 1's lists say no family, and AprilTag 3 has more than OpenCV: a line, not an error after the whole solve."""
    p, R = passing("arc")
    views = [replace(v, family=family) for v in views_of(p, R, np.random.default_rng(0))]
    found, (line,) = estimate_tags(views, track_of(p, R), None)
    assert found == []
    assert "tag 77" in line


def test_two_cameras_may_see_it_at_once() -> None:
    p, R = passing("arc", 20)
    views = views_of(p, R, np.random.default_rng(0)) + views_of(p, R, np.random.default_rng(1))
    (tag,), _ = estimate_tags(views, track_of(p, R), SIZE_M)
    assert np.linalg.norm(np.array(tag.xyz_m) - PLACE_M) < 0.1


def beside(view: TagView, frame: str, camera: str = "bow") -> TagSighting:
    """A surveyed tag of a frame in the image of a view."""
    mode = TagMode(p_world_camera_m=np.zeros(3), R_world_camera=np.eye(3), cov=np.eye(6), probability=1.0)
    return TagSighting(
        stamp_ns=view.stamp_ns, sensor="tags", seq=0, camera=camera, frame=frame, numbers=(1,), families=("36h11",),
        points_m=np.zeros((4, 3)), pivot_m=np.zeros(3), rays=np.zeros((4, 2)), cov=np.eye(8), t_body_camera_m=CAMERA_M,
        R_body_camera=AHEAD, modes=(mode,),
    )  # fmt: skip


def test_beside_whose_tags_a_tag_is_seen() -> None:
    """In the same image: another camera at the same time looks elsewhere. Beside two docks, or a dock and the quay: none."""
    p, R = passing("arc", 6)
    views = views_of(p, R, np.random.default_rng(0))
    on_pier = [beside(v, "pier") for v in views[:3]]
    of = ("36h11", 77)
    assert only_beside(views, on_pier) == {of: ("tags", "pier")}
    assert only_beside(views, [*on_pier, beside(views[4], "world", "stern")]) == {of: ("tags", "pier")}
    assert only_beside(views, [*on_pier, beside(views[4], "world")]) == {}
    assert only_beside(views, [*on_pier, beside(views[4], "raft")]) == {}
    assert only_beside(views, [beside(v, "pier", "stern") for v in views]) == {}
    assert only_beside(views, [beside(v, "world") for v in views]) == {}
    assert only_beside(views, []) == {}
