# SPDX-License-Identifier: Apache-2.0
"""How good a run is, compared with the filters, and whether it can be trusted."""

from __future__ import annotations

from dataclasses import dataclass

from graphloc.eval.report._data import ReportData
from graphloc.eval.report._judged import Judged, Reason, Trust, judged, worst


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """What a report says first.

    Attributes:
        tracks: the run's own, and where it has one beside it, that of the online mode.
    """

    tracks: tuple[Judged, ...]

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """Those of all tracks."""
        return tuple(reason for track in self.tracks for reason in track.reasons)

    @property
    def trust(self) -> Trust:
        """That of the worst track."""
        return worst(track.trust for track in self.tracks)


def verdict(data: ReportData) -> Verdict:
    """Say how good a run is, compared with the filters, and whether it can be trusted, offline and online."""
    return Verdict(tracks=tuple(judged(data, solution) for solution in data.solutions))
