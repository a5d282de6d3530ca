# SPDX-License-Identifier: Apache-2.0
"""What `graphloc` exports, and what a program that uses it from Python can get wrong."""

import ast
import re
from dataclasses import replace
from functools import cache
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

import graphloc
from graphloc.blocks import MountConfig
from graphloc.config import VesselConfig, load_config
from graphloc.eval.simulate import Scenario, SimulatedRun
from graphloc.factors import KINDS
from graphloc.frames import rotation_from_rpy_deg
from graphloc.replay import arrivals
from tests.slowly import simulate_slowly

ROOT = Path(__file__).parent.parent
LEVER_M, TURN = np.array([0.5, -0.2, 1.1]), rotation_from_rpy_deg(np.array([180.0, 0.0, 92.0]))


@cache
def simulated() -> SimulatedRun:
    scenario = Scenario(duration_s=12.0, imu_hz=50.0, gnss_hz=2.0, compass_hz=2.0, false_fraction=0.0)
    return simulate_slowly(scenario, 3)


def by_frame(config: VesselConfig, name: str) -> VesselConfig:
    """The configuration with the mount of a sensor from /tf_static."""
    sensor = config.sensors[name]
    return config.with_sensors({name: sensor.model_copy(update={"mount": MountConfig(tf_frame="somewhere")})})


def test_names_are_the_same_for_readers_type_checkers_and_programs() -> None:
    tree = ast.parse((ROOT / "graphloc/__init__.py").read_text(encoding="utf-8"))
    (checked,) = (node for node in tree.body if isinstance(node, ast.If))
    homes = {a.name: found.module for found in checked.body if isinstance(found, ast.ImportFrom) for a in found.names}
    assert {*homes, "__version__"} == set(graphloc.__all__) <= set(dir(graphloc))
    for name, home in homes.items():
        assert getattr(graphloc, name) is getattr(import_module(str(home)), name)
    told = set(re.findall(r"\b\w+\b", (ROOT / "docs/api.md").read_text(encoding="utf-8")))
    assert set(homes) - told == set()
    with pytest.raises(AttributeError, match="'graphloc' has no attribute 'smoth'"):
        _ = graphloc.smoth


@pytest.mark.parametrize("name", ["imu", "gnss"])
def test_a_mount_by_a_frame_that_nothing_tells_is_refused(name: str) -> None:
    """It was taken for none: the antenna in the origin, the IMU along the axes of the body."""
    run, lost = simulated(), by_frame(simulated().config, name)
    with pytest.raises(graphloc.InputError, match=rf"sensors\.{name}\.mount\.tf_frame: no /tf_static is read here"):
        graphloc.online_smoother(lost)
    with pytest.raises(graphloc.InputError, match=rf"sensors\.{name}\.mount\.tf_frame: no /tf_static is read here"):
        graphloc.smooth_recording(run.recording, lost)
    assert graphloc.online_smoother(lost, mounts={name: (LEVER_M, TURN)}).waiting_for == "the first IMU sample"


@pytest.mark.usefixtures("map_alone")
def test_the_effective_configuration_has_mounts_in_numbers(tmp_path: Path) -> None:
    """So it serves where there is no /tf_static: a stream, a program."""
    run, lost = simulated(), by_frame(simulated().config, "gnss")
    recording = replace(run.recording, mounts={"gnss": (LEVER_M, TURN)})
    page = graphloc.write(graphloc.smooth_recording(recording, lost), str(tmp_path / "run"))
    mount = load_config(page.parent / "vessel.effective.yaml", KINDS).sensors["gnss"].mount
    assert mount.tf_frame is None
    np.testing.assert_allclose(mount.t_body_sensor_m, LEVER_M, atol=1e-12)
    assert mount.rpy_deg == (180.0, 0.0, 92.0)


def test_a_name_that_no_sensor_has_is_said_once(tmp_path: Path) -> None:
    run = simulated()
    online = graphloc.online_smoother(run.config, snapshot=str(tmp_path / "now.json"))
    for m in run.recording.of(graphloc.GnssPosition):
        online.feed(replace(m, sensor="gnns"))
    assert [e.text for e in online.events()] == [
        "gnns: its messages are ignored: no sensor has this name in the configuration"
    ]


def test_a_recording_shows_in_a_line() -> None:
    recording = simulated().recording
    assert repr(recording) == (
        f"<Recording of (simulated): 600 samples of imu, {len(recording.measurements)} measurements of "
        f"{recording.message_count} messages>"
    )


def test_how_wide_a_bound_is_good_is_configured_for_both_modes() -> None:
    run = simulated()
    strict = run.config.model_copy(update={"output": run.config.output.model_copy(update={"good_bound_m": 0.01})})
    for config, some in [(run.config, True), (strict, False)]:
        online = graphloc.online_smoother(config)
        estimates = [found for m in arrivals(run.recording) if (found := online.feed(m)) is not None]
        assert any(found.health == "good" for found in estimates) is some
        solution = graphloc.smooth_recording(run.recording, config).solution
        assert any(health == "good" for health in solution.health) is some
