# SPDX-License-Identifier: Apache-2.0
"""A run for the rerun viewer: tracks, scans on the image, tags, matches and weights over the time of the bag.

World is as in graphloc: x east, y north, z up, metres. Entities: docs/rerun.md.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from graphloc.config import AerialConfig, VesselConfig
from graphloc.errors import InputError, OutputError
from graphloc.eval.ekf import FilterResult, as_pose, named_tracks
from graphloc.eval.plots import colour_of
from graphloc.extras import need
from graphloc.frames import Array, Datum
from graphloc.frontends.aerial.cloud import level
from graphloc.frontends.aerial.image import AerialImage
from graphloc.frontends.aerial.live import Turn, outside
from graphloc.frontends.aerial.scans import ScanFeed
from graphloc.frontends.part import Bags
from graphloc.frontends.source import Bag
from graphloc.ledger import LedgerRow
from graphloc.measurements import GnssPosition, Measurement, PoseFix, TagSighting, world_from_fixes
from graphloc.recording import Recording
from graphloc.solution import Health, Solution
from graphloc.survey import Survey
from graphloc.trajectory import Trajectory, bounds_95

TIMELINE = "stamp"
_POSES = 4000  # most poses of a track: more cannot be seen
_POINTS = 2000  # most points of a turn of the LiDARs
_TEXELS = 1024  # most pixels of the image, each way
_AROUND_M = 60.0  # margin of the image around the track
_LEVELS = {Health.GOOD: "INFO", Health.DEGRADED: "WARN", Health.DEAD_RECKONING: "WARN", Health.LOST: "ERROR"}
_TRUTH = "#F0E442"  # not black as in the report, which cannot be seen on water
_BELOW_M = 1.0  # depth of the image below the water, so that waves and tide leave the tracks above it
_BOW = np.array([[[0.0, 0.0, 0.0], [4.0, 0.0, 0.0]]])  # drawn if no hull is known: a line ahead, m in body


def write_rerun(
    path: Path,
    solution: Solution,
    recording: Recording,
    config: VesselConfig,
    filters: Sequence[FilterResult] = (),
    *,
    bags: Bags = (),
    folder: Path = Path(),
) -> None:
    """Write a run as `path` (.rrd).

    Args:
        solution: of the recording. filters: other estimates of the recording.
        bags: source of scans; empty: no scans. folder: base of relative paths of images.

    Raises:
        ExtraError: rerun is not installed. OutputError: the file cannot be written.
        InputError: an image or a bag can no longer be read.
    """
    rr = need("rerun", "rerun")
    half_written = path.with_name(f".{path.name}.part")
    make_folder(path)
    try:
        stream = rr.RecordingStream("graphloc")
        stream.set_log_time_enabled(False)
        stream.set_log_tick_enabled(False)
        stream.save(half_written, default_blueprint=_blueprint())
        stream.send_recording_name(f"{config.vessel}: {Path(recording.source).name}")
        stream.send_recording_start_time_nanos(int(solution.trajectory.stamps_ns[0]))
        stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for name, track in named_tracks(solution, filters):
            _log_track(stream, name, track, colour_of(name), config)
        if recording.truth is not None:
            _log_track(stream, "truth", recording.truth, _TRUTH, config)
        _log_health(stream, solution)
        _log_measurements(stream, recording, solution)
        _log_tags(stream, config)
        for name, sensor in config.of_kind("aerial").items():
            _log_image(stream, name, sensor, solution, folder)
            if bags:
                _log_scans(stream, name, sensor, config, solution.trajectory, bags)
        stream.flush()
        stream.disconnect()
        half_written.replace(path)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror or error})") from None
    finally:
        half_written.unlink(missing_ok=True)


def make_folder(path: Path) -> None:
    """Create the folder of a file.

    Raises:
        OutputError: it cannot be created.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{path}: its folder cannot be made ({error.strerror})") from None


def _blueprint() -> Any:
    rrb = need("rerun.blueprint", "rerun")
    beside = rrb.Vertical(
        rrb.TimeSeriesView(origin="bound_95_m", name="95 % bound, m"),
        rrb.TimeSeriesView(origin="weights", name="weights"),
        rrb.TextLogView(origin="health", name="health"),
    )
    return rrb.Blueprint(rrb.Horizontal(rrb.Spatial3DView(origin="world", name="world"), beside, column_shares=[3, 1]))


def _pixels(size: float) -> Any:
    """Return a radius of some pixels on the screen, which is visible from any distance."""
    return need("rerun", "rerun").Radius.ui_points(size)


def _entity(name: str) -> str:
    """Return a name as a unique part of an entity path, with escaped characters."""
    return str(need("rerun", "rerun").escape_entity_path_part(name))


def _columns(stream: Any, entity: str, stamps_ns: Any, columns: Any) -> None:
    rr = need("rerun", "rerun")
    stamps = np.asarray(stamps_ns).astype("datetime64[ns]")
    stream.send_columns(entity, indexes=[rr.TimeColumn(TIMELINE, timestamp=stamps)], columns=columns)


def _log_track(stream: Any, name: str, track: Trajectory, colour: str, config: VesselConfig) -> None:
    """Log the whole path of a track, and the body that moves along it."""
    rr = need("rerun", "rerun")
    entity, thin = f"world/{_entity(name)}", slice(None, None, -(-len(track) // _POSES))
    rgb = [int(colour[k : k + 2], 16) for k in (1, 3, 5)]
    places = track.p_world_m[thin]
    stream.log(f"{entity}/track", rr.LineStrips3D([places], colors=[rgb], radii=_pixels(2)), static=True)
    hulls = [np.array(s.hull_m) for s in config.of_kind("aerial").values() if s.hull_m]
    lines = [np.column_stack([h, np.zeros(len(h))])[[*range(len(h)), 0]] for h in hulls] or _BOW
    stream.log(f"{entity}/body/hull", rr.LineStrips3D(lines, colors=[rgb], radii=_pixels(2)), static=True)
    turned = Rotation.from_matrix(track.R_world_body[thin]).as_quat()
    _columns(
        stream, f"{entity}/body", track.stamps_ns[thin], rr.Transform3D.columns(translation=places, quaternion=turned)
    )
    if track.cov is not None:
        bounds = bounds_95(track.cov[thin])[:, 0]
        _columns(stream, f"bound_95_m/{_entity(name)}", track.stamps_ns[thin], rr.Scalars.columns(scalars=bounds))


def _log_health(stream: Any, solution: Solution) -> None:
    """Log a line at each change of health or its reason."""
    rr = need("rerun", "rerun")
    said = list(zip(solution.health, solution.health_reason, strict=True))
    new = [0, *(k for k, (before, now) in enumerate(pairwise(said), start=1) if before != now)]
    texts = [f"{said[k][0].value}: {said[k][1]}".removesuffix(": ") for k in new]
    columns = rr.TextLog.columns(text=texts, level=[_LEVELS[said[k][0]] for k in new])
    _columns(stream, "health", solution.trajectory.stamps_ns[new], columns)


def _log_measurements(stream: Any, recording: Recording, solution: Solution) -> None:
    """Log the weight of each measurement, and the position that it gives (for body or the antenna), red if rejected."""
    rr = need("rerun", "rerun")
    rows = {row.seq: row for row in solution.ledger if row.weight is not None and row.seq >= 0}
    by_sensor: dict[str, list[tuple[Measurement, LedgerRow]]] = {}
    for m in recording.measurements:
        if m.seq in rows:
            by_sensor.setdefault(m.sensor, []).append((m, rows[m.seq]))
    for name, items in by_sensor.items():
        stamps = np.array([m.stamp_ns for m, _ in items], dtype=np.int64)
        weights = np.array([row.weight for _, row in items], dtype=float)
        _columns(stream, f"weights/{_entity(name)}", stamps, rr.Scalars.columns(scalars=weights))
        heights = np.interp(stamps, solution.trajectory.stamps_ns, solution.trajectory.p_world_m[:, 2])
        said = [_said_m(m, row, solution.datum, z) for (m, row), z in zip(items, heights, strict=True)]
        placed = [k for k, place in enumerate(said) if place is not None]
        if placed:
            colours = np.column_stack([255 * (1 - weights), 200 * weights, 0 * weights])[placed].astype(np.uint8)
            points = rr.Points3D.columns(
                positions=[said[k] for k in placed], colors=colours, radii=np.repeat(_pixels(3), len(placed))
            )
            _columns(stream, f"world/measured/{_entity(name)}", stamps[placed], points)


def _said_m(m: Measurement, row: LedgerRow, datum: Datum, height_m: float) -> Array | None:
    """Return the position (3,) in world that a measurement gives for body, or the antenna; None if it gives none."""
    if isinstance(m, GnssPosition):
        place = np.array(world_from_fixes([m], datum)[0])
        place[2] = place[2] if m.has_height else height_m
        return place
    pose = as_pose(m, Survey()) if isinstance(m, TagSighting) else m
    if not isinstance(pose, PoseFix) or pose.axes[:2] != ("x", "y"):
        return None
    value = pose.modes[row.mode or 0].value
    return np.array([value[0], value[1], value[2] if "z" in pose.axes else height_m])


def _log_tags(stream: Any, config: VesselConfig) -> None:
    """Log the surveyed tags, floating docks at rest."""
    rr = need("rerun", "rerun")
    for name, sensor in config.of_kind("apriltag").items():
        survey = sensor.surveyed
        squares, labels = [], []
        for tag in survey.tags:
            t, R = survey.rest(tag.frame)
            corners = tag.corners_m @ R.T + t
            squares.append(corners[[0, 1, 2, 3, 0]])
            labels.append(survey.called(tag.family, tag.id))
        if squares:
            stream.log(
                f"world/tags/{_entity(name)}", rr.LineStrips3D(squares, labels=labels, radii=_pixels(2)), static=True
            )


def _log_image(stream: Any, name: str, sensor: AerialConfig, solution: Solution, folder: Path) -> None:
    """Log the image around the track, just below the water."""
    if not sensor.image:
        return
    rr = need("rerun", "rerun")
    places = solution.trajectory.p_world_m
    low, high = places.min(axis=0), places.max(axis=0)
    half_m = float((high - low)[:2].max()) / 2.0 + _AROUND_M
    image = AerialImage(folder / sensor.image, solution.datum)
    patch = image.patch((low + high)[:2] / 2.0, half_m, max(2.0 * half_m / _TEXELS, 0.1))
    rows, columns = patch.inside.shape
    west, north = patch.west_m - patch.cell_m / 2.0, patch.north_m + patch.cell_m / 2.0
    east, south = west + columns * patch.cell_m, north - rows * patch.cell_m
    water_m = float(np.median(places[:, 2])) + sensor.waterline_m
    corners = [[x, y, water_m - _BELOW_M] for x, y in ((west, north), (east, north), (east, south), (west, south))]
    mesh = rr.Mesh3D(
        vertex_positions=corners,
        triangle_indices=[[0, 2, 1], [0, 3, 2]],
        vertex_texcoords=[[0, 0], [1, 0], [1, 1], [0, 1]],
        albedo_texture=patch.pixels,
    )
    stream.log(f"world/image/{_entity(name)}", mesh, static=True)


def _log_scans(
    stream: Any, name: str, sensor: AerialConfig, config: VesselConfig, track: Trajectory, bags: Bags
) -> None:
    """Log the turns of the LiDARs at the matching interval, each from where the track has its LiDARs."""
    rr = need("rerun", "rerun")
    with Bag(bags) as bag:
        feed = ScanFeed(bag, sensor, config.body_frame)
        for turn in _due(feed, track, sensor.every_s):
            try:
                cloud = level(list(turn.clouds), feed.mounts, track, turn.stamp_ns, sensor.waterline_m)
            except InputError:  # the ledger says why
                continue
            pose = track.at(np.array([turn.stamp_ns]))
            c, s = np.cos(pose.yaw_rad[0]), np.sin(pose.yaw_rad[0])
            points = cloud.points_m[:: -(-len(cloud.points_m) // _POINTS) or 1]
            R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
            placed = points @ R.T + pose.p_world_m[0] + np.array([0.0, 0.0, sensor.waterline_m])
            stream.set_time(TIMELINE, timestamp=np.datetime64(turn.stamp_ns, "ns"))
            stream.log(f"world/scan/{_entity(name)}", rr.Points3D(placed, radii=_pixels(1)))
    stream.reset_time()


def _due(feed: ScanFeed, track: Trajectory, every_s: float) -> Iterator[Turn]:
    last_ns: int | None = None
    for turn in feed:
        if turn.why_not or not turn.clouds or outside(turn, track):
            continue
        if last_ns is None or abs(turn.stamp_ns - last_ns) >= 0.9e9 * every_s:
            last_ns = turn.stamp_ns
            yield turn
