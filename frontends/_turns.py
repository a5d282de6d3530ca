# SPDX-License-Identifier: Apache-2.0
"""Consistency of headings with the gyroscope and with each other.

The solver trusts headings and gyroscope; where they contradict each other it would blame the noise of the IMU.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from graphloc.config import CompassConfig, ImuConfig
from graphloc.errors import InputError
from graphloc.frames import Array, wrap_angle
from graphloc.measurements import CompassHeading, ImuSeries
from graphloc.signals.series import integral, rms
from graphloc.time import NS_PER_S, stamps_of

_BLOCK_S = 120.0  # duration of a block, in which a gyro's bias and a compass's offset are steady
_HOLE_S, _STEP_S = 0.5, 2.0
_TURNS_DEG = 5.0  # least RMS of turns that tell, of a block's turn about a line, or of changes within `_LONG_S`
_CLEAR = 0.5  # negative correlation of steps from which headings turn against the gyro
_LIKELY = 2.0  # a step of the heading beyond so many times the largest step by the gyro is a false heading
_NEAR_S, _ASKED, _FEW, _LOST_DEG = 2.0, 20, 3, 30.0
"""A heading is compared with the next `_ASKED` headings to either side within `_NEAR_S`; with fewer than `_FEW` it is
kept. By then a bias of 3 deg/s makes 6 deg, and a craft in a sharp turn has turned by 30 deg, hence `_LOST_DEG`."""
# A larger step does not tell which way the craft turned; largest RMS about a steady turn of headings that are kept.
_LEAP_DEG, _SMOOTH_DEG = 120.0, 15.0
SCATTERED = (
    "differs from most headings around it, with and without the gyro: a course over ground at rest is no heading"
)
# Tilt: crossover time from gyroscope to accelerometer, longer than a wave; a craft is seldom tilted by more.
_TILT_S, _UPRIGHT_RAD = 5.0, 0.8
_GRAVITY_MPS2 = 5.0  # median acceleration below which there is no gravity in it
_TILT_RAD = np.radians(1.0)  # error of the tilt, 1 sigma: turns are felt as tilt; a choice
WANDERS_DEG = 1.0
"""Least wander of a compass beside the gyroscope that is said, 1 sigma: a smaller one may be the comparison's error."""
_CELL_S, _WANDER_BLOCK_S, _LONG_BLOCK_S, _LAGS_S, _MINUTE_S = 2.0, 300.0, 60.0, (4.0, 24.0), 60.0
"""For the wander: cells over which headings are averaged; longest and shortest block; lags over which changes are
compared; correlation time to which the wander refers."""
_BENDS, _BENDS_S = 0.5, 180.0
"""The wander about a parabola is taken if it is below this share of that about a line, in a run of at least this time:
three correlation times of a wander."""
_DEVIATES = 3.0  # a deviation is told if it is larger than so many times what a wander makes of it
# Least wrong scale that is said: ranges of a gyroscope differ by a factor of 2, a compass in iron turns a third too
# much.
_SCALE = 1.6
Yaws = tuple[NDArray[np.int64], Array]  # stamps (N,), ns, and yaw (N,), rad
_PART_DEG, _PART = 3.0, 3.0  # RMS from which a deviation is said: in deg, and as a multiple of the claimed sigma
_LONG_S = 12.0  # time over which a change of course is no noise (as in `turning.py`)
_UNIT, _UNIT_CLEAR, _BY_CHANCE = 2.3, 0.8, 5.0
"""Turns fit a unit if their ratio is right within this factor; they are clear from this correlation and this value
of Student's t, which says how far the correlation is beyond chance."""


def turn_warnings(imu: ImuSeries, sensor: str, headings: Sequence[CompassHeading], convention: str) -> list[str]:
    """Return a warning if headings turn against the gyroscope, or deviate from it by far more than they claim.

    The vertical is the median acceleration, so the IMU needs no mount; an IMU without gravity gives no warning.

    Args:
        imu: the samples. sensor: name of the compass.
        headings: of one compass, converted as configured, of an axis that is level (`without_tilt`). convention: the configured one.
    """
    against, apart = _compared(imu, _said(headings))
    if against:
        other = "enu" if convention == "ned" else "ned"
        said = f"{sensor}: its headings turn the other way than {imu.sensor}, levelled by its own gravity: set convention: "
        return [f"{said}{other}; or the signs of {imu.sensor} are wrong (gravity: inverted)"]
    if not apart:
        return []
    claimed = float(np.degrees(np.median([m.sigma_rad for m in headings])))
    part = float(np.degrees(rms(np.concatenate(apart))))
    if part < max(_PART_DEG, _PART * claimed):
        return []
    said = f"{sensor}: its headings differ by {part:.0f} deg (RMS) from the integrated gyro of {imu.sensor} but claim {claimed:.1f} deg: "
    return [
        f"{said}magnetic deviation, frozen or late headings (enabled: false may be better); or the unit of {imu.sensor}'s rates"
    ]


def pose_turn_warning(imu: ImuSeries, sensor: str, yaws: Yaws) -> list[str]:
    """Return a warning if the yaws of poses turn against the gyroscope, as yaws of a north, east, down frame do."""
    if not _compared(imu, yaws)[0]:
        return []
    said = f"{sensor}: its yaw turns the other way than {imu.sensor}, levelled by its own gravity: its frame is not east, north, up"
    return [
        f"{said} but looks like north, east, down: convert it; or the signs of {imu.sensor} are wrong (gravity: inverted)"
    ]


def _compared(imu: ImuSeries, yaws: Yaws) -> tuple[bool, list[Array]]:
    """Return whether yaws turn against the gyroscope, and by block yaw minus turn, about a straight line, rad.

    Without clear turns: False, and no blocks.
    """
    together, power, apart, turns = 0.0, 0.0, [], []
    for _, turned, yaw, at_s in _blocks(imu, yaws):
        if len(at_s) < 20:
            continue
        step = max(1, round(_STEP_S / max(float(np.median(np.diff(at_s))), 1e-3)))
        if step >= len(at_s):
            continue
        by_gyro, by_yaw = turned[step:] - turned[:-step], wrap_angle(yaw[step:] - yaw[:-step])
        likely = np.abs(by_yaw) <= _LIKELY * np.abs(by_gyro).max()  # leaves out most false matches
        by_gyro, by_yaw = by_gyro[likely], by_yaw[likely]
        together += float((by_gyro * by_yaw).sum())
        power += float(np.sqrt((by_gyro**2).sum() * (by_yaw**2).sum()))
        apart.append(without_line(np.unwrap(yaw - turned), at_s))
        turns.append(without_line(turned, at_s))
    if not apart or np.degrees(rms(np.concatenate(turns))) < _TURNS_DEG:
        return False, []
    return together < -_CLEAR * power, apart


def without_line(values: Array, at_s: Array, *columns: Array) -> Array:
    """Return the residuals of values (N,) about a least-squares line in time, at_s (N,), s, and other columns (N,)."""
    line = np.column_stack([np.ones(len(at_s)), at_s - at_s.mean(), *columns])
    return np.asarray(values - line @ np.linalg.lstsq(line, values, rcond=None)[0])


def refuse_unit(imu: ImuSeries, config: ImuConfig, yaws_by_source: Mapping[str, Yaws]) -> bool:
    """Refuse rates in another unit than configured: beside headings they turn 57 times too little or too much.

    The solver would take the missing part of a turn for a bias, and the heading for known.

    Args:
        imu: samples, converted as configured. config: of the IMU.
        yaws_by_source: headings or courses, by their name in the message.

    Returns:
        Whether rates, as configured, turn as some of the headings or courses do.

    Raises:
        InputError: the rates are in the other unit.
    """
    wrong, right = ("less", "rad/s") if config.gyro_unit == "deg/s" else ("more", "deg/s")
    other = np.degrees(1.0) if wrong == "less" else np.radians(1.0)
    fits = False
    for source, yaws in yaws_by_source.items():
        times = _times_turned(imu, yaws)
        fits |= _alike(times, 1.0)
        if _alike(times, other):
            raise InputError(
                f"{imu.sensor}: its gyro turns {max(times, 1.0 / times):.0f} times {wrong} than {source}, in step with them: "
                f"angular_velocity of {config.topic} is in {right}; set gyro_unit: {right} of sensors.{imu.sensor}"
            )
    return fits


def unit_of_turns(imu: ImuSeries, yaws: Yaws) -> Literal["rad/s", "deg/s"] | None:
    """Return the unit in which rates turn as headings or courses do; None if neither is clear.

    Args:
        imu: rates as they are told. yaws: headings or courses.
    """
    times = _times_turned(imu, yaws)
    if _alike(times, 1.0):
        return "rad/s"
    return "deg/s" if _alike(times, np.radians(1.0)) else None


def _alike(times: float, expected: float) -> bool:
    return bool(expected / _UNIT < times < expected * _UNIT)


def scale_warning(imu: ImuSeries, sensor: str, yaws: Yaws) -> list[str]:
    """Return a warning if yaws turn in step with the gyroscope, but clearly more or less.

    Then its driver takes a wrong range of the gyroscope, or has a unit of its own.
    """
    times = _times_turned(imu, yaws)
    if times == 0.0 or 1.0 / _SCALE < times < _SCALE:
        return []
    more = f"{times:.1f} times less" if times > 1.0 else f"{1.0 / times:.1f} times more"
    said = f"{imu.sensor}: its gyro turns {more} than the headings of {sensor}, in step with them: its rates are neither in rad/s nor in deg/s"
    return [
        f"{said} (a driver that takes another range for the gyroscope's), which no key corrects; or these headings are in another unit, or off by 20 deg or more in iron"
    ]


def _times_turned(imu: ImuSeries, yaws: Yaws) -> float:
    """Return the unsigned ratio of turns by headings to turns by the gyroscope; 0 if they do not clearly correlate."""
    by_gyro, by_heading, alone = [np.zeros(0)], [np.zeros(0)], 0.0
    for _, turned, yaw, at_s in _blocks(imu, yaws):
        if len(at_s) < 20 or at_s[-1] - at_s[0] <= _LONG_S:
            continue
        yaw, later = np.unwrap(yaw), np.searchsorted(at_s, at_s + _LONG_S)
        begins = np.flatnonzero(later < len(at_s))
        by_gyro.append(turned[later[begins]] - turned[begins])
        by_heading.append(yaw[later[begins]] - yaw[begins])
        alone += (at_s[-1] - at_s[0]) / _LONG_S
    a, b = np.concatenate(by_gyro), np.concatenate(by_heading)
    if alone <= 2.0:
        return 0.0
    a, b = a - a.mean(), b - b.mean()  # removes the gyro's bias
    largest = max(rms(a), rms(b))
    power = float(np.sqrt((a**2).sum() * (b**2).sum()))
    if np.degrees(largest) < _TURNS_DEG or power == 0.0:
        return 0.0
    clear = min(abs(float(a @ b)) / power, 1.0 - 1e-9)
    if clear < _UNIT_CLEAR or clear * np.sqrt((alone - 2.0) / (1.0 - clear**2)) < _BY_CHANCE:
        return 0.0
    return float(np.sqrt((b**2).sum() / (a**2).sum()))


def wander_deg(imu: ImuSeries, headings: Sequence[CompassHeading]) -> float | None:
    """Return a compass's wander against the gyroscope, 1 sigma, deg, at a correlation time of a minute.

    From heading minus integrated rate, a straight line per block (offset, bias) and parts proportional to sines and
    cosines of the heading (deviation), turn (scale) and rate (delay) are removed. If the residual diffuses, its mean
    square step grows by q t from some seconds to half a minute, on top of white noise. For a first-order Gauss-Markov
    process, q = 2 sigma^2 / tau.

    The removal takes along part of the wander, two thirds in a run of 90 s; this part is computed and compensated.

    The changing bias of a gyroscope that warms up bends the difference. So the wander about a parabola is taken instead
    if it is less than half of that about a line. In a run of under three minutes it is not, since a wander itself
    bends.

    Args:
        imu: the samples. headings: of one compass, converted as configured.

    Returns:
        None of a run without a block of a minute.
    """
    by_line = _wander_beside(imu, headings, 1)
    if by_line is None or (headings[-1].stamp_ns - headings[0].stamp_ns) / NS_PER_S < _BENDS_S:
        return by_line
    by_parabola = _wander_beside(imu, headings, 2)
    return by_line if by_parabola is None or by_parabola > _BENDS * by_line else by_parabola


def _wander_beside(imu: ImuSeries, headings: Sequence[CompassHeading], degree: int) -> float | None:
    """Return the wander of `wander_deg`, with a polynomial of a degree removed from each block; None without blocks."""
    beside = _beside_by_cells(imu, headings, degree)
    if beside is None:
        return None
    blocks, bends, design, apart = beside
    parts = [len(cells) for cells, _ in blocks]
    left = np.split(apart - design @ np.linalg.lstsq(design, apart, rcond=1e-6)[0], np.cumsum(parts)[:-1])
    soon, late = (_squared_steps(blocks, left, round(lag_s / _CELL_S)) for lag_s in _LAGS_S)
    grown = max(late - soon, 0.0)
    wander = float(np.degrees(np.sqrt(0.5 * grown / (_LAGS_S[1] - _LAGS_S[0]) * _MINUTE_S)))
    cells = [own for own, _ in blocks]
    by_steps = grown / _grown_of_unit(cells, _left_of_unit(cells, design))
    # A real wander scatters about the polynomials as much as it should. A periodic error scatters less, and its steps
    # are not compensated for a removal.
    off_bend = apart - bends @ np.linalg.lstsq(bends, apart, rcond=1e-6)[0]
    left_of_unit = np.concatenate([cov.diagonal() for cov in _left_of_unit(cells, bends)])
    by_spread = float((off_bend**2).mean() / left_of_unit.mean())
    return max(wander, float(np.degrees(np.sqrt(min(by_steps, by_spread)))))


def deviation_deg(imu: ImuSeries, headings: Sequence[CompassHeading]) -> float | None:
    """Return the magnetic deviation that a compass shows beside the gyroscope, as `deviation_sigma_deg` counts it.

    That is the size of one coefficient: of B and C (sine and cosine of the heading) the root mean square, of D and E
    (twice the heading) twice that. The coefficients are those of the parts that `wander_deg` removes. A wander of the
    compass, of `WANDERS_DEG` at least, makes them uncertain, the more so where the headings do not go round.

    Args:
        imu: the samples. headings: of one compass, converted as configured.

    Returns:
        None where neither pair is clear of that.
    """
    wander, beside = wander_deg(imu, headings), _beside_by_cells(imu, headings, 1)
    if wander is None or beside is None:
        return None
    blocks, _, design, apart = beside
    inverse = np.linalg.pinv(design, rcond=1e-6)
    cut = np.cumsum([len(cells) for cells, _ in blocks])[:-1]
    parts = zip((cells for cells, _ in blocks), np.split(inverse, cut, axis=1), strict=True)
    cov = sum(g @ np.exp(-_CELL_S / _MINUTE_S * np.abs(own[:, None] - own)) @ g.T for own, g in parts)
    sigmas_deg = max(wander, WANDERS_DEG) * np.sqrt(np.diagonal(cov)[-4:])
    found = []
    for size_deg, sigma_deg, share in zip(
        np.degrees(inverse[-4:] @ apart).reshape(2, 2), sigmas_deg.reshape(2, 2), (1.0, 0.5), strict=True
    ):
        if rms(size_deg) > _DEVIATES * rms(sigma_deg):
            found.append(rms(size_deg) / share)
    return max(found, default=None)


def _beside_by_cells(
    imu: ImuSeries, headings: Sequence[CompassHeading], degree: int
) -> tuple[list[tuple[NDArray[np.intp], Array]], Array, Array, Array] | None:
    """Return heading minus integrated rate, averaged over cells, and what may explain it; None without blocks.

    Returns:
        blocks: of each its cell numbers (n,), and the columns (n, k) of its own. bends: (N, b) polynomials of all blocks.
        design: (N, b + 6) these, turn, rate, and sine and cosine of the heading and of twice the heading.
        apart: (N,) heading minus integrated rate, rad.
    """
    blocks, first = [], degree + 1  # index of the first column after the polynomial's
    for _, turned, yaw, at_s in _blocks(imu, _said(headings), _WANDER_BLOCK_S):
        cell = ((at_s - at_s[0]) // _CELL_S).astype(int)
        if cell[-1] * _CELL_S < _LONG_BLOCK_S:
            continue
        there, count = np.unique(cell, return_counts=True)
        apart = np.unwrap(yaw - turned)
        middle = (at_s - at_s.mean()) / _WANDER_BLOCK_S
        columns = [*(middle**k for k in range(first)), turned, np.gradient(turned, at_s), apart]
        # Deviation by the heading of the gyroscope, without its bias: by that of the compass, an error explains itself.
        along = turned + np.polyval(np.polyfit(middle, apart, degree), middle)
        columns += [f(k * along) for k in (1.0, 2.0) for f in (np.sin, np.cos)]
        means = [np.bincount(cell, column)[there] / count for column in columns]
        blocks.append((there, np.column_stack(means)))
    if not blocks:
        return None
    common = np.vstack([np.delete(columns[:, first:], 2, axis=1) for _, columns in blocks])
    bends = block_diag(*(columns[:, :first] for _, columns in blocks))
    apart, design = np.concatenate([columns[:, first + 2] for _, columns in blocks]), np.hstack([bends, common])
    return blocks, bends, design, apart


def _left_of_unit(cells: Sequence[NDArray[np.intp]], design: Array) -> list[Array]:
    """Return the covariance (n, n) of each block's residuals of a wander of 1 rad and one minute, about `design`.

    Errors e with covariance C have the residuals r = M e with M = I - Q Q^T, where Q is an orthonormal basis of the
    columns of `design`. The covariance of r is M C M. C is block diagonal: a block of C is exp(-t / tau).

    Args:
        cells: (n,) cell numbers of each block, N in all. design: (N, k) columns that are removed.
    """
    left, size, _ = np.linalg.svd(design, full_matrices=False)
    base = np.split(left[:, size > 1e-6 * size[0]], np.cumsum([len(own) for own in cells])[:-1])
    C = [np.exp(-_CELL_S / _MINUTE_S * np.abs(own[:, None] - own)) for own in cells]
    middle = sum(q.T @ c @ q for q, c in zip(base, C, strict=True))
    halves = [q @ (q.T @ c) for q, c in zip(base, C, strict=True)]
    return [c - half - half.T + q @ middle @ q.T for q, c, half in zip(base, C, halves, strict=True)]


def _grown_of_unit(cells: Sequence[NDArray[np.intp]], covs: Sequence[Array]) -> float:
    """Return the growth of the mean square step from the shorter lag to the longer one, of residuals with `covs`.

    Args:
        cells: (n,) cell numbers of each block. covs: (n, n) covariance of the residuals of each block.
    """
    soon: list[Array] = []
    late: list[Array] = []
    for own, cov in zip(cells, covs, strict=True):
        for lag_s, found in zip(_LAGS_S, (soon, late), strict=True):
            i, j = np.nonzero(own - own[:, None] == round(lag_s / _CELL_S))
            found.append(cov[i, i] + cov[j, j] - 2.0 * cov[i, j])
    return max(float(np.concatenate(late).mean() - np.concatenate(soon).mean()), 1e-6)


def wander_warning(imu: ImuSeries, sensor: str, headings: Sequence[CompassHeading], config: CompassConfig) -> list[str]:
    """Return a warning if a compass wanders far more than configured: the bounds of the heading would be too small."""
    found = wander_deg(imu, headings)
    if found is None or found < max(WANDERS_DEG, 2.0 * config.wander_sigma_deg):
        return []
    said = f"{sensor}: its error wanders by {found:.1f} deg beside the integrated gyro of {imu.sensor} (1 sigma, in a minute)"
    return [
        f"{said}, and wander_sigma_deg is {config.wander_sigma_deg:g}: set it so, or the heading's bounds are too small"
    ]


def _squared_steps(blocks: Sequence[tuple[NDArray[np.intp], Array]], left: Sequence[Array], steps: int) -> float:
    """Return the mean square change of residuals over a number of cells, within blocks."""
    changes = [np.zeros(0)]
    for (cells, _), rest in zip(blocks, left, strict=True):
        along = np.full(int(cells[-1]) + 1, np.nan)
        along[cells] = rest
        changes.append(along[steps:] - along[:-steps])
    return float(np.nanmean(np.concatenate(changes) ** 2))


def scattered(imu: ImuSeries, headings: Sequence[CompassHeading]) -> NDArray[np.bool_]:
    """Return (N,) which headings agree with fewer than half of their neighbours, with and without the gyroscope's turn.

    Such are headings that a receiver derives from its motion while it stands: each claims to be good to a degree or
    two.
    Headings that only the gyroscope contradicts are kept, also those of a pivot: the unit of the gyroscope, or the
    convention of the headings, may be wrong.
    """
    bad = np.zeros(len(headings), dtype=bool)
    for own, turned, yaw, at_s in _blocks(imu, _said(headings)):
        apart = np.full((2 * _ASKED, len(own)), np.nan)
        for lag in range(1, min(_ASKED, len(own) - 1) + 1):
            turns = wrap_angle(yaw[lag:] - yaw[:-lag])
            off = np.minimum(np.abs(turns), np.abs(wrap_angle(turns - (turned[lag:] - turned[:-lag]))))
            off[at_s[lag:] - at_s[:-lag] > _NEAR_S] = np.nan
            apart[2 * lag - 2, lag:], apart[2 * lag - 1, :-lag] = off, off
        known = np.isfinite(apart).sum(axis=0) >= _FEW
        bad[own[known]] = np.nanmedian(apart[:, known], axis=0) > np.radians(_LOST_DEG)
        bad[own] &= ~_smooth(yaw, at_s)
    return bad


def _smooth(yaw: Array, at_s: Array) -> NDArray[np.bool_]:
    """Return (N,) which headings fit a steady turn within `_NEAR_S` to either side, whatever the gyroscope says."""
    steps = wrap_angle(np.diff(yaw))
    way = np.concatenate([[0.0], np.cumsum(steps)])
    too_far = np.concatenate([[0], np.cumsum(np.abs(steps) > np.radians(_LEAP_DEG))])
    sums = [np.concatenate([[0.0], np.cumsum(of)]) for of in (at_s, way, at_s**2, at_s * way, way**2)]
    first, last = np.searchsorted(at_s, at_s - _NEAR_S), np.searchsorted(at_s, at_s + _NEAR_S, side="right")
    n = np.maximum(last - first, 1)
    t, y, tt, ty, yy = [(total[last] - total[first]) / n for total in sums]
    line = (ty - t * y) ** 2 / np.maximum(tt - t**2, 1e-9)
    rest = np.sqrt(np.maximum(yy - y**2 - line, 0.0))
    return np.asarray((n > _FEW) & (too_far[last - 1] == too_far[first]) & (rest < np.radians(_SMOOTH_DEG)))


def yaw_rate(t_s: Array, accel_mps2: Array, gyro_radps: Array, up: Array) -> Array:
    """Return the yaw rate (N,), rad/s, of a craft that rolls and pitches: (q sin(roll) + r cos(roll)) / cos(pitch).

    Roll and pitch are by the gyroscope for times shorter than `_TILT_S`, and by the accelerometer for longer ones. The
    integrated rate about the mean vertical would drift, each wave, by half of the area that roll and pitch enclose: of
    8 and 4 deg by degrees a minute, and differently in each group of waves.

    Args:
        t_s: (N,), s. accel_mps2, gyro_radps: (N, 3), in any axes. up: (3,) mean vertical in the same axes, any length.
    """
    z = up / np.linalg.norm(up)
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x /= np.linalg.norm(x)
    level = np.column_stack([x, np.cross(z, x), z])
    _, q, r = (gyro_radps @ level).T
    roll, pitch = _roll_pitch(t_s, accel_mps2 @ level, gyro_radps @ level)
    if max(float(np.quantile(np.abs(angle), 0.95)) for angle in (roll, pitch)) > _UPRIGHT_RAD:
        return np.asarray(r)  # no upright craft: rates in another unit, or a hand-held camera
    return np.asarray((q * np.sin(roll) + r * np.cos(roll)) / np.cos(pitch))


def _roll_pitch(t_s: Array, accel_mps2: Array, gyro_radps: Array) -> tuple[Array, Array]:
    """Return roll and pitch (N,), rad, of the axes of the samples, of which the third is about upwards.

    The accelerometer removes what is slow: a bias of the rates, and a mean vertical that is a little askew.
    """
    f = accel_mps2
    roll = _joined(t_s, gyro_radps[:, 0], np.arctan2(f[:, 1], f[:, 2]))
    return roll, _joined(t_s, gyro_radps[:, 1], np.arctan2(-f[:, 0], np.hypot(f[:, 1], f[:, 2])))


def without_tilt(
    imu: ImuSeries, R_body_imu: Array, R_body_compass: Array, headings: Sequence[CompassHeading]
) -> list[CompassHeading]:
    """Return headings of the vessel's own x axis instead of a compass's, which roll and pitch may turn by itself.

    Of a compass whose x axis is tilted by p, a roll r turns the heading by r tan(p). Roll and pitch are by the IMU, and
    what they leave open, as in turns, is added to the sigmas; without gravity, or of no upright craft, the headings are returned as they are.
    """
    if not len(imu.stamps_ns) or float(np.linalg.norm(np.median(imu.accel_mps2, axis=0))) < _GRAVITY_MPS2:
        return list(headings)
    t = (imu.stamps_ns - imu.stamps_ns[0]) / NS_PER_S
    roll, pitch = _roll_pitch(t, imu.accel_mps2 @ R_body_imu.T, imu.gyro_radps @ R_body_imu.T)
    if max(float(np.quantile(np.abs(angle), 0.95)) for angle in (roll, pitch)) > _UPRIGHT_RAD:
        return list(headings)
    x, y, z = R_body_compass[:, 0]
    to_port = y * np.cos(roll) - z * np.sin(roll)
    ahead = x * np.cos(pitch) + np.sin(pitch) * (y * np.sin(roll) + z * np.cos(roll))
    at = (stamps_of(headings) - imu.stamps_ns[0]) / NS_PER_S
    beside = np.interp(at, t, np.unwrap(np.arctan2(to_port, ahead)))
    unsure = _TILT_RAD * abs(z) / max(float(np.hypot(x, y)), 1e-3)
    return [
        replace(m, yaw_rad=float(wrap_angle(m.yaw_rad - by)), sigma_rad=float(np.hypot(m.sigma_rad, unsure)))
        for m, by in zip(headings, beside, strict=True)
    ]


def _joined(t_s: Array, rate: Array, slow: Array) -> Array:
    """Return a complementary filter's angle (N,), rad: fast changes by a rate (N,), slow ones by an angle (N,).

    The crossover time is `_TILT_S`.
    """
    from scipy.signal import lfilter  # brings scipy.stats: a fifth of what most commands need to begin

    steps = np.diff(t_s)
    if not len(steps) or np.median(steps) <= 0.0:
        return slow
    kept = float(np.exp(-np.median(steps) / _TILT_S))
    fast = integral(t_s, rate) - slow
    forth = [float(np.median(fast[: max(1, round(_TILT_S / float(np.median(steps))))]))]
    smooth = lfilter([1.0 - kept], [1.0, -kept], fast, zi=[kept * forth[0]])[0]
    return np.asarray(slow + fast - smooth)


def _said(headings: Sequence[CompassHeading]) -> Yaws:
    return stamps_of(headings), np.array([m.yaw_rad for m in headings])


def _blocks(
    imu: ImuSeries, yaws: Yaws, block_s: float = _BLOCK_S
) -> Iterator[tuple[NDArray[np.intp], Array, Array, Array]]:
    """Yield for each block without an IMU gap: indices into `yaws`, integrated yaw rate, yaw (rad), and time (s).

    Times increase. Of yaws with equal stamps (of a clock that was set back by whole seconds) the first is taken.
    Nothing is yielded without gravity, or of fewer than 20 yaws.
    """
    up = np.median(imu.accel_mps2, axis=0) if len(imu.stamps_ns) else np.zeros(3)
    if float(np.linalg.norm(up)) < _GRAVITY_MPS2 or len(yaws[0]) < 20:
        return
    t = (imu.stamps_ns - imu.stamps_ns[0]) / NS_PER_S
    turned = integral(t, yaw_rate(t, imu.accel_mps2, imu.gyro_radps, up))
    holes: NDArray[np.intp] = np.flatnonzero(np.diff(t) > _HOLE_S)
    stamps, yaw = yaws
    order = np.argsort(stamps, kind="stable")
    order = order[np.diff(stamps[order], prepend=stamps[order[0]] - 1) > 0]
    at = (stamps[order] - imu.stamps_ns[0]) / NS_PER_S
    yaw = yaw[order]
    # A block ends where the next hole begins, and after `block_s`.
    part = np.searchsorted(t[holes], at)
    block = part * (1 + int(t[-1] / block_s)) + np.clip(at // block_s, 0, t[-1] // block_s).astype(int)
    after = np.clip(np.searchsorted(t, at), 1, len(t) - 1)
    inside = (at >= t[0]) & (at <= t[-1]) & (t[after] - t[after - 1] <= _HOLE_S)
    for k in np.unique(block[inside]):
        own = inside & (block == k)
        yield order[own], np.interp(at[own], t, turned), yaw[own], at[own]
