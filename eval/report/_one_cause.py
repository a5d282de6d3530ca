# SPDX-License-Identifier: Apache-2.0
"""The one cause of most of an error against truth, where there is one: an origin, another place on the vessel, or a clock."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from graphloc.eval.metrics import TrackErrors
from graphloc.frames import Array
from graphloc.signals.series import rms

_LEFT = 0.45  # share of an error (RMS) that its cause may leave; a choice
# What another cause may leave, beside the one that leaves least, to be named as well, times and m. On a straight course at
# a steady speed all three look alike.
_AS_WELL, _ALIKE_M = 1.5, 0.01


def one_cause(found: TrackErrors, offset_s: float) -> str:
    """Return a sentence on each cause that explains most of the horizontal error as well as any; empty if none does.

    The error is that of an origin if it stays the same in world, of a place if it does in body, of a clock if it is the
    velocity times a constant.

    Args:
        found: the errors. offset_s: the configured `truth_time_offset_s`.
    """
    off, track = found.position_m[:, :2], found.estimate
    causes: list[tuple[Array, Callable[[Array], str]]] = [
        (np.tile(np.eye(2), (len(off), 1, 1)), _origin),
        (track.R_world_body[:, :2, :2], _place),
    ]
    if track.v_world_mps is not None:
        causes.append((track.v_world_mps[:, :2, None], lambda late_s: _clock(late_s, offset_s)))
    explained = []
    for shape, said in causes:
        made = np.linalg.lstsq(shape.reshape(2 * len(off), -1), off.ravel(), rcond=None)[0]
        explained.append((rms(np.linalg.norm(off - shape @ made, axis=1)), said(np.asarray(made))))
    least_m = min(left_m for left_m, _ in explained)
    if least_m >= _LEFT * rms(np.linalg.norm(off, axis=1)):
        return ""
    alike = (
        f"ll but {left_m:.2f} m (RMS) of its error {said}"
        for left_m, said in explained
        if left_m <= _AS_WELL * least_m + _ALIKE_M
    )
    return ". A" + "; or a".join(alike)


def _origin(off_m: Array) -> str:
    east, north = off_m
    return (
        f"stays the same, {abs(east):.2f} m {'east' if east > 0.0 else 'west'} and {abs(north):.2f} m {'north' if north > 0.0 else 'south'} "
        "of the truth: the datum, where an image or a survey lies, or a mount is wrong, or a receiver drifts for longer than the run"
    )


def _place(off_m: Array) -> str:
    ahead, port = -off_m
    return (
        f"turns with the vessel: the truth is {abs(ahead):.2f} m {'ahead' if ahead > 0.0 else 'astern'} and {abs(port):.2f} m to "
        f"{'port' if port > 0.0 else 'starboard'} of the vessel's origin, as if the truth were that of an antenna or a prism elsewhere; or a mount is wrong"
    )


def _clock(late_s: Array, offset_s: float) -> str:
    (late,) = late_s
    return (
        f"goes with the velocity: the truth is stamped {abs(late):.2f} s {'late' if late > 0.0 else 'early'} (then set truth_time_offset_s: "
        f"{offset_s - late:.2f}), or the sensors are as much the other way"
    )
