# SPDX-License-Identifier: Apache-2.0
"""Figures of a run, as functions of what is shown. One table of colours (Okabe-Ito, safe for colour-blind eyes)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray
from plotly.subplots import make_subplots

from graphloc.eval.ekf import FilterResult, as_pose
from graphloc.eval.metrics import Levers, errors, held_out_errors
from graphloc.frames import Array, Datum
from graphloc.ledger import LedgerRow
from graphloc.measurements import GnssPosition, Measurement, PoseFix, TagSighting
from graphloc.outputs import bounds_95
from graphloc.recording import Recording
from graphloc.solution import Health, SlowEstimate, Solution
from graphloc.survey import Survey
from graphloc.time import utc_text
from graphloc.trajectory import Trajectory

COLOURS = ("#0072B2", "#D55E00", "#CC79A7", "#009E73", "#E69F00", "#56B4E9")
TRUTH, BAND = "#000000", "rgba(0,114,178,0.18)"
HEALTH = {
    Health.GOOD: "rgba(0,0,0,0)",
    Health.DEGRADED: "rgba(230,159,0,0.25)",
    Health.DEAD_RECKONING: "rgba(213,94,0,0.30)",
    Health.LOST: "rgba(120,0,0,0.45)",
}
_LOST = 4.0  # times the next larger error
_MOST = 4000  # points a trace: more cannot be seen and make a heavy page


def _every(n: int) -> slice:
    return slice(None, None, max(1, n // _MOST))


def _layout(figure: go.Figure, height: int) -> go.Figure:
    figure.update_layout(
        template="plotly_white",
        height=height,
        margin={"l": 55, "r": 15, "t": 30, "b": 45},
        legend={"orientation": "h", "y": 1.02, "yanchor": "bottom", "x": 0},
        font={"size": 13},
    )
    return figure


def _place(m: Measurement, row: LedgerRow | None, datum: Datum) -> Array | None:
    if isinstance(m, GnssPosition):
        return datum.enu_from_geodetic(*(np.array([v]) for v in m.position))[0, :2]
    if isinstance(m, PoseFix) and m.axes[:2] == ("x", "y"):
        return np.asarray(m.modes[row.mode if row and row.mode is not None else 0].value[:2])
    if isinstance(m, TagSighting):
        return np.asarray(as_pose(m, Survey()).modes[row.mode if row and row.mode is not None else 0].value[:2])
    return None


def _hover(row: LedgerRow) -> str:
    residual = "" if row.residual_m is None else f"<br>residual {row.residual_m:.2f} m"
    weight = "" if row.weight is None else f"<br>weight {row.weight:.2f}"
    reason = "<br>".join(t.replace("<", "&lt;") for t in (row.detail, row.reason) if t)
    return f"{row.sensor}: {row.outcome.value}{weight}{residual}<br>{utc_text(row.stamp_ns)}<br>{reason}"


def track_map(recording: Recording, solution: Solution, filters: Sequence[FilterResult]) -> go.Figure:
    """Map in ENU: tracks, truth, and every absolute measurement coloured by its final weight."""
    figure = go.Figure()
    rows = {row.seq: row for row in solution.ledger if row.seq >= 0}
    places, weights, texts = [], [], []
    for m in recording.measurements:
        row = rows.get(m.seq)
        place = None if row is None else _place(m, row, solution.datum)
        if place is not None and row is not None:
            places.append(place)
            weights.append(row.weight if row.weight is not None else 0.0)
            texts.append(_hover(row))
    if places:
        xy, step = np.array(places), _every(len(places))
        marker = {
            "color": weights[step],
            "colorscale": "Cividis",
            "cmin": 0,
            "cmax": 1,
            "size": 6,
            "opacity": 0.7,
            "colorbar": {"title": "weight", "thickness": 12, "len": 0.6},
        }
        figure.add_scatter(
            x=xy[step, 0],
            y=xy[step, 1],
            mode="markers",
            marker=marker,
            text=texts[step],
            hoverinfo="text",
            name="measurements",
        )
    tracks: list[tuple[str, Trajectory, str, str]] = [
        (f.name, f.trajectory, COLOURS[1 + i], "dash") for i, f in enumerate(filters)
    ]
    if recording.truth is not None:
        tracks.append(("truth", recording.truth, TRUTH, "dot"))
    tracks.append((solution.name, solution.trajectory, COLOURS[0], "solid"))
    for name, track, colour, dash in tracks:
        p = track.p_world_m[_every(len(track))]
        line = {"color": colour, "dash": dash, "width": 2}
        figure.add_scatter(x=p[:, 0], y=p[:, 1], mode="lines", line=line, name=name)
    figure.update_xaxes(title="east, m")
    figure.update_yaxes(title="north, m", scaleanchor="x", scaleratio=1)
    return _layout(figure, 560)


def error_over_time(
    recording: Recording,
    solution: Solution,
    filters: Sequence[FilterResult],
    held: Sequence[GnssPosition],
    levers_m: Levers,
) -> go.Figure:
    """Position and heading error over time where truth or held-out fixes exist, and the 95 % bounds."""
    figure = make_subplots(rows=2, cols=1, shared_xaxes=True, vertical_spacing=0.06)
    start = int(solution.trajectory.stamps_ns[0])
    names = [(solution.name, solution.trajectory), *((f.name, f.trajectory) for f in filters)]
    largest_m = []
    for i, (name, track) in enumerate(names):
        line = {"color": COLOURS[i], "width": 2 if not i else 1.2}
        if recording.truth is not None:
            stamps, error, heading, _, _ = errors(track, recording.truth)
            step = _every(len(stamps))
            t = (stamps[step] - start) * 1e-9
            size = np.hypot(error[step, 0], error[step, 1])
            largest_m.append(float(size.max()))
            figure.add_scatter(x=t, y=size, line=line, name=name, legendgroup=name, row=1, col=1)
            shown = np.degrees(np.abs(heading[step]))
            figure.add_scatter(x=t, y=shown, line=line, name=name, legendgroup=name, showlegend=False, row=2, col=1)
        elif held:
            stamps, error, _ = held_out_errors(track, held, solution.datum, levers_m)
            t = (stamps - start) * 1e-9
            size = np.hypot(error[:, 0], error[:, 1])
            marker = {"color": COLOURS[i], "size": 5}
            figure.add_scatter(x=t, y=size, mode="markers", marker=marker, name=f"{name}, held-out", row=1, col=1)
    track = solution.trajectory
    assert track.cov is not None
    step = _every(len(track))
    bound, t = bounds_95(track.cov[step]), (track.stamps_ns[step] - start) * 1e-9
    for k, row in ((0, 1), (2, 2)):
        figure.add_scatter(
            x=t,
            y=bound[:, k],
            fill="tozeroy",
            mode="none",
            fillcolor=BAND,
            name="95 % bound",
            showlegend=row == 1,
            row=row,
            col=1,
        )
    _health_bands(figure, solution, start)
    figure.update_yaxes(title="position error, m", rangemode="tozero", row=1, col=1)
    *_, second, first = sorted([0.0, 0.0, *largest_m])
    if first > _LOST * second > 0.0:  # a filter that is lost would press the others flat; double click shows it whole
        figure.update_yaxes(range=[0.0, _LOST * second], row=1, col=1)
    figure.update_yaxes(title="heading error, deg", rangemode="tozero", row=2, col=1)
    figure.update_xaxes(title="time, s", row=2, col=1)
    return _layout(figure, 520)


def _band(figure: go.Figure, t: NDArray[np.floating], value: Array, wide: Array, colour: str, row: int) -> None:
    """Shade value +- wide."""
    figure.add_scatter(
        x=np.concatenate([t, t[::-1]]),
        y=np.concatenate([value + wide, (value - wide)[::-1]]),
        fill="toself",
        mode="none",
        fillcolor=colour,
        opacity=0.15,
        hoverinfo="skip",
        showlegend=False,
        row=row,
        col=1,
    )


def berths_over_time(solution: Solution) -> go.Figure:
    """The vessel seen from each berth: across, along, angle with 95 % bands."""
    tracks = solution.berths
    titles = [f"{b.berth.name}: {what}" for b in tracks for what in ("across and along, m", "angle, deg")]
    figure = make_subplots(
        rows=max(len(titles), 1),
        cols=1,
        shared_xaxes=True,
        vertical_spacing=0.25 / max(len(titles), 1),
        subplot_titles=titles,
    )
    start = int(solution.trajectory.stamps_ns[0])
    for n, track in enumerate(tracks):
        assert track.cov is not None
        step = _every(len(track.stamps_ns))
        t = (track.stamps_ns[step] - start) * 1e-9
        band = 1.96 * np.sqrt(np.diagonal(track.cov[step], axis1=1, axis2=2))
        for k, (name, scale) in enumerate((("across", 1.0), ("along", 1.0), ("angle", 180.0 / np.pi))):
            row = 2 * n + (2 if name == "angle" else 1)
            value, wide = scale * track.value[step, k], scale * band[:, k]
            line = {"color": COLOURS[k]}
            figure.add_scatter(x=t, y=value, line=line, name=name, legendgroup=name, showlegend=n == 0, row=row, col=1)
            _band(figure, t, value, wide, COLOURS[k], row)
    figure.update_xaxes(title="time, s", row=max(len(titles), 1), col=1)
    return _layout(figure, 120 + 190 * max(len(titles), 1))


def _health_bands(figure: go.Figure, solution: Solution, start: int) -> None:
    """Shade the times at which the estimate says that it is not good."""
    stamps, health = solution.trajectory.stamps_ns, solution.health
    k = 0
    shapes = []
    while k < len(health):
        end = k
        while end + 1 < len(health) and health[end + 1] == health[k]:
            end += 1
        if health[k] is not Health.GOOD:
            span = [(int(stamps[j]) - start) * 1e-9 for j in (k, end)]
            shapes.append(
                {
                    "type": "rect",
                    "xref": "x",
                    "yref": "paper",
                    "x0": span[0],
                    "x1": span[1],
                    "y0": 0,
                    "y1": 1,
                    "fillcolor": HEALTH[health[k]],
                    "line": {"width": 0},
                    "layer": "below",
                }
            )
        k = end + 1
    figure.update_layout(shapes=shapes[:500])


def residuals_over_time(solution: Solution) -> go.Figure:
    """Residual of each sensor over time, coloured by weight."""
    by_sensor: dict[str, list[LedgerRow]] = {}
    for row in solution.ledger:
        if row.seq >= 0 and row.nis is not None and row.dof:
            by_sensor.setdefault(row.sensor, []).append(row)
    start = int(solution.trajectory.stamps_ns[0])
    figure = make_subplots(
        rows=max(len(by_sensor), 1), cols=1, shared_xaxes=True, vertical_spacing=0.05, subplot_titles=list(by_sensor)
    )
    for i, rows in enumerate(by_sensor.values()):
        shown = sorted(rows, key=lambda r: r.stamp_ns)[_every(len(rows))]
        figure.add_scatter(
            x=[(r.stamp_ns - start) * 1e-9 for r in shown],
            y=[float(np.sqrt((r.nis or 0.0) / (r.dof or 1))) for r in shown],
            mode="markers",
            marker={"size": 4, "color": [r.weight for r in shown], "colorscale": "Cividis", "cmin": 0, "cmax": 1},
            text=[_hover(r) for r in shown],
            hoverinfo="text",
            showlegend=False,
            row=i + 1,
            col=1,
        )
        figure.update_yaxes(title="sigmas", rangemode="tozero", row=i + 1, col=1)
    figure.update_xaxes(title="time, s", row=max(len(by_sensor), 1), col=1)
    return _layout(figure, 120 + 170 * max(len(by_sensor), 1))


def _keyed(names: Sequence[str]) -> str:
    """Names in the colours of their lines."""
    return ", ".join(f'<span style="color:{COLOURS[k]}">{name}</span>' for k, name in enumerate(names))


def _slow_panels(
    sensor: str, e: SlowEstimate
) -> Iterator[tuple[str, NDArray[np.int64], Array, Array | None, tuple[str, ...]]]:
    """A panel for each unit, of three axes at most."""
    for unit in dict.fromkeys(e.units):
        every = [k for k, u in enumerate(e.units) if u == unit]
        for n in range(0, len(every), 3):
            some = every[n : n + 3]
            title = f"{sensor}: {e.name}, {unit}"
            yield title, e.stamps_ns, e.value[:, some], 1.96 * e.sigma[:, some], tuple(e.axes[k] for k in some)


def slow_over_time(solution: Solution) -> go.Figure:
    """Estimated slow states (GNSS error, compass offset) with 95 % bands, and IMU biases."""
    panels: list[tuple[str, NDArray[np.int64], Array, Array | None, tuple[str, ...]]] = [
        panel for sensor, estimate in solution.slow.items() for panel in _slow_panels(sensor, estimate)
    ]
    stamps, axes = solution.trajectory.stamps_ns, ("x", "y", "z")
    panels.append(("gyro bias, deg/s", stamps, np.degrees(solution.gyro_bias_radps), None, axes))
    panels.append(("accelerometer bias, m/s^2", stamps, solution.accel_bias_mps2, None, axes))
    start = int(stamps[0])
    titles = [f"{p[0]} ({_keyed(p[4])})" for p in panels]
    figure = make_subplots(rows=len(panels), cols=1, shared_xaxes=True, vertical_spacing=0.05, subplot_titles=titles)
    for i, (title, at, value, band, names) in enumerate(panels):
        step = _every(len(at))
        t = (at[step] - start) * 1e-9
        for a, name in enumerate(names):
            figure.add_scatter(
                x=t,
                y=value[step, a],
                line={"color": COLOURS[a]},
                name=f"{title.split(':')[0]} {name}",
                showlegend=False,
                text=[name] * len(t),
                row=i + 1,
                col=1,
            )
            if band is not None:
                _band(figure, t, value[step, a], band[step, a], COLOURS[a], i + 1)
    figure.update_xaxes(title="time, s", row=len(panels), col=1)
    return _layout(figure, 120 + 180 * len(panels))
