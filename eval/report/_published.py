# SPDX-License-Identifier: Apache-2.0
"""Results that the two theses published.

BL: Bergman & Lindell, *Aerial Imagery Based Position and Heading Estimation*, Chalmers 2023, tables 4.1 to 4.8.
D: Digerud, *Utilizing vision-based techniques to aid unmanned cargo ships in the auto-docking scenario*, NTNU 2022,
table in figure 4.13. Their recordings are not published, so our numbers are of other runs.
"""

from __future__ import annotations

from typing import NamedTuple


class BlRun(NamedTuple):
    """A run of BL: RMSE and largest error of position (m) and heading (deg), with GNSS as truth.

    Attributes:
        case, noise: of the run. measured_table, measured_m: table of the errors of the disturbed GNSS, and the errors.
        table, position_m, heading_deg: table of the errors of BL's EKF, and the errors.
    """

    case: int
    noise: str
    measured_table: str
    measured_m: tuple[float, float]
    table: str
    position_m: tuple[float, float]
    heading_deg: tuple[float, float]


class DigerudRun(NamedTuple):
    """A row of D's table 4.13; n/d: not determined. `range_m`: largest distance of a detection."""

    condition: str
    error: str
    range_m: float | None
    ambiguity: str


BL_RUNS = (
    BlRun(1, "drift", "4.1", (1.3567, 1.7044), "4.3", (0.5893, 1.6668), (1.7332, 4.8879)),
    BlRun(1, "jump", "4.2", (2.4596, 14.5443), "4.4", (0.7241, 1.8233), (1.7118, 4.9983)),
    BlRun(2, "drift", "4.1", (1.3658, 1.7044), "4.5", (1.7394, 5.5664), (1.6366, 3.8959)),
    BlRun(2, "jump", "4.2", (2.4428, 14.5115), "4.6", (1.2505, 2.8422), (1.5556, 3.9108)),
    BlRun(3, "drift", "4.1", (1.2847, 1.5985), "4.7", (0.2901, 0.9984), (2.3374, 5.0670)),
    BlRun(3, "jump", "4.2", (3.6406, 9.9748), "4.8", (0.3500, 1.1214), (1.8218, 3.2051)),
)
DIGERUD_RUNS = (
    DigerudRun("optimal light", "< 0.10 m within 4.8 m", 28.0, "minimal"),
    DigerudRun("fog, smoke", "n/d", 22.0, "few"),
    DigerudRun("mirrored counter-light", "n/d", 25.0, "significant"),
    DigerudRun("water droplet", "n/d", 16.0, "n/d"),
    DigerudRun("dark", "n/d", 16.0, "few"),
    DigerudRun("illuminated tags", "n/d", None, "n/d"),
)
