# SPDX-License-Identifier: Apache-2.0
"""Which way y of a log looks, that tells its speed to the side as well: by what the IMU feels there.

Makers of Doppler logs have x ahead, y to starboard, z down; drivers for ROS turn it to port and up, or do not. Speeds ahead do not tell.

To the side an IMU feels a = dv_y/dt + w v_x. Over windows, as in `_mount_yaw.py`: what it feels across is fitted by the bends of ways by
v_x and by v_y, so that the factor of the latter is +1 or -1. What rolls and turns move a log by that sits below or ahead of the IMU, and
gravity as it rolls, goes as those: a part in proportion to each is fitted with it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from graphloc.frames import Array, rotation_from_rpy_deg
from graphloc.frontends._assess import sane
from graphloc.frontends._mount_yaw import FEWEST, HALF_S, STEP_S, Felt, bent, unbroken
from graphloc.frontends._reports import BODY_AXES, Side, VelocityReport
from graphloc.frontends._streams import TopicData
from graphloc.signals.series import integral
from graphloc.time import NS_PER_S

_BLOCK_S = 20.0  # what one is off by differs from the next
_CLEAR, _BY_CHANCE = 6.0, 1e-4  # sigmas; of Student's t where blocks are few
# Of a factor that is 1 or -1: else it is no speed of the same craft, or the IMU sits otherwise.
_LEAST, _MOST = 0.5, 1.5
_AHEAD = 2.0  # sigmas, by which the speed ahead goes the right way round turns: an IMU that sits astern has both sides exchanged
_STILL_MPS = 0.02  # RMS: a log that says less to the side says nothing


def with_side(report: VelocityReport, stream: TopicData, felt: Felt | None) -> VelocityReport:
    """Return the report of a log with which way its y looks, where it tells a speed to the side, and neither its type nor its name tells that."""
    if report.axes != BODY_AXES or report.mount or report.sideways or report.reverse or not _tells(stream, -2):
        return report
    R = None if report.rpy_deg is None else rotation_from_rpy_deg(np.array(report.rpy_deg))
    side = None if felt is None else side_of(felt, stream, R)
    if side and not side.to_port and report.tf_frame:  # other axes than those of tf
        side = None
    return replace(report, side=side, rises=_tells(stream, -1), unsided=side is None)


def _tells(stream: TopicData, column: int) -> bool:
    """Whether velocities tell a speed along an axis at all: one that does not is 0 or NaN there."""
    along = stream.rows[sane(stream, np.s_[-3:-2]), column]
    along = along[np.isfinite(along)]
    return len(along) > FEWEST and float(np.sqrt((along**2).mean())) > _STILL_MPS


def side_of(felt: Felt, stream: TopicData, R_body_sensor: Array | None = None) -> Side | None:
    """Return which way y of a log looks whose x looks ahead; None where that is not clear.

    Args:
        felt: of an IMU in the axes of the vessel. stream: velocities in its last three columns. R_body_sensor: (3, 3), how its axes are
            turned by tf.
    """
    keep = sane(stream, np.s_[-3:-1])
    v = np.nan_to_num(stream.rows[keep, -3:])
    v = v if R_body_sensor is None else v @ R_body_sensor.T
    t, at = felt.t_s, (stream.stamps_ns[keep] - felt.origin_ns) / NS_PER_S
    if len(at) <= FEWEST:
        return None
    faced = np.exp(1j * np.interp(at, t, felt.turned))
    ways = [(t, felt.way_m), (at, integral(at, v[:, 0] * faced)), (at, integral(at, 1j * v[:, 1] * faced))]
    ways += [(t, felt.swing_m), (t, np.exp(1j * felt.turned))]
    found = [side for half_s in HALF_S if (side := _side_by(felt, at, ways, half_s))]
    return min(found, key=lambda side: side.sigma, default=None)


def _side_by(felt: Felt, at: Array, ways: list[tuple[Array, NDArray[np.complex128]]], half_s: float) -> Side | None:
    """Return the same by windows of one length; None where that is not clear.

    Args:
        at: times (M,) of the log, as those of `felt` are counted. ways: times and places of what is felt, of v_x, of v_y, of what a place
            a metre above moves by, and of one a metre ahead.
    """
    middle = np.arange(max(felt.t_s[0], at[0]) + half_s, min(felt.t_s[-1], at[-1]) - half_s, STEP_S)
    middle = middle[unbroken(at, middle, half_s)]
    block = np.unique(middle // _BLOCK_S, return_inverse=True)[1]
    if len(middle) * STEP_S < FEWEST * half_s or block[-1] < 3:
        return None
    back = np.exp(-1j * np.interp(middle, felt.t_s, felt.turned))
    felt_m, *parts = ((bent(times, way, middle, half_s)[0] * back).imag for times, way in ways)
    design = np.column_stack([*parts, np.ones(len(middle))])

    def factors(kept: NDArray[np.bool_]) -> Array:
        return np.asarray(np.linalg.lstsq(design[kept], felt_m[kept], rcond=1e-9)[0][:2])

    ahead, side = factors(np.ones(len(middle), dtype=bool))
    without = np.array([factors(block != k) for k in range(block[-1] + 1)])
    ahead_sigma, sigma = np.sqrt(block[-1] * without.var(axis=0))
    clear = max(_CLEAR, -float(stdtrit(block[-1], _BY_CHANCE / 2.0)))
    if ahead < _AHEAD * ahead_sigma or abs(side) < clear * sigma or not _LEAST < abs(side) < _MOST:
        return None
    return Side(float(side), float(sigma))
