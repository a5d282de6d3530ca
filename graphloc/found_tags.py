# SPDX-License-Identifier: Apache-2.0
"""Tags that were seen but not surveyed: where a solved run puts them, and what it says against the survey."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from ruamel.yaml import YAML

from graphloc.config import VesselConfig
from graphloc.eval.tag_check import mount_off, suspect_tags
from graphloc.frontends.tags.unsurveyed import Riding, estimate_tags, only_beside
from graphloc.measurements import TagSighting
from graphloc.recording import Recording
from graphloc.solution import Solution
from graphloc.survey import WORLD, Survey, TagConfig

FILE = "tags.found.yaml"


def about_tags(
    recording: Recording, config: VesselConfig, solution: Solution
) -> tuple[tuple[TagConfig, ...], list[str]]:
    """Return the tags that the run has located, and lines on these and on tags whose survey it contradicts."""
    said = suspect_tags(recording, config, solution)
    if not recording.tag_views:
        return (), said
    surveys = {name: sensor.surveyed for name, sensor in config.of_kind("apriltag").items()}
    size_m = next((s.other_size_m for s in surveys.values() if s.other_size_m), None)
    riding = _riding(recording, surveys, solution)
    off = {
        name: mount_off(solution, sensor, name)
        for sensor, c in config.of_kind("apriltag").items()
        for name in c.cameras
    }
    views = [replace(v, R_body_camera=off[v.camera].as_matrix() @ v.R_body_camera) for v in recording.tag_views]
    found, left = estimate_tags(views, solution.trajectory, size_m, riding)
    every = Survey.model_construct(tags=(*found, *(tag for s in surveys.values() for tag in s.tags)))
    for frame in sorted({tag.frame for tag in found}):
        names = ", ".join(every.called(tag.family, tag.id) for tag in found if tag.frame == frame)
        where = (
            "its estimated pose is" if frame == WORLD else f"seen only beside tags of {frame}, so placed on that dock"
        )
        said.append(f"{names}: not in the survey; {where} in {FILE}")
    return tuple(found), [*said, *left]


def _riding(recording: Recording, surveys: Mapping[str, Survey], solution: Solution) -> dict[tuple[str, int], Riding]:
    """Return how the docks moved on which unsurveyed tags seem to ride, by tag."""
    seen = recording.of(TagSighting)
    found = {}
    for tag, (sensor, frame) in only_beside(recording.tag_views, seen).items():
        dock, slow = surveys[sensor].dock(frame), solution.slow[sensor]
        assert dock is not None  # sightings are of a frame of the survey
        first = slow.axes.index(f"{frame} east")
        moved = slow.value[:, first : first + 6] * np.repeat([1.0, np.pi / 180.0], 3)
        found[tag] = Riding(dock, slow.stamps_ns, moved)
    return found


def write(path: Path, found: Sequence[TagConfig], config: VesselConfig) -> None:
    """Write the surveys with the tags that were found, as one survey that can be read again."""
    surveys = [sensor.surveyed for sensor in config.of_kind("apriltag").values()]
    tags = {(tag.family, tag.id): tag for tag in (*found, *(tag for s in surveys for tag in s.tags))}
    docks = {dock.name: dock for s in surveys for dock in s.docks}
    whole = Survey(
        tags=tuple(tags.values()), docks=tuple(docks.values()), berths=tuple(b for s in surveys for b in s.berths)
    )
    with path.open("w", encoding="utf-8") as stream:
        YAML(typ="safe", pure=True).dump(whole.model_dump(mode="json", exclude_none=True), stream)
