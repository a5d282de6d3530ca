# SPDX-License-Identifier: Apache-2.0
"""Verdict of a report: how accurate a run is, compared with the filters, and whether it can be trusted."""

from __future__ import annotations

from dataclasses import dataclass

from graphloc.eval.report._data import ReportData
from graphloc.eval.report._track_verdict import Reason, TrackVerdict, Trust, track_verdict, worst


@dataclass(frozen=True, slots=True, kw_only=True)
class RunVerdict:
    """Verdict on a run.

    Attributes:
        tracks: verdict on the run's own track, then on that of the online mode if it was compared.
    """

    tracks: tuple[TrackVerdict, ...]

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """Reasons of all tracks."""
        return tuple(reason for track in self.tracks for reason in track.reasons)

    @property
    def trust(self) -> Trust:
        """The lowest level of trust among the tracks."""
        return worst(track.trust for track in self.tracks)


def verdict(data: ReportData) -> RunVerdict:
    """Return the verdict on each track of a run."""
    return RunVerdict(tracks=tuple(track_verdict(data, solution) for solution in data.solutions))
