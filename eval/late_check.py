# SPDX-License-Identifier: Apache-2.0
"""Whether stamps that a run contradicts (`calibrate`) put its track, or its heading, outside its bounds."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from graphloc.config import AerialConfig, GnssConfig, VelocityConfig, VesselConfig
from graphloc.eval.calibrate import Calibration
from graphloc.signals.series import rms
from graphloc.solution import Solution
from graphloc.trajectory import bounds_95

_PLACES = ("gnss", "pose", "aerial")


def late_doubts(solution: Solution, config: VesselConfig, calibration: Calibration) -> Iterator[str]:
    """Yield a sentence, without its full stop, on each suggested time offset that matters.

    It does if it moves the track (of a position sensor), or turns it (of a velocity), by more than its bounds.
    """
    track = solution.trajectory
    if track.cov is None or track.v_world_mps is None:
        return
    speed_mps = rms(np.linalg.norm(track.v_world_mps[:, :2], axis=1))
    bound_m = float(np.median(bounds_95(track.cov)[:, 0]))
    for found in calibration.suggestions:
        off_s, block = abs(found.suggested - found.configured), config.sensors[found.sensor]
        if isinstance(block, VelocityConfig) and found.unit == "s" and block.stamp_sigma_s == 0.0:
            yield from _late_velocity(found.sensor, off_s, solution)
        if isinstance(block, GnssConfig | AerialConfig) and block.stamp_sigma_s > 0.0:
            taken_s = solution.time_offsets_s.get(found.sensor)
            if isinstance(block, GnssConfig) or taken_s is None:
                continue  # the delay is estimated, and the bounds include it
            off_s = abs(found.suggested - found.configured - taken_s)  # a large delay is estimated only in part
        if found.unit == "s" and block.kind in _PLACES and off_s * speed_mps > bound_m:
            yield (
                f"{found.sensor} and the IMU are {off_s:.2g} s apart (see Calibration): at this run's {speed_mps:.1f} m/s the track is up to "
                f"{off_s * speed_mps:.2f} m behind or ahead, more than its bounds of {bound_m:.2f} m (median)"
            )


def _late_velocity(sensor: str, off_s: float, solution: Solution) -> Iterator[str]:
    """Yield a sentence on a velocity sensor whose delay `off_s` turns the heading by more than its bounds.

    It turns the heading by as much as the accelerations turn within the delay, on average.
    """
    track = solution.trajectory
    assert track.cov is not None
    assert track.v_world_mps is not None
    if len(track.stamps_ns) < 2:
        return
    gained = np.gradient(track.v_world_mps[:, :2], track.stamps_ns * 1e-9, axis=0)
    power = (gained**2).sum(axis=1)
    turned_deg = abs(float(np.degrees(off_s * (power @ solution.gyro_radps[:, 2]) / max(power.sum(), 1e-9))))
    bound_deg = float(np.median(bounds_95(track.cov)[:, 2]))
    if turned_deg > bound_deg:
        yield (
            f"{sensor} and the IMU are {off_s:.2g} s apart (see Calibration): as this run turns, the heading is about {turned_deg:.1f} deg "
            f"off where it comes from the motion, more than its bounds of {bound_deg:.1f} deg (median)"
        )
