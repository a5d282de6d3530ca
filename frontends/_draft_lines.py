# SPDX-License-Identifier: Apache-2.0
"""Lines of a drafted `vessel.yaml` that blocks of several sensors have."""

from __future__ import annotations

import json

from graphloc.frontends._reports import FILTER, WATER, MountGuess, filtered
from graphloc.frontends._streams import COURSE, HEADING

_ANTENNA_OFF_M = 1.0  # from the IMU: of a car; 4 m on a boat or 0.3 m on a robot are found with it as well
FILTERED = "by its name, or its messages, a filter's output: it has used the IMU already, and its errors are correlated, so it gets too much weight"
"""Why a filter's output is not to be fused, or with care."""


def topic_lines(topic: str) -> list[str]:
    """Return the topic; of NMEA (see `read_streams`) with the sentence that is read."""
    for beside in (FILTER, COURSE, HEADING, WATER):
        topic = topic.removesuffix(beside)
    name, *sentence = topic.split(" ")
    return [f"  topic: {name}", *(f"  nmea: [{', '.join(said.split('+'))}]" for said in sentence)]


def numbered(name: str, k: int) -> str:
    """Return the name of the k-th sensor of a kind: without a number of the first one."""
    return name if k == 0 else f"{name}_{k + 1}"


def mount_line(mount: MountGuess) -> str:
    """Return the mount of a sensor, with its evidence."""
    if mount.tf_frame is not None:
        return f"  mount: {{tf_frame: {json.dumps(mount.tf_frame)}}}  # {mount.evidence}"
    rpy = ", ".join(f"{a:.1f}" for a in mount.rpy_deg)
    xyz = ", ".join(f"{a:.3f}" for a in mount.xyz_m) if mount.xyz_m else "0.0, 0.0, 0.0"
    whose = "xyz as there" if mount.xyz_m else "xyz unknown"
    return f"  mount: {{xyz_m: [{xyz}], rpy_deg: [{rpy}]}}  # guess: {mount.evidence}; {whose}"


def antenna_lines(frame: str | None, evidence: str, keeps_m: float) -> list[str]:
    """Return where an antenna sits. Of two that keep their distance one is half of it, or more, from anywhere."""
    if frame is not None:
        return [f"  mount: {{tf_frame: {json.dumps(frame)}}}  # {evidence}"]
    off_m = max(_ANTENNA_OFF_M, keeps_m / 2.0)
    far = f": two antennas keep {keeps_m:.0f} m apart" if off_m > _ANTENNA_OFF_M else ""
    return [
        "  mount: {xyz_m: [0.0, 0.0, 0.0]}  # guess: where the antenna sits is not in the bag; measure it",
        f"  mount_sigma_m: {off_m:.1f}  # guess: how far off that may be{far}; estimated with the run; 0 once it is measured",
    ]


def filtered_lines(topic: str) -> list[str]:
    """Say that a topic is a filter's output, if it is."""
    return [f"  # guess: {FILTERED}"] if filtered(topic) else []
