# SPDX-License-Identifier: Apache-2.0
"""Choices among measurements are weighed as all of their joint densities say, whatever the graph holds at the time."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from graphloc import keys
from graphloc.config import PoseConfig
from graphloc.eval.metrics import squared_over_covariance
from graphloc.eval.simulate import bl_scenario
from graphloc.factors import pose
from graphloc.frames import Array
from graphloc.graph import Residual
from graphloc.measurements import Measurement, PoseFix, PoseMode
from graphloc.online._alternatives import choices
from graphloc.online._judge import Judge
from graphloc.replay import replay
from tests.slowly import simulate_slowly, sparsely

SIGMA_M, FALSE_M, FALSE = 0.3, pose.FALSE_SPREAD_M, 0.2
PRIOR = np.array([[1.0, 0.9, 0.7], [0.9, 1.1, 0.9], [0.7, 0.9, 1.3]])  # of the places x at three stamps, m^2
TOLD_M = np.array([1.4, 1.3, -0.2])
OFF = np.array([0.8, 1.4, 0.0])
SECOND = 1_000_000_000


def stream(news: float = 1.0) -> Any:
    config = PoseConfig(topic="/aerial", axes=("x",), false_fraction=FALSE, false_repeats=0.0)
    mode = PoseMode(value=np.zeros(1), cov=np.eye(1) * SIGMA_M**2)
    fixes = [
        PoseFix(stamp_ns=n * SECOND, sensor="aerial", seq=n, axes=("x",), modes=(mode,), news=news) for n in range(3)
    ]
    return SimpleNamespace(row=pose.ROW, config=config, measurements=fixes)


def log_gauss(x: Array, cov: Array) -> float:
    return float(-0.5 * (x @ np.linalg.inv(cov) @ x + np.log(np.linalg.det(2.0 * np.pi * cov))))


def after(right: tuple[int, ...]) -> tuple[Array, Array]:
    """Mean and covariance of the places by the prior and the measurements that are right."""
    rows = list(right)
    if not rows:
        return np.zeros(3), PRIOR
    S = PRIOR[np.ix_(rows, rows)] + SIGMA_M**2 * np.eye(len(rows))
    gain = PRIOR[:, rows] @ np.linalg.inv(S)
    return gain @ TOLD_M[rows], PRIOR - gain @ PRIOR[rows]


def probability(right: tuple[int, ...], news: float = 1.0) -> float:
    """Prior x joint density of what is right, each other being false around its own place as known from what is right before it.

    Of what is no news only the distance of what is right counts in full.
    """
    log = 0.0
    for n in range(3):
        mean, cov = after(tuple(k for k in right if k < n))
        r, P = np.array([mean[n] - TOLD_M[n]]), cov[n : n + 1, n : n + 1]
        if n in right:
            S = P + SIGMA_M**2
            log += news * (np.log(1.0 - FALSE) + log_gauss(np.zeros(1), S)) - 0.5 * r @ np.linalg.solve(S, r)
        else:
            log += news * (np.log(FALSE) + log_gauss(r, P + SIGMA_M**2 + FALSE_M**2))
    return float(np.exp(log))


@pytest.mark.parametrize("news", [1.0, 0.3])
@pytest.mark.parametrize("held", [(), (0, 1), (2,), (0, 1, 2)])
def test_all_choices_are_weighed_whichever_is_in_the_graph(held: tuple[int, ...], news: float) -> None:
    mean, cov = after(held)
    residuals = [
        (Residual(raw=mean[n : n + 1] - TOLD_M[n], cov=np.eye(1) * SIGMA_M**2, jacobian=lambda: np.eye(1),
                  prior=1.0 - FALSE, size_m=None, size_deg=None),)
        for n in range(3)
    ]  # fmt: skip
    place = 2  # the newest
    J = np.vstack([np.eye(3)[place], np.eye(3)])
    found, unplaced = choices(
        stream(news), range(3), residuals, J @ cov @ J.T, [(0, 1.0) if n in held else None for n in range(3)]
    )
    ways = [tuple(n for n in range(3) if bits[n]) for bits in product([False, True], repeat=3)]
    total = sum(probability(right, news) for right in ways)
    for c in found:
        right = tuple(n for n, mode in enumerate(c.modes) if mode is not None)
        assert np.exp(c.log) == pytest.approx(probability(right, news) / total, rel=1e-6)
        assert c.step[0] == pytest.approx(after(right)[0][place] - mean[place], abs=1e-9)
        assert c.cov[0, 0] == pytest.approx(after(right)[1][place, place], abs=1e-9)
    assert not unplaced
    assert len(found) == len(ways)
    assert found[0].log == max(c.log for c in found)


@pytest.mark.parametrize("off_m", [-0.05, 0.05])
def test_what_is_known_by_one_measurement_alone_is_not_thrown_elsewhere_by_its_removal(off_m: float) -> None:
    """Known to 20 m without it: that its factor was linearised 5 cm aside moved the mean of all choices by metres, for a second.

    After an outage, or at a start beside a quay, the estimate was said 7 m off, and lost.
    """
    var = 1.0 / (1.0 / 20.0**2 + 1.0 / SIGMA_M**2)
    found = Residual(
        raw=np.array([off_m]), cov=np.eye(1) * SIGMA_M**2, jacobian=lambda: np.eye(1), prior=1.0 - FALSE, size_m=None, size_deg=None
    )  # fmt: skip
    weighed, unplaced = choices(stream(), [0], [(found,)], np.full((2, 2), var), [(0, 1.0)])
    (without,) = (c for c in weighed if c.modes == (None,))
    assert abs(without.step[0]) < 1.0
    assert unplaced
    assert without.cov[0, 0] > (5.0 * SIGMA_M) ** 2  # so that it is known badly, which counts by its probability


def test_a_match_that_outweighs_all_else_is_taken_out_by_solving_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first one, good to 5 cm beside fixes that drift: without it the estimate is where it would be had it never come.

    Its mean was taken from none: two of sixteen vessels were 4 and 2.8 m off (RMSE), a false match being believed.
    """
    run = sparsely(simulate_slowly(replace(bl_scenario(1, "drift"), pose_sigma_m=0.05, duration_s=20.0), 3))
    begin_ns = int(run.truth.stamps_ns[0]) + 16 * SECOND
    fixes = tuple(m for m in run.recording.measurements if not isinstance(m, PoseFix))
    matches = tuple(m for m in run.recording.of(PoseFix) if m.stamp_ns > begin_ns)
    noted: list[tuple[int, Array, Array]] = []
    solved: Any = Judge._solved_without  # noqa: SLF001

    def note(judge: Any, *args: Any) -> Any:
        timeline, found = judge._problem.timeline, solved(judge, *args)  # noqa: SLF001
        here = judge._window.values.atPose3(keys.pose(timeline.last)).translation()  # noqa: SLF001
        (without,) = (c for c in found if not any(mode is not None for mode in c.modes))
        noted.append((timeline.stamps_ns[timeline.last], here, without.step[:3]))
        return found

    monkeypatch.setattr(Judge, "_solved_without", note)
    replay(replace(run.recording, measurements=tuple(sorted((*fixes, *matches), key=lambda m: m.seq))), run.config)
    never = replay(replace(run.recording, measurements=fixes), run.config).solution.trajectory
    at_ns, here, step = noted[0]
    there = never.at(np.array([at_ns]))
    imu_m = there.p_world_m[0] + there.R_world_body[0] @ run.config.sensors["imu"].mount.t_body_sensor_m
    moves_m = float(np.hypot(*(imu_m - here)[:2]))
    assert moves_m > 0.5  # else nothing is shown
    # Not all of it: by then fixes have been judged beside the match.
    assert np.hypot(*(here + step - imu_m)[:2]) < 0.15 * moves_m


def test_two_false_ones_that_agree_are_within_the_bounds_and_given_up_when_a_right_one_comes() -> None:
    """Two of them, 1.6 m off, after some seconds without any: four sigmas of what is predicted."""
    run = sparsely(simulate_slowly(replace(bl_scenario(1, "drift"), false_fraction=0.0, duration_s=32.0), 3))
    matches = run.recording.of(PoseFix)
    start_ns = int(run.truth.stamps_ns[0])
    silent = {m.seq for m in matches if 17.0 < (m.stamp_ns - start_ns) * 1e-9 < 21.0}
    false = {m.seq for m in matches if 21.0 < (m.stamp_ns - start_ns) * 1e-9 < 23.0}
    taken: list[Measurement] = []
    for m in run.recording.measurements:
        if isinstance(m, PoseFix) and m.seq in false:
            taken.append(replace(m, modes=tuple(replace(mode, value=mode.value + OFF) for mode in m.modes)))
        elif m.seq not in silent:
            taken.append(m)
    assert len(false) == 2
    track = replay(replace(run.recording, measurements=tuple(taken)), run.config).solution.trajectory
    true, at_s = run.truth.at(track.stamps_ns), (track.stamps_ns - start_ns) * 1e-9
    off = track.p_world_m - true.p_world_m
    assert track.cov is not None
    squared, misled = squared_over_covariance(off, track.cov), (at_s > 21.0) & (at_s < 23.3)
    assert np.hypot(*off[misled, :2].T).max() > 1.0  # else nothing is shown
    assert squared[misled].max() < 25.0
    assert np.hypot(*off[(at_s > 23.6) & (at_s < 30.0), :2].T).max() < 0.8
