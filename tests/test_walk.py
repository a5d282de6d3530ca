# SPDX-License-Identifier: Apache-2.0
"""A slow error walks between its nodes: fixes good to centimetres do not tell the speed to centimetres a second."""

from dataclasses import replace

import numpy as np
import pytest

from graphloc.build import spacing_s, walk_between_nodes
from graphloc.config import GnssConfig
from graphloc.eval.metrics import compare_to_truth
from graphloc.eval.simulate import Scenario, bl_scenario, simulate
from graphloc.factors.gnss import ROW as GNSS
from graphloc.frames import Datum
from graphloc.graph import Decision, Residual, SlowProcess
from graphloc.judge.decide import Verdict
from graphloc.measurements import GnssPosition, world_from_fixes
from graphloc.online._entries import Entry
from graphloc.online._live import LiveStream
from graphloc.replay import replay
from graphloc.time import NS_PER_S
from tests.slowly import simulate_slowly

SLOW = SlowProcess(
    name="error", axes=("east", "offset"), units=("m", "m"), scale=np.ones(2), sigma=np.array([2.0, 1.0]),
    time_constant_s=np.array([200.0, np.inf]),
)  # fmt: skip


@pytest.mark.parametrize("n", [2, 5, 10])
def test_the_mean_of_those_at_one_node_is_off_by_what_it_has_walked_since_the_first(n: int) -> None:
    """A random walk of 0.04 m^2/s; its first reading is where the node is."""
    rng = np.random.default_rng(5)
    steps = rng.normal(0.0, np.sqrt(0.04 / n), (200_000, n - 1))
    walked = np.hstack([np.zeros((len(steps), 1)), np.cumsum(steps, axis=1)])
    share, constant = walk_between_nodes(SLOW, 1.0, 1.0 / n)
    assert share / n == pytest.approx(walked.mean(axis=1).var(), rel=0.02)
    assert constant == 0.0


@pytest.mark.parametrize("apart_s", [1.0, 4.0, np.inf])
def test_one_at_each_node_is_where_the_node_is(apart_s: float) -> None:
    assert walk_between_nodes(SLOW, 1.0, apart_s) == pytest.approx(0.0)


def test_bounds_hold_beside_fixes_good_to_centimetres_that_walk() -> None:
    """By 0.15 m in a second, which is less than is expected of them (0.2 m)."""
    scenario: Scenario = replace(
        bl_scenario(1, "clean"),
        duration_s=60.0,
        imu_hz=50.0,
        gnss_hz=5.0,
        compass_hz=1.0,
        gnss_sigma_m=0.03,
        false_fraction=0.0,
    )
    run = simulate_slowly(scenario, 4, rate_hz=2.5)
    rng, walked, fixes = np.random.default_rng(6), np.zeros(3), []
    datum = Datum(next(m.position for m in run.recording.of(GnssPosition)))
    for m in run.recording.measurements:
        if isinstance(m, GnssPosition):
            walked = walked + rng.normal(0.0, 0.15 / np.sqrt(5.0), 3)
            place = datum.geodetic_from_enu(world_from_fixes([m], datum) + walked)[0]
            m = replace(m, position=type(m.position)(*place))
        fixes.append(m)
    track = replay(replace(run.recording, measurements=tuple(fixes)), run.config).solution.trajectory
    found = compare_to_truth(track, run.truth)
    assert found.nees is not None
    assert found.nees < 4.0  # 2 when true


@pytest.mark.parametrize("burst", [1, 2, 5, 20])
def test_fixes_in_bursts_tell_as_much_as_evenly_spaced_ones(burst: int) -> None:
    """10 Hz on average. By the time between two of them, those of a burst of five would weigh a fortieth."""
    came = np.arange(400)
    stamps_ns = np.rint(((came // burst) * burst * 0.1 + (came % burst) * 0.002) * 1e9).astype(np.int64)
    apart_s = spacing_s(stamps_ns)[100:]
    white_m2 = 0.2**2
    told = np.array([1.0 / (white_m2 + walk_between_nodes(SLOW, 1.0, float(each_s))[0]) for each_s in apart_s])
    even = 1.0 / (white_m2 + walk_between_nodes(SLOW, 1.0, 0.1)[0])
    assert told.mean() == pytest.approx(even, rel=0.05)


def test_how_far_apart_fixes_are_does_not_depend_on_the_order_of_arrival() -> None:
    """10 Hz, each up to 2 s late: beside one that has just come every second one or so is still missing."""
    fixes = [m for m in simulate(bl_scenario(1, "drift"), 0).recording.measurements if isinstance(m, GnssPosition)][
        :200
    ]
    late = np.arange(len(fixes)) * 0.1 + np.random.default_rng(3).uniform(0.0, 2.0, len(fixes))
    spaced = []
    for order in (range(len(fixes)), np.argsort(late)):
        stream = LiveStream(0, "gnss", GNSS, GnssConfig(), SLOW, None, (), None)
        for i in order:
            stream.measurements.append(fixes[i])
            stream.space()
        spaced.append({stream.measurements[k].stamp_ns: stream.apart_s[k] for k in range(len(fixes))})
    assert spaced[1] == spaced[0]
    assert list(spaced[0].values()) == pytest.approx([np.inf, *[0.1] * (len(fixes) - 1)])


def test_slow_fixes_are_not_silent() -> None:
    """Every 5 s: a receiver that resolves its ambiguities anew after 2 s without RTK would do so at each of them."""
    fixes = [m for m in simulate(bl_scenario(1, "drift"), 0).recording.measurements if isinstance(m, GnssPosition)]
    stream = LiveStream(0, "gnss", GNSS, GnssConfig(), replace(SLOW, anew_after_s=2.0), None, (), None)
    for k in range(6):
        stream.measurements.append(replace(fixes[0], stamp_ns=k * 5 * NS_PER_S))
        stream.space()
        stream.told_ns = k * 5 * NS_PER_S
    assert not stream.drawn_anew(stream.told_ns + 6 * NS_PER_S)
    assert stream.drawn_anew(stream.told_ns + 16 * NS_PER_S)


def test_a_factor_is_replaced_where_the_walk_of_its_fix_turns_out_to_be_another() -> None:
    def verdict(variance_m2: float) -> Verdict:
        residual = Residual(
            raw=np.zeros(3), cov=np.eye(3) * variance_m2, jacobian=lambda: np.zeros((3, 6)), prior=1.0, size_m=None,
            size_deg=None,
        )  # fmt: skip
        return Verdict(Decision(), 1.0, 1.0, residual, 0, None)  # type: ignore[arg-type]

    entry = Entry(LiveStream(0, "gnss", GNSS, GnssConfig(), SLOW, None, (), None), 0, verdict(1.0))
    assert entry.weighs_other(verdict(1.3))
    assert entry.weighs_other(verdict(0.7))
    assert not entry.weighs_other(verdict(1.05))
