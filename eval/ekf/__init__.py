# SPDX-License-Identifier: Apache-2.0
"""EKFs for comparison with the graph, on the same measurements.

`run_bl` is BL alg. 6 as printed, with its 2 m gate; the terms that the printed Jacobian lacks are an option.
`run_honest` is a planar EKF for a fair comparison: exact Jacobian, gyro bias, GNSS velocity, chi-square gates that open
as the covariance grows. The state of each is x, y (m, world), surge, sway (m/s, body), heading psi (rad); `run_honest`
adds the gyro bias.
"""

from __future__ import annotations

from graphloc.config import VesselConfig
from graphloc.eval.ekf._bl import BlConfig, run_bl
from graphloc.eval.ekf._honest import run_honest
from graphloc.eval.ekf._inputs import as_pose, starts_at_truth
from graphloc.eval.ekf._planar import FilterResult, filter_row, named_tracks
from graphloc.frames import Datum
from graphloc.recording import Recording

__all__ = [
    "BlConfig", "FilterResult", "as_pose", "filter_row", "named_tracks", "run_all", "run_bl", "run_honest", "starts_at_truth",
]  # fmt: skip


def run_all(
    recording: Recording, config: VesselConfig, datum: Datum, options: BlConfig | None = None
) -> tuple[FilterResult, ...]:
    """Run the two EKFs; `options`: of `run_bl`."""
    return (run_bl(recording, config, datum, options), run_honest(recording, config, datum))
