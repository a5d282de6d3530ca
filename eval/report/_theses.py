# SPDX-License-Identifier: Apache-2.0
"""Tables of the theses (BL 4.1 to 4.8, D 4.13) in their own form, with this run beside the published numbers."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from graphloc.eval.docking import accurate_within_m
from graphloc.eval.ekf import named_tracks
from graphloc.eval.formatting import number
from graphloc.eval.html import note, table
from graphloc.eval.metrics import compare_to_truth, receiver_errors
from graphloc.eval.report._data import ReportData
from graphloc.eval.report._published import BL_RUNS, DIGERUD_RUNS
from graphloc.measurements import GnssPosition, PoseFix, TagSighting
from graphloc.signals.series import rms
from graphloc.time import stamps_of
from graphloc.trajectory import Trajectory

_BL = (
    "Grey: as printed, from BL's own recordings, with GNSS as truth and noise added to it. Below: this run, in the same form; "
    "another vessel or harbour, so the two are not to be subtracted. The BL EKF below is their filter on this run."
)
_DIGERUD = (
    "Grey: as printed, from D's own recordings with RTK GNSS as truth. Below: this run. Error: the distance to the nearest tag "
    "within which 95 % of horizontal errors are below 0.10 m, from the first sighting on. Range: the true distance of the "
    "farthest sighting. Ambiguity: of two poses that a sighting allows, how often the run took the one that fits the image less."
)


def theses_section(data: ReportData) -> str:
    """Return the tables that this run has data for, as HTML; empty without truth."""
    parts = [*_bl(data), *_digerud(data)] if data.recording.truth is not None else []
    return "".join(parts)


def _bl(data: ReportData) -> Iterator[str]:
    truth = data.recording.truth
    assert truth is not None
    kinds = {type(m) for m in data.recording.measurements}
    if not {GnssPosition, PoseFix} <= kinds:
        return
    printed = [(f"case {r.case}, {r.noise} ({r.measured_table})", *r.measured_m) for r in BL_RUNS]
    measured = _gnss_error_m(data, truth) if truth.headed else []  # without one the antenna's place is not known
    yield "<h3>BL 4.1, 4.2: position of the measurement, m</h3>" + note(_BL)
    rows = [(name, number(rms, 4), number(most, 4)) for name, rms, most in printed]
    mine = [(f"this run: {name}", number(rms, 4), number(most, 4)) for name, rms, most in measured]
    yield table(("Measurement", "RMSE", "Max error"), [*rows, *mine], _classes(len(rows), len(mine)))
    yield "<h3>BL 4.3 to 4.8: the estimate</h3>"
    rows4 = [
        (f"case {r.case}, {r.noise} ({r.table})", *(number(v, 4) for v in (*r.position_m, *r.heading_deg)))
        for r in BL_RUNS
    ]
    mine4 = []
    for name, track in named_tracks(data.solution, data.filters):
        m = compare_to_truth(track, truth)
        values = (m.position_rmse_m, m.position_max_m, m.heading_rmse_deg, m.heading_max_deg)
        mine4.append((f"this run: {name}", *(number(v, 4) for v in values)))
    head = ("State", "Position [m] RMSE", "Max error", "Heading [°] RMSE", "Max error")
    yield table(head, [*rows4, *mine4], _classes(len(rows4), len(mine4)))


def _classes(printed: int, mine: int) -> list[str]:
    return ["print"] * printed + ["part ours"] * min(mine, 1) + [""] * (mine - 1)


def _gnss_error_m(data: ReportData, truth: Trajectory) -> list[tuple[str, float, float]]:
    """Return RMSE and largest horizontal error (m) of each receiver, at its antenna."""
    found = []
    for name in data.config.of_kind("gnss"):
        antennas = data.antennas.of(data.solution.name)
        off = receiver_errors(truth, data.recording.of(GnssPosition, name), data.solution.datum, antennas)
        if off is not None:
            found.append((name, rms(off.horizontal_m), float(off.horizontal_m.max())))
    return found


def _digerud(data: ReportData) -> Iterator[str]:
    truth = data.recording.truth
    assert truth is not None
    rows = [
        (r.condition, r.error, "n/d" if r.range_m is None else f"{r.range_m:.0f} m", r.ambiguity) for r in DIGERUD_RUNS
    ]
    mine = []
    for sensor, config in data.config.of_kind("apriltag").items():
        seen = data.recording.of(TagSighting, sensor)
        if not seen:
            continue
        stamps = stamps_of(seen)
        far, flipped = _farthest(seen, truth), _second_pose(data, sensor)
        for name, track in named_tracks(data.solution, data.filters):
            within = accurate_within_m(track, truth, config.surveyed, stamps, seen[0].t_body_camera_m)
            said = "not < 0.10 m anywhere" if within is None else f"< 0.10 m within {within:.1f} m"
            mine.append((f"this run: {name}", said, far, flipped if track is data.solution.trajectory else ""))
    if mine:
        yield "<h3>D 4.13: tags</h3>" + note(_DIGERUD)
        head = ("Scenario", "Absolute error", "Max detection range", "The ambiguity problem")
        yield table(head, [*rows, *mine], _classes(len(rows), len(mine)), text=(1, 3))


def _farthest(seen: list[TagSighting], truth: Trajectory) -> str:
    """Return the true distance from the camera to the tags, docks at rest, of the farthest sighting."""
    stamps = stamps_of(seen)
    covered = np.flatnonzero(truth.covers(stamps))
    if not len(covered):
        return "-"
    away = [
        np.linalg.norm(p + R @ m.t_body_camera_m - m.points_m.mean(axis=0))
        for p, R, m in zip(*truth.poses_at(stamps[covered]), (seen[k] for k in covered), strict=True)
    ]
    return f"{max(away):.1f} m"


def _second_pose(data: ReportData, sensor: str) -> str:
    rows = [r for r in data.solution.ledger if r.sensor == sensor and r.mode is not None]
    return f"{sum(bool(r.mode) for r in rows)} of {len(rows)} sightings"
