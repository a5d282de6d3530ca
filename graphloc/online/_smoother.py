# SPDX-License-Identifier: Apache-2.0
"""Feed measurements as they arrive, get estimates."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from graphloc.config import VesselConfig
from graphloc.estimate import Estimate
from graphloc.frames import Datum
from graphloc.graph import InertialRow, Sensor
from graphloc.ledger import LedgerRow
from graphloc.measurements import Measurement
from graphloc.trajectory import Trajectory


class OnlineSmoother:
    """A fixed-lag smoother that starts, restarts and mends itself.

    Args:
        config: the vessel, its surveys read. rows, inertial: the table of sensors (`graphloc.factors`).
        datum: origin of world; None: from the configuration, or else from the first fixes.
        lag_s: how long measurements can still be re-judged, and how late they may come.
        snapshot: file that is written every few seconds, and resumed from if it is there; None: no such file.
    """

    def __init__(
        self,
        config: VesselConfig,
        *,
        rows: Sequence[Sensor],
        inertial: InertialRow,
        datum: Datum | None = None,
        lag_s: float = 10.0,
        snapshot: Path | None = None,
    ) -> None:
        raise NotImplementedError

    @property
    def waiting_for(self) -> str:
        """What the start waits for, in plain words; empty while there is an estimate."""
        raise NotImplementedError

    @property
    def datum(self) -> Datum | None:
        """Origin of world; None before it is known."""
        raise NotImplementedError

    def feed(self, m: Measurement) -> Estimate | None:
        """Take a measurement (an `ImuSample` too); return the newest estimate if this made a new one."""
        raise NotImplementedError

    def predict(self, stamp_ns: int | None = None) -> Estimate | None:
        """Return the pose at a stamp (default: of the newest IMU sample) from the newest state; None before the start."""
        raise NotImplementedError

    def window(self) -> Trajectory | None:
        """Return the states of the lag as they are now estimated, up to the newest IMU sample: a prior for front-ends.

        The covariance at all of them is that of the newest.
        """
        raise NotImplementedError

    def rows(self) -> list[LedgerRow]:
        """Return the rows of the ledger that became final since this was last asked; measurements leave with the lag."""
        raise NotImplementedError

    def finish(self) -> list[LedgerRow]:
        """End: return the rows of all that is left."""
        raise NotImplementedError

    def events(self) -> list[str]:
        """Return what happened since this was last asked, a line each: started, restarted, rebuilt, resumed."""
        raise NotImplementedError
