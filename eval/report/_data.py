# SPDX-License-Identifier: Apache-2.0
"""Everything that a report needs, as one value."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from graphloc.config import VesselConfig
from graphloc.eval import plots
from graphloc.eval.calibrate import Calibration
from graphloc.eval.ekf import FilterResult
from graphloc.eval.metrics import Antennas, Table
from graphloc.measurements import GnssPosition
from graphloc.recording import Recording
from graphloc.solution import Solution


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ReportData:
    """Everything that a report needs.

    Attributes:
        title: of the page. solution: of the run. recording, config: its input. filters: results of the EKFs.
        held: fixes that were held out. antennas: of the receivers, in body.
        tables: the metrics. truth_statement: what the metrics were measured against.
        pictures: captions and JPEGs of matches. underlay: the aerial image under the map; None: there is none.
        calibration: checks and suggestions of an offline run; None: there are none.
        online: solution of the online mode on the same measurements; None: it was not compared.
        command: the command line.
    """

    title: str
    solution: Solution
    recording: Recording
    config: VesselConfig
    filters: Sequence[FilterResult]
    held: Sequence[GnssPosition]
    antennas: Antennas
    tables: Sequence[Table]
    truth_statement: str
    pictures: Sequence[tuple[str, bytes]] = ()
    underlay: plots.Underlay | None = None
    calibration: Calibration | None = None
    online: Solution | None = None
    command: str = ""

    @property
    def solutions(self) -> tuple[Solution, ...]:
        """The run's own solution, and that of the online mode if it was compared."""
        return (self.solution,) if self.online is None else (self.solution, self.online)

    @property
    def begin_ns(self) -> int:
        """Origin of the time axes: stamp of the first pose of the run's own solution."""
        return int(self.solution.trajectory.stamps_ns[0])

    @property
    def warnings(self) -> tuple[str, ...]:
        """All warnings of the run (`all_warnings`)."""
        return all_warnings(self.recording, self.solution, self.online)


def all_warnings(recording: Recording, solution: Solution, online: Solution | None) -> tuple[str, ...]:
    """Return the warnings of a run, then the warnings that only the online mode gave, under its name."""
    own = (*recording.warnings, *solution.stats.warnings)
    if online is None:
        return own
    return (*own, *(f"{online.name}: {line}" for line in online.stats.warnings if line not in own))


def figures(data: ReportData) -> dict[str, plots.Figure]:
    """Return the figures of a run by name; figures without data are left out."""
    recording, solution, filters = data.recording, data.solution, data.filters
    found = (
        plots.run_map(recording, solution, filters, data.held, data.underlay),
        plots.error_over_time(recording, solution, filters, data.held, data.antennas),
        plots.consistency(recording, solution, filters),
        plots.coverage(recording, solution, filters),
        plots.berths_over_time(solution),
        plots.residuals_over_time(solution),
        plots.slow_over_time(solution),
    )
    return {figure.name: figure for figure in found if figure is not None}
