# SPDX-License-Identifier: Apache-2.0
"""The report of a run: what it says (`verdict`), and the page (`write_report`)."""

from graphloc.eval.report._data import ReportData, all_warnings, figures
from graphloc.eval.report._health import Stretch, durations_s, stretches
from graphloc.eval.report._page import write_report
from graphloc.eval.report._theses import theses_section
from graphloc.eval.report._track_verdict import Reason, TrackVerdict, Trust
from graphloc.eval.report._verdict import RunVerdict, verdict

__all__ = [
    "Reason",
    "ReportData",
    "RunVerdict",
    "Stretch",
    "TrackVerdict",
    "Trust",
    "all_warnings",
    "durations_s",
    "figures",
    "stretches",
    "theses_section",
    "verdict",
    "write_report",
]
