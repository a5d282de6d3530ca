# SPDX-License-Identifier: Apache-2.0
"""Lines of a drafted `vessel.yaml` that the blocks of several kinds of sensors share."""

from __future__ import annotations

import json

from graphloc.frontends._reports import FILTER, WATER, MountGuess, filtered
from graphloc.frontends._streams import COURSE, HEADING

_ANTENNA_OFF_M = 1.0  # distance from the IMU, as on a car; with it 4 m on a boat or 0.3 m on a robot are found as well
FILTERED = "by its name, or its messages, a filter's output: it has used the IMU already, and its errors are correlated, so it gets too much weight"
"""Why a filter's output is not fused, or only with care."""


def topic_lines(topic: str) -> list[str]:
    """Return the lines on the topic of a stream; of NMEA (see `read_streams`) also on the sentences that are read."""
    for beside in (FILTER, COURSE, HEADING, WATER):
        topic = topic.removesuffix(beside)
    name, *sentence = topic.split(" ")
    return [f"  topic: {name}", *(f"  nmea: [{', '.join(said.split('+'))}]" for said in sentence)]


def numbered(name: str, k: int) -> str:
    """Return the name of the k-th sensor of a kind, from 0; the first one has no number."""
    return name if k == 0 else f"{name}_{k + 1}"


def mount_line(mount: MountGuess) -> str:
    """Return the line on the mount of a sensor, with the evidence."""
    if mount.tf_frame is not None:
        return f"  mount: {{tf_frame: {json.dumps(mount.tf_frame)}}}  # {mount.evidence}"
    rpy = ", ".join(f"{a:.1f}" for a in mount.rpy_deg)
    xyz = ", ".join(f"{a:.3f}" for a in mount.xyz_m) if mount.xyz_m else "0.0, 0.0, 0.0"
    whose = "xyz as there" if mount.xyz_m else "xyz unknown"
    return f"  mount: {{xyz_m: [{xyz}], rpy_deg: [{rpy}]}}  # guess: {mount.evidence}; {whose}"


def antenna_lines(frame: str | None, evidence: str, keeps_m: float) -> list[str]:
    """Return the lines on where an antenna is.

    Args:
        frame: in tf; None if tf does not tell. evidence: of the frame.
        keeps_m: least distance from another antenna: one of the two is half of it or more from any place.
    """
    if frame is not None:
        return [f"  mount: {{tf_frame: {json.dumps(frame)}}}  # {evidence}"]
    off_m = max(_ANTENNA_OFF_M, keeps_m / 2.0)
    far = f": two antennas keep {keeps_m:.0f} m apart" if off_m > _ANTENNA_OFF_M else ""
    return [
        "  mount: {xyz_m: [0.0, 0.0, 0.0]}  # guess: where the antenna sits is not in the bag; measure it",
        f"  mount_sigma_m: {off_m:.1f}  # guess: how far off that may be{far}; estimated with the run; 0 once it is measured",
    ]


def filtered_lines(topic: str) -> list[str]:
    """Return the line that a topic is a filter's output, if it is."""
    return [f"  # guess: {FILTERED}"] if filtered(topic) else []
