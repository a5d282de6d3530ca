# SPDX-License-Identifier: Apache-2.0
"""LiDARs whose mounts are turned: all headings of matches are off alike, and positions are not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graphloc import app
from graphloc.config import AerialConfig
from graphloc.eval.metrics import compare_to_truth
from graphloc.eval.simulate import Scenario
from graphloc.factors.aerial import slow
from graphloc.measurements import PoseFix
from graphloc.recording import Recording
from graphloc.trajectory import bounds_95
from tests.slowly import simulate_slowly

_TURNED_DEG = 1.5


@pytest.mark.parametrize(
    ("changes", "axes", "sigma"),
    [
        ({}, ("east", "north", "yaw", "late"), (0.3, 0.3, np.radians(1.0), 0.05)),
        ({"stamp_sigma_s": 0.0}, ("east", "north", "yaw"), (0.3, 0.3, np.radians(1.0))),
        ({"mount_sigma_deg": 0.0}, ("east", "north", "late"), (0.3, 0.3, 0.05)),
        ({"image_sigma_m": 0.0, "mount_sigma_deg": 2.0}, ("yaw", "late"), (np.radians(2.0), 0.05)),
        ({"axes": ("x", "y"), "stamp_sigma_s": 0.1}, ("east", "north", "late"), (0.3, 0.3, 0.1)),
    ],
)
def test_what_all_matches_are_off_by(
    changes: dict[str, object], axes: tuple[str, ...], sigma: tuple[float, ...]
) -> None:
    process = slow(AerialConfig.model_validate(changes))
    assert process is not None
    assert process.axes == axes
    assert process.constant.all()
    np.testing.assert_allclose(process.sigma, sigma)


def test_exact_mounts_an_exact_image_and_an_exact_clock_have_no_state() -> None:
    assert slow(AerialConfig(image_sigma_m=0.0, mount_sigma_deg=0.0, stamp_sigma_s=0.0)) is None
    assert slow(AerialConfig(image_sigma_m=0.0, axes=("x", "y"), stamp_sigma_s=0.0)) is None


def _turned(recording: Recording, by_deg: float) -> Recording:
    """Return the recording with the headings of all matches turned."""
    turned = np.array([0.0, 0.0, np.radians(by_deg)])
    return replace(
        recording,
        measurements=tuple(
            replace(m, modes=tuple(replace(mode, value=mode.value + turned) for mode in m.modes))
            if isinstance(m, PoseFix)
            else m
            for m in recording.measurements
        ),
    )


@pytest.mark.parametrize(("mount_sigma_deg", "inside"), [(1.0, True), (0.0, False)])
def test_mounts_that_are_turned_are_in_the_bounds_of_the_heading(mount_sigma_deg: float, inside: bool) -> None:
    """Matches alone tell the heading, 1.5 deg off: off by as much, and that is stated only where mounts may be turned."""
    run = simulate_slowly(
        Scenario(
            path="loops", noise="clean", duration_s=30.0, false_fraction=0.0, compass_hz=0.0, imu_hz=50.0, gnss_hz=2.0
        ),
        1,
        2.5,
    )
    matched = AerialConfig(image_sigma_m=0.0, mount_sigma_deg=mount_sigma_deg)
    recording = _turned(run.recording, _TURNED_DEG)
    (name,) = run.config.of_kind("pose")
    solution = app.smooth_recording(recording, run.config.with_sensors({name: matched})).solution
    found = compare_to_truth(solution.trajectory, run.truth)
    assert found.heading_rmse_deg is not None
    assert found.heading_coverage_95 is not None
    assert found.position_rmse_m < 0.15
    assert 0.5 < found.heading_rmse_deg < 1.1 * _TURNED_DEG
    assert (found.heading_coverage_95 > 0.9) == inside
    assert solution.trajectory.cov is not None
    assert (np.median(bounds_95(solution.trajectory.cov)[:, 2]) > 1.0) == inside


def test_lidars_turned_in_their_mounts_are_named() -> None:
    """Beside a compass, 4 deg were shared among its offset and theirs, 2 deg each, and nothing was said."""
    scenario = Scenario(path="loops", noise="clean", duration_s=60.0, false_fraction=0.0, compass_hz=2.0)
    run = simulate_slowly(replace(scenario, imu_hz=25.0, gnss_hz=2.0), 2, 1.0)
    (name,) = run.config.of_kind("pose")
    config = run.config.with_sensors({name: AerialConfig(image_sigma_m=0.0)})
    solved = app.smooth_recording(_turned(run.recording, 4.0), config)
    found = solved.calibration
    assert found is not None
    assert any(w.startswith(f"{name}: its headings are turned by +") for w in solved.solution.stats.warnings)
    (said,) = (s for s in found.suggestions if s.key.startswith(f"sensors.{name}.lidars"))
    assert said.suggested == pytest.approx(4.0, abs=3.0 * said.sigma)
    assert said.sigma < 1.0
