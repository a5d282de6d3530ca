# SPDX-License-Identifier: Apache-2.0
"""Sightings of tags: found in the images of a bag, placed by a survey."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from graphloc.config import VesselConfig
from graphloc.errors import ConfigError
from graphloc.frames import Datum, Geodetic
from graphloc.frontends.part import Bags
from graphloc.frontends.tags.grid import in_world
from graphloc.frontends.tags.sightings import camera_info_topic, sightings_of_bag
from graphloc.frontends.tags.sizes import REFUSED, size_factors
from graphloc.gather._gathering import Gathering
from graphloc.measurements import TagSighting
from graphloc.recording import Progress, Recording
from graphloc.survey import WORLD, Survey, TagConfig, load_survey

_NEAR_DEG = 0.05  # a tag that many metres from where a latitude and a longitude would be is one by chance
_REASONS = 8  # that are said, of those why something was refused
_DOUBTFUL = 0.5  # share of the images with tags, above which those that a limit refuses are said


def with_surveys(config: VesselConfig, folder: Path) -> VesselConfig:
    """Read the surveys that tag sensors name; relative paths count from `folder`.

    Raises:
        ConfigError: there is none, or it cannot be used.
    """
    read = {}
    for name, sensor in config.of_kind("apriltag").items():
        if not sensor.survey:
            raise ConfigError(f"sensors.{name}.survey: name the tags.yaml that says where the tags are (docs/tags.md)")
        if isinstance(sensor.survey, str):
            survey = _in_world(load_survey(folder / sensor.survey), config, folder / sensor.survey)
            read[name] = sensor.model_copy(update={"survey": survey})
    return config.with_sensors(read)


def _in_world(survey: Survey, config: VesselConfig, path: Path) -> Survey:
    """Return a survey in world; `path` is named in errors."""
    if config.datum and (tag := _in_degrees(survey, config.datum.geodetic)):
        raise ConfigError(
            f"{path}: tag {tag.id}: its xyz_m is a latitude and a longitude: give metres east, north, up from the datum, or those of a `grid`"
        )
    if survey.grid and config.datum is None:
        raise ConfigError(f"{path}: a survey in a grid needs a `datum:` in vessel.yaml, any place near by")
    try:
        return in_world(survey, Datum(config.datum.geodetic)) if config.datum else survey
    except ValueError as error:
        raise ConfigError(f"{path}: {error}") from None


def _in_degrees(survey: Survey, datum: Geodetic) -> TagConfig | None:
    """Return a tag of world whose place is given as the datum's latitude and longitude, to some km; None if there is none."""
    here = np.array([datum.latitude_deg, datum.longitude_deg])
    metres = survey.grid != "" or np.abs(here).max() < 1.0  # simulators have their origin at 0, 0: so may a tag
    for tag in () if metres else survey.tags:
        place = np.array(tag.xyz_m[:2])
        if tag.frame == WORLD and min(np.abs(place - here).max(), np.abs(place - here[::-1]).max()) < _NEAR_DEG:
            return tag
    return None


def with_sightings(recording: Recording, config: VesselConfig, bags: Bags, progress: Progress) -> Recording:
    """Add what every tag sensor sees; each sighting, and each thing that cannot be used, is a row of the ledger.

    Raises:
        InputError: a camera that cannot be used.
    """
    gathered, views = Gathering(recording), list(recording.tag_views)
    for name, sensor in config.of_kind("apriltag").items():
        cameras = {camera.topic for camera in sensor.cameras.values()}
        total, without = sum(r.count for r in recording.rows if r.topic in cameras), 0
        infos = {camera.info_topic or camera_info_topic(camera.topic) for camera in sensor.cameras.values()}
        taken: list[TagSighting] = []
        reasons, doubts, shown = Counter[str](), Counter[str](), Counter[str]()
        found = sightings_of_bag(bags, name, sensor, config.body_frame, warn=gathered.said.append)
        for done, seen in enumerate(found, start=1):
            views += seen.views
            without += not seen.sightings
            taken += seen.sightings
            for why in (*seen.troubles, *seen.doubtful):
                gathered.refuse(name, seen.stamp_ns, why)
            reasons.update(seen.troubles)
            doubts.update(seen.doubtful)
            shown["doubtful"] += bool(seen.doubtful)
            shown["tags"] += bool(seen.sightings or seen.views or seen.doubtful)
            progress("looking for tags", min(done, total), total)
        _take_sized(gathered, name, taken, sensor.surveyed)
        read = f"read by {name}; {without} of {total} show no tag that can be used"
        gathered.sensor(name, dict.fromkeys(infos, f"read by {name} for its lens") | dict.fromkeys(cameras, read))
        if total and without == total:
            gathered.said.append(
                f"{name}: none of {total} images or detection messages shows a tag of the survey: "
                + ("the reason follows" if reasons and not shown["tags"] else "check ids and family there")
            )
        if shown["doubtful"] > _DOUBTFUL * shown["tags"]:  # else a limit does what it is there for
            gathered.said.append(
                f"{name}: {shown['doubtful']} of {shown['tags']} images with tags have a rejected detection, most often: "
                f"{doubts.most_common(1)[0][0]}"
            )
        gathered.said += [f"{name}: {why} ({count} times)" for why, count in reasons.most_common(_REASONS)]
        if len(reasons) > _REASONS:
            gathered.said.append(f"{name}: {len(reasons) - _REASONS} more such reasons are in the ledger")
    return replace(gathered.recording(), tag_views=tuple(views))


def _take_sized(gathered: Gathering, name: str, sightings: Sequence[TagSighting], survey: Survey) -> None:
    """Take the sightings but of frames whose tags have sizes that cannot be: a run that follows those is metres off.

    Where they are off by less, it blames places and attitudes of single tags: so the sizes are named first.
    """
    reasons = {}
    for frame, factor in size_factors(sightings, survey).items():
        off = 100.0 * abs(1.0 / factor - 1.0)
        why = f"sizes in tags.yaml disagree with the spacing of the tags by {off:.0f} %"
        refused = abs(factor - 1.0) > REFUSED
        until = (
            "no sighting of these tags is used"
            if refused
            else "distances to them are wrong by as much, beyond any bound"
        )
        gathered.said.append(
            f"{name}: {why}: measure a tag (the black square without its white margin) and the spacing; in {frame} "
            f"size_m times {factor:.2f} would agree. Until then {until}"
        )
        if refused:
            reasons[frame] = why
    for m in sightings:
        if m.frame in reasons:
            gathered.refuse(name, m.stamp_ns, reasons[m.frame])
        else:
            gathered.take(m)
