# SPDX-License-Identifier: Apache-2.0
"""The start: wait until position and heading are observable, then solve the data so far with the batch solver.

The window then begins at the first data, with the prior of the start, linearised at the solution. So the choice of
modes of matches stays open as long as these are in the window. If the start had to wait for much longer than the window
is (for a heading from travel alone), the window begins its own length before the newest data, with the prior that all
earlier data give for the state there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

import gtsam
import numpy as np

from graphloc import keys, origin
from graphloc.build import Made, Problem, build_graph, company_of, make_problem
from graphloc.errors import GraphlocError, SolveError
from graphloc.frames import Array, Datum
from graphloc.judge.covariances import ANY_HEADING_RAD, Unmodelled, world_covariance
from graphloc.judge.decide import AGREES, decisions
from graphloc.judge.imu_noise import LARGEST_NOISE_SCALE
from graphloc.judge.ledger import row_of
from graphloc.ledger import LedgerRow
from graphloc.measurements import ImuSeries, Measurement
from graphloc.online._anchor import Anchor
from graphloc.online._setup import Setup
from graphloc.online._unmeasured_heading import DOUBTFUL_RAD, UnmeasuredHeading
from graphloc.online._unmodelled import BeforeStart
from graphloc.recording import Recording
from graphloc.signals.rates_in_degrees import swing_of_degrees
from graphloc.solve.alignment import wanted_travel_m
from graphloc.solve.batch import BatchResult, solve_batch
from graphloc.solve.imu_mount import followed_before
from graphloc.solve.stretch import StretchStep, past_at
from graphloc.solve.unmodelled import unmodelled
from graphloc.solve.warnings import noise_warnings
from graphloc.time import duration_ns

LEAST_S = 5.0  # of IMU data: enough for the gyroscope's bias, roll and pitch of a vessel in waves
# Longest wait for a heading from travel alone, or an IMU that fits; then a position with a doubtful heading is better
# than none.
_LONGEST_WAIT_S = 30.0
# Probability of being false, above which several measurements must agree; that of tags and poses is smaller
_DOUBTFUL = 0.1
# Fewest, and least share, of them that must agree; longest wait for that. Two false matches of five may agree with each
# other.
_AGREEING, _SHARE, _CHOICE_WAIT_S = 3, 0.4, 15.0
# Length of the data, in windows, up to which the window begins at the first data: so a little delay changes nothing
_WHOLE = 1.5
_FIXES = 3  # fewest fixes to set a datum


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Started:
    """A solved start.

    Attributes:
        datum: origin of world.
        anchor: first state of the window, with its prior; later measurements are not in it, as the window judges them
            again.
        pose, velocity, bias: of the first state, as solved, at the IMU with the body's axes, in world: gtsam.Pose3,
            (3,) m/s, (6,) accelerometer first.
        heights_m: configured heights (m, up in world), by sensor.
        heading: how far the heading may be off where no sensor measures it; None: one does, or the motion told it.
        noise_scale: factor on all of the IMU's noise. gyro_noise, accel_noise: further factors on the noise of each.
        bias_walk: factors on the walk of the biases of accelerometers and of gyroscopes.
        sensor_noise: factors on sigmas of other sensors, by sensor and key of its configuration.
        before: effect of left-out slow errors and of the IMU's mount on the first state; None: none is known.
        notes: what the alignment was based on. warnings: on noise that is taken to be larger than configured.
        rows: ledger rows of the measurements before the first state.
    """

    datum: Datum
    anchor: Anchor
    pose: gtsam.Pose3
    velocity: Array
    bias: Array
    heights_m: Mapping[str, float]
    heading: UnmeasuredHeading | None
    noise_scale: float
    gyro_noise: float
    accel_noise: float
    bias_walk: tuple[float, float]
    sensor_noise: Mapping[str, Mapping[str, float]]
    before: BeforeStart | None
    notes: tuple[str, ...]
    warnings: tuple[str, ...]
    rows: tuple[LedgerRow, ...]


def try_start(
    setup: Setup,
    imu: ImuSeries,
    measurements: Sequence[Measurement],
    datum: Datum | None,
    near_rad: float | None = None,
) -> Started | str:
    """Return the start, or in words what it waits for.

    Args:
        setup: of the online mode. imu, measurements: the data so far. datum: origin of world; None: it is to be chosen.
        near_rad: yaw at the first sample, about, where later motion told it: the only candidate; None: all are tried.
    """
    config = setup.config
    span_s = float(imu.stamps_ns[-1] - imu.stamps_ns[0]) * 1e-9 if len(imu) else 0.0
    if span_s < LEAST_S:
        return f"{LEAST_S:g} s of IMU data"
    told = setup.imu is None or setup.imu.gyro_unit == "rad/s"  # else a user has said that they are as large
    if told and span_s < _LONGEST_WAIT_S and (swing := swing_of_degrees(imu.stamps_ns, imu.accel_mps2, imu.gyro_radps)):
        return f"IMU data that a vessel can have: it rolls and pitches by {np.degrees(swing):.0f} deg within 5 s: rates in deg/s?"
    recording = Recording(
        source="(online)",
        imu=imu,
        measurements=tuple(sorted(measurements, key=lambda m: (m.stamp_ns, m.seq))),
        mounts=setup.mounts,
        topics={name: sensor.topic for name, sensor in config.sensors.items()},
    )
    if datum is None and config.datum is None and len(origin.fixes_of(recording)) < _FIXES:
        return f"{_FIXES} GNSS fixes to set the origin, as no `datum:` is configured"
    try:
        datum = datum or origin.choose_datum(recording, config, setup.rows)
        if config.datum is not None:
            origin.refuse_far_fixes(recording, datum)
    except GraphlocError as error:
        return str(error)
    missing, told = _missing(setup, recording, datum, patient=span_s >= _LONGEST_WAIT_S)
    if missing:
        return missing
    try:
        return _solved(setup, recording, datum, told=told, near_rad=near_rad)
    except SolveError as error:
        return f"data from which the start can be solved: {error}"


def _missing(setup: Setup, recording: Recording, datum: Datum, *, patient: bool) -> tuple[str, bool]:
    """Return what position or heading still needs (empty: nothing), and whether sensors or travel tell the heading.

    Args:
        patient: whether travel was waited for long enough. Less of it will do then: a craft that circles within a small
            place gets a position, and its heading is a guess.
    """
    hints = [setup.hint(m, datum) for m in recording.measurements]
    placed = [k for k, h in enumerate(hints) if np.isfinite(h.p_world_m[:2]).all()]
    places = [hints[k] for k in placed]
    if not places:
        return "a position: a fix, a match, a tag or a pose", False
    if setup.config.start.heading_deg is not None or any(np.isfinite(h.yaw_rad) for h in hints):
        return "", True
    p = np.array([h.p_world_m[:2] for h in places])
    names = [recording.measurements[k].sensor for k in placed]
    kinds = {row.kind: row for row in setup.rows}
    noises = []
    for name in dict.fromkeys(names):
        config = setup.config.sensors[name]
        sigma_m = np.array([h.p_sigma_m[:2] for h, of in zip(places, names, strict=True) if of == name])
        noises.append((sigma_m, kinds[config.kind].slow(config)))
    usual_m, least_m = wanted_travel_m(noises)
    wanted_m, travelled_m = least_m if patient else usual_m, np.hypot(*(p - np.median(p[:5], axis=0)).T).max()
    if travelled_m > wanted_m:
        return "", bool(travelled_m > usual_m)
    return f"a heading: from a sensor, from `start.heading_deg`, or from {wanted_m:.0f} m of travel", False


def _solved(setup: Setup, recording: Recording, datum: Datum, *, told: bool, near_rad: float | None) -> Started | str:
    """Return the start as the batch solver solves it, or in words what it waits for.

    Args:
        told: whether sensors or enough travel tell the heading. near_rad: as in `try_start`.
    """
    config, rows = setup.config, setup.rows
    whole = origin.with_synthetic(recording, config, datum, rows)
    problem = make_problem(whole, config, datum, rows, setup.inertial, company_of(config, rows))
    result = solve_batch(problem, newest=True, near_rad=near_rad)
    span_s = _span_s(result)
    if result.noise_scale > LARGEST_NOISE_SCALE and span_s < _LONGEST_WAIT_S:
        return "data in which the IMU and the other sensors agree"
    if span_s < _CHOICE_WAIT_S and (undecided := _undecided(problem, result)):
        return undecided
    heading = _heading(setup, recording, datum, result, told=told)
    if isinstance(heading, str):
        return heading
    heights = {
        name: origin.height_m(recording, config, sensor.height_m, datum)
        for row in rows
        if row.synthetic is not None
        for name, sensor in config.of_kind(row.kind).items()
    }
    stated, taken = config.sensors, result.problem.config.sensors
    imu, taken_imu = stated[problem.imu.sensor], taken[problem.imu.sensor]
    k, anchor = _anchor(result, setup.lag_s)
    before = [
        row_of(stream, m, stream.config.topic, result.verdicts[stream.number, i])
        for stream in result.problem.streams
        for i, m in enumerate(stream.measurements)
        if m.stamp_ns < anchor.stamp_ns and m.seq >= 0
    ]
    return Started(
        datum=datum,
        anchor=anchor,
        pose=result.values.atPose3(keys.pose(k)),
        velocity=np.asarray(result.values.atVector(keys.velocity(k))),
        bias=result.values.atConstantBias(keys.bias(int(result.problem.timeline.slow_of[k]))).vector(),
        heights_m=heights,
        heading=heading,
        noise_scale=result.noise_scale,
        gyro_noise=taken_imu.gyro_noise_radps / imu.gyro_noise_radps,
        accel_noise=taken_imu.accel_noise_mps2 / imu.accel_noise_mps2,
        bias_walk=(
            taken_imu.accel_bias_walk_mps2 / imu.accel_bias_walk_mps2,
            taken_imu.gyro_bias_walk_radps / imu.gyro_bias_walk_radps,
        ),
        sensor_noise={stream.name: taken[stream.name].sigmas_over(stated[stream.name]) for stream in problem.streams},
        before=_before(result, k),
        notes=result.notes,
        warnings=tuple(noise_warnings(problem, result)),
        rows=tuple(before),
    )


def _span_s(result: BatchResult) -> float:
    stamps_ns = result.problem.timeline.stamps_ns
    return float((stamps_ns[-1] - stamps_ns[0]) * 1e-9)


def _undecided(problem: Problem, result: BatchResult) -> str:
    """Return which measurements, of those that may well be false, have yet to agree with each other; empty: none."""
    for stream in problem.streams:
        weights = [result.verdicts[(stream.number, i)].weight for i in range(len(stream.measurements))]
        agreeing = sum(weight >= AGREES for weight in weights)
        doubtful = [m for m in stream.measurements if stream.row.false is not None
                    and stream.row.false(m, stream.config).probability > _DOUBTFUL]  # fmt: skip
        if len(doubtful) > 1 and (agreeing < _AGREEING or agreeing < _SHARE * len(weights)):
            return f"{_AGREEING} measurements of {stream.name} that agree with each other ({agreeing} of {len(weights)} do)"
    return ""


def _heading(
    setup: Setup, recording: Recording, datum: Datum, result: BatchResult, *, told: bool
) -> UnmeasuredHeading | str | None:
    """Return how far the heading may be off; None: sensors or the motion tell it; a text: the start waits for it."""
    problem = result.problem
    last = keys.pose(len(problem.timeline) - 1)
    R = result.values.atPose3(last).rotation().matrix()
    linear_var = world_covariance(result.cov[last], R, np.zeros(3))[5, 5]
    sigma = min(float(np.sqrt(max(linear_var, result.heading_var[-1]))), ANY_HEADING_RAD)
    last_ns, drift_radps = int(problem.timeline.stamps_ns[-1]), _vertical_bias_sigma(problem.R_body_imu, result)
    if setup.config.start.heading_deg is not None and not _measured(setup, recording, datum):
        why = "the heading is a guess: it comes from `start.heading_deg` alone, and the gyroscope has carried it since"
        return UnmeasuredHeading(why=why, since_ns=last_ns, sigma_rad=sigma, drift_radps=drift_radps)
    if told and not (result.headings > 1 or sigma > DOUBTFUL_RAD):
        return None
    found = f"the motion so far shows it to {np.degrees(sigma):.0f} deg (1 sigma)"
    if not told:
        found = "it has not gone far enough for its motion to show it"
    elif result.headings > 1:
        found += f", {result.headings} candidates explain it"
    if told and _span_s(result) < _LONGEST_WAIT_S:
        return f"a heading: {found}; turn, add a heading sensor or set `start.heading_deg`"
    why = f"the heading is a guess: {found}"
    return UnmeasuredHeading(why=why, since_ns=last_ns, sigma_rad=ANY_HEADING_RAD, drift_radps=drift_radps)


def _measured(setup: Setup, recording: Recording, datum: Datum) -> bool:
    """Return whether sensors measure the heading, themselves or, with positions, by velocities along body axes."""
    heard = {m.sensor for m in recording.measurements}
    along_body = any(heard & setup.config.of_kind(row.kind).keys() for row in setup.rows if row.along_body)
    return along_body or any(np.isfinite(setup.hint(m, datum).yaw_rad) for m in recording.measurements)


def _vertical_bias_sigma(R_body_imu: Array, result: BatchResult) -> float:
    """Return the prior sigma (rad/s) of the gyroscope's bias about the vertical."""
    up = R_body_imu[2]
    return float(np.sqrt(up @ result.prior.bias_cov[3:, 3:] @ up))


def _before(result: BatchResult, k: int) -> BeforeStart | None:
    """Return the effect of left-out slow errors and the IMU's mount on state `k`, the window's first; None for 0."""
    if not k:
        return None
    slow = by_mount = None
    with suppress(RuntimeError, np.linalg.LinAlgError):  # not determined: the window goes on without it
        slow = unmodelled(result)
    with suppress(RuntimeError, np.linalg.LinAlgError):
        by_mount = followed_before(result.problem, result.values, result.verdicts, result.prior, k)
    return BeforeStart(None if slow is None else Unmodelled(slow.rotation[k], slow.velocity[k]), by_mount)


def _anchor(result: BatchResult, lag_s: float) -> tuple[int, Anchor]:
    """Return the number of the state that the window begins at, and its prior from earlier data.

    If the window always began at the first data, a heading that took half a minute of travel would have to be found
    again from ten seconds at a time.
    """
    problem, values = result.problem, result.values
    timeline, last = problem.timeline, len(problem.timeline) - 1
    first_ns, last_ns = int(timeline.stamps_ns[0]), int(timeline.stamps_ns[last])
    back = timeline.floor(last_ns - duration_ns(lag_s))
    # Not at the last slow node: the prior that closes the slow chains there would be part of the anchor, and count
    # twice.
    k = int(np.searchsorted(timeline.slow_of, min(timeline.slow_of[back], timeline.slow_of[last] - 1)))
    if k == 0 or last_ns - first_ns <= duration_ns(_WHOLE * lag_s):
        return 0, Anchor.of_start(first_ns, result.prior)
    made: Made = {}
    graph, guess = build_graph(problem, values, decisions(result.verdicts), 0, last, result.prior, made=made)
    # Earlier measurements may be attached to this state; the window takes only those from its stamp on.
    stamps_ns = {s.number: [m.stamp_ns for m in s.measurements] for s in problem.streams}
    after = {at: found for at, found in made.items() if stamps_ns[at[0]][at[1]] >= timeline.stamps_ns[k]}
    past = past_at(problem, StretchStep(guess, graph, after, 0, 0.0, 0.0), k)
    return k, Anchor.of_past(problem, values, past, k)
