# SPDX-License-Identifier: Apache-2.0
"""What takes more than a message to measure: sightings of tags (images and a survey), matches of scans (an image and a track).

Matches are made around the track of a solved run, or scan by scan around the prediction of a smoother under way. Each gives measurements that a recording gains, and a row of the ledger for whatever gave none.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from graphloc.config import VesselConfig
from graphloc.errors import ConfigError
from graphloc.eval.match_picture import Gallery
from graphloc.frames import Datum
from graphloc.frontends._part import Bags
from graphloc.frontends._source import Bag
from graphloc.frontends.aerial import match_bag
from graphloc.frontends.aerial.live import LiveMatcher, Matched, Turn
from graphloc.frontends.aerial.scans import ScanFeed
from graphloc.frontends.tags.sightings import camera_info_topic, sightings_of_bag
from graphloc.frontends.tags.sizes import size_factors
from graphloc.ledger import LedgerRow, Outcome
from graphloc.measurements import Measurement, TagSighting
from graphloc.online import OnlineSmoother
from graphloc.recording import Progress, Recording, quiet
from graphloc.solution import Solution
from graphloc.survey import Survey, load_survey

_BUSY = "not tried: the previous scan was still being matched"
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
            read[name] = sensor.model_copy(update={"survey": load_survey(folder / sensor.survey)})
    return config.with_sensors(read)


class Gathering:
    """A recording that gains measurements: each, and each thing that gave none, is a row of the ledger."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self._measurements, self.rows = list(recording.measurements), list(recording.rows)
        self._topics, self._seq = dict(recording.topics), recording.message_count
        self.said: list[str] = []

    def sensor(self, name: str, read: Mapping[str, str]) -> None:
        """A sensor that gathers, and what its topics, which no decoder reads, are read for."""
        self._topics[name] = f"({name})"
        self.rows = [
            replace(
                r,
                outcome=Outcome.READ,
                reason=read[r.topic] if r.outcome is Outcome.IGNORED else f"{r.reason}; {read[r.topic]}",
            )
            if r.topic in read and r.outcome in (Outcome.IGNORED, Outcome.READ)
            else r
            for r in self.rows
        ]

    def take(self, measurement: Measurement) -> Measurement:
        """Number a measurement, and keep it."""
        numbered = replace(measurement, seq=self._seq)
        self._measurements.append(numbered)
        self._seq += 1
        return numbered

    def refuse(self, sensor: str, stamp_ns: int, why: str) -> None:
        """Enter what gave no measurement."""
        self.rows.append(
            LedgerRow(
                seq=self._seq, stamp_ns=stamp_ns, sensor=sensor, topic=f"({sensor})", outcome=Outcome.REJECTED, reason=why
            )
        )  # fmt: skip
        self._seq += 1

    def refused(self, sensor: str) -> Counter[str]:
        """Why, and how often."""
        return Counter(row.reason for row in self.rows if row.sensor == sensor and row.outcome is Outcome.REJECTED)

    def recording(self) -> Recording:
        """Return the recording with all that it gained."""
        return replace(
            self._recording,
            measurements=tuple(sorted(self._measurements, key=lambda m: (m.stamp_ns, m.seq))),
            rows=tuple(self.rows),
            topics=self._topics,
            message_count=self._seq,
            warnings=tuple(dict.fromkeys([*self._recording.warnings, *self.said])),
        )


def with_sightings(recording: Recording, config: VesselConfig, bags: Bags, progress: Progress = quiet) -> Recording:
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
                f"{name}: none of {total} images or detection messages shows a tag of the survey: check ids and family there"
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
    """Take the sightings but of frames whose tags have sizes that cannot be: a run that follows those is metres off."""
    reasons = {}
    for frame, factor in size_factors(sightings, survey).items():
        off = 100.0 * abs(1.0 / factor - 1.0)
        reasons[frame] = f"sizes in tags.yaml disagree with the spacing of the tags by {off:.0f} %"
        gathered.said.append(
            f"{name}: {reasons[frame]}: measure a tag (the black square without its white margin) and the spacing; in {frame} "
            f"size_m times {factor:.2f} would agree. Until then no sighting of these tags is used"
        )
    for m in sightings:
        if m.frame in reasons:
            gathered.refuse(name, m.stamp_ns, reasons[m.frame])
        else:
            gathered.take(m)


@dataclass(frozen=True, slots=True)
class Scans:
    """Where scans are matched from: the bags, and the folder that relative image paths count from."""

    bags: Bags
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
    gathered, track = Gathering(recording), solution.trajectory
    span_s = int((track.stamps_ns[-1] - track.stamps_ns[0]) / 1e9)
    for name, sensor in config.of_kind("aerial").items():
        gathered.sensor(name, dict.fromkeys((lidar.topic for lidar in sensor.lidars.values()), f"read by {name}"))
        found = match_bag(scans.bags, sensor, scans.folder, config.body_frame, track, datum, warn=gathered.said.append)
        for item in found:
            if item.match is not None and gallery is not None:
                gallery.offer(item.match, name, (item.stamp_ns - int(track.stamps_ns[0])) / 1e9)
            if item.match is not None and item.match.modes:
                gathered.take(item.match.fix(item.stamp_ns, name, item.news, sensor.axes))
            else:
                gathered.refuse(name, item.stamp_ns, item.why_not)
            progress("matching", min(int((item.stamp_ns - track.stamps_ns[0]) / 1e9), span_s), span_s)
        progress("matching", span_s, span_s)
        gathered.said += _few_matches(name, gathered.refused(name))
    return gathered.recording()


def _few_matches(sensor: str, reasons: Counter[str]) -> list[str]:
    """Say so where most scans of a sensor gave no match."""
    if reasons.total() < 5:
        return []
    ((most, count),) = reasons.most_common(1)
    return [f"{sensor}: {reasons.total()} scans gave no match, {count} of them: {most}; `graphloc match` shows one"]


class LiveMatching:
    """Scans of one aerial sensor, each matched as soon as the smoother has reached it.

    With a `pool` the replay does not wait for a match: it comes when it is done, and scans that arrived meanwhile are not matched.
    """

    def __init__(
        self, name: str, config: VesselConfig, scans: Scans, bag: Bag, gathering: Gathering, pool: Executor | None
    ) -> None:
        self._name, self._sensor, self._scans, self._pool = name, config.sensors[name], scans, pool
        self._feed = ScanFeed(bag, self._sensor, config.body_frame)
        self._turns = iter(self._feed)
        self._matcher: LiveMatcher | None = None
        self._gathering = gathering
        self._next: Turn | None = next(self._turns, None)
        self._underway: Future[Matched | Literal["wait"] | None] | None = None
        gathering.sensor(
            name, dict.fromkeys((lidar.topic for lidar in self._sensor.lidars.values()), f"read by {name}")
        )

    def due(self, smoother: OnlineSmoother, now_ns: int) -> Iterator[Measurement]:
        """Yield the matches that are ready."""
        if self._underway is not None and self._underway.done():
            found, self._underway = self._underway.result(), None
            if found == "wait":  # offered too early, and too late to be offered again
                self._gathering.refuse(self._name, now_ns, "the scan ended after the newest pose")
            elif found is not None:
                yield from self._taken(found)
        while self._next is not None and self._next.last_ns <= now_ns:
            turn, window, datum = self._next, smoother.window(), smoother.datum
            if window is None or datum is None or len(window) < 2:
                self._refuse(turn, "there was no estimate to match around")
                continue
            if self._underway is not None:
                self._refuse(turn, _BUSY)
                continue
            if self._matcher is None:
                self._matcher = LiveMatcher(self._sensor, self._scans.folder, datum, self._feed.mounts)
            if self._pool is not None:
                self._underway, self._next = (
                    self._pool.submit(self._matcher.offer, turn, window),
                    next(self._turns, None),
                )
                return
            found = self._matcher.offer(turn, window)
            if found == "wait":
                return
            self._next = next(self._turns, None)
            if found is not None:
                yield from self._taken(found)

    def end(self) -> Iterator[Measurement]:
        """Yield the match in progress; the remaining scans are refused."""
        if self._underway is not None:
            found = self._underway.result()
            if found is not None and found != "wait":
                yield from self._taken(found)
        while self._next is not None:
            self._refuse(self._next, "the run ended before it could be matched")

    def _refuse(self, turn: Turn, why: str) -> None:
        self._gathering.refuse(self._name, turn.stamp_ns, turn.why_not or why)
        self._next = next(self._turns, None)

    def _taken(self, found: Matched) -> Iterator[Measurement]:
        if found.match is not None and found.match.modes:
            yield self._gathering.take(found.match.fix(found.stamp_ns, self._name, found.news, self._sensor.axes))
        else:
            self._gathering.refuse(self._name, found.stamp_ns, found.why_not)


def with_busy_warning(recording: Recording, config: VesselConfig) -> Recording:
    """Add a warning if many scans were skipped because the matcher was busy."""
    busy = sum(row.reason == _BUSY for row in recording.rows)
    scans = sum(row.reason == _BUSY or row.sensor in config.of_kind("aerial") for row in recording.rows)
    if busy <= 0.2 * scans:
        return recording
    warning = f"the matcher did not keep up: {busy} scans were never tried"
    return replace(recording, warnings=(*recording.warnings, warning))
