# SPDX-License-Identifier: Apache-2.0
"""Map of a run: tracks, truth, and every absolute measurement, coloured by its final weight."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from graphloc.eval.ekf import FilterResult, as_pose
from graphloc.eval.plots._marks import (
    TRUTH,
    Dash,
    Figure,
    Line,
    Mark,
    Panel,
    Points,
    Shape,
    Underlay,
    colour_of,
    shown_of,
    thinned,
)
from graphloc.frames import Array, Datum
from graphloc.ledger import LedgerRow
from graphloc.measurements import GnssPosition, Measurement, PoseFix, TagSighting, world_from_fixes
from graphloc.recording import Recording
from graphloc.solution import Solution
from graphloc.survey import WORLD, Survey
from graphloc.time import utc_text
from graphloc.trajectory import Trajectory

_SHAPES: dict[type[Measurement], Shape] = {GnssPosition: "circle", PoseFix: "diamond", TagSighting: "square"}
_HEIGHT_PX = 620


@dataclass(frozen=True, slots=True)
class Placed:
    """An absolute measurement on the map.

    Attributes:
        p_m: (2,) position that it gives for body; of a fix: for its antenna. kind: its type. row: its ledger row.
    """

    p_m: Array
    kind: type[Measurement]
    row: LedgerRow


def placed(recording: Recording, solution: Solution) -> Iterator[Placed]:
    """Yield every measurement that gives a position, by the chosen mode or, if none was chosen, the first one."""
    rows = {row.seq: row for row in solution.ledger if row.seq >= 0}
    for m in recording.measurements:
        row = rows.get(m.seq)
        where = None if row is None else _place(m, row, solution.datum)
        if where is not None and row is not None:
            yield Placed(where, type(m), row)


def _place(m: Measurement, row: LedgerRow, datum: Datum) -> Array | None:
    if isinstance(m, GnssPosition):
        return world_from_fixes([m], datum)[0, :2]
    if isinstance(m, PoseFix) and m.axes[:2] == ("x", "y"):
        return np.asarray(m.modes[row.mode or 0].value[:2])
    if isinstance(m, TagSighting):
        return np.asarray(as_pose(m, Survey()).modes[row.mode or 0].value[:2])
    return None


def hover(row: LedgerRow) -> str:
    """Return a ledger row as the lines of a tooltip."""
    said = [f"{row.sensor}: {row.outcome.value}" + ("" if row.weight is None else f", weight {row.weight:.2f}")]
    if row.mode is not None and row.mode_probability is not None:
        said.append(f"mode {row.mode}, probability {row.mode_probability:.2f}")
    off = [f"{v:.2f} {u}" for v, u in ((row.residual_m, "m"), (row.residual_deg, "deg")) if v is not None]
    if row.nis is not None and row.dof:
        off.append(f"{np.sqrt(row.nis / row.dof):.1f} sigmas")
    said += [f"residual {', '.join(off)}"] if off else []
    said.append(f"{utc_text(row.stamp_ns)[11:23]} UTC, arrival {row.seq}")
    return "<br>".join([*said, *(t.replace("<", "&lt;") for t in (row.detail, row.reason) if t)])


def run_map(
    recording: Recording,
    solution: Solution,
    filters: Sequence[FilterResult],
    held: Sequence[GnssPosition] = (),
    underlay: Underlay | None = None,
) -> Figure:
    """Return the map in ENU metres from the datum."""
    marks: list[Mark] = list(_measured(recording, solution))
    if held:
        p = world_from_fixes(held, solution.datum)[thinned(len(held))]
        marks.append(Points(name="held-out fixes", x=p[:, 0], y=p[:, 1], shape="x", size=4.0))
    for f in filters:
        marks.append(_track(f.name, f.trajectory, colour_of(f.name), "dash"))
    if recording.truth is not None:
        marks.append(_track("truth", recording.truth, TRUTH, "dot"))
    marks.append(_track(solution.name, solution.trajectory, colour_of(solution.name), "solid"))
    panel = Panel(title="", y="north, m", marks=tuple(marks))
    return Figure(name="map", x="east, m", panels=(panel,), height=_HEIGHT_PX, is_map=True, underlay=underlay)


def _track(name: str, track: Trajectory, colour: str, dash: Dash) -> Line:
    p = track.p_world_m[thinned(len(track))]
    return Line(name=name, x=p[:, 0], y=p[:, 1], colour=colour, dash=dash)


def _measured(recording: Recording, solution: Solution) -> Iterator[Points]:
    by_sensor: defaultdict[tuple[str, type[Measurement]], list[Placed]] = defaultdict(list)
    for item in placed(recording, solution):
        by_sensor[item.row.sensor, item.kind].append(item)
    for (sensor, kind), items in by_sensor.items():
        weight = np.array([item.row.weight or 0.0 for item in items])
        some = shown_of(weight)
        p = np.array([items[k].p_m for k in some])
        yield Points(
            name=f"{sensor} by weight", x=p[:, 0], y=p[:, 1], weight=weight[some], text=[hover(items[k].row) for k in some],
            shape=_SHAPES[kind], size={GnssPosition: 4.0, TagSighting: 5.0}.get(kind, 7.0),
        )  # fmt: skip
    yield from _tags(recording)


def _tags(recording: Recording) -> Iterator[Points]:
    """Yield the positions of the tags that were seen, docks at rest."""
    seen: dict[tuple[str, int], tuple[Array, str]] = {}
    for m in recording.measurements:
        if isinstance(m, TagSighting):
            for k, number in enumerate(m.numbers):
                where = "" if m.frame == WORLD else f", on {m.frame}"
                seen.setdefault((m.families[k], number), (m.points_m[4 * k : 4 * k + 4, :2].mean(axis=0), where))
    if seen:
        p = np.array([p for p, _ in seen.values()])
        text = [f"tag {number} ({family}){where}" for (family, number), (_, where) in seen.items()]
        yield Points(name="tags", x=p[:, 0], y=p[:, 1], text=text, colour="#D7191C", shape="square", size=10.0)
