# SPDX-License-Identifier: Apache-2.0
"""Consistency of headings with the gyroscope and with each other. The solver trusts both and would blame the IMU's noise."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
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

_BLOCK_S = 120.0  # within it a gyro's bias and a compass's offset are steady
_HOLE_S, _STEP_S = 0.5, 2.0
_TURNS_DEG = 5.0  # RMS of the turns in 2 s, or all in all, from which they tell
_CLEAR = 0.5  # correlation
_LIKELY = 2.0  # of the fastest turn by the gyro
_NEAR_S, _ASKED, _FEW, _LOST_DEG = 2.0, 20, 3, 30.0
"""Headings within `_NEAR_S`, the next `_ASKED` to either side at most and `_FEW` at least, are asked whether they agree: a
bias of 3 deg/s is 6 deg by then, a craft in a sharp turn 30 deg off what it was."""
_LEAP_DEG, _SMOOTH_DEG = 120.0, 15.0  # beyond the one, which way it turned is a guess; RMS from a steady turn
SCATTERED = (
    "differs from most headings around it, with and without the gyro: a course over ground at rest is no heading"
)
_TILT_S, _UPRIGHT_RAD = 5.0, 0.8  # a wave lasts less; a craft is seldom tilted by more
WANDERS_DEG = 1.0
"""Of a compass beside the gyroscope: above it there is more than such a comparison errs by."""
_CELL_S, _WANDER_BLOCK_S, _LONG_BLOCK_S, _LAGS_S, _MINUTE_S = 2.0, 300.0, 60.0, (4.0, 24.0), 60.0
"""Headings are averaged over the first; of blocks as long as the second, changes over the third are compared."""
_BENDS, _BENDS_S = 0.5, 180.0
"""Of a wander about a line, below which what is left about a parabola is taken for it; in a run of at least this time, three times that a wander lasts."""
_SCALE = 1.6  # of the ranges of a gyroscope each is twice the next; a compass in iron turns by a third too much
Yaws = tuple[NDArray[np.int64], Array]  # stamps (N,), ns, and yaw (N,), rad
_PART_DEG, _PART = 3.0, 3.0  # least RMS that is said; times the sigma that is claimed
_LONG_S = 12.0  # over which courses are no noise (as in `_assess_imu.py`)
_UNIT, _UNIT_CLEAR, _BY_CHANCE = 2.3, 0.8, 5.0
"""Turns are another unit's within this factor; correlation, and that over what it is by chance (Student's t), from which that is clear."""


def turn_warnings(imu: ImuSeries, sensor: str, headings: Sequence[CompassHeading], convention: str) -> list[str]:
    """Return a line if headings turn against the gyroscope, or deviate from it by far more than they claim.

    The vertical is the median acceleration, so no mount is needed; an IMU without gravity gives no warning.

    Args:
        headings: of one compass, converted as configured. convention: the configured one.
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
    """Return a line if the yaws of poses turn against the gyroscope, as those in north, east, down do."""
    if not _compared(imu, yaws)[0]:
        return []
    said = f"{sensor}: its yaw turns the other way than {imu.sensor}, levelled by its own gravity: its frame is not east, north, up"
    return [
        f"{said} but looks like north, east, down: convert it; or the signs of {imu.sensor} are wrong (gravity: inverted)"
    ]


def _compared(imu: ImuSeries, yaws: Yaws) -> tuple[bool, list[Array]]:
    """Return whether yaws turn against the gyroscope, and by block how far they are off its turn, rad; none if there is hardly a turn."""
    together, power, apart, turns = 0.0, 0.0, [], []
    for _, turned, yaw, at_s in _blocks(imu, yaws):
        if len(at_s) < 20:
            continue
        step = max(1, round(_STEP_S / max(float(np.median(np.diff(at_s))), 1e-3)))
        if step >= len(at_s):
            continue
        by_gyro, by_yaw = turned[step:] - turned[:-step], wrap_angle(yaw[step:] - yaw[:-step])
        likely = np.abs(by_yaw) <= _LIKELY * np.abs(by_gyro).max()  # without most of false matches
        by_gyro, by_yaw = by_gyro[likely], by_yaw[likely]
        together += float((by_gyro * by_yaw).sum())
        power += float(np.sqrt((by_gyro**2).sum() * (by_yaw**2).sum()))
        apart.append(without_line(np.unwrap(yaw - turned), at_s))
        turns.append(without_line(turned, at_s))
    if not apart or np.degrees(rms(np.concatenate(turns))) < _TURNS_DEG:
        return False, []
    return together < -_CLEAR * power, apart


def without_line(values: Array, at_s: Array, *columns: Array) -> Array:
    """Return values (N,) less their best fit by a straight line in time, at_s (N,), s, and by other columns (N,)."""
    line = np.column_stack([np.ones(len(at_s)), at_s - at_s.mean(), *columns])
    return np.asarray(values - line @ np.linalg.lstsq(line, values, rcond=None)[0])


def refuse_unit(imu: ImuSeries, config: ImuConfig, yaws_by_source: Mapping[str, Yaws]) -> bool:
    """Refuse rates in another unit than configured: they turn by 57 times too little or too much, compared with headings.

    The solver would take the missing part of a turn for a bias, and the heading for known.

    Args:
        yaws_by_source: headings or courses, by their name in the message.

    Returns:
        Whether rates turn as some of these do, as configured.

    Raises:
        InputError: they are.
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
    """Return the unit in which rates turn as headings or courses do; None where these tell neither."""
    times = _times_turned(imu, yaws)
    if _alike(times, 1.0):
        return "rad/s"
    return "deg/s" if _alike(times, np.radians(1.0)) else None


def _alike(times: float, expected: float) -> bool:
    return bool(expected / _UNIT < times < expected * _UNIT)


def scale_warning(imu: ImuSeries, sensor: str, yaws: Yaws) -> list[str]:
    """Return a line if yaws turn in step with the gyroscope, but clearly more or less: a driver that has its range, or a unit of its own."""
    times = _times_turned(imu, yaws)
    if times == 0.0 or 1.0 / _SCALE < times < _SCALE:
        return []
    more = f"{times:.1f} times less" if times > 1.0 else f"{1.0 / times:.1f} times more"
    said = f"{imu.sensor}: its gyro turns {more} than the headings of {sensor}, in step with them: its rates are neither in rad/s nor in deg/s"
    return [
        f"{said} (a driver that takes another range for the gyroscope's), which no key corrects; or these headings are in another unit, or off by 20 deg or more in iron"
    ]


def _times_turned(imu: ImuSeries, yaws: Yaws) -> float:
    """Return the ratio of the turn by headings to that by the gyroscope, unsigned; 0 if they are not clearly correlated."""
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
    a, b = a - a.mean(), b - b.mean()  # a gyro's bias is in the mean
    largest = max(rms(a), rms(b))
    power = float(np.sqrt((a**2).sum() * (b**2).sum()))
    if np.degrees(largest) < _TURNS_DEG or power == 0.0:
        return 0.0
    clear = min(abs(float(a @ b)) / power, 1.0 - 1e-9)
    if clear < _UNIT_CLEAR or clear * np.sqrt((alone - 2.0) / (1.0 - clear**2)) < _BY_CHANCE:
        return 0.0
    return float(np.sqrt((b**2).sum() / (a**2).sum()))


def wander_deg(imu: ImuSeries, headings: Sequence[CompassHeading]) -> float | None:
    """Return a compass's wander against the gyroscope, 1 sigma, deg, at a correlation time of a minute; None of a short run.

    Of heading minus integrated rate, a straight line per block (offset, bias) and the parts proportional to heading (deviation),
    turn (scale) and rate (delay) are removed. If the rest diffuses, its mean square step grows by q t from some seconds to half a
    minute, on top of white noise. For a first-order Gauss-Markov process, q = 2 sigma^2 / tau.

    What is removed takes part of the wander along, in a run of 90 s two thirds of it, which is known and made up for.

    A gyroscope that warms up bends what the line is taken off: where a parabola leaves less than half of it, that is the wander. By less, or
    in a shorter time, a wander bends by itself.

    Args:
        headings: of one compass, converted as configured.
    """
    by_line = _wander_beside(imu, headings, 1)
    if by_line is None or (headings[-1].stamp_ns - headings[0].stamp_ns) / NS_PER_S < _BENDS_S:
        return by_line
    by_parabola = _wander_beside(imu, headings, 2)
    return by_line if by_parabola is None or by_parabola > _BENDS * by_line else by_parabola


def _wander_beside(imu: ImuSeries, headings: Sequence[CompassHeading], degree: int) -> float | None:
    """Return the same with a polynomial of a degree taken off each block."""
    blocks, first = [], degree + 1  # column after the polynomial's
    for _, turned, yaw, at_s in _blocks(imu, _said(headings), _WANDER_BLOCK_S):
        cell = ((at_s - at_s[0]) // _CELL_S).astype(int)
        if cell[-1] * _CELL_S < _LONG_BLOCK_S:
            continue
        there, count = np.unique(cell, return_counts=True)
        apart = np.unwrap(yaw - turned)
        middle = (at_s - at_s.mean()) / _WANDER_BLOCK_S
        columns = [*(middle**k for k in range(first)), turned, np.gradient(turned, at_s), apart]
        # The heading by the gyroscope, its bias taken off: by the compass itself, its error would explain itself.
        along = turned + np.polyval(np.polyfit(middle, apart, degree), middle)
        columns += [f(k * along) for k in (1.0, 2.0) for f in (np.sin, np.cos)]
        means = [np.bincount(cell, column)[there] / count for column in columns]
        blocks.append((there, np.column_stack(means)))
    if not blocks:
        return None
    parts = [len(cells) for cells, _ in blocks]
    common = np.vstack([np.delete(columns[:, first:], 2, axis=1) for _, columns in blocks])
    bends = block_diag(*(columns[:, :first] for _, columns in blocks))
    apart, design = np.concatenate([columns[:, first + 2] for _, columns in blocks]), np.hstack([bends, common])
    left = np.split(apart - design @ np.linalg.lstsq(design, apart, rcond=1e-6)[0], np.cumsum(parts)[:-1])
    soon, late = (_squared_steps(blocks, left, round(lag_s / _CELL_S)) for lag_s in _LAGS_S)
    grown = max(late - soon, 0.0)
    wander = float(np.degrees(np.sqrt(0.5 * grown / (_LAGS_S[1] - _LAGS_S[0]) * _MINUTE_S)))
    cells = [own for own, _ in blocks]
    by_steps = grown / _grown_of_unit(cells, _left_of_unit(cells, design))
    # No wander scatters by less about that than it should; what swings evenly only looks as if much had been taken off.
    off_bend = apart - bends @ np.linalg.lstsq(bends, apart, rcond=1e-6)[0]
    left_of_unit = np.concatenate([cov.diagonal() for cov in _left_of_unit(cells, bends)])
    by_spread = float((off_bend**2).mean() / left_of_unit.mean())
    return max(wander, float(np.degrees(np.sqrt(min(by_steps, by_spread)))))


def _left_of_unit(cells: Sequence[NDArray[np.intp]], design: Array) -> list[Array]:
    """Return the covariance (n, n) of each block that a wander of 1 rad in a minute has left once `design` is removed from it.

    The residuals r = M e of errors e with covariance C, M = I - Q Q^T, have the covariance M C M; of C only blocks are not 0.

    Args:
        cells: (n,) of each block. design: (N, k); Q is an orthonormal base of it.
    """
    left, size, _ = np.linalg.svd(design, full_matrices=False)
    base = np.split(left[:, size > 1e-6 * size[0]], np.cumsum([len(own) for own in cells])[:-1])
    C = [np.exp(-_CELL_S / _MINUTE_S * np.abs(own[:, None] - own)) for own in cells]
    middle = sum(q.T @ c @ q for q, c in zip(base, C, strict=True))
    halves = [q @ (q.T @ c) for q, c in zip(base, C, strict=True)]
    return [c - half - half.T + q @ middle @ q.T for q, c, half in zip(base, C, halves, strict=True)]


def _grown_of_unit(cells: Sequence[NDArray[np.intp]], covs: Sequence[Array]) -> float:
    """Return by how much the mean square step of residuals with such covariances grows from the shorter lag to the longer one."""
    soon: list[Array] = []
    late: list[Array] = []
    for own, cov in zip(cells, covs, strict=True):
        for lag_s, found in zip(_LAGS_S, (soon, late), strict=True):
            i, j = np.nonzero(own - own[:, None] == round(lag_s / _CELL_S))
            found.append(cov[i, i] + cov[j, j] - 2.0 * cov[i, j])
    return max(float(np.concatenate(late).mean() - np.concatenate(soon).mean()), 1e-6)


def wander_warning(imu: ImuSeries, sensor: str, headings: Sequence[CompassHeading], config: CompassConfig) -> list[str]:
    """Return a line if a compass wanders by far more than configured: the bounds of the heading would be too small."""
    found = wander_deg(imu, headings)
    if found is None or found < max(WANDERS_DEG, 2.0 * config.wander_sigma_deg):
        return []
    said = f"{sensor}: its error wanders by {found:.1f} deg beside the integrated gyro of {imu.sensor} (1 sigma, in a minute)"
    return [
        f"{said}, and wander_sigma_deg is {config.wander_sigma_deg:g}: set it so, or the heading's bounds are too small"
    ]


def _squared_steps(blocks: Sequence[tuple[NDArray[np.intp], Array]], left: Sequence[Array], steps: int) -> float:
    """Return the mean square of changes over some cells."""
    changes = [np.zeros(0)]
    for (cells, _), rest in zip(blocks, left, strict=True):
        along = np.full(int(cells[-1]) + 1, np.nan)
        along[cells] = rest
        changes.append(along[steps:] - along[:-steps])
    return float(np.nanmean(np.concatenate(changes) ** 2))


def scattered(imu: ImuSeries, headings: Sequence[CompassHeading]) -> NDArray[np.bool_]:
    """Return (N,) which headings agree with fewer than half of their neighbours, with or without the gyroscope's turn.

    Such are headings that a receiver derives from its motion while it has none: each claims to be good to a degree or two. Headings
    that only the gyroscope contradicts are kept, pivots included: its unit, or the headings' convention, may be wrong.
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
    """Return (N,) which headings fit a steady turn within `_NEAR_S` to either side, without the gyroscope."""
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
    """Return how fast (N,), rad/s, the yaw changes of a craft that rolls and pitches: (q sin(roll) + r cos(roll)) / cos(pitch).

    Roll and pitch are those of the gyroscope within `_TILT_S`, and of the accelerometer beyond. The rate about the mean vertical alone goes off by
    half of the area that the two enclose, each wave: of 8 and 4 deg by degrees a minute, and by another rate in each group of waves.

    Args:
        t_s: (N,). accel_mps2, gyro_radps: (N, 3), in any axes. up: (3,) the vertical in these, on average.
    """
    z = up / np.linalg.norm(up)
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x /= np.linalg.norm(x)
    level = np.column_stack([x, np.cross(z, x), z])
    p, q, r = (gyro_radps @ level).T
    f = accel_mps2 @ level
    # Of an IMU that stands a little askew on the way, and of rates that carry a bias: both are slow.
    roll, pitch = (
        _joined(t_s, rate, felt)
        for rate, felt in ((p, np.arctan2(f[:, 1], f[:, 2])), (q, np.arctan2(-f[:, 0], np.hypot(f[:, 1], f[:, 2]))))
    )
    if max(float(np.quantile(np.abs(angle), 0.95)) for angle in (roll, pitch)) > _UPRIGHT_RAD:
        return np.asarray(r)  # rates in another unit, or a camera in the hand
    return np.asarray((q * np.sin(roll) + r * np.cos(roll)) / np.cos(pitch))


def _joined(t_s: Array, rate: Array, slow: Array) -> Array:
    """Return an angle (N,), rad, whose changes within `_TILT_S` are those of a rate (N,), and the others those of another angle (N,)."""
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
    """Yield for each block without an IMU gap: indices into `yaws`, turn by the gyroscope, yaw, and time (s), increasing.

    Of yaws with one stamp (a clock that was set back by whole seconds) the first is taken.
    """
    up = np.median(imu.accel_mps2, axis=0) if len(imu.stamps_ns) else np.zeros(3)
    if float(np.linalg.norm(up)) < 5.0 or len(yaws[0]) < 20:  # m/s^2: no gravity in it
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
