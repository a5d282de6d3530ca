# SPDX-License-Identifier: Apache-2.0
"""Warnings of both solvers: what of a sensor contradicts its configuration."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graphloc.config import SIGMA_SCALES, SensorConfig
from graphloc.frames import Array
from graphloc.graph import TIME_OFFSET, Constant, SlowProcess, corrections
from graphloc.judge.decide import AGREES
from graphloc.judge.health import FAR_OFF
from graphloc.signals.series import runs
from graphloc.solution import Graded
from graphloc.time import utc_text

_MUCH_NOISIER = 1.5  # times what is stated, from which a warning is given: bounds would be a third too small; a choice
_SMALL_M = 0.1  # a slow error that is smaller is that of RTK
_TOGETHER_S = 5.0  # shortest row of refused measurements that is said, if so many in a row are unlikely to be false
_BY_CHANCE = 1e-3  # probability below which that is unlikely, anywhere in the run; a choice


def slow_error_warning(sensor: str, left_out: SlowProcess | None, *, without_height: bool) -> list[str]:
    """Return what a slow error that nothing can tell from motion does to the bounds and to the use of heights.

    Nothing is said of bounds if the error is as small as that of RTK.
    """
    said = list[str]()
    if left_out is not None and left_out.sigma[0] >= _SMALL_M:
        said.append(
            f"{sensor}: no second sensor measures position or velocity, so its drift (multipath) cannot be told apart from motion; "
            f"the bounds include {left_out.sigma[0]:.2g} m (1 sigma) for it: slow_error.horizontal_sigma_m (RTK: 0.03)"
        )
    if without_height:
        said.append(
            f"{sensor}: its heights are not used: the waterline (sigma_m, tide_sigma_m of the height) is known better than they are (slow_error.vertical_sigma_m)"
        )
    return said


def disagreement_warning(sensor: str, weights: Array) -> list[str]:
    """Return a warning where most measurements of a sensor disagree with the rest, or none.

    Args:
        weights: (N,) of its measurements.
    """
    share = float((weights < AGREES).mean()) if len(weights) else 0.0
    if share <= 0.5 or len(weights) <= 10:
        return []
    return [f"{sensor}: {100 * share:.0f} % of its measurements disagree with the rest"]


def noisier_warning(sensor: str, noisier: float) -> list[str]:
    """Return a warning where a sensor is taken to be `noisier` times as noisy as it states, or none."""
    if noisier < _MUCH_NOISIER:
        return []
    cure = "set its sigma or the floor of it accordingly (a compass also use_reported_sigma: false)"
    said = f"{sensor}: its measurements scatter more than they state, and are taken with {noisier:.1f} times their sigma: {cure}"
    return [Graded(said, f"scatter of {sensor}", noisier)]


def scale_warning(sensor: str, stated: SensorConfig, taken: SensorConfig) -> list[str]:
    """Return a warning where factors on a sensor's sigmas are taken to be larger than configured, or none."""
    times = taken.sigmas_over(stated)
    if not times:
        return []
    floors = [floor for key in times for floor in SIGMA_SCALES[key] if hasattr(taken, floor)]
    cure = ", ".join(
        [f"{key}: {getattr(taken, key):.2g}" for key in floors] + [f"{key}: {getattr(taken, key):.1f}" for key in times]
    )
    said = f"{sensor}: its measurements scatter more than they state; this run uses the following, which should be set unless its mount or stamps are wrong: {cure}"
    return [Graded(said, f"sigmas of {sensor}", max(times.values()))]


def joint_rejection_warning(sensor: str, stamps_ns: NDArray[np.int64], weights: Array, false: Array) -> list[str]:
    """Return a warning where more measurements in a row are refused than are false together by chance, or none.

    Args:
        stamps_ns, weights: (N,) of the measurements. false: (N,) probability of each that it is false.
    """
    chance = np.concatenate([[0.0], np.cumsum(np.log(np.maximum(false, 1e-6)))])
    rows = [
        ((stamps_ns[end - 1] - stamps_ns[begin]) * 1e-9, begin, end)
        for begin, end in runs(weights < AGREES)
        if end - begin < len(weights) and np.log(len(weights)) + chance[end] - chance[begin] < np.log(_BY_CHANCE)
    ]
    lasts_s, begin, end = max(rows, default=(0.0, 0, 0))
    if lasts_s < _TOGETHER_S:
        return []
    since = utc_text(int(stamps_ns[begin]))
    return [
        f"{sensor}: all {end - begin} measurements in the {lasts_s:.0f} s from {since} on are rejected: they or the track are wrong"
    ]


def far_off(name: str, constant: Constant, value: Array, mount: Any) -> Iterator[tuple[str, float, str]]:
    """Yield each setting of a sensor that is far from its estimate: its key, by how much, and a line.

    A setting that another sensor shares is yielded by one of them only.

    Args:
        value: (k,) estimate of the constant. mount: of the sensor (gtsam.Pose3).
    """
    found = corrections([(constant, value)], mount)
    for n, key in constant.settings:
        if n >= constant.of_another and (off := abs(found[key]) / constant.sigma[n]) > FAR_OFF:
            yield key, found[key], _add_to(name, key, found[key], off)


def late_far_off(name: str, slow: SlowProcess | None, late_s: float) -> list[str]:
    """Return a warning where the delay of a sensor's stamps, by its slow state, is far from its setting, or none."""
    if slow is None or slow.late is None:
        return []
    off = abs(late_s) / float(slow.sigma[slow.late])
    return [_add_to(name, TIME_OFFSET, late_s, off)] if off > FAR_OFF else []


def _add_to(name: str, key: str, by: float, off: float) -> str:
    return f"{name}: {key} is {off:.1f} sigmas from its configured value: add {by:+.3f} to it"
