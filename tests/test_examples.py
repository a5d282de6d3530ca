"""Every script in examples/ does what it says, in less than 40 lines."""

import importlib
import re
import runpy
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from graphloc.eval import simulate as simulation
from graphloc.eval.simulate import Scenario, find_scenario, simulate
from graphloc.eval.simulate.bag import write_bag
from graphloc.graph import Decision
from graphloc.linear import factors_of
from tests.slowly import simulate_slowly
from tests.test_factors import attachment, values_of

EXAMPLES = Path(__file__).parent.parent / "examples"
ELSEWHERE = {"stream_client.py"}  # in test_stream.py; kitti/make_bag.py in test_bag.py
HERE = {"compare_in_memory.py", "online_loop.py", "smooth_a_bag.py", "use_a_new_sensor.py"}


def lighter(name: str, changes: dict[str, str], share: float = 2.0 / 3.0) -> Scenario:
    """The scenario of an example, with fewer measurements, and so much of its duration."""
    lasts_s = share * float(changes["duration_s"])
    return find_scenario(
        name, {**changes, "duration_s": f"{lasts_s:g}", "imu_hz": "50", "gnss_hz": "2", "compass_hz": "1"}
    )


def run(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    name: str,
    *arguments: object,
    share: float = 2.0 / 3.0,
) -> str:
    """Run a script, on what it simulates in half the time; return what it prints."""
    monkeypatch.setattr(simulation, "simulate", simulate_slowly)
    monkeypatch.setattr(simulation, "find_scenario", partial(lighter, share=share))
    monkeypatch.setattr(sys, "argv", [name, *map(str, arguments)])
    monkeypatch.setattr(sys, "path", [*sys.path])
    runpy.run_path(str(EXAMPLES / name), run_name="__main__")
    return capsys.readouterr().out


def test_each_has_a_test_is_short_and_is_named_in_the_readme() -> None:
    scripts = {path.name for path in EXAMPLES.glob("*.py")}
    assert scripts == HERE | ELSEWHERE
    readme = (EXAMPLES / "README.md").read_text()
    for name in scripts:
        assert len((EXAMPLES / name).read_text().splitlines()) < 40, name
        assert f"`{name}`" in readme


def test_smooth_a_bag(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    made = simulate(Scenario(duration_s=15.0, false_fraction=0.0, imu_hz=50.0, gnss_hz=2.0, compass_hz=2.0), 3)
    said = run(monkeypatch, capsys, "smooth_a_bag.py", *write_bag(made, tmp_path / "bag", ros=2))
    first = re.search(r"Z?  (\d+\.\d{7})  (\d+\.\d{7})  [\d.]+ deg  \+- [\d.]+ m$", said, re.MULTILINE)
    assert first is not None, said
    origin, p = made.config.datum, made.truth.p_world_m[0]
    assert origin is not None
    # One degree of latitude is 111.4 km at 57.7 deg, of longitude 59.7 km.
    assert float(first[1]) == pytest.approx(origin.latitude_deg + p[1] / 111.4e3, abs=2e-5)
    assert float(first[2]) == pytest.approx(origin.longitude_deg + p[0] / 59.7e3, abs=4e-5)
    assert "imu: {'used': 750}" in said


def test_online_loop(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    said = run(monkeypatch, capsys, "online_loop.py", share=1.0)
    assert "waiting for" in said
    assert len(re.findall(r"m north, \+- 0\.\d\d m, good", said)) >= 2
    assert "matcher: rejected, judged false" in said


def test_compare_in_memory(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    said = run(monkeypatch, capsys, "compare_in_memory.py")
    rmse = {name: float(value) for name, value in re.findall(r"^([\w ]*?):? ?RMSE ([\d.]+) m", said, re.MULTILINE)}
    assert set(rmse) >= {"", "graphloc online", "BL EKF", "honest EKF"}
    assert rmse[""] < 0.3 < rmse["BL EKF"]


def test_use_a_new_sensor(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    said = run(monkeypatch, capsys, "use_a_new_sensor.py")
    alone, ranges = (float(v) for v in re.findall(r"RMSE ([\d.]+) m", said))
    assert 2.0 * ranges < alone


def test_the_new_sensor_is_as_ours_are(monkeypatch: pytest.MonkeyPatch) -> None:
    """Zero at the truth, and slopes as differences give them: what test_factors.py asks of every row."""
    monkeypatch.syspath_prepend(str(EXAMPLES / "range_beacon"))
    beacon = importlib.import_module("graphloc_range_beacon")

    config = beacon.RangeBeaconConfig(beacon_m=(90.0, -70.0, 12.0))
    at = attachment(beacon.ROW, config)
    m = beacon.ROW.ideal(at, config)
    at_state = np.asarray(at.T_world_body.matrix()) @ np.array([-1.5, 0.4, 2.2, 1.0])
    antenna = at_state[:3] + np.array([0.3, -0.2, 0.05])  # the way since the state
    assert m.range_m == pytest.approx(float(np.linalg.norm(antenna - [90.0, -70.0, 12.0])))
    (factor,) = factors_of(beacon.ROW, m, config, at, Decision()).factors
    assert factor.error(values_of(at, ())) < 1e-12
    (residual,) = beacon.ROW.residuals(m, config, at)
    for axis, slope in enumerate(residual.jacobian()[0]):
        step = np.zeros(6)
        step[axis] = 1e-5
        far, near = (
            beacon.ROW.residuals(m, config, replace(at, T_world_body=at.T_world_body.retract(k * step)))[0].raw[0]
            for k in (1.0, -1.0)
        )
        assert slope == pytest.approx((far - near) / 2e-5, abs=1e-6)
