"""Bounds that hold also where what was believed of a sensor is false as a whole."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm

from graphloc import app
from graphloc.eval.metrics import compare_to_truth
from graphloc.eval.simulate import bl_scenario
from graphloc.frames import Array
from graphloc.frontends.aerial.matcher import Since
from graphloc.graph import Decision, FalseModel, Residual
from graphloc.measurements import Measurement, PoseFix
from graphloc.solution import Graded
from graphloc.solve import _solution
from graphloc.solve._doubt import ambiguity, doubt_of, probability_false, widening
from graphloc.solve._solution import _add_doubt
from graphloc.solve.batch import BatchResult
from tests.slowly import simulate_slowly

SECOND = 1_000_000_000
FAR_M2 = 1e12
SURE = replace(
    bl_scenario(1, "clean"), false_fraction=0.0, duration_s=30.0, imu_hz=50.0, gnss_hz=5.0, compass_hz=5.0
)  # fmt: skip
PLANE = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # residuals of position, by x, y and yaw


def turned(angle: float) -> Array:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def widened(cov: Array, more: Array, off: Array, spread: float, probability: float) -> Array:
    (turn,) = widening(cov[None], more[None], off[None], spread, np.array([probability]))
    return np.asarray(turn @ cov @ turn.T)


@pytest.mark.parametrize("probability", [0.01, 0.04, 0.1, 0.6])
@pytest.mark.parametrize("off_m", [0.0, 3.0])
def test_bounds_hold_for_95_percent_of_both_cases(probability: float, off_m: float) -> None:
    """Sigmas of 0.2 and 0.5 m; in the other case 2.0 and 1.5 m, and off along the first axis."""
    cov, other = np.diag([0.2, 0.5]) ** 2, np.diag([2.0, 1.5]) ** 2
    off = np.array([off_m, 0.0])
    found = widened(cov, other - cov, off, FAR_M2, probability)
    assert abs(found[0, 1]) < 1e-12
    for k, bound in enumerate(norm.ppf(0.975) * np.sqrt(np.diag(found))):
        inside = norm.cdf(bound, scale=np.sqrt(cov[k, k])) - norm.cdf(-bound, scale=np.sqrt(cov[k, k]))
        beside = norm(loc=off[k], scale=np.sqrt(other[k, k]))
        assert (1.0 - probability) * inside + probability * (beside.cdf(bound) - beside.cdf(-bound)) == pytest.approx(
            0.95, abs=1e-6
        )
    R = turned(0.7)
    np.testing.assert_allclose(
        widened(R @ cov @ R.T, R @ (other - cov) @ R.T, R @ off, FAR_M2, probability), R @ found @ R.T, atol=1e-9
    )


def test_what_is_certain_stays_as_it_is() -> None:
    cov = np.array([[0.2, 0.05], [0.05, 0.1]])
    np.testing.assert_allclose(widened(cov, np.eye(2) * 100.0, np.ones(2), FAR_M2, 0.0), cov, atol=1e-9)
    np.testing.assert_allclose(widened(cov, np.zeros((2, 2)), np.zeros(2), FAR_M2, 0.5), cov, atol=1e-9)


def test_nowhere_is_the_vessel_farther_off_than_false_ones_are() -> None:
    """A run without the sensor that knows nothing (sigma 10 km, 300 m off): the false ones are 5 m off, and so may the vessel be."""
    cov = np.diag([0.04, 0.01])
    limited = widened(cov, np.eye(2) * 1e8, np.array([300.0, -100.0]), 25.0, 0.2)
    np.testing.assert_allclose(limited, widened(cov, np.eye(2) * 25.0, np.zeros(2), FAR_M2, 0.2), rtol=1e-3)


def residual(raw: Array, prior: float = 0.5, sigma: float = 0.3) -> Residual:
    along = np.zeros((2, 6))
    along[:, 3:5] = np.eye(2)
    return Residual(raw=raw, cov=np.eye(2) * sigma**2, jacobian=lambda: along, prior=prior, size_m=None, size_deg=None)


def model(news: float) -> FalseModel:
    return FalseModel(probability=0.2, cov=np.eye(2) * 25.0, repeats=0.5, news=news)


def test_each_is_judged_by_the_run_without_its_sensor() -> None:
    """Two modes 4 m apart, and one of them twice, around a prediction good to 2 m."""
    P = np.eye(2) * 4.0
    modes = (
        residual(np.array([0.5, 0.0]), 0.3),
        residual(np.array([4.5, 0.0]), 0.4),
        residual(np.array([0.6, 0.1]), 0.1),
    )
    density = [m.prior * multivariate_normal(np.zeros(2), m.cov + P).pdf(m.raw) for m in modes]
    false = 0.2 * sum(
        m.prior / 0.8 * multivariate_normal(np.zeros(2), m.cov + P + np.eye(2) * 25.0).pdf(m.raw) for m in modes
    )
    for chosen, right in ((0, density[0] + density[2]), (1, density[1]), (2, density[0] + density[2])):
        expected = 1.0 - right / (sum(density) + false)
        assert probability_false(modes, P, model(0.1), chosen, PLANE, slice(0, 2)) == pytest.approx(expected)
    alike = 1.0 - sum(density) / (sum(density) + false)  # all have one heading, which none of them measures
    assert probability_false(modes, P, model(0.1), 0, PLANE, slice(2, 3)) == pytest.approx(alike)


def test_a_row_of_boats_leaves_the_place_open_but_not_the_heading() -> None:
    """Two modes a berth apart with one heading, seen 2 m ahead of the body, and a third that is turned by 20 deg."""
    by_plane = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 2.0], [0.0, 0.0, 1.0]])
    noise, P = np.diag([0.2, 0.2, 0.01]) ** 2, np.diag([2.0, 2.0, 0.2]) ** 2

    def mode(raw: list[float], prior: float) -> Residual:
        return replace(residual(np.zeros(2), prior), raw=np.array(raw), cov=noise)

    wide = FalseModel(probability=0.1, cov=np.diag([5.0, 5.0, 0.1]) ** 2, repeats=0.5, news=0.1)
    modes = (mode([0.0, 0.0, 0.0], 0.4), mode([4.0, 0.0, 0.005], 0.4), mode([0.0, 0.7, 0.35], 0.1))
    density = np.array([m.prior * multivariate_normal(np.zeros(3), noise + P).pdf(m.raw) for m in modes])
    false = 0.1 * sum(m.prior / 0.9 * multivariate_normal(np.zeros(3), noise + P + wide.cov).pdf(m.raw) for m in modes)
    # Turned about the body, the third is at the same place, and what the sensor sees 2 m ahead 0.7 m beside.
    for axes, alike in ((slice(0, 2), [0, 2]), (slice(2, 3), [0, 1])):
        expected = 1.0 - density[alike].sum() / (density.sum() + false)
        assert probability_false(modes, P, wide, 0, by_plane, axes) == pytest.approx(expected)


def doubts(news: Array, false: Array, weights: Array, sigmas: Array) -> Any:
    verdicts: list[Any] = [
        SimpleNamespace(weight=w, decision=Decision() if w else None, residual=residual(np.zeros(2), sigma=s))
        for w, s in zip(weights, sigmas, strict=True)
    ]
    places = [PLANE[:, :2]] * len(news)
    return doubt_of(np.arange(len(news)) * SECOND, false, [model(n) for n in news], verdicts, places)


def test_of_many_that_repeat_each_other_all_are_false_together() -> None:
    """However many there are; what a measurement tells anew, its neighbours have shown right or wrong."""
    count, ones = 40, np.ones(40)
    for news in (0.05, 0.5, 1.0):
        found = doubts(np.full(count, news), np.full(count, 0.3), ones, ones)
        np.testing.assert_allclose(found.probability, 0.3 * (1.0 - news))
    assert found.spread == pytest.approx(25.0)


def test_their_errors_are_as_alike_as_the_matcher_says() -> None:
    """Along a path they are by exp(-way); the first is all news, counts as if alone, and is as false as those that repeat it."""
    way = np.random.default_rng(0).uniform(0.05, 1.5, 12)
    along, false, sigmas = np.cumsum(way), np.linspace(0.1, 0.6, 12), np.linspace(0.3, 2.0, 12)
    news = np.array([1.0, *(Since(w, 1.0).news for w in way[1:])])
    says = np.exp(-np.abs(along[:, None] - along)) / sigmas**2
    shared = 1.0 - np.minimum(news, [*news[1:], 1.0])
    found = doubts(news, false, np.ones(12), sigmas)
    np.testing.assert_allclose(found.probability, says @ (false * shared) / says.sum(axis=1))
    tight = doubts(np.array([1.0, *[0.05] * 39]), np.full(40, 0.3), np.ones(40), np.array([0.1, *[0.45] * 39]))
    np.testing.assert_allclose(tight.probability, 0.3 * 0.95)


def test_only_what_determines_the_position_is_in_doubt() -> None:
    """Ten doubtful ones, then ten others that have no error in common with these; loose ones, and refused ones, count for nothing."""
    count = 20
    news, false = np.full(count, 0.01), np.where(np.arange(count) < 10, 0.4, 0.0)
    news[10] = 0.999
    found = doubts(news, false, np.ones(count), np.ones(count)).probability
    np.testing.assert_allclose(found[:10], 0.4 * 0.99, rtol=2e-3)
    assert found[10:].max() < 1e-3
    far_off = np.where(np.arange(count) % 2, 0.9, 0.1)
    loose = doubts(np.full(count, 0.01), far_off, np.ones(count), np.where(np.arange(count) % 2, 100.0, 1.0))
    refused = doubts(np.full(count, 0.01), far_off, np.where(np.arange(count) % 2, 0.0, 1.0), np.ones(count))
    for few in (loose, refused):
        np.testing.assert_allclose(few.probability, 0.1 * 0.99, rtol=2e-3)
    assert doubts(np.full(count, 0.01), far_off, np.zeros(count), np.ones(count)) is None


def test_ambiguity_at_the_end_of_a_run_is_said() -> None:
    over_time = np.repeat([0.0, 0.04, 0.2, 0.3], [40, 20, 30, 10])
    (line,) = ambiguity("aerial", "position", over_time)
    assert "probability of 20%" in line
    assert "for 40% of the run" in line
    assert not ambiguity("aerial", "position", np.repeat([0.04, 0.2], [91, 9]))  # it is short


def watch(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Array, Array]]:
    """Return the covariances of each solution before and after they are widened, as they come."""
    covs, widen = list[tuple[Array, Array]](), _solution.widen_by_doubt

    def watched(result: BatchResult, cov: Array) -> list[str]:
        before = cov.copy()
        lines = widen(result, cov)
        covs.append((before, cov.copy()))
        return lines

    monkeypatch.setattr(_solution, "widen_by_doubt", watched)
    return covs


def test_matches_that_are_all_a_berth_off_leave_the_vessel_within_its_bounds(monkeypatch: pytest.MonkeyPatch) -> None:
    """All take one boat for the next, 3.4 m off, where GNSS is good to 2 m; they say themselves that half of such are false."""
    run = simulate_slowly(SURE, 3, rate_hz=2.5)

    def a_berth_off(news: float) -> Any:
        def moved(m: Measurement) -> Measurement:
            if not isinstance(m, PoseFix):
                return m
            (mode,) = m.modes
            berth = replace(mode, value=mode.value + np.array([3.0, 1.6, 0.0]), cov=mode.cov / news, probability=0.5)
            return replace(m, modes=(berth,), news=news)

        return moved

    covs = watch(monkeypatch)
    inside, said = {}, {}
    for news in (0.03, 1.0):
        solution = app.smooth_recording(run.recording.changed(a_berth_off(news)), run.config).solution
        metrics = compare_to_truth(solution.trajectory, run.truth)
        assert metrics.position_rmse_m > 2.0
        assert metrics.coverage_95 is not None
        inside[news] = metrics.coverage_95
        said[news] = [line for line in solution.stats.warnings if "ambiguous" in line]
    assert inside[0.03] > 0.95
    assert inside[1.0] < 0.2  # independent, they confirm each other
    assert [aspect in line for aspect, line in zip(("position", "heading"), said[0.03], strict=True)] == [True, True]
    assert all("for 100% of the run" in line for line in said[0.03])
    assert all(isinstance(line, Graded) for line in said[0.03])  # each leg of a long run has its own figure
    assert not said[1.0]
    (narrow, wide), (same, as_it_was) = covs
    np.testing.assert_array_equal(same, as_it_was)
    assert np.linalg.eigvalsh((wide - narrow)[:, :2, :2]).min() > 0.5
    assert (wide - narrow)[:, 5, 5].min() > 0.0
    wide[:, :2, :2], wide[:, 5, 5] = narrow[:, :2, :2], narrow[:, 5, 5]
    np.testing.assert_array_equal(wide, narrow)  # so the arm between heading and place is what it was


@pytest.mark.parametrize(("news", "wider"), [(0.3, (1.0, 1.3)), (0.03, (4.0, 50.0))])
def test_what_agrees_over_a_long_way_is_not_in_doubt(
    news: float, wider: tuple[float, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without GNSS, matches of which each says that it may be false: 18 lengths of correlation that the IMU ties together, or two."""
    run = simulate_slowly(SURE, 3, rate_hz=2.5)

    def doubtful(m: Measurement) -> Measurement:
        if not isinstance(m, PoseFix):
            return m
        return replace(
            m, modes=tuple(replace(mode, cov=mode.cov / news, probability=0.8) for mode in m.modes), news=news
        )

    covs = watch(monkeypatch)
    recording = run.recording.changed(doubtful)
    alone = replace(recording, measurements=tuple(m for m in recording.measurements if m.sensor != "gnss"))
    app.smooth_recording(alone, run.config)
    ((narrow, wide),) = covs
    assert wider[0] <= np.median(np.sqrt(wide[:, 0, 0] / narrow[:, 0, 0])) <= wider[1]


def test_a_run_stands_where_its_doubt_cannot_be_reckoned(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(_result: BatchResult, _cov: Array) -> list[str]:
        raise np.linalg.LinAlgError("not positive definite")

    monkeypatch.setattr(_solution, "widen_by_doubt", fails)
    result: Any = None
    (said,) = _add_doubt(result, np.eye(6)[None])
    assert "do not include that believed poses may be false together" in said
