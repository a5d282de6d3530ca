# SPDX-License-Identifier: Apache-2.0
"""The report of a run: what it says (`verdict`), and the page (`write_report`)."""

from graphloc.eval.report._data import ReportData, figures
from graphloc.eval.report._page import write_report
from graphloc.eval.report._theses import theses_section
from graphloc.eval.report._verdict import Reason, Trust, Verdict, verdict

__all__ = ["Reason", "ReportData", "Trust", "Verdict", "figures", "theses_section", "verdict", "write_report"]
