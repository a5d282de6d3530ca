# SPDX-License-Identifier: Apache-2.0
"""Matches of scans made while a smoother runs, around its prediction (after a run: `_matches.py`)."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor, Future
from dataclasses import replace
from typing import Literal

from graphloc.config import VesselConfig
from graphloc.frontends.aerial.live import LiveMatcher, Matched
from graphloc.frontends.aerial.scans import ScanFeed
from graphloc.frontends.aerial.submap import Turn
from graphloc.frontends.source import Bag
from graphloc.gather._gathering import Gathering
from graphloc.gather._matches import Scans
from graphloc.measurements import Measurement
from graphloc.online import OnlineSmoother
from graphloc.recording import Recording

_BUSY = "not tried: the previous scan was still being matched"


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
        self._offered_ns = 0  # stamp of the scan that is underway
        self._underway: Future[Matched | Literal["wait"] | None] | None = None
        gathering.sensor(
            name, dict.fromkeys((lidar.topic for lidar in self._sensor.lidars.values()), f"read by {name}")
        )

    def due(self, smoother: OnlineSmoother, now_ns: int) -> Iterator[Measurement]:
        """Yield the matches that are ready."""
        if self._underway is not None and self._underway.done():
            found, self._underway = self._underway.result(), None
            if found == "wait":  # offered too early, and too late to be offered again
                self._gathering.refuse(self._name, self._offered_ns, "the scan ended after the newest pose")
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
                self._underway, self._offered_ns = self._pool.submit(self._matcher.offer, turn, window), turn.stamp_ns
                self._next = next(self._turns, None)
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
        self._gathering.said += self._feed.silences

    def _refuse(self, turn: Turn, why: str) -> None:
        self._gathering.refuse(self._name, turn.stamp_ns, turn.why_not or why)
        self._next = next(self._turns, None)

    def _taken(self, found: Matched) -> Iterator[Measurement]:
        if found.match is not None and found.match.modes:
            yield self._gathering.take(found.match.fix(found.stamp_ns, self._name, found.since, self._sensor.axes))
        else:
            self._gathering.refuse(self._name, found.stamp_ns, found.why_not)


def with_busy_warning(recording: Recording, config: VesselConfig) -> Recording:
    """Add a warning if many scans were skipped because the matcher was busy."""
    matchers = config.of_kind("aerial")
    refused = [row.reason for row in recording.rows if row.sensor in matchers]
    scans, busy = len(refused) + sum(m.sensor in matchers for m in recording.measurements), refused.count(_BUSY)
    if busy <= 0.2 * scans:
        return recording
    warning = f"the matcher did not keep up: {busy} scans were never tried"
    return replace(recording, warnings=(*recording.warnings, warning))
