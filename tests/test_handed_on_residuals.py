# SPDX-License-Identifier: Apache-2.0
"""What a measurement was judged by is also what its factor is made of: the residual is handed on, not reckoned again."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from graphloc import app
from graphloc.build import Problem, _graph
from graphloc.eval.simulate import bl_scenario, simulate
from graphloc.factors import INERTIAL, SENSORS
from graphloc.graph import Residual, Sensor
from graphloc.linear import factors_of
from graphloc.solve import _final_passes, smooth
from graphloc.solve._choices import other_choices
from tests.slowly import sparsely


def same(residual: Residual, row: Sensor, m: Any, config: Any, at: Any, mode: int) -> None:
    """Whether a residual is the one that the row gives at this attachment."""
    anew = row.residuals(m, config, at)[mode]
    np.testing.assert_array_equal(residual.raw, anew.raw)
    np.testing.assert_array_equal(residual.cov, anew.cov)
    np.testing.assert_array_equal(residual.jacobian(), anew.jacobian())


def test_a_residual_that_is_handed_on_is_that_at_its_attachment(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where another choice of matches is tried, whose mode is from one solution and its attachment from another."""
    given, tried = Counter[str](), Counter[str]()

    def checked(row: Any, m: Any, config: Any, at: Any, decision: Any, residual: Any) -> Any:
        if residual is not None:
            given[row.kind] += 1
            same(residual, row, m, config, at, decision.mode)
        return factors_of(row, m, config, at, decision, residual)

    def choices(problem: Problem, *rest: Any) -> Iterator[Any]:
        streams = {s.number: s for s in problem.streams}
        for others, used in other_choices(problem, *rest):
            for (number, i), v in others.items():
                if v.decision is not None:
                    tried[(s := streams[number]).row.kind] += 1
                    same(v.residual, s.row, s.measurements[i], s.config, v.at, v.decision.mode)
            yield others, used

    monkeypatch.setattr(_graph, "factors_of", checked)
    monkeypatch.setattr(_final_passes, "other_choices", choices)
    run = sparsely(simulate(replace(bl_scenario(3, "drift"), duration_s=40.0), 4))
    smooth(run.recording, run.config, app.choose_datum(run.recording, run.config), rows=SENSORS, inertial=INERTIAL)
    assert min(given[kind] for kind in ("gnss", "compass", "pose")) > 50
    assert tried["pose"] > 10
