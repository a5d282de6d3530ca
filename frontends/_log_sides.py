# SPDX-License-Identifier: Apache-2.0
"""Side to which y of a log points, if it also tells a speed along y: by what the IMU feels to the side.

Makers of Doppler logs have x ahead, y to starboard, z down; drivers for ROS turn y to port and z up, or do not. Speeds
ahead do not tell.

To the side an IMU feels a = dv_y/dt + w v_x. This is fitted over windows, see `_mount_yaw.py`: what the IMU feels
across is a combination of the second differences of ways by v_x and by v_y, in which the factor of the latter is +1 or
-1. A log that is below or ahead of the IMU moves as the vessel rolls and turns, and gravity is felt as she rolls: parts
in proportion to roll and turn are fitted, too.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from graphloc.frames import Array, rotation_from_rpy_deg
from graphloc.frontends._assess import sane
from graphloc.frontends._mount_yaw import FEWEST, HALF_S, STEP_S, Felt, bent, middles_of, unbroken
from graphloc.frontends._reports import BODY_AXES, Side, VelocityReport
from graphloc.frontends._topic_data import TopicData
from graphloc.signals.series import integral
from graphloc.time import NS_PER_S

_BLOCK_S = 20.0  # duration of a block; errors of blocks are independent
_CLEAR, _BY_CHANCE = 6.0, 1e-4  # least significance, sigmas; probability by Student's t, for few blocks
# Range of a factor that is 1 or -1. Outside it the speed is not of this craft, or the IMU's mount is wrong.
_LEAST, _MOST = 0.5, 1.5
# Least significance, sigmas, of the factor of the speed ahead, which must be positive: of an IMU that is mounted
# backwards, both sides are exchanged.
_AHEAD = 2.0
_STILL_MPS = 0.02  # least RMS of a speed along an axis; a log that says less tells nothing along it


def with_side(report: VelocityReport, stream: TopicData, felt: Felt | None) -> VelocityReport:
    """Return the report of a log with the side to which its y points.

    Reports are returned as they are if the log tells no speed along y, or if its type or name tells the side.
    """
    if report.axes != BODY_AXES or report.mount or report.sideways or report.reverse or not _tells(stream, -2):
        return report
    R = None if report.rpy_deg is None else rotation_from_rpy_deg(np.array(report.rpy_deg))
    side = None if felt is None else side_of(felt, stream, R)
    if side and not side.to_port and report.tf_frame:  # other axes than those of tf
        side = None
    return replace(report, side=side, rises=_tells(stream, -1), unsided=side is None)


def _tells(stream: TopicData, column: int) -> bool:
    """Return whether velocities tell a speed along an axis at all, rather than 0 or NaN."""
    along = stream.rows[sane(stream, np.s_[-3:-2]), column]
    along = along[np.isfinite(along)]
    return len(along) > FEWEST and float(np.sqrt((along**2).mean())) > _STILL_MPS


def side_of(felt: Felt, stream: TopicData, R_body_sensor: Array | None) -> Side | None:
    """Return the side to which y of a log points, whose x points ahead; None if that is not clear.

    Args:
        felt: of an IMU in the axes of the vessel. stream: has velocities in its last three columns.
        R_body_sensor: (3, 3), rotation of its axes by tf; None: unknown.
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
    """Return the side by windows of one duration; None if that is not clear.

    Args:
        felt: of the IMU. at: (M,) times of the log, s since the origin of `felt`.
        ways: times and positions of the felt motion, of the ways by v_x and by v_y, and of the displacements of points
            a metre above and a metre ahead of the IMU.
    """
    middle = middles_of(felt.t_s, at, half_s)
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
