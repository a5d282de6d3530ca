# SPDX-License-Identifier: Apache-2.0
"""The application: the one place, beside the CLI, where all rooms meet.

`bag -> frontend -> measurements -> rows -> graph -> solution -> outputs and report`, in that order.
"""

from graphloc.app._estimate import (
    choose_datum,
    configured,
    load,
    match_at,
    online_smoother,
    replay_recording,
    seen_frames,
    simulated,
    smooth_recording,
    solve,
    truth_of_file,
    with_synthetic,
)
from graphloc.app._run import Run, antennas
from graphloc.app._written import inputs_of, report_data, sha256, tables, truth_statement, write
from graphloc.gather import Scans

__all__ = [
    "Run",
    "Scans",
    "antennas",
    "choose_datum",
    "configured",
    "inputs_of",
    "load",
    "match_at",
    "online_smoother",
    "replay_recording",
    "report_data",
    "seen_frames",
    "sha256",
    "simulated",
    "smooth_recording",
    "solve",
    "tables",
    "truth_of_file",
    "truth_statement",
    "with_synthetic",
    "write",
]
