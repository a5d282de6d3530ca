# SPDX-License-Identifier: Apache-2.0
"""Pauses of all sensors at once: nothing was recorded for a while, or the clock that stamps them all was set forward.

Either leaves a gap of about the same length in every stream. For a sensor that measures every P seconds, unrecorded
messages leave a gap of a multiple of P; a clock that was set forward by g leaves one of P + g. So only sensors with P >
g can tell the two apart, and not always. A pause that no sensor contradicts may be either.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from graphloc.time import NS_PER_S, duration_ns, utc_text

Stamps = NDArray[np.int64]
_LEAST_S = 0.1  # shorter pauses do not count: a fast vessel goes a metre in this time
_LEAST_STEPS = 5.0  # shortest pause, in usual steps of the IMU
_NEAR_S = 1.0  # by which a sensor's stamps may be off, and its own pause may be longer
_FEWEST = 5  # fewest steps that tell a sensor's period
_REGULAR = 1.5  # a sensor is regular where the 90 % quantile of its steps is below so many medians
_OFF_P, _OFF_G = 0.25, 0.1  # share of P, and of g, by which a sensor's gap may differ from P + g
_OFF_NONE = 0.5  # share of g by which that gap may differ at most


def common_pauses(imu_ns: Stamps, others_ns: Iterable[Stamps]) -> list[tuple[int, int]]:
    """Return the pauses (start, stop), ns, of an IMU and all other sensors at once, as if their clock were set forward.

    A sensor counts only if it is regular and measured on both sides of a pause. Where none counts, there is no common
    pause.

    Args:
        imu_ns: (N,) stamps of the IMU's samples, in order. others_ns: (M,) those of each other sensor, in any order.
    """
    steps = np.diff(imu_ns)
    usual = float(np.median(steps)) if len(steps) else 0.0
    wide = np.flatnonzero(steps > max(_LEAST_STEPS * usual, duration_ns(_LEAST_S)))
    regular = [(np.sort(own), period) for own in others_ns if (period := _period_ns(own))] if len(wide) else []
    found = []
    for n in wide.tolist():
        start, stop = int(imu_ns[n]), int(imu_ns[n + 1])
        told = [paused for own, period in regular if (paused := _pauses(own, period, start, stop, usual)) is not None]
        if told and all(told):
            found.append((start, stop))
    return found


def pauses_warning(pauses: Sequence[tuple[int, int]]) -> str:
    """Return a warning on pauses (start, stop), ns; empty if there are none."""
    if not pauses:
        return ""
    longest_s = max(b - a for a, b in pauses) / NS_PER_S
    which = f"for {longest_s:.2f} s" if len(pauses) == 1 else f"{len(pauses)} times, for up to {longest_s:.2f} s"
    first = "" if len(pauses) == 1 else "the first time "
    return (
        f"all sensors pause {which}, {first}at {utc_text(pauses[0][0])}: either nothing was recorded meanwhile, or the computer's clock, "
        "which stamps them all, jumped forward and no time passed; the bounds of an offline run there allow for both"
    )


def _period_ns(stamps_ns: Stamps) -> float:
    """Return the period of a sensor, ns; 0 where its steps are uneven or too few."""
    steps = np.diff(np.sort(stamps_ns))
    steps = steps[steps > 0]
    if len(steps) < _FEWEST:
        return 0.0
    usual, most = np.quantile(steps, [0.5, 0.9])
    return float(usual) if most < _REGULAR * usual else 0.0


def _pauses(own_ns: Stamps, period_ns: float, start_ns: int, stop_ns: int, usual_ns: float) -> bool | None:
    """Return whether a sensor has a gap as if its clock were set forward in a pause of the IMU.

    None where it did not measure on both sides of the pause.

    Args:
        own_ns: (M,) stamps of the sensor, in order. period_ns: its period.
        start_ns, stop_ns: the IMU's pause. usual_ns: usual step of the IMU.
    """
    near = duration_ns(_NEAR_S)
    first, last = np.searchsorted(own_ns, [start_ns - near, stop_ns + near])
    steps = np.diff(own_ns[max(int(first) - 1, 0) : int(last) + 1])
    set_ns = stop_ns - start_ns - usual_ns
    if not len(steps) or steps.max() > 2.0 * period_ns + set_ns + near:
        return None
    # Nearer to P + g than to P: else all sensors that measure rarely would seem to share a short pause of the IMU
    # alone.
    off_ns = min(_OFF_P * period_ns + _OFF_G * set_ns, _OFF_NONE * set_ns)
    return bool(abs(steps.max() - period_ns - set_ns) < off_ns)
