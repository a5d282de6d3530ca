"""`tags.yaml`: what it means, and what is said where it means nothing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pyproj import Transformer

from graphloc.config import AprilTagConfig, CompassConfig, VesselConfig
from graphloc.errors import ConfigError
from graphloc.frames import Array
from graphloc.gather import with_surveys
from graphloc.survey import Survey, TagConfig, load_survey


def entry(**changes: str | None) -> str:
    """A tags.yaml of one tag, some of its keys changed or (None) left out."""
    keys: dict[str, str | None] = {"id": "3", "size_m": "0.4", "xyz_m": "[1, 2, 3]", "facing_deg": "180", **changes}
    return "tags:\n- {" + ", ".join(f"{k}: {v}" for k, v in keys.items() if v is not None) + "}\n"


def written(folder: Path, text: str) -> Path:
    path = folder / "tags.yaml"
    path.write_text(text)
    return path


BERTH = "{name: b, xyz_m: [0, 0, 0], facing_deg: 0}"
BAD = {
    "no size": (entry(size_m=None), "tags.0.size_m: Field required"),
    "negative size": (entry(size_m="-0.4"), "tags.0.size_m: Input should be greater than 0"),
    "size zero": (entry(size_m="0"), "tags.0.size_m: Input should be greater than 0"),
    "size in mm": (entry(size_m="400"), "tags.0.size_m: Input should be less than or equal to 10"),
    "unknown key": (entry(colour="red"), "unknown key 'tags.0.colour'"),
    "unknown block": ("tgas: []", "unknown key 'tgas'; did you mean 'tags'?"),
    "family that is none": (entry(family="36h12"), "tags.0.family: Input should be '16h5', '25h9'"),
    "both attitudes": (entry(rpy_deg="[0, 0, 0]"), "tag 3 needs rpy_deg or facing_deg, one of them"),
    "no attitude": (entry(facing_deg=None), "tag 3 needs rpy_deg or facing_deg, one of them"),
    "facing a word": (entry(facing_deg="south"), "tags.0.facing_deg: Input should be a valid number"),
    "endless": (entry(facing_deg=".inf"), "tags.0.facing_deg: Input should be a finite number"),
    "no id": (entry(id=None), "tags.0.id: Field required"),
    "negative id": (entry(id="-3"), "tags.0.id: Input should be greater than or equal to 0"),
    "half an id": (entry(id="3.5"), "tags.0.id: Input should be a valid integer"),
    "two coordinates": (entry(xyz_m="[1, 2]"), "tags.0.xyz_m: 3 values are wanted (got [1, 2])"),
    "not a number": (entry(xyz_m="[.nan, 1, 2]"), "tags.0.xyz_m.0: Input should be a finite number"),
    "negative sigma": (entry(sigma_m="-0.1"), "tags.0.sigma_m: Input should be greater than or equal to 0"),
    "no such dock": (entry(frame="pier"), "tag 3: frame 'pier' is neither 'world' nor one of the docks"),
    "there twice": (entry() + entry().removeprefix("tags:\n"), "tag 36h11 3 is there twice"),
    "a dock called world": ("docks: [{name: world}]", "docks need names of their own"),
    "docks of one name": ("docks: [{name: a}, {name: a}]", "docks need names of their own"),
    "dock without a name": ("docks: [{name: ''}]", "docks.0.name: String should have at least 1 character"),
    "dock without a period": ("docks: [{name: a, period_s: 0}]", "docks.0.period_s: Input should be greater than 0"),
    "berth nowhere": (
        "berths: [{name: b, frame: x, xyz_m: [0, 0, 0], facing_deg: 0}]",
        "berth b: frame 'x' is neither",
    ),
    "berths of one name": (f"berths: [{BERTH}, {BERTH}]", "berth b is there twice"),
    "negative other size": ("other_size_m: -1", "other_size_m: Input should be greater than 0"),
    "a list": ("- 1", "the top level must be a mapping"),
    "not YAML": ("tags: [", "not valid YAML"),
    "one key twice": ("tags: []\ntags: []", "duplicate key"),
}


@pytest.mark.parametrize("name", BAD)
def test_what_cannot_be_used_is_one_line_with_the_file_and_the_entry(tmp_path: Path, name: str) -> None:
    text, said = BAD[name]
    path = written(tmp_path, text)
    with pytest.raises(ConfigError) as caught:
        load_survey(path)
    line = str(caught.value)
    assert line.startswith(f"{path}: ")
    assert said in line
    assert "\n" not in line


@pytest.mark.parametrize(
    ("text", "end"),
    [
        (entry(size_m=None), "tags.0.size_m: Field required"),
        (entry(facing_deg=None), "tag 3 needs rpy_deg or facing_deg, one of them"),
        (entry() + f"docks: [{{name: {'a' * 50}}}, {{name: {'a' * 50}}}]", "none may be called 'world'"),
        (entry(xyz_m="[1, 2]"), "tags.0.xyz_m: 3 values are wanted (got [1, 2])"),
        (entry(xyz_m="{x: 1, y: 2}"), "a list in brackets is wanted (got a mapping)"),
        (entry(size_m="[1, 2, 3]"), "(got [1, 2, 3])"),
        (entry(size_m=f"[{'1, ' * 50}]"), "(got a list)"),
        (entry(facing_deg="s" * 60), f"(got '{'s' * 36}...)"),
        (entry(size_m="-0.4"), "(got -0.4)"),
    ],
)
def test_what_was_given_is_reported_in_short(tmp_path: Path, text: str, end: str) -> None:
    """A whole block in the middle of a line hides what is wrong with it."""
    path = written(tmp_path, text)
    with pytest.raises(ConfigError) as caught:
        load_survey(path)
    assert str(caught.value).endswith(end)


def test_a_file_that_is_not_there_says_who_names_it(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"cannot be read .*`survey:` of the apriltag sensor names it"):
        load_survey(tmp_path / "tags.yaml")


@pytest.mark.parametrize("family", ["36h11", "'36h11'", "tag36h11", "TAG36H11", "tag_36h11", "DICT_APRILTAG_36h11"])
def test_families_by_the_names_that_others_give_them(tmp_path: Path, family: str) -> None:
    (tag,) = load_survey(written(tmp_path, entry(family=family))).tags
    assert tag.family == "36h11"


@pytest.mark.parametrize("family", ["16h5", "25h9", "36h10", "36h11"])
def test_families_need_no_quotes(tmp_path: Path, family: str) -> None:
    """None of them is a number of YAML; `16e5` would be one."""
    assert load_survey(written(tmp_path, entry(family=family))).tags[0].family == family


@pytest.mark.parametrize(("form", "number"), [("'3'", 3), ("3.0", 3), ("007", 7), ("0", 0)])
def test_forms_of_an_id(tmp_path: Path, form: str, number: int) -> None:
    assert load_survey(written(tmp_path, entry(id=form))).tags[0].id == number


def test_one_id_in_two_families(tmp_path: Path) -> None:
    survey = load_survey(written(tmp_path, entry() + entry(family="25h9").removeprefix("tags:\n")))
    assert [tag.family for tag in survey.tags] == ["36h11", "25h9"]


# Where a face looks, and its axes (x right, y up, z out) as columns in world, by hand: who looks at a face to the
# south has east to the right; to the north, west; to the east, north; to the west, south.
BY_HAND = [
    (0.0, [(-1, 0, 0), (0, 0, 1), (0, 1, 0)], [90.0, 0.0, 180.0]),
    (90.0, [(0, 1, 0), (0, 0, 1), (1, 0, 0)], [90.0, 0.0, 90.0]),
    (180.0, [(1, 0, 0), (0, 0, 1), (0, -1, 0)], [90.0, 0.0, 0.0]),
    (270.0, [(0, -1, 0), (0, 0, 1), (-1, 0, 0)], [90.0, 0.0, -90.0]),
]


@pytest.mark.parametrize(("facing", "axes", "rpy"), BY_HAND)
def test_facing_is_a_short_form_of_rpy(facing: float, axes: list[tuple[int, int, int]], rpy: list[float]) -> None:
    upright = TagConfig.model_validate({"id": 0, "size_m": 1, "xyz_m": [0, 0, 0], "facing_deg": facing})
    turned = TagConfig.model_validate({"id": 0, "size_m": 1, "xyz_m": [0, 0, 0], "rpy_deg": rpy})
    by_hand = np.array(axes, dtype=float).T
    np.testing.assert_allclose(upright.R_frame_tag, by_hand, atol=1e-12)
    np.testing.assert_allclose(turned.R_frame_tag, by_hand, atol=1e-12)


def test_corners_of_a_tag_that_faces_south() -> None:
    """Top-left, top-right, bottom-right, bottom-left as one sees it from the south: west is left."""
    tag = TagConfig.model_validate({"id": 0, "size_m": 0.4, "xyz_m": [0, 0, 0], "facing_deg": 180})
    by_hand = [(-0.2, 0.0, 0.2), (0.2, 0.0, 0.2), (0.2, 0.0, -0.2), (-0.2, 0.0, -0.2)]
    np.testing.assert_allclose(tag.corners_m, by_hand, atol=1e-12)


DOCKED = Survey.model_validate(
    {
        "tags": [
            {"id": 1, "size_m": 0.4, "xyz_m": [2, 0, 1], "facing_deg": 180},
            {"id": 2, "size_m": 0.4, "xyz_m": [6, 2, 3], "facing_deg": 180},
            {"id": 3, "size_m": 0.4, "frame": "pier", "xyz_m": [5, 0, 1], "facing_deg": 90},
        ],
        "docks": [{"name": "unused"}, {"name": "pier", "xyz_m": [10, 20, 0.5], "rpy_deg": [0, 0, 90]}],
        "berths": [{"name": "inner", "frame": "pier", "xyz_m": [0, 0, 0], "facing_deg": 0}],
    }
)


def test_a_dock_that_is_turned_at_rest() -> None:
    """A quarter to port: its x axis points north, so what is 5 m along it is 5 m north; what faces its x faces north."""
    p, R = DOCKED.rest("pier")
    tag = DOCKED.tags[2]
    np.testing.assert_allclose(p + R @ np.array(tag.xyz_m), [10.0, 25.0, 1.5], atol=1e-12)
    np.testing.assert_allclose(R @ tag.R_frame_tag[:, 2], [0.0, 1.0, 0.0], atol=1e-12)
    for name in ("world",):
        at, turned = DOCKED.rest(name)
        np.testing.assert_array_equal(at, np.zeros(3))
        np.testing.assert_array_equal(turned, np.eye(3))


def test_frames_pivots_and_docks() -> None:
    assert DOCKED.frames == ("world", "pier")
    assert DOCKED.dock("world") is None
    pier = DOCKED.dock("pier")
    assert pier is not None
    assert pier.rpy_deg == (0.0, 0.0, 90.0)


def test_a_part_of_a_survey_keeps_what_it_needs() -> None:
    """Its berths stay, also those of frames that are left out: without them it would get berths of its own."""
    part = DOCKED.of({"world"})
    assert ([tag.id for tag in part.tags], part.docks, part.frames) == ([1, 2], (), ("world",))
    assert [berth.name for berth in part.berths] == ["inner"]
    assert DOCKED.of({"world", "pier"}).frames == DOCKED.frames
    assert len(DOCKED.tags) == 3
    assert DOCKED.of(()).frames == ()


def test_a_survey_comes_back_from_its_own_dump() -> None:
    assert Survey.model_validate(DOCKED.model_dump(mode="json")) == DOCKED


def vessel(**sensors: object) -> VesselConfig:
    return VesselConfig.model_construct(sensors=sensors)


def test_surveys_are_read_beside_the_vessel_file(tmp_path: Path) -> None:
    (tmp_path / "harbour").mkdir()
    (tmp_path / "harbour" / "tags.yaml").write_text(entry())
    compass = CompassConfig(topic="/heading")
    read = with_surveys(vessel(tags=AprilTagConfig(survey="harbour/tags.yaml"), compass=compass), tmp_path)
    tags = read.sensors["tags"]
    assert isinstance(tags, AprilTagConfig)
    assert [tag.id for tag in tags.surveyed.tags] == [3]
    assert read.sensors["compass"] == compass
    again = with_surveys(read, Path("/nowhere"))  # what is read is not read again
    assert again.sensors["tags"] == tags


def test_an_absolute_path_is_taken_as_it_is(tmp_path: Path) -> None:
    path = written(tmp_path, entry())
    read = with_surveys(vessel(tags=AprilTagConfig(survey=str(path))), Path("/nowhere"))
    tags = read.sensors["tags"]
    assert isinstance(tags, AprilTagConfig)
    assert len(tags.surveyed.tags) == 1


@pytest.mark.parametrize("place", ["[57.7012, 11.9034, 3.0]", "[11.9034, 57.7012, 43.0]"])
def test_a_survey_in_degrees_is_refused(tmp_path: Path, place: str) -> None:
    """Three tags were in one place, by it, and a run of them was 11 m off and told to look at their sizes."""
    path = written(tmp_path, entry() + entry(id="4", xyz_m=place).removeprefix("tags:\n"))
    config = VesselConfig.model_validate({"sensors": {}, "datum": UTM_33})
    config = config.model_copy(update={"sensors": {"tags": AprilTagConfig(survey="tags.yaml")}})
    with pytest.raises(ConfigError, match=rf"{path}: tag 4: its xyz_m is a latitude and a longitude: give metres"):
        with_surveys(config, tmp_path)


def test_a_tag_at_the_origin_of_a_simulator_is_not_taken_for_one_in_degrees(tmp_path: Path) -> None:
    """Its datum is 0, 0."""
    written(tmp_path, entry(xyz_m="[0.0, 0.0, 1.0]"))
    config = VesselConfig.model_validate({"sensors": {}, "datum": dict.fromkeys(UTM_33, 0.0)})
    config = config.model_copy(update={"sensors": {"tags": AprilTagConfig(survey="tags.yaml")}})
    assert len(with_surveys(config, tmp_path).sensors["tags"].surveyed.tags) == 1


def test_a_sensor_without_a_survey_says_what_it_needs(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"sensors\.bow\.survey: name the tags\.yaml"):
        with_surveys(vessel(bow=AprilTagConfig()), tmp_path)
    with pytest.raises(ConfigError, match=r"tags\.yaml: cannot be read"):
        with_surveys(vessel(bow=AprilTagConfig(survey="tags.yaml")), tmp_path)


def test_before_it_is_read_a_survey_is_empty() -> None:
    assert AprilTagConfig(survey="tags.yaml").surveyed == Survey()


def test_corners_turn_with_the_tag() -> None:
    """A tag that lies on the ground, its top to the north: corners by a rotation matrix written out here."""
    tag = TagConfig.model_validate({"id": 0, "size_m": 2.0, "xyz_m": [1, 2, 3], "rpy_deg": [0, 0, 0]})
    expected: Array = np.array([(0.0, 3.0, 3.0), (2.0, 3.0, 3.0), (2.0, 1.0, 3.0), (0.0, 1.0, 3.0)])
    np.testing.assert_allclose(tag.corners_m, expected, atol=1e-12)


IN_GRID = """grid: {grid}
tags:
- {{id: 3, size_m: 0.4, xyz_m: [{east}, {north}, {up}], facing_deg: 180}}
- {{id: 4, size_m: 0.4, xyz_m: [{east}, {north}, {up}], rpy_deg: [90, 0, 30]}}
- {{id: 5, size_m: 0.4, frame: d, xyz_m: [1, 2, 3], facing_deg: 180}}
docks:
- {{name: d, xyz_m: [{east}, {north}, {up}], rpy_deg: [0, 0, 20]}}
berths:
- {{name: b, xyz_m: [{east}, {north}, {up}], facing_deg: 90}}
"""
UTM_33 = {"latitude_deg": 57.7, "longitude_deg": 11.9, "height_m": 40.0}


def in_grid(folder: Path, datum: dict[str, float] | None = UTM_33, **changes: object) -> Survey:
    longitude, latitude = 11.9 + 0.002, 57.7 + 0.001
    east, north = Transformer.from_crs(4326, 32633, always_xy=True).transform(longitude, latitude)
    written(folder, IN_GRID.format(**{"grid": "EPSG:32633", "east": east, "north": north, "up": 43.0, **changes}))
    tags = AprilTagConfig(survey="tags.yaml")
    config = VesselConfig.model_validate({"sensors": {}, **({"datum": datum} if datum else {})})
    config = config.model_copy(update={"sensors": {"tags": tags}})
    sensor = with_surveys(config, folder).sensors["tags"]
    assert isinstance(sensor, AprilTagConfig)
    return sensor.surveyed


def test_a_survey_in_a_grid_is_turned_by_the_convergence_there(tmp_path: Path) -> None:
    """Its places and directions, but not those on a dock; by the radii of curvature of the ellipsoid, and Snyder's convergence."""
    survey = in_grid(tmp_path)
    a, e2, lat = 6378137.0, 0.00669437999014, np.radians(57.7005)
    across = a / np.sqrt(1.0 - e2 * np.sin(lat) ** 2)
    along = a * (1.0 - e2) / (1.0 - e2 * np.sin(lat) ** 2) ** 1.5
    east, north = np.radians(0.002) * across * np.cos(np.radians(57.701)), np.radians(0.001) * along
    grid_north_deg = np.degrees(np.arctan(np.tan(np.radians(11.902 - 15.0)) * np.sin(np.radians(57.701))))
    # Meridians lean to the zone's middle, which is east of here.
    assert grid_north_deg == pytest.approx(-2.62, abs=0.01)
    free, turned, riding = survey.tags
    np.testing.assert_allclose(free.xyz_m, (east, north, 3.0), atol=0.02)
    assert free.facing_deg == pytest.approx(180.0 + grid_north_deg, abs=0.01)
    assert turned.rpy_deg == pytest.approx((90.0, 0.0, 30.0 - grid_north_deg), abs=0.01)
    assert (riding.xyz_m, riding.facing_deg) == ((1.0, 2.0, 3.0), 180.0)
    np.testing.assert_allclose(survey.docks[0].xyz_m, free.xyz_m)
    assert survey.docks[0].rpy_deg == pytest.approx((0.0, 0.0, 20.0 - grid_north_deg), abs=0.01)
    np.testing.assert_allclose(survey.berths[0].xyz_m, free.xyz_m)
    assert survey.berths[0].facing_deg == pytest.approx(90.0 + grid_north_deg, abs=0.01)
    assert survey.grid == ""  # the one of the run folder is in world


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"grid": "EPSG:99999"}, "grid EPSG:99999 is not known"),
        ({"grid": "EPSG:4326"}, "does not count metres"),
        ({"grid": "EPSG:2263"}, "does not count metres"),  # feet
        ({"grid": "EPSG:2048"}, "does not count metres"),  # west and south
        (
            {"grid": "EPSG:5845"},
            "has heights of its own: name that of SWEREF99 TM alone, and give heights above the ellipsoid",
        ),
        ({"grid": "EPSG:32632"}, "km from the datum"),  # the next zone
        ({"east": 1e12}, "tag 3: 1e+12, "),
        ({"datum": None}, "needs a `datum:`"),
    ],
)
def test_a_survey_in_a_grid_that_is_none_is_one_line(changes: dict[str, object], said: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"tags\.yaml: ") as caught:
        in_grid(tmp_path, **changes)  # type: ignore[arg-type]
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("grid", "told"), [("EPSG:26910", True), ("EPSG:32610", False)], ids=["NAD 83", "WGS 84"])
def test_a_grid_whose_place_on_earth_is_known_to_metres_only_is_said(
    grid: str, caplog: pytest.LogCaptureFixture, *, told: bool, tmp_path: Path
) -> None:
    datum = {"latitude_deg": 37.8, "longitude_deg": -122.4, "height_m": 0.0}
    east, north = Transformer.from_crs(4326, 32610, always_xy=True).transform(-122.4, 37.8)
    in_grid(tmp_path, datum, grid=grid, east=east, north=north)
    assert ("is tied to WGS 84 to" in caplog.text) is told
