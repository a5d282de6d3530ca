# SPDX-License-Identifier: Apache-2.0
"""The gate of `make bench`: a count that is worse fails, a time never does."""

from __future__ import annotations

import importlib
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

_BENCHMARKS = Path(__file__).parent.parent / "benchmarks"


@pytest.fixture(scope="module")
def gate() -> Any:
    sys.path.append(str(_BENCHMARKS))
    try:
        return importlib.import_module("_gate")
    finally:
        sys.path.remove(str(_BENCHMARKS))


@pytest.fixture
def committed(gate: Any) -> dict[str, Any]:
    found: dict[str, Any] = gate.read(_BENCHMARKS / "baseline.json")
    return found


def _status(gate: Any, committed: dict[str, Any], changed: dict[str, Any], whole: bool = True) -> int:
    figures = [changed.get(key, f) for key, f in committed.items()]
    return int(gate.finish([f for f in figures if f], _BENCHMARKS / "baseline.json", whole=whole, update=False))


def test_committed_baseline_stands_against_itself_and_has_every_part(gate: Any, committed: dict[str, Any]) -> None:
    assert _status(gate, committed, {}) == 0
    for part in ("batch 2 min", "batch 20 min", "online", "soak", "matcher", "tag detector", "bag", "run folder"):
        assert any(f.kind == "count" and key.startswith(part) for key, f in committed.items()), part


def test_each_count_fails_alone_where_it_is_worse(gate: Any, committed: dict[str, Any]) -> None:
    for key, f in committed.items():
        by = f.tolerance * abs(f.value) + max(1.0, 0.01 * abs(f.value))
        for sign, worse in ((1.0, f.direction in ("<=", "==")), (-1.0, f.direction in (">=", "=="))):
            changed = {key: replace(f, value=f.value + sign * by)}
            assert _status(gate, committed, changed) == int(f.kind == "count" and worse), (key, sign)


def test_tolerance_and_direction_are_those_of_the_baseline(gate: Any, committed: dict[str, Any]) -> None:
    key = next(key for key, f in committed.items() if f.kind == "count" and f.direction == "==")
    lax = gate.Figure(key, committed[key].value + 5.0, "count", "count", ">=", 9.0)
    assert _status(gate, committed, {key: lax}) == 1


def test_count_that_is_gone_fails_only_where_its_case_was_run(gate: Any, committed: dict[str, Any]) -> None:
    key = next(key for key, f in committed.items() if f.kind == "count")
    assert _status(gate, committed, {key: None}) == 1
    assert _status(gate, committed, {key: None}, whole=False) == 0


def test_no_time_fails_and_none_that_is_not_a_number_passes_as_a_count(gate: Any, committed: dict[str, Any]) -> None:
    slow = {key: replace(f, value=100.0 * f.value) for key, f in committed.items() if f.kind == "ratio"}
    assert slow
    assert _status(gate, committed, slow) == 0
    key = next(key for key, f in committed.items() if f.kind == "count")
    assert _status(gate, committed, {key: replace(committed[key], value=float("nan"))}) == 1


def test_update_keeps_what_was_not_run(gate: Any, tmp_path: Path) -> None:
    path = tmp_path / "baseline.json"
    a, b = gate.Figure("a", 3.0, "count", "count", "<=", 0.1), gate.Figure("b", 0.123456, "power", "count")
    assert gate.finish([a, b], path, whole=True, update=True) == 0
    assert gate.finish([replace(a, value=4.0)], path, whole=False, update=False) == 1
    assert gate.finish([replace(a, value=4.0)], path, whole=False, update=True) == 0
    assert gate.read(path)["a"].value == 4.0
    assert gate.finish([replace(a, value=4.0), b], path, whole=True, update=False) == 0  # b is stored to four digits
