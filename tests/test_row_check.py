# SPDX-License-Identifier: Apache-2.0
"""`check_row` finds what is wrong with a row, and nothing in one that is right."""

import importlib
import re
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from graphloc.factors import SENSORS
from graphloc.graph import Attachment, FalseModel, Residual, Sensor
from graphloc.row_check import check_row
from tests.test_factors import SETTINGS, config_of

PACKAGE = Path(__file__).parent.parent / "examples/range_beacon"
LEFT_OUT = {
    "gnss": ["the residual depends on the velocity, and no Jacobian says so"],  # by the delay of its stamps
    "aerial": ["the residual depends on the velocity, and no Jacobian says so", "jacobian[2, 0]"],
    "pose": ["jacobian[3, 0]"],
}
"""What the built-in rows neglect, as their docstrings say: delay times velocity; yaw of a craft that heels, without its roll."""


@pytest.fixture
def beacon(monkeypatch: pytest.MonkeyPatch) -> tuple[Sensor, Any]:
    monkeypatch.setattr(sys, "path", [str(PACKAGE), *sys.path])
    row: Sensor = importlib.import_module("graphloc_range_beacon").ROW
    return row, row.config.model_validate({"kind": "range_beacon", "beacon_m": [80.0, -120.0, 4.0]})


@pytest.mark.parametrize(
    ("row", "settings"), [(row, settings) for row in SENSORS for settings in SETTINGS.get(row.kind, ({},))]
)
def test_nothing_is_found_in_the_rows_of_the_table_but_what_they_neglect(row: Sensor, settings: dict[str, Any]) -> None:
    config = row.config.model_validate({**config_of(row).model_dump(), **settings})
    for said in check_row(row, config):
        assert any(said.startswith(known) for known in LEFT_OUT.get(row.kind, [])), said


def with_residual(row: Sensor, change: Callable[[Residual, Attachment], Residual]) -> Sensor:
    return replace(row, residuals=lambda m, config, at: tuple(change(r, at) for r in row.residuals(m, config, at)))


def of_a_false(cov: np.ndarray) -> dict[str, Any]:
    return {"false": lambda *_: FalseModel(probability=0.1, cov=cov, repeats=0.5)}


MISTAKES: dict[str, tuple[Callable[[Residual, Attachment], Residual], str]] = {
    "sign": (lambda r, _: replace(r, jacobian=lambda: -r.jacobian()), r"jacobian\[0, \d\] is .*, and the residual's slope there"),
    "order": (lambda r, _: replace(r, jacobian=lambda: np.roll(r.jacobian(), 3, axis=1)), r"jacobian\[0, \d\] is"),
    "shape": (lambda r, _: replace(r, jacobian=lambda: r.jacobian()[0]), r"jacobian has the shape \(6,\); \(1, 6\) is wanted"),
    "model": (lambda r, at: replace(r, raw=r.raw + at.v_world_mps[:1] - 1.0), "is not zero"),
    "cov": (lambda r, _: replace(r, cov=np.zeros((1, 1))), "cov is no covariance"),
    "size of cov": (lambda r, _: replace(r, cov=np.eye(3)), r"cov has the shape \(3, 3\), where raw has 1 numbers"),
    "NaN": (lambda r, _: replace(r, raw=np.array([np.nan])), "is not finite"),
    "prior": (lambda r, _: replace(r, prior=0.0), "prior is 0, no probability"),
}  # fmt: skip


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_named(name: str, beacon: tuple[Sensor, Any]) -> None:
    row, config = beacon
    assert check_row(row, config) == []
    change, said = MISTAKES[name]
    found = check_row(with_residual(row, change), config)
    assert any(re.search(said, line) for line in found), found


def test_a_dependence_that_no_jacobian_tells_is_named(beacon: tuple[Sensor, Any]) -> None:
    """As of a range that is taken late: it is longer by the velocity times the delay."""
    row, config = beacon

    def late(at: Attachment) -> Attachment:
        return replace(at, carried_m=at.carried_m + 0.1 * at.v_world_mps)

    late_row = replace(
        row, residuals=lambda m, c, at: row.residuals(m, c, late(at)), ideal=lambda at, c: row.ideal(late(at), c)
    )
    assert check_row(late_row, config) == ["the residual depends on the velocity, and no Jacobian says so"]


def test_other_types_are_named(beacon: tuple[Sensor, Any]) -> None:
    row, config = beacon
    assert check_row(replace(row, residuals=lambda *_: ()), config) == [
        "residuals returns none: a measurement has one hypothesis or more"
    ]
    fix = next(r for r in SENSORS if r.kind == "gnss")
    assert check_row(replace(row, ideal=lambda at, _: fix.ideal(at, fix.config(kind="gnss"))), config) == [
        "ideal returns a GnssPosition, not a BeaconRange"
    ]
    assert check_row(replace(row, **of_a_false(np.eye(2))), config) == [
        "false gives a covariance of the shape (2, 2), residuals (1, 1)"
    ]
