# SPDX-License-Identifier: Apache-2.0
"""Drills: harbour failures injected into a recording, and the errors of estimators with them."""

from graphloc.eval.drill.failures import Failure, Struck, script
from graphloc.eval.drill.measure import Measured, Times, judge
from graphloc.eval.drill.plan import Case, DrillWindow, cut, schedule

__all__ = ["Case", "DrillWindow", "Failure", "Measured", "Struck", "Times", "cut", "judge", "schedule", "script"]
