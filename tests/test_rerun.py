"""What is written for the rerun viewer, read back with its own reader: what is there, when, and where."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from graphloc import app
from graphloc.config import AerialConfig, AprilTagConfig
from graphloc.errors import ExtraError, OutputError
from graphloc.eval import rerun_log
from graphloc.eval.plots import colour_of
from graphloc.eval.rerun_log import write_rerun
from graphloc.eval.simulate import Scenario, simulate
from graphloc.eval.simulate.bag import write_bag
from graphloc.frontends.aerial.cloud import Cloud
from graphloc.frontends.aerial.live import Turn
from graphloc.ledger import Ledger
from tests.commands import called
from tests.slowly import simulate_slowly

BLANK = r"\ "  # in an entity path


def read(path: Path) -> dict[str, dict[str, list[Any]]]:
    """Entity -> column -> values, in the order of the rows; `stamp` in ns."""
    from rerun.chunk import RrdReader

    found: dict[str, dict[str, list[Any]]] = {}
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        entity = found.setdefault(chunk.entity_path, {})
        for name in batch.schema.names:
            column = batch.column(name)
            values = column.cast("int64").to_pylist() if name == "stamp" else column.to_pylist()
            entity.setdefault(name.rpartition(":")[2], []).extend(values)
    return found


@pytest.fixture(scope="module")
def run() -> app.Run:
    return app.simulated(
        simulate_slowly(Scenario(duration_s=14.0, noise="jump", imu_hz=50.0, gnss_hz=2.0, compass_hz=2.0), 5, 5.0),
        compare=True,
    )


def write(run: app.Run, path: Path, **options: Any) -> dict[str, dict[str, list[Any]]]:
    write_rerun(path, run.solution, run.recording, run.config, run.filters, **options)
    return read(path)


def test_tracks_weights_and_health_are_those_of_the_run(run: app.Run, tmp_path: Path) -> None:
    said = write(run, tmp_path / "deep/run.rrd")
    track, truth = run.solution.trajectory, run.recording.truth
    assert truth is not None
    names = {name.split("/")[2] for name in said if name.startswith("/world/") and name.endswith("/body")}
    assert names == {"graphloc", r"graphloc\ online", "truth", *(f.name.replace(" ", BLANK) for f in run.filters[1:])}

    body = said["/world/graphloc/body"]
    assert body["stamp"] == track.stamps_ns.tolist()
    np.testing.assert_allclose(np.array(body["translation"])[:, 0], track.p_world_m, atol=1e-4)
    turned = Rotation.from_quat(np.array(body["quaternion"])[:, 0]).as_matrix()
    np.testing.assert_allclose(turned, track.R_world_body, atol=1e-5)
    assert track.cov is not None
    radius = [np.sqrt(5.991 * np.linalg.eigvalsh(cov[:2, :2])[-1]) for cov in track.cov]
    np.testing.assert_allclose(np.array(said["/bound_95_m/graphloc"]["scalars"])[:, 0], radius, rtol=1e-3)
    np.testing.assert_allclose(said["/world/truth/track"]["strips"][0][0], truth.p_world_m, atol=1e-4)

    for name in ("graphloc", *(f.name for f in run.filters)):
        (rgba,) = np.ravel(said[f"/world/{name.replace(' ', BLANK)}/track"]["colors"])
        assert f"#{int(rgba) >> 8:06X}" == colour_of(name)  # as in the report

    rows = [row for row in run.solution.ledger if row.sensor == "matcher"]
    stamps = {m.seq: m.stamp_ns for m in run.recording.measurements}
    weights = said["/weights/matcher"]
    assert dict(zip(weights["stamp"], np.ravel(weights["scalars"]), strict=True)) == {
        stamps[row.seq]: row.weight for row in rows
    }
    changes = [run.solution.health[0]]
    for health in run.solution.health:
        changes += [health] if health != changes[-1] else []
    lines = [text[0].split(":")[0] for text in said["/health"]["text"]]
    assert [a for k, a in enumerate(lines) if k == 0 or a != lines[k - 1]] == [h.value for h in changes]


def test_measurements_lie_where_they_say_red_where_they_are_not_believed(run: app.Run, tmp_path: Path) -> None:
    said = write(run, tmp_path / "run.rrd")
    false = {row.seq: row.weight for row in run.solution.ledger if row.sensor == "matcher"}
    matches = [m for m in run.recording.measurements if m.sensor == "matcher"]
    points = said["/world/measured/matcher"]
    assert points["stamp"] == [m.stamp_ns for m in matches]
    for m, (place,), (colour,) in zip(matches, points["positions"], points["colors"], strict=True):
        assert m.modes[0].value[:2] == pytest.approx(place[:2], abs=1e-4)  # type: ignore[attr-defined]
        red, green = colour >> 24, (colour >> 16) & 255
        assert (red > green) == (float(false[m.seq] or 0.0) < 200 / 455)
    antenna = np.array(said["/world/measured/gnss"]["positions"])[:, 0]
    assert np.abs(antenna[:, :2] - said["/world/graphloc/track"]["strips"][0][0][0][:2]).max() < 60.0
    assert 1.0 < np.median(antenna[:, 2] - np.array(said["/world/truth/track"]["strips"][0][0])[0, 2]) < 6.0
    assert "/world/measured/compass" not in said  # says no place
    assert len(said["/weights/compass"]["stamp"]) == 28


def test_sensors_of_like_names_are_told_apart(run: app.Run, tmp_path: Path) -> None:
    """Matches as `my fix`, fixes as `my_fix`: each has its own stamps and weights, and nobody else's."""
    names = {"matcher": "my fix", "gnss": "my_fix", "compass": "my/fix"}
    measurements = tuple(replace(m, sensor=names.get(m.sensor, m.sensor)) for m in run.recording.measurements)
    ledger = Ledger()
    for row in run.solution.ledger:
        ledger.add(replace(row, sensor=names.get(row.sensor, row.sensor)))
    said = write(
        replace(
            run,
            recording=replace(run.recording, measurements=measurements),
            solution=replace(run.solution, ledger=ledger),
        ),
        tmp_path / "run.rrd",
    )
    for name, escaped in (("my fix", rf"my{BLANK}fix"), ("my_fix", "my_fix"), ("my/fix", r"my\/fix")):
        stamps = [m.stamp_ns for m in measurements if m.sensor == name]
        assert said[f"/weights/{escaped}"]["stamp"] == stamps, name
        if name != "my/fix":  # a heading says no place
            assert said[f"/world/measured/{escaped}"]["stamp"] == stamps, name


def test_scans_the_image_and_tags_lie_in_world(run: app.Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A point of a quay, seen from two places by a LiDAR that is mounted askew, is drawn where it is."""
    track = run.solution.trajectory
    quay = np.array([40.0, -25.0, 3.0])
    mount = (np.array([2.0, 0.5, 3.0]), Rotation.from_euler("ZYX", [170, 5, -3], degrees=True).as_matrix())
    turns = []
    for k in (10, 11, 30, 50):  # the second comes too soon after the first
        from_body = track.R_world_body[k].T @ (quay - track.p_world_m[k])
        seen, at_ns = mount[1].T @ (from_body - mount[0]), int(track.stamps_ns[k])
        turns.append(Turn(at_ns, at_ns, (Cloud("top", at_ns, seen[None], np.array([at_ns])),)))
    turns.append(Turn(int(track.stamps_ns[-1]), 0, (), "damaged"))

    class Feed:
        mounts = {"top": mount}  # noqa: RUF012

        def __iter__(self) -> Iterator[Turn]:
            return iter(turns)

    patch = SimpleNamespace(
        inside=np.ones((40, 60), bool), pixels=np.zeros((40, 60, 3), np.uint8), west_m=-10.0, north_m=7.0, cell_m=0.5
    )
    monkeypatch.setattr(rerun_log, "ScanFeed", lambda *_: Feed())
    monkeypatch.setattr(rerun_log, "Bag", lambda _: pytest.MonkeyPatch.context())
    monkeypatch.setattr(rerun_log, "AerialImage", lambda *_: SimpleNamespace(patch=lambda *_: patch))
    tag = {"id": 7, "size_m": 0.4, "xyz_m": [5.0, 1.0, 2.0], "facing_deg": 180.0}  # to the south
    sensors = {
        **run.config.sensors,
        "match": AerialConfig(image="x.tif", waterline_m=-0.5, hull_m=((3.0, 0.0), (-3.0, 2.0), (-3.0, -2.0))),
        "tags": AprilTagConfig.model_validate({"survey": {"tags": [tag]}}),
    }
    whole = replace(run, config=run.config.model_copy(update={"sensors": sensors}))
    said = write(whole, tmp_path / "run.rrd", bags=[Path("x")])
    scans = said["/world/scan/match"]
    assert scans["stamp"] == [turns[k].stamp_ns for k in (0, 2, 3)]
    np.testing.assert_allclose(np.array(scans["positions"]), np.tile(quay, (3, 1, 1)), atol=0.02)
    corners = np.array(said["/world/image/match"]["vertex_positions"][0])
    np.testing.assert_allclose(corners[:, :2], [[-10.25, 7.25], [19.75, 7.25], [19.75, -12.75], [-10.25, -12.75]])
    np.testing.assert_allclose(corners[:, 2], np.median(track.p_world_m[:, 2]) - 1.5, atol=1e-4)
    square = np.array(said["/world/tags/tags"]["strips"][0][0])
    # Seen from the south, east is to the right: the print's top left is west and up.
    expected = [[4.8, 1, 2.2], [5.2, 1, 2.2], [5.2, 1, 1.8], [4.8, 1, 1.8], [4.8, 1, 2.2]]
    np.testing.assert_allclose(square, expected, atol=1e-5)
    assert said["/world/graphloc/body/hull"]["strips"][0][0][0] == [3.0, 0.0, 0.0]


def test_nothing_is_left_half_written(run: app.Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match=r"file/run\.rrd"):
        write(run, tmp_path / "file/run.rrd")
    monkeypatch.setattr(rerun_log, "_log_tags", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        write(run, tmp_path / "run.rrd")
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


@pytest.mark.usefixtures("map_alone")
def test_the_commands_write_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    bag, config = write_bag(
        simulate(Scenario(duration_s=12.0, imu_hz=50.0, gnss_hz=2.0, compass_hz=2.0), 3), tmp_path / "bag", ros=2
    )

    for command, name in (("smooth", "graphloc"), ("replay", r"graphloc\ online")):
        path = tmp_path / f"{command}.rrd"
        assert called(monkeypatch, command, bag, "-c", config, "-o", tmp_path / command, "--rerun", path) == 0
        assert len(read(path)[f"/world/{name}/body"]["stamp"]) > 50
    capsys.readouterr()
    monkeypatch.setattr("graphloc.app.load", lambda *_: pytest.fail("refused only after the bag was read"))
    assert called(monkeypatch, "compare", bag, "-c", config, "-o", tmp_path / "x", "--rerun", path) == 2
    assert "--overwrite" in capsys.readouterr().err

    def missing(*_: object) -> None:
        raise ExtraError("rerun is not installed: pip install 'graphloc[rerun]'")

    monkeypatch.setattr("graphloc.extras.need", missing)  # before anything else
    assert called(monkeypatch, "smooth", bag, "-c", config, "-o", tmp_path / "y", "--rerun", tmp_path / "y.rrd") == 2
    assert capsys.readouterr().err.strip() == "graphloc: rerun is not installed: pip install 'graphloc[rerun]'"
