# SPDX-License-Identifier: Apache-2.0
"""Results of the calibration checks."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from graphloc.eval.metrics import Table


@dataclass(frozen=True, slots=True, kw_only=True)
class Suggestion:
    """A setting that the run contradicts.

    Attributes:
        sensor: its name. key: of the setting in vessel.yaml. unit: of the numbers.
        configured, suggested: the present value, and the one that fits the run best.
        sigma: 1 sigma of `suggested`. z: difference of the two values, in sigmas.
        evidence: the reason, in one sentence. action: what to do.
    """

    sensor: str
    key: str
    unit: str
    configured: float
    suggested: float
    sigma: float
    z: float
    evidence: str
    action: str

    def __str__(self) -> str:
        return (
            f"{self.key}: {_number(self.suggested, self.sigma)} +- {_number(self.sigma)} {self.unit} instead of "
            f"{_number(self.configured, self.sigma)}: {self.evidence}; {self.action}"
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Check:
    """A setting that was checked.

    Attributes:
        key, unit, configured: as in `Suggestion`. change, sigma: the estimated correction and its 1 sigma.
        said: what the correction means, or which manoeuvre would determine it.
    """

    key: str
    unit: str
    configured: float
    change: float
    sigma: float
    said: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Calibration:
    """Calibration checks and suggestions of a run."""

    suggestions: tuple[Suggestion, ...] = ()
    checks: tuple[Check, ...] = ()

    def table(self) -> Table:
        """Return all settings that were checked, with the estimated correction of each."""
        rows = tuple((f"{c.key}, {c.unit}", (c.configured, c.change, c.sigma)) for c in self.checks)
        note = "change: correction that the run suggests if this alone were wrong; sigma: its 1 sigma. Nothing was applied."
        return Table("Calibration", ("configured", "change", "sigma"), rows, note)

    def lines(self) -> tuple[str, ...]:
        """Return the suggestions, and what this run could not determine, a line each."""
        return (*(str(s) for s in self.suggestions), *(f"{c.key}: {c.said}" for c in self.checks))

    def as_dict(self) -> dict[str, Any]:
        """Return plain data for `calibration.json`."""
        return {
            "suggestions": [asdict(s) for s in self.suggestions],
            "checks": [asdict(c) for c in self.checks],
            "note": "nothing of this was applied",
        }


def _number(value: float, sigma: float = np.inf) -> str:
    """Return a value to three digits, or to as many as its sigma supports: an offset of years may be known to ms."""
    digits = 4 if abs(value) >= 1000.0 else 3
    if value and 0.0 < sigma < abs(value):
        digits = max(digits, 2 + int(np.floor(np.log10(abs(value) / sigma))))
    return f"{value:.{digits}g}"
