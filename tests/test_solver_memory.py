"""What the solver lets go of before it asks for more: memory that is free goes back, graphs with it."""

import ctypes
import os
import sys
import weakref
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import graphloc.solve
from graphloc import app
from graphloc.build import Problem, make_problem
from graphloc.eval.calibrate import PROBE
from graphloc.eval.simulate import Scenario, simulate
from graphloc.factors import INERTIAL, SENSORS
from graphloc.solve import _final_passes, smooth
from graphloc.solve._memory import give_back_memory
from graphloc.solve._offsets import offsets_of
from graphloc.solve.batch import BatchResult, solve_batch

PIECE, PIECES = 4096, 20_000  # bytes; small enough for the heap


@pytest.fixture(scope="module")
def problem() -> Problem:
    run = simulate(Scenario(duration_s=12.0, imu_hz=50.0, gnss_hz=2.0, compass_hz=2.0), 1)
    datum = app.choose_datum(run.recording, run.config)
    recording = app.with_synthetic(run.recording, run.config, datum)
    return make_problem(recording, run.config, datum, SENSORS, INERTIAL)


def resident() -> int:
    """Bytes of this process that are in memory."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.skipif(
    sys.platform != "linux" or not hasattr(ctypes.CDLL(None), "malloc_trim"), reason="the C library cannot give back"
)
def test_memory_that_is_free_goes_back_to_the_system() -> None:
    """80 MB in small pieces, all freed but the last: below that one the C library keeps them."""
    libc: Any = ctypes.CDLL(None)
    libc.malloc.restype, libc.malloc.argtypes, libc.free.argtypes = (
        ctypes.c_void_p,
        [ctypes.c_size_t],
        [ctypes.c_void_p],
    )
    pieces = [libc.malloc(PIECE) for _ in range(PIECES)]
    for piece in pieces:
        ctypes.memset(piece, 1, PIECE)
    *below, last = pieces
    for piece in below:
        libc.free(piece)
    kept = resident()
    give_back_memory()
    assert kept - resident() > 0.9 * PIECE * PIECES
    libc.free(last)


@pytest.mark.parametrize("library", [SimpleNamespace(), None], ids=["no such function", "not linux"])
def test_where_none_can_be_given_back_nothing_happens(library: object, monkeypatch: pytest.MonkeyPatch) -> None:
    def load(_: object) -> object:
        assert library is not None
        return library

    monkeypatch.setattr(ctypes, "CDLL", load)
    monkeypatch.setattr(sys, "platform", "linux" if library is not None else "darwin")
    give_back_memory()


def test_a_result_without_its_graph_is_the_same_otherwise(problem: Problem) -> None:
    result = solve_batch(problem)
    light = result.lightened()
    assert light.graph.size() == 0
    assert result.graph.size() > len(problem.timeline.stamps_ns)  # the whole one is left as it is
    for field in fields(BatchResult):
        if field.name != "graph":
            assert getattr(light, field.name) is getattr(result, field.name), field.name
    asked, whole = offsets_of(light, PROBE), offsets_of(result, PROBE)
    assert asked is not None
    assert whole is not None
    np.testing.assert_array_equal(asked.gradient, whole.gradient)
    np.testing.assert_array_equal(asked.curvature, whole.curvature)


def test_the_graph_is_gone_before_memory_is_given_back_and_offsets_are_asked(
    problem: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    held: list[weakref.ref[Any]] = []
    said: list[str] = []

    def solved(*arguments: Any, **options: Any) -> BatchResult:
        result = solve_batch(*arguments, **options)
        held.append(weakref.ref(result.graph))
        return result

    def noted(what: str, then: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any) -> Any:
            said.append(f"{what}: {sum(ref() is not None for ref in held)} held")
            return then(*arguments)

        return call

    monkeypatch.setattr(graphloc.solve, "solve_batch", solved)
    monkeypatch.setattr(graphloc.solve, "give_back_memory", noted("given back", give_back_memory))
    monkeypatch.setattr(graphloc.solve, "offsets_of", noted("asked", offsets_of))
    run = simulate(Scenario(duration_s=12.0, imu_hz=50.0, gnss_hz=2.0, compass_hz=2.0), 1)
    smooth(run.recording, run.config, problem.datum, rows=SENSORS, inertial=INERTIAL, probe=PROBE)
    assert len(held) == 1
    assert said == ["given back: 0 held", "asked: 0 held"]


def test_a_graph_is_gone_before_the_next_is_made_where_sensors_scatter(
    problem: Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a run of hours two of them are gigabytes more."""
    held: list[weakref.ref[Any]] = []
    final_passes, rounds = _final_passes._final_passes, [{"gnss": {"sigma_scale": 1.5}}, {}]  # noqa: SLF001

    def passes(*arguments: Any) -> Any:
        assert all(ref() is None for ref in held)
        settled = final_passes(*arguments)
        held.append(weakref.ref(settled.graph))
        return settled

    monkeypatch.setattr(_final_passes, "_final_passes", passes)
    monkeypatch.setattr(_final_passes, "scattering", lambda *_, **__: rounds.pop(0))
    found = solve_batch(problem)
    assert rounds == []
    assert len(held) == 2
    assert found.problem.config.sensors["gnss"].sigma_scale == 1.5 * problem.config.sensors["gnss"].sigma_scale
