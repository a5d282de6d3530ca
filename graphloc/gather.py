# SPDX-License-Identifier: Apache-2.0
"""What takes more than a message to measure: sightings of tags (images and a survey), matches of scans (an image and a track).

Each gives measurements that a recording gains, and a row of the ledger for whatever gave none.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from graphloc.config import VesselConfig
from graphloc.errors import ConfigError
from graphloc.eval.match_picture import Gallery
from graphloc.frames import Datum
from graphloc.frontends.aerial import match_bag
from graphloc.frontends.tags.sightings import info_beside, sightings_of_bag
from graphloc.ledger import LedgerRow, Outcome
from graphloc.recording import Progress, Recording, quiet
from graphloc.solution import Solution
from graphloc.survey import load_survey


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
            read[name] = sensor.model_copy(update={"survey": load_survey(folder / sensor.survey)})
    return config.model_copy(update={"sensors": {**config.sensors, **read}}) if read else config


def with_sightings(
    recording: Recording, config: VesselConfig, bags: Sequence[Path], progress: Progress = quiet
) -> Recording:
    """Add what every tag sensor sees; each sighting, and each thing that cannot be used, is a row of the ledger.

    Raises:
        InputError: a camera that cannot be used.
    """
    measurements, rows, topics = list(recording.measurements), list(recording.rows), dict(recording.topics)
    views, damage, seq = list(recording.tag_views), list[str](), recording.message_count
    for name, sensor in config.of_kind("apriltag").items():
        topics[name] = f"({name})"
        cameras = {camera.topic for camera in sensor.cameras.values()}
        total = sum(r.count for r in rows if r.topic in cameras)
        without = 0
        found = sightings_of_bag(bags, name, sensor, config.body_frame, warn=damage.append)
        for done, seen in enumerate(found, start=1):
            views += seen.views
            without += not seen.sightings
            for sighting in seen.sightings:
                measurements.append(replace(sighting, seq=seq))
                seq += 1
            for trouble in seen.troubles:
                rows.append(
                    LedgerRow(
                        seq=seq, stamp_ns=seen.stamp_ns, sensor=name, topic=topics[name], outcome=Outcome.REJECTED,
                        reason=trouble,
                    )
                )  # fmt: skip
                seq += 1
            progress("looking for tags", min(done, total), total)
        read = f"read by {name}; {without} of {total} show no tag that can be used"
        infos = {camera.info_topic or info_beside(camera.topic) for camera in sensor.cameras.values()}
        reasons = {**dict.fromkeys(infos, f"read by {name} for its lens"), **dict.fromkeys(cameras, read)}
        rows = [
            replace(r, reason=reasons[r.topic]) if r.topic in reasons and r.outcome is Outcome.IGNORED else r
            for r in rows
        ]
        if total and without == total:
            damage.append(f"{name}: none of {total} images shows a tag of the survey: look at one, and at its family")
        damage += _troubles(name, rows)
    return replace(
        recording,
        measurements=tuple(sorted(measurements, key=lambda m: (m.stamp_ns, m.seq))),
        rows=tuple(rows),
        topics=topics,
        message_count=seq,
        tag_views=tuple(views),
        warnings=tuple(dict.fromkeys([*recording.warnings, *damage])),
    )


def _troubles(sensor: str, rows: Sequence[LedgerRow]) -> list[str]:
    """Say what of a sensor could not be used, and how often."""
    reasons = Counter(row.reason for row in rows if row.sensor == sensor and row.outcome is Outcome.REJECTED)
    return [f"{sensor}: {reason} ({count} times)" for reason, count in reasons.most_common(5)]


@dataclass(frozen=True, slots=True)
class Scans:
    """Where scans are matched from: the bags, and the folder that relative image paths count from."""

    bags: tuple[Path, ...]
    folder: Path


def with_matches(
    recording: Recording,
    config: VesselConfig,
    datum: Datum,
    solution: Solution,
    scans: Scans,
    progress: Progress = quiet,
    gallery: Gallery | None = None,
) -> Recording:
    """Add the matches of every aerial sensor, made around a solution; a scan that gave none is a row of the ledger.

    Raises:
        InputError: an image or LiDAR that cannot be used.
    """
    measurements, rows, topics = list(recording.measurements), list(recording.rows), dict(recording.topics)
    track, seq = solution.trajectory, recording.message_count
    damage: list[str] = []
    span_s = int((track.stamps_ns[-1] - track.stamps_ns[0]) / 1e9)
    for name, sensor in config.of_kind("aerial").items():
        topics[name] = f"({name})"
        read = {lidar.topic for lidar in sensor.lidars.values()}
        rows = [
            replace(r, reason=f"read by {name}") if r.topic in read and r.outcome is Outcome.IGNORED else r
            for r in rows
        ]
        found = match_bag(scans.bags, sensor, scans.folder, config.body_frame, track, datum, warn=damage.append)
        for item in found:
            if item.match is not None and gallery is not None:
                gallery.offer(item.match, name, (item.stamp_ns - int(track.stamps_ns[0])) / 1e9)
            if item.match is not None and item.match.modes:
                measurements.append(replace(item.match.fix(item.stamp_ns, name, item.news, sensor.axes), seq=seq))
            else:
                rows.append(
                    LedgerRow(
                        seq=seq, stamp_ns=item.stamp_ns, sensor=name, topic=topics[name], outcome=Outcome.REJECTED,
                        reason=item.why_not,
                    )
                )  # fmt: skip
            seq += 1
            progress("matching", min(int((item.stamp_ns - track.stamps_ns[0]) / 1e9), span_s), span_s)
        progress("matching", span_s, span_s)
        damage += _few_matches(name, rows)
    return replace(
        recording,
        measurements=tuple(sorted(measurements, key=lambda m: (m.stamp_ns, m.seq))),
        rows=tuple(rows),
        topics=topics,
        message_count=seq,
        warnings=tuple(dict.fromkeys([*recording.warnings, *damage])),
    )


def _few_matches(sensor: str, rows: Sequence[LedgerRow]) -> list[str]:
    """Say so where most scans of a sensor gave no match."""
    reasons = Counter(row.reason for row in rows if row.sensor == sensor and row.outcome is Outcome.REJECTED)
    if reasons.total() < 5:
        return []
    ((most, count),) = reasons.most_common(1)
    return [f"{sensor}: {reasons.total()} scans gave no match, {count} of them: {most}; `graphloc match` shows one"]
