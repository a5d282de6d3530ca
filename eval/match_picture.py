# SPDX-License-Identifier: Apache-2.0
"""Picture of an aerial match: the scan on the image, the score as a heat map, the modes with their 95 % ellipses."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from graphloc.chi2 import chi2_95
from graphloc.errors import OutputError
from graphloc.frames import Array
from graphloc.frontends.aerial import Match
from graphloc.frontends.aerial.image import Pixels

_SIDE, _LEAST_M = 1440, 60.0  # side, px; what is shown to each side of the vessel, or more if the scan reaches farther
_FACES, _SHORES, _PRIOR = (60, 60, 255), (80, 255, 80), (255, 160, 0)  # blue, green, red
_LINES = (200, 160, 90)
_SAID = {
    "best": "probability {first:.2f} and the tightest for it",
    "worst": "{far:.1f} sigmas from where the run had the vessel without matches",
    "most ambiguous": "modes of {first:.2f} and {second:.2f}",
}
_MODES = ((0, 255, 255), (255, 0, 255), (255, 255, 0), (200, 200, 200), (120, 120, 120))


class _View(NamedTuple):
    """Map cell of the picture's top-left corner, and pixels per cell."""

    corner: Array
    zoom: float


class Gallery:
    """Pictures of some matches of a run: the best, the worst, the most ambiguous, and the first without a mode."""

    def __init__(self) -> None:
        self._kept: dict[str, tuple[float, str, str, bytes]] = {}

    def offer(self, match: Match, sensor: str, at_s: float) -> None:
        """Keep a match if it is the best, worst or most ambiguous so far."""
        if match.score is None:
            return
        if not match.modes:
            if "without a mode" not in self._kept:
                self._keep("without a mode", 0.0, f"{sensor} at {at_s:.1f} s", match.why_not, match)
            return
        first, *others = match.modes
        off = first.pose[:2] - match.prior.pose[:2]
        far = float(np.hypot(*off)) / float(
            np.sqrt(np.trace(first.cov[:2, :2]) + np.square(match.prior.sigma[:2]).sum())
        )
        marks = {
            "best": first.probability / float(np.sqrt(np.trace(first.cov[:2, :2]))),
            "worst": far,
            "most ambiguous": others[0].probability if others else 0.0,
        }
        for what, mark in marks.items():
            if mark > self._kept.get(what, (0.0,))[0]:
                said = _SAID[what].format(far=far, first=first.probability, second=marks["most ambiguous"])
                self._keep(what, mark, f"{sensor} at {at_s:.1f} s", said, match)

    def _keep(self, what: str, mark: float, where: str, said: str, match: Match) -> None:
        coded = cv2.imencode(".jpg", drawn(match), [cv2.IMWRITE_JPEG_QUALITY, 80])[1]
        self._kept[what] = (mark, where, said, coded.tobytes())

    def pictures(self) -> list[tuple[str, bytes]]:
        """Return captions and JPEGs; a match that is kept for two reasons comes once."""
        found: dict[str, tuple[str, bytes]] = {}
        for what, (_, where, said, coded) in self._kept.items():
            before = f"{found[where][0]}; " if where in found else ""
            found[where] = (f"{before}{what}: {said}", coded)
        return [(f"{where}, {said}", coded) for where, (said, coded) in found.items()]


def write_picture(match: Match, path: Path) -> None:
    """Write the picture of a match.

    Raises:
        OutputError: there is nothing to draw, or the file cannot be written.
    """
    canvas = drawn(match)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        written = cv2.imwrite(str(path), canvas)
    except (OSError, cv2.error) as error:
        raise OutputError(f"{path}: cannot be written ({' '.join(str(error).split())[:160]})") from None
    if not written:
        raise OutputError(f"{path}: cannot be written")


def drawn(match: Match) -> Pixels:
    """Return the picture (rows, columns, 3) in BGR; the scan is placed by the best mode, or else by the prior.

    Raises:
        OutputError: there is nothing to draw.
    """
    if match.layers is None or match.grid is None or match.score is None:
        raise OutputError(f"nothing to draw: {match.why_not or 'this matcher has no score of each pose'}")
    pose = match.modes[0].pose if match.modes else match.prior.pose
    canvas, view = _image(match, pose)
    c, s = np.cos(pose[2]), np.sin(pose[2])
    for points, colour in ((match.found.shore_m, _SHORES), (match.found.faces_m, _FACES)):
        for at in _pixels(match, points @ np.array([[c, s], [-s, c]]) + pose[:2], view):
            cv2.circle(canvas, (int(at[0]), int(at[1])), 2, colour, -1)
    _arrow(canvas, match, match.prior.pose, view, _PRIOR)
    for mode, colour in zip(match.modes, _MODES, strict=False):
        _arrow(canvas, match, mode.pose, view, colour)
        _ellipse(canvas, match, mode.pose, mode.cov[:2, :2], view, colour)
    canvas = np.hstack([canvas, _heat(match, canvas.shape[0])])
    lines = [
        f"{m.probability:.2f}  +-{np.sqrt(m.cov[0, 0]):.2f} m east, {np.sqrt(m.cov[1, 1]):.2f} m north (1 sigma)"
        for m in match.modes
    ]
    for k, (line, colour) in enumerate(
        zip(
            [*lines, f"{match.none:.2f}  none of them" + ("" if lines else ": scan at the prior"), "prior"],
            (*_MODES[: len(lines)], (255, 255, 255), _PRIOR),
            strict=True,
        )
    ):
        cv2.putText(canvas, line, (12, 28 + 26 * k), cv2.FONT_HERSHEY_SIMPLEX, 0.7, (0, 0, 0), 4, cv2.LINE_AA)
        cv2.putText(canvas, line, (12, 28 + 26 * k), cv2.FONT_HERSHEY_SIMPLEX, 0.7, colour, 2, cv2.LINE_AA)
    return np.asarray(canvas, dtype=np.uint8)


def _image(match: Match, pose: Array) -> tuple[Pixels, _View]:
    """Return the enlarged image around a pose and the scan, and the view that it shows."""
    assert match.layers is not None
    patch = match.layers.patch
    places_m = np.vstack([match.found.faces_m, match.found.shore_m])
    around_m = max(_LEAST_M, 1.1 * float(np.hypot(*places_m.T).max(initial=0.0)))
    half = int(around_m / patch.cell_m)
    zoom = 0.5 * _SIDE / half
    column, row = np.rint(patch.cells(pose[None, :2])[0]).astype(int)
    low = np.maximum([column - half, row - half], 0)
    window = (slice(low[1], row + half), slice(low[0], column + half))
    part = patch.pixels[window][..., ::-1].copy()
    if match.layers.drawn is not None:  # lines that a user drew may lie on no image
        part[match.layers.drawn[window]] = _LINES
    large = cv2.resize(np.ascontiguousarray(part), None, fx=zoom, fy=zoom, interpolation=cv2.INTER_NEAREST)
    return np.asarray(large, dtype=np.uint8), _View(low.astype(float), zoom)


def _pixels(match: Match, p_m: Array, view: _View) -> Array:
    assert match.layers is not None
    return (match.layers.patch.cells(p_m) - view.corner + 0.5) * view.zoom


def _arrow(canvas: Pixels, match: Match, pose: Array, view: _View, colour: tuple[int, int, int]) -> None:
    ahead = pose[:2] + 4.0 * np.array([np.cos(pose[2]), np.sin(pose[2])])
    a, b = _pixels(match, np.stack([pose[:2], ahead]), view).astype(int).tolist()
    cv2.arrowedLine(canvas, a, b, colour, 2, cv2.LINE_AA)


def _ellipse(canvas: Pixels, match: Match, pose: Array, cov: Array, view: _View, colour: tuple[int, int, int]) -> None:
    """Draw the 95 % ellipse of a mode."""
    angle = np.linspace(0.0, 2.0 * np.pi, 60)
    ring = np.column_stack([np.cos(angle), np.sin(angle)]) @ np.linalg.cholesky(chi2_95(2) * cov).T + pose[:2]
    cv2.polylines(canvas, [_pixels(match, ring, view).astype(np.int32)], True, colour, 2, cv2.LINE_AA)


def _heat(match: Match, rows: int) -> Pixels:
    """Return the score at the best heading of each position, with a legend below."""
    assert match.score is not None
    assert match.grid is not None
    best = match.score.max(axis=0)
    grey = np.clip(255.0 * (1.0 + (best - best.max()) / 40.0), 0.0, 255.0).astype(np.uint8)
    coloured = cv2.applyColorMap(grey, cv2.COLORMAP_INFERNO)
    side = rows // 2
    heat = np.zeros((rows, side, 3), dtype=np.uint8)
    heat[:side] = cv2.resize(coloured, (side, side), interpolation=cv2.INTER_NEAREST)
    wide_m = float(np.ptp(match.grid.east_m))
    for k, (line, colour) in enumerate(
        (
            (f"score at the best heading, {wide_m:.0f} m wide", (255, 255, 255)),
            ("scan: faces", _FACES),
            ("scan: first returns", _SHORES),
        )
    ):
        cv2.putText(heat, line, (12, side + 32 + 28 * k), cv2.FONT_HERSHEY_SIMPLEX, 0.7, colour, 2, cv2.LINE_AA)
    return heat
