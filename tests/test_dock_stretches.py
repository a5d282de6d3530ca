"""A stretch of a run that ends between two nodes of a dock's motion is solved without the node beyond."""

from graphloc import app
from graphloc.build import make_problem
from graphloc.eval.simulate import find_scenario, simulate
from graphloc.factors import INERTIAL, SENSORS
from graphloc.solve._align import align
from graphloc.solve._decide import decisions, weigh
from graphloc.solve._grow import grow, solve_start
from graphloc.solve._stretch import solve_stretch, weak_prior
from tests import tagfactory


def test_a_stretch_may_end_anywhere() -> None:
    less = {"imu_hz": "50", "gnss_hz": "2", "compass_hz": "4", "lidar_hz": "0", "camera_hz": "0"}
    true = simulate(find_scenario("dock-floating-optimal", {**less, "duration_s": "30", "route_s": "30"}), 1)
    run, _ = tagfactory.sighted(true, rate_hz=3.0)
    datum = app.choose_datum(run.recording, run.config)
    whole = app.with_synthetic(run.recording, run.config, datum)
    problem = make_problem(whole, app.seen_frames(run.config, whole), datum, SENSORS, INERTIAL)
    values, prior, known, *_ = solve_start(problem, align(problem), lambda *_: None)
    grow(problem, values, prior, known, lambda *_: None)
    last = len(problem.timeline) - 1
    seen = next(s for s in problem.streams if s.name == "tags")
    for stop in (int(k) for k in seen.state[len(seen.state) // 2 :][:6]):
        first = stop - 60
        verdicts = weigh(problem, values, first=first, last=stop, stage="final")
        assert any(v.at.slow_next is not None for key, v in verdicts.items() if key[0] == seen.number)
        start = weak_prior(problem, values, first)
        step = solve_stretch(problem, values, first, stop, start, decisions(verdicts))
        assert step.moved_m < 2.0  # as far as the weak prior lets it
    assert stop < last
