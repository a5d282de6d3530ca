# SPDX-License-Identifier: Apache-2.0
"""The report of a run: what it says (`verdict`), and the page (`write_report`)."""

from graphloc.eval.report._data import ReportData, figures, said_on_the_way
from graphloc.eval.report._health import Stretch, durations_s, stretches
from graphloc.eval.report._judged import Judged, Reason, Trust
from graphloc.eval.report._page import write_report
from graphloc.eval.report._theses import theses_section
from graphloc.eval.report._verdict import Verdict, verdict

__all__ = [
    "Judged",
    "Reason",
    "ReportData",
    "Stretch",
    "Trust",
    "Verdict",
    "durations_s",
    "figures",
    "said_on_the_way",
    "stretches",
    "theses_section",
    "verdict",
    "write_report",
]
