"""Right or false: the chain of hypotheses against enumeration, and choices that confirm themselves."""

from dataclasses import replace
from itertools import product
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from graphloc import app
from graphloc.eval.metrics import compare_to_truth
from graphloc.eval.simulate import bl_scenario
from graphloc.frames import Array
from graphloc.graph import FalseModel, Residual
from graphloc.judge.best_chain import best_chain
from graphloc.judge.decide import Verdict, by_hypotheses
from graphloc.judge.hypotheses import FalseSequence
from graphloc.judge.prediction import Prediction
from graphloc.judge.warnings import joint_rejection_warning
from graphloc.measurements import Measurement, PoseFix
from graphloc.replay import replay
from tests.slowly import simulate_slowly, sparsely

SIGMA_M = 0.2


@pytest.fixture(params=["all in the estimate", "some new"])
def sequence(request: pytest.FixtureRequest) -> FalseSequence:
    rng = np.random.default_rng(2)
    right, fresh = rng.normal(-1.0, 2.0, (2, 7)), rng.normal(-1.5, 1.0, (2, 7))
    repeated = np.concatenate([fresh[:, :1], fresh[:, 1:] + rng.normal(0.0, 2.0, (2, 6))], axis=1)
    new = np.array([False, False, True, False, True, True, True]) & (request.param == "some new")
    return FalseSequence(right, fresh, repeated, new, np.ones(7))


def log_joint(s: FalseSequence, false: tuple[bool, ...]) -> float:
    total, seen = 0.0, 0  # whether a new one was right before
    for n, is_false in enumerate(false):
        repeated = n > 0 and false[n - 1]
        total += (s.repeated[seen, n] if repeated else s.fresh[seen, n]) if is_false else s.right[seen, n]
        seen |= int(s.new[n] and not is_false)
    return float(total)


def test_posterior_is_that_of_all_128_sequences(sequence: FalseSequence) -> None:
    paths = list(product((False, True), repeat=7))
    logs = np.array([log_joint(sequence, p) for p in paths])
    weights = np.exp(logs - logs.max())
    right = np.array([[not f for f in p] for p in paths])
    np.testing.assert_allclose(sequence.posterior(), weights @ right / weights.sum(), atol=1e-12)
    assert sequence.log_evidence() == pytest.approx(np.logaddexp.reduce(logs))
    # Of what is no news nothing counts: the last three, then the rest of it.
    upto = np.array([log_joint(cut(sequence, 4), p) for p in product((False, True), repeat=4)])
    unheard = replace(sequence, news=np.array([1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0]))
    assert unheard.log_evidence() == pytest.approx(np.logaddexp.reduce(upto))


def cut(s: FalseSequence, count: int) -> FalseSequence:
    """The first of a sequence."""
    return FalseSequence(s.right[:, :count], s.fresh[:, :count], s.repeated[:, :count], s.new[:count], s.news[:count])


def stream_of(offsets: Array, repeats: float = 0.5, news: float = 1.0) -> tuple[Any, range, list[tuple[Residual, ...]]]:
    """A stream of matches at 1 Hz whose residuals lie at `offsets` (N, 2), m."""
    model = FalseModel(probability=0.4, cov=np.eye(2) * 25.0, repeats=repeats, news=news)
    measurements = [SimpleNamespace(stamp_ns=n * 1_000_000_000) for n in range(len(offsets))]
    stream = SimpleNamespace(row=SimpleNamespace(false=lambda *_: model), config=None, measurements=measurements)
    cov = np.eye(2) * SIGMA_M**2
    found: list[tuple[Residual, ...]] = [
        (Residual(raw=o, cov=cov, jacobian=lambda: np.zeros((2, 6)), prior=0.6, size_m=None, size_deg=None),)
        for o in offsets
    ]
    return stream, range(len(found)), found


def test_the_longest_slow_offset_is_the_right_one() -> None:
    """60 % false, five of them in one place: what lies along one slowly moving offset, 4 m away, is right."""
    rng = np.random.default_rng(4)
    count = 40
    drift = np.column_stack([3.0 + 0.02 * np.arange(count), np.full(count, -3.0)])
    offsets = drift + rng.normal(0.0, SIGMA_M, (count, 2))
    false = np.sort(rng.choice(count, 24, replace=False))
    offsets[false] += rng.uniform(-5.0, 5.0, (24, 2)) + np.sign(rng.normal(size=(24, 2)))
    offsets[10:15] = rng.normal(0.0, 0.05, (5, 2))  # where the estimate is: they confirm each other, and it
    expected = [n not in {*false.tolist(), *range(10, 15)} for n in range(count)]
    found = [mode is not None for mode in best_chain(*stream_of(offsets))]
    assert sum(a != b for a, b in zip(found, expected, strict=True)) <= 1


def test_a_loose_prediction_believes_but_one_of_two_that_contradict_each_other() -> None:
    """Two tags in each image, one of a wrong size: 6 m apart at first and less as the vessel comes in, mostly within bounds."""
    rng, count = np.random.default_rng(6), 20
    right = np.column_stack([np.full(count, -1.0), 0.5 - 0.02 * np.arange(count)])  # what the prediction is off
    wrong = right + np.column_stack([6.0 - 0.25 * np.arange(count), np.zeros(count)])
    offsets = np.stack([right, wrong], axis=1).reshape(-1, 2) + rng.normal(0.0, SIGMA_M, (2 * count, 2))
    stream, indices, residuals = stream_of(offsets)
    for n, m in enumerate(stream.measurements):
        m.stamp_ns = n // 2 * 1_000_000_000
    verdicts = judged(stream, indices, residuals, [Prediction(np.eye(2) * 2.0, 4.0) for _ in offsets])
    weights = np.array([v.weight for v in verdicts]).reshape(-1, 2)
    assert weights[:, 0].min() > 0.9
    assert weights[:, 1].max() == 0.0
    assert all(v.decision is None for v in verdicts[1::2])


def judged(
    stream: Any, indices: range, residuals: list[tuple[Residual, ...]], predictions: list[Prediction | None]
) -> list[Verdict]:
    stream.row.one_likelihood = False
    at: Any = None
    return by_hypotheses(stream, list(indices), [at] * len(residuals), residuals, predictions)


def test_right_ones_after_a_hole_are_no_repeated_false_one() -> None:
    """The prediction is good to 20 m and 15 m off; every third match is false."""
    rng, count = np.random.default_rng(7), 20
    offsets = np.array([12.0, -9.0]) + rng.normal(0.0, SIGMA_M, (count, 2))
    false = np.arange(count) % 3 == 1
    offsets[false] += rng.uniform(2.0, 5.0, (int(false.sum()), 2))
    verdicts = judged(*stream_of(offsets), [Prediction(np.eye(2) * 20.0, 30.0) for _ in offsets])
    weights = np.array([v.weight for v in verdicts])
    assert weights[~false].min() > 0.9
    assert weights[false].max() < 0.1


@pytest.mark.parametrize(("news", "believed"), [(1.0, 6.0), (0.02, 0.0)])
def test_a_row_of_boats_outvotes_the_prediction_only_where_each_is_news(news: float, believed: float) -> None:
    """Thirty scans a second apart look right 6 m off, ten where the prediction, good to 2 m, has the vessel."""
    offsets = np.array([[6.0, 0.0] if n % 4 else [0.0, 0.0] for n in range(40)])
    stream, indices, found = stream_of(offsets, news=news)
    chain = best_chain(stream, indices, found, [Prediction(np.eye(2) * 2.0, 1e6)] * 40)
    assert {offsets[n, 0] for n, mode in enumerate(chain) if mode is not None} == {believed}


def test_what_repeats_far_outside_the_prediction_is_false() -> None:
    """Five that agree with each other, 5 m off where the prediction is good to 0.7 m: each later one alone would do."""
    offsets = np.array([4.0, 3.0]) + np.random.default_rng(8).normal(0.0, 0.05, (5, 2))
    verdicts = judged(*stream_of(offsets), [Prediction(np.eye(2) * 0.7, 4.0) for _ in offsets])
    assert max(v.weight for v in verdicts) < 0.1


def test_a_heading_that_is_loose_moves_what_is_ahead_and_abeam_apart() -> None:
    """30 m ahead and 30 m abeam, heading 6 deg off and good to 5: residuals of 3 m across each, one error."""
    off_rad = np.radians(6.0)
    arms = np.array([[0.0, 30.0], [-30.0, 0.0]] * 5)  # d raw / d heading
    offsets = arms * off_rad + np.random.default_rng(9).normal(0.0, SIGMA_M, (10, 2))
    predictions: list[Prediction | None] = [
        Prediction(np.column_stack([np.eye(2) * 0.3, arm * np.radians(5.0)])) for arm in arms
    ]  # place and heading
    assert min(v.weight for v in judged(*stream_of(offsets), predictions)) > 0.9


def test_what_a_loose_velocity_moves_apart_is_no_contradiction() -> None:
    """At a start, two sightings 1 s apart: known to 3 m and 6 m/s, they may differ by 5 m; known to 0.1 m/s, they may not."""
    offsets = np.array([[-2.0, 0.0], [3.0, 0.0]])
    for lasts_s, both in ((3.0 / 6.0, True), (3.0 / 0.1, False)):
        verdicts = judged(*stream_of(offsets), [Prediction(np.eye(2) * 3.0, lasts_s) for _ in offsets])
        assert (min(v.weight for v in verdicts) > 0.4) == both


def test_nothing_but_noise_makes_no_long_chain() -> None:
    offsets = np.random.default_rng(1).uniform(-5.0, 5.0, (30, 2))
    assert sum(mode is not None for mode in best_chain(*stream_of(offsets))) <= 5


def test_false_matches_that_repeat_do_not_bend_the_track() -> None:
    """Five equal ones at the start, six at the end."""
    run = sparsely(simulate_slowly(bl_scenario(3, "drift"), 4, rate_hz=1.25))
    assert compare_to_truth(app.simulated(run).solution.trajectory, run.truth).position_rmse_m < 0.2


def test_matches_that_are_refused_together_are_reported() -> None:
    """For 20 s all say 15 m beside: so many are not false by chance. Usual ones, 40 % of them, are not said."""
    run = sparsely(
        simulate_slowly(
            replace(bl_scenario(1, "clean"), duration_s=42.0, imu_hz=50.0, gnss_hz=5.0, compass_hz=5.0), 3, rate_hz=1.25
        )
    )
    begin_ns = int(run.truth.stamps_ns[0]) + 15_000_000_000

    def beside(m: Measurement) -> Measurement:
        if not isinstance(m, PoseFix) or not 0 <= m.stamp_ns - begin_ns < 20_000_000_000:
            return m
        return replace(m, modes=tuple(replace(mode, value=mode.value + np.array([15.0, 0.0, 0.0])) for mode in m.modes))

    recording = run.recording.changed(beside)
    said = {
        "usual": app.simulated(run).solution.stats.warnings,
        "batch": app.smooth_recording(recording, run.config).solution.stats.warnings,
        "online": replay(recording, run.config).solution.stats.warnings,
    }
    assert not any("are rejected" in line for line in said["usual"])
    for mode in ("batch", "online"):
        (line,) = (line for line in said[mode] if line.startswith("matcher: all ") and "are rejected" in line)
        assert 18 <= int(line.split(" all ")[1].split()[0]) <= 24, line


def test_few_or_brief_ones_are_no_news() -> None:
    stamps_ns, weights = np.arange(40) * 1_000_000_000, np.ones(40)
    weights[10:17] = 0.0
    rare, usual = np.full(40, 0.02), np.full(40, 0.4)
    assert joint_rejection_warning("tags", stamps_ns, weights, rare)
    assert not joint_rejection_warning("matcher", stamps_ns, weights, usual)  # 0.4 ** 7 * 40 is 0.07
    assert not joint_rejection_warning("tags", stamps_ns // 10, weights, rare)  # within 0.6 s
    assert not joint_rejection_warning("tags", stamps_ns, np.zeros(40), rare)  # all: said otherwise
    doubtful = np.where(weights > 0.5, 0.02, 0.9)
    assert not joint_rejection_warning("matcher", stamps_ns, weights, doubtful)  # so they said themselves
    brief = np.concatenate([stamps_ns, stamps_ns[-1] + 1 + np.arange(30) * 1_000_000])
    (line,) = joint_rejection_warning("tags", brief, np.append(weights, np.zeros(30)), np.full(70, 0.02))
    assert "all 7 measurements in the 6 s" in line  # 30 more within 30 ms are no longer row


def test_long_outage_does_not_lock_the_matches_out() -> None:
    """After 40 s without fixes and matches the prediction is metres off: the returning matches are believed."""
    scenario = replace(bl_scenario(1, "drift"), duration_s=100.0, outage_s=(40.0, 80.0))
    run = sparsely(simulate_slowly(scenario, 5, rate_hz=1.25))
    solution = app.simulated(run).solution
    after = run.truth.stamps_ns[(run.truth.stamps_ns - run.truth.stamps_ns[0]) > 90_000_000_000]
    error = solution.trajectory.at(after[:-200]).p_world_m - run.truth.at(after[:-200]).p_world_m
    assert float(np.hypot(error[:, 0], error[:, 1]).max()) < 1.0
