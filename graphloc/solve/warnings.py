# SPDX-License-Identifier: Apache-2.0
"""Warnings on a solved run: what in it contradicts the configuration, or itself."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from graphloc import keys
from graphloc.build import Problem, Stream, solved_constants
from graphloc.config import PoseConfig
from graphloc.graph import CONSTANT_TAILS
from graphloc.judge.bias_walk import WALK_KEYS, WANDERS_S, too_steady, walk_times, wandered
from graphloc.judge.decide import Verdict
from graphloc.judge.health import FAR_OFF, late_of
from graphloc.judge.imu_noise import LARGEST_NOISE_SCALE, too_quiet
from graphloc.judge.warnings import (
    disagreement_warning,
    far_off,
    joint_rejection_warning,
    late_far_off,
    noisier_warning,
    scale_warning,
    slow_error_warning,
)
from graphloc.signals.heading_steps import step_warnings
from graphloc.signals.position_jumps import jump_warnings, largest_sigma
from graphloc.solution import CONTRADICTING_COST, Graded, SolveStats
from graphloc.solve._lasting import lasting
from graphloc.solve._passes import expected_cost
from graphloc.solve.batch import BatchResult
from graphloc.solve.imu_mount import MountError, mount_sigma_rad
from graphloc.time import NS_PER_S, stamps_of, utc_text

# Sigmas from which a mount is said to be turned; share of a prior's variance that others must take off it.
_TURNED, _TOLD = 2.5, 0.1
_UNAIDED_S = 30.0  # length of an end of the run, from which the IMU alone is metres off
# Sigmas of the random walk over `WANDERS_S` from which a bias is said to wander: one that walks as configured moves,
# smoothed, by less than two. It is more than the 3 from which `bias_walk` looks closer: there a test of the whole run
# decides as well, and costs nothing where it denies; here the user is asked to act on this alone.
_WANDERS_SAID = 4.0
_LEVELS_M = 0.5  # sigma for levels that may be the usual ones as well, from which it is said


def _far_from_prior(stream: Stream, result: BatchResult) -> tuple[float, str]:
    """Return how many of its sigmas a constant slow state (a mount's offset) lies from zero, and a text on it.

    0 where there is none. The text says which, where, and what to do.
    """
    slow = stream.slow
    if slow is None:
        return 0.0, ""
    value = result.values.atVector(keys.slow(stream.number, 0))
    far = np.where(slow.constant, np.abs(value) / slow.sigma, 0.0)
    if slow.late is not None:
        far[slow.late] = 0.0  # a delay is no mount (`late_far_off`)
    k = int(np.argmax(far))
    where = f"{slow.axes[k]} {value[k] * slow.scale[k]:.3g} {slow.units[k]}"
    cure = "check its mount and the IMU's, or raise the configured sigma"
    if slow.axes[k] in slow.no_tails:
        cure = "it varies with the heading, as by iron near a magnetic compass: raise deviation_sigma_deg"
    if slow.axes[k] == "scale":
        times = 1.0 + float(value[k])
        wrong = "check its unit and calibration, or raise scale_sigma"
        wrong = wrong if times > 0.0 else "turn its mount by 180 deg (rpy_deg), or check its sign"
        cure = f"it reads {times:.2f} times the speed: {wrong}"
    return float(far[k]), f"its {slow.offset or slow.name} is estimated {far[k]:.1f} sigmas ({where}) from zero: {cure}"


def _turned_mount(stream: Stream, result: BatchResult) -> list[str]:
    """Return a warning if, by the other sensors, headings are turned by more than the mount's sigma and theirs allow.

    Two sensors that may each be turned share what they differ by, and neither lies far from zero: with 4 deg between
    mounts good to 1 deg, each is 2 deg off, 2.8 sigmas of what they should differ by. So the turn by the other sensors
    alone is taken, with its variance.
    """
    slow = stream.slow
    if slow is None or (k := slow.mount_yaw) is None:
        return []
    key = keys.slow(stream.number, 0)
    value, sigma = float(result.values.atVector(key)[k]), float(slow.sigma[k])
    var = float(result.cov[key][k, k])
    prior = sigma**2 * (1.0 + (value / sigma) ** 2 / CONSTANT_TAILS)
    told = prior - var  # variance that the other sensors took off it
    if told < _TOLD * prior:
        return []
    others, others_var = value * prior / told, var * prior / told
    sigmas = abs(others) / float(np.sqrt(sigma**2 + others_var))
    if sigmas < _TURNED:
        return []
    turned, checked = "its headings are turned by", "its mount (of a LiDAR matcher, those of the LiDARs)"
    if stream.row.along_body:
        turned, checked = "its velocities are turned by", "its mount"
    said = (
        f"{turned} {np.degrees(others):+.1f} deg against the other sensors' ({sigmas:.1f} sigmas of the configured mount errors): "
        f"check {checked} and theirs"
    )
    return [f"{stream.name}: {said}"]


def _noisier(stream: Stream, result: BatchResult) -> float:
    """Return how many times its stated noise a sensor with a kernel is taken to have."""
    if stream.row.has_hypotheses:
        return 1.0
    found = [result.verdicts[stream.number, i].decision for i in range(len(stream.measurements))]
    return max((decision.weight**-0.5 for decision in found if decision is not None), default=1.0)


def mount_warning(problem: Problem, error: MountError) -> list[str]:
    """Return a warning where, by the other sensors, the IMU's mount has more yaw than sigmas allow, or none.

    The estimated turn is shrunk by its prior, so its scatter is what the other sensors take off the prior's variance.
    """
    sigma = float(mount_sigma_rad(problem)[2])
    turn, told = float(problem.imu_turn_rad[2]) + error.yaw_rad, sigma**2 - error.sigma_rad**2
    if told <= _TOLD * sigma**2 or (sigmas := abs(turn) / float(np.sqrt(told))) < _TURNED:
        return []
    said = f"{problem.imu.sensor}: the other sensors turn its mount by {np.degrees(turn):+.1f} +- {np.degrees(error.sigma_rad):.1f} deg of yaw"
    kept = "" if problem.imu_turn_rad.any() else ", though it stays as configured"
    said += f"{kept} ({sigmas:.1f} sigmas of what mount_sigma_deg allows): check its mount and theirs"
    return [Graded(said, "mount of the IMU", sigmas)]


def mount_event(problem: Problem) -> tuple[str, ...]:
    """Return a line if the run was solved with the mount of the IMU turned, or none."""
    turn_deg = float(np.degrees(problem.imu_turn_rad[2]))
    name = problem.imu.sensor
    return (
        (f"{name}: its mount is taken as turned by {turn_deg:+.1f} deg of yaw (mount_sigma_deg)",) if turn_deg else ()
    )


def stats_of(problem: Problem, result: BatchResult) -> SolveStats:
    """Return costs, iterations and warnings of a solved run."""
    expected = expected_cost(problem, result.verdicts)
    warnings = [*problem.warnings, *_of_the_run(problem, result, expected)]
    for stream in problem.streams:
        warnings += [*_of_a_sensor(stream, result), *_of_constants(stream, result)]
    return SolveStats(
        passes=result.passes,
        iterations=result.iterations,
        states=len(problem.timeline),
        factors=int(result.graph.size()),
        cost=result.cost,
        expected_cost=expected,
        converged=result.converged,
        warnings=tuple(warnings),
    )


def _of_the_run(problem: Problem, result: BatchResult, expected: float) -> list[str]:
    warnings = list[str]()
    if not result.converged:
        warnings.append("the solver did not converge: the last pass still moved the track by centimetres or more")
    warnings += _unaided_ends(problem)
    warnings += noise_warnings(problem, result)
    warnings += _wandering_biases(problem, result)
    if expected > 0 and result.cost > CONTRADICTING_COST * expected:
        said = f"the cost is {result.cost / expected:.1f} times its expectation: noise is configured too small, or a "
        said += "mount, a unit or a time offset is wrong"
        warnings.append(Graded(said, "cost", result.cost / expected))
    if (beside_m := max(map(largest_sigma, result.levels_cov))) > _LEVELS_M:
        warnings.append(
            "the fixes jump, and no other sensor shows which level is right: the one held longest is taken, "
            f"and the bounds include {beside_m:.1f} m (1 sigma) for the others"
        )
    return warnings


def _unaided_ends(problem: Problem) -> list[str]:
    """Return a warning on each end of the run at which nothing measures position or velocity for long.

    There the IMU alone carries the track.
    """
    aided_ns = [m.stamp_ns for stream in problem.streams if stream.row.company for m in stream.measurements]
    first_ns, last_ns = (int(stamp_ns) for stamp_ns in problem.timeline.stamps_ns[[0, -1]])
    if not aided_ns:
        return []
    begun_ns, over_ns = min(aided_ns), max(aided_ns)
    ends = [(begun_ns - first_ns, f"before {utc_text(begun_ns)}"), (last_ns - over_ns, f"after {utc_text(over_ns)}")]
    return [
        f"for {silent_ns * 1e-9:.0f} s, {when}, nothing measures position or velocity: the IMU alone carries the track there, and it cannot "
        "tell a steady speed from rest, so the track may be far off though the vessel lies still; leave that part out (--start, --duration)"
        for silent_ns, when in ends
        if silent_ns > _UNAIDED_S * NS_PER_S
    ]


def _wandering_biases(problem: Problem, result: BatchResult) -> list[str]:
    """Return a warning on biases that wander far more than their random walk allows, where that is not to be raised.

    Axes that gravity shows tell it. The rate about the vertical wanders as much, unseen where nothing measures the
    heading.
    """
    config, warnings = problem.config.sensors[problem.imu.sensor], list[str]()
    if config.adapt_noise:
        return []
    every = wandered(problem, result.values)
    for times, what, key, bounds in zip(
        every, ("accelerometers", "gyroscopes"), WALK_KEYS, ("roll, pitch and position", "the heading"), strict=True
    ):
        if times > _WANDERS_SAID:
            said = f"{problem.imu.sensor}: a bias of its {what} changes within {WANDERS_S:.0f} s by {times:.1f} sigmas of what {key} allows"
            cure = f"it is warming up, or a cheap IMU; set {key}: {float(f'{times * getattr(config, key):.2g}'):g} or more, until this warning is gone; otherwise the bounds of {bounds} are too small"
            warnings.append(Graded(f"{said}: {cure}", f"wandering {what}", float(times)))
    return warnings


def noise_warnings(problem: Problem, result: BatchResult) -> list[str]:
    """Return warnings on sensors whose noise is taken to be larger than configured.

    Args:
        problem: as configured.
    """
    warnings = list[str]()
    if result.noise_scale > 1.0:
        said = (
            f"IMU noise scaled up {result.noise_scale:.1f} times: as configured, the IMU contradicts the other sensors"
        )
        if result.noise_scale > LARGEST_NOISE_SCALE:
            cure = "no IMU is that noisy: look for a wrong mount, unit, axis convention, time offset or sensor"
        else:
            cure = (
                "set accel_noise_ug_per_sqrt_hz and gyro_noise_mdps_per_sqrt_hz accordingly, or look for a wrong mount"
            )
            if any(not constant.corrects for stream in problem.streams for constant in stream.constants):
                cure += ", or for tags on a floating dock that the survey has as fixed"
        warnings.append(Graded(f"{said}; {cure}", "IMU noise by contradiction", result.noise_scale))
    name = problem.imu.sensor
    stated, taken = problem.config.sensors, result.problem.config.sensors
    for stream in problem.streams:
        warnings += scale_warning(stream.name, stream.config, taken[stream.name])
    if said := too_quiet(name, stated[name], taken[name]):
        times = (
            taken[name].gyro_noise_radps / stated[name].gyro_noise_radps,
            taken[name].accel_noise_mps2 / stated[name].accel_noise_mps2,
        )
        warnings.append(Graded(said, "IMU noise by its samples", max(times)))
    if said := too_steady(name, stated[name], taken[name]):
        raised = walk_times(stated[name], taken[name])
        warnings.append(Graded(said, "walk of the IMU's biases", max(raised.values())))
    return warnings


def _lasting_error(stream: Stream, verdicts: Sequence[Verdict]) -> list[str]:
    """Return a warning if poses share errors that count as independent, or none."""
    if not isinstance(stream.config, PoseConfig) or (found := lasting(stream, verdicts)) is None:
        return []
    said = f"{stream.name}: its errors last for some {found.time_s:.0f} s, by its residuals, and count as independent"
    said += f": set slow_error: {{sigma_m: {found.sigma_m:.2g}, time_constant_s: {found.time_s:.0f}}}, or more; "
    said += "if its errors are independent, the sensors between its poses (IMU, wheels) are noisier than configured"
    return [Graded(said, f"errors of {stream.name} that last", found.sigma_m)]


def _of_constants(stream: Stream, result: BatchResult) -> list[str]:
    warnings = list[str]()
    for constant, value in solved_constants(stream, result.values):
        warnings += [said for *_, said in far_off(stream.name, constant, value, stream.mount)]
        if not constant.corrects and (off := np.abs(value / constant.sigma).max()) > FAR_OFF:
            warnings.append(
                f"{stream.name}: {constant.name} is {off:.1f} sigmas from the survey: survey it again, or raise "
                "its sigmas"
            )
    return warnings


def _of_a_sensor(stream: Stream, result: BatchResult) -> list[str]:
    warnings = list[str]()
    far, said = _far_from_prior(stream, result)
    if far > FAR_OFF:
        warnings.append(f"{stream.name}: {said}")
    else:
        warnings += _turned_mount(stream, result)
    warnings += late_far_off(stream.name, stream.slow, late_of(stream, result.values) or 0.0)
    warnings += slow_error_warning(stream.name, stream.left_out, without_height=stream.without_height)
    allowed = stream.left_out is not None
    warnings += step_warnings(stream.name, stream.heading_steps)
    warnings += jump_warnings(stream.name, *stream.position_jumps, allowed=allowed, followed=stream.slow is None)
    verdicts = [result.verdicts[(stream.number, i)] for i in range(len(stream.measurements))]
    warnings += _lasting_error(stream, verdicts)
    weights = np.array([verdict.weight for verdict in verdicts])
    warnings += disagreement_warning(stream.name, weights)
    warnings += noisier_warning(stream.name, _noisier(stream, result))
    if stream.row.false is not None:
        stamps_ns = stamps_of(stream.measurements)
        false = np.array([stream.row.false(m, stream.config).probability for m in stream.measurements])
        warnings += joint_rejection_warning(stream.name, stamps_ns, weights, false)
    return warnings
