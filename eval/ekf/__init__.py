# SPDX-License-Identifier: Apache-2.0
"""The filters that the graph is compared with, on the same measurements.

`run_bl` is BL alg. 6 as printed, 2 m gate included; its missing Jacobian is a switch. `run_honest` is the planar
filter that one would honestly compare with: exact Jacobian, gyro bias, GNSS velocity, chi-square gates
that open as the covariance grows. State of both: x, y (m, world), surge, sway (m/s, body), heading psi
(rad); then the gyro bias.
"""

from __future__ import annotations

from graphloc.config import VesselConfig
from graphloc.eval.ekf._bl import BlConfig, run_bl
from graphloc.eval.ekf._honest import run_honest
from graphloc.eval.ekf._inputs import as_pose
from graphloc.eval.ekf._planar import FilterResult, filter_row
from graphloc.frames import Datum
from graphloc.recording import Recording

__all__ = ["BlConfig", "FilterResult", "as_pose", "filter_row", "run_all", "run_bl", "run_honest"]


def run_all(
    recording: Recording, config: VesselConfig, datum: Datum, options: BlConfig | None = None
) -> tuple[FilterResult, ...]:
    """Run both filters; `options` are those of BL's."""
    return (run_bl(recording, config, datum, options), run_honest(recording, config, datum))
