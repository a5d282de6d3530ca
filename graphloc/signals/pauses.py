# SPDX-License-Identifier: Apache-2.0
"""Pauses of all sensors at once: nothing was recorded for a while, or the clock that stamps them all was set forward.

Both leave the same gap in every stream. They differ in what comes after: of a sensor that measures every P seconds, messages that were not
recorded leave a gap of some P; a clock that was set by g leaves one of P + g. So only sensors that measure less often than g tell, and
only some of them: what is left is either.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from graphloc.time import NS_PER_S, duration_ns, utc_text

Stamps = NDArray[np.int64]
_LEAST_S = 0.1  # a shorter pause is none: of a fast vessel, a metre
_LEAST_STEPS = 5.0  # of a pause, of the usual steps of the IMU
_NEAR_S = 1.0  # sensors' stamps may be off by so much, and their own pauses
_FEWEST = 5  # steps that tell a sensor's period
_REGULAR = 1.5  # times the median step, at the 90 % point
_OFF_P, _OFF_G = 0.25, 0.1  # share of the period, and of the pause, by which a sensor's own pause may be off
_OFF_NONE = 0.5  # at most this share of the pause


def common_pauses(imu_ns: Stamps, others_ns: Iterable[Stamps]) -> list[tuple[int, int]]:
    """Return the pauses (start, stop), ns, that an IMU has with every sensor that was there, as if its clock were set forward; none if it is alone.

    Args:
        imu_ns: (N,) stamps of its samples, in order. others_ns: (M,) those of each other sensor, in any order.
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
    """Return a line on pauses (start, stop), ns; empty where there are none."""
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
    """Return the period of a sensor; 0 where it comes unevenly, or has hardly come."""
    steps = np.diff(np.sort(stamps_ns))
    steps = steps[steps > 0]
    if len(steps) < _FEWEST:
        return 0.0
    usual, most = np.quantile(steps, [0.5, 0.9])
    return float(usual) if most < _REGULAR * usual else 0.0


def _pauses(own_ns: Stamps, period_ns: float, start_ns: int, stop_ns: int, usual_ns: float) -> bool | None:
    """Return whether a sensor pauses as if its clock were set in a pause of the IMU; None where it was not there on both sides."""
    near = duration_ns(_NEAR_S)
    first, last = np.searchsorted(own_ns, [start_ns - near, stop_ns + near])
    steps = np.diff(own_ns[max(int(first) - 1, 0) : int(last) + 1])
    set_ns = stop_ns - start_ns - usual_ns
    if not len(steps) or steps.max() > 2.0 * period_ns + set_ns + near:
        return None
    # Nearer to the pause than to none: else a short one of the IMU alone would be one of each sensor that comes rarely.
    off_ns = min(_OFF_P * period_ns + _OFF_G * set_ns, _OFF_NONE * set_ns)
    return bool(abs(steps.max() - period_ns - set_ns) < off_ns)
