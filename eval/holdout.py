# SPDX-License-Identifier: Apache-2.0
"""Hold GNSS fixes out of a run, to measure its accuracy at them: every n-th fix, or all fixes of some gaps."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import count

from graphloc.config import VesselConfig
from graphloc.errors import ConfigError
from graphloc.ledger import Outcome
from graphloc.measurements import GnssPosition, GnssVelocity, Measurement
from graphloc.recording import Recording

_MOST_GAPS, _GAP_S, _FEWEST_FIXES = 8, 10, 10


def suggested(fixes: Sequence[GnssPosition]) -> str | None:
    """Return the value of --hold-out that suits a run with these fixes; None: there are too few.

    It is gaps that are as far apart as they are long or, in a short run, every fifth fix.
    """
    if len(fixes) < _FEWEST_FIXES:
        return None
    gaps = int(((fixes[-1].stamp_ns - fixes[0].stamp_ns) * 1e-9 / _GAP_S - 1.0) / 2.0)
    return f"gaps:{min(gaps, _MOST_GAPS)}x{_GAP_S}" if gaps > 0 else "every:5"


def telling(held: Sequence[GnssPosition], config: VesselConfig) -> tuple[GnssPosition, ...]:
    """Return the held-out fixes that a track is measured at; where RTK comes and goes, only those with RTK.

    If none of them has RTK, all of the receiver's count. Beside RTK fixes, the errors of the other fixes, of metres,
    would be all that is measured.
    """
    # A fix may be of a sensor that is not in the configuration, or whose kind another package adds.
    turns = {m.sensor for m in held if m.sensor in config.sensors and config.sensors[m.sensor].takes_turns}
    rtk = {name for name in turns if config.sensors[name].fixes == "rtk"}
    worse = {name for name in turns - rtk if rtk.intersection(config.by_turns(name))}
    return tuple(m for m in held if m.sensor not in worse)


@dataclass(frozen=True, slots=True)
class HoldOut:
    """Every `every`-th fix, or `gaps` gaps of `gap_s` seconds each, spread evenly over the span of the fixes.

    A gap is an outage of GNSS, as in a drill: its velocities are held out, too; measurements of other devices are not.
    """

    every: int = 0
    gaps: int = 0
    gap_s: float = 0.0

    def __str__(self) -> str:
        """Return it as on the command line."""
        return "--hold-out " + (f"every:{self.every}" if self.every else f"gaps:{self.gaps}x{self.gap_s:g}")

    @staticmethod
    def parse(text: str) -> HoldOut:
        """Parse `every:N` or `gaps:COUNTxSECONDS`.

        Raises:
            ConfigError: the text has neither form.
        """
        if match := re.fullmatch(r"every:(\d+)", text):
            if int(match[1]) >= 2:
                return HoldOut(every=int(match[1]))
        elif (match := re.fullmatch(r"gaps:(\d+)x(\d+(?:\.\d+)?)", text)) and int(match[1]) and float(match[2]):
            return HoldOut(gaps=int(match[1]), gap_s=float(match[2]))
        raise ConfigError(f"--hold-out {text}: use every:N (N of 2 or more) or gaps:COUNTxSECONDS, e.g. gaps:8x10")

    def split(self, recording: Recording) -> tuple[Recording, tuple[GnssPosition, ...]]:
        """Return the recording without the held-out measurements, and the held-out fixes.

        Each held-out measurement keeps a row in the recording's ledger.

        Raises:
            ConfigError: there are too few fixes, or the gaps would overlap.
        """
        fixes = recording.of(GnssPosition)
        if len(fixes) < 3:
            raise ConfigError(f"{recording.source}: --hold-out needs at least 3 fixes, the run has {len(fixes)}")
        span = (fixes[-1].stamp_ns - fixes[0].stamp_ns) * 1e-9
        if self.gaps and self.gap_s * (self.gaps + 1) >= span:
            raise ConfigError(
                f"{recording.source}: {self}: the gaps do not fit into the "
                f"{span:.1f} s from the first fix to the last; ask for fewer or shorter ones"
            )
        # Counted for each receiver: of two receivers that alternate, every second fix would be all of one.
        number: defaultdict[str, count[int]] = defaultdict(count)
        held = tuple(m for m in fixes if self._holds(next(number[m.sensor]), m, fixes))
        if not held:
            raise ConfigError(f"{recording.source}: {self} holds nothing of {len(fixes)} fixes")
        velocities = [m for m in recording.of(GnssVelocity) if self._gaps_of(m, fixes)]
        gone = {id(m) for m in (*held, *velocities)}
        rows = [recording.row_of(m, Outcome.HELD_OUT, "kept out of the graph to test it") for m in held]
        rows += [recording.row_of(m, Outcome.HELD_OUT, "kept out with the fixes of a gap") for m in velocities]
        kept = recording.where(lambda m: id(m) not in gone)
        warnings = (*kept.warnings, *self._of_empty_gaps(held, fixes))
        return replace(kept, rows=(*recording.rows, *rows), warnings=warnings), held

    def _of_empty_gaps(self, held: Sequence[GnssPosition], fixes: list[GnssPosition]) -> list[str]:
        """Return a warning if some gaps lie where there are no fixes that could be held out."""
        full = {n for m in held for n in self._gaps_of(m, fixes)}
        if len(full) == self.gaps:
            return []
        said = f"{self}: no fixes in {self.gaps - len(full)} of the gaps anyway"
        return [f"{said}: the error is that of the other {len(full)}"]

    def _holds(self, i: int, m: GnssPosition, fixes: list[GnssPosition]) -> bool:
        return i % self.every == self.every - 1 if self.every else bool(self._gaps_of(m, fixes))

    def _gaps_of(self, m: Measurement, fixes: list[GnssPosition]) -> list[int]:
        """Return the numbers of the gaps that a measurement lies in."""
        span = (fixes[-1].stamp_ns - fixes[0].stamp_ns) * 1e-9
        at = (m.stamp_ns - fixes[0].stamp_ns) * 1e-9
        centres = (span * (n + 1.0) / (self.gaps + 1.0) for n in range(self.gaps))
        return [n for n, centre in enumerate(centres) if abs(at - centre) <= self.gap_s / 2.0]
