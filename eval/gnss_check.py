# SPDX-License-Identifier: Apache-2.0
"""Warn of a constant offset between a GNSS receiver and the other position sensors, which the slow error would absorb.

A receiver's slow error d is a first-order Gauss-Markov process with sigma s and time constant T_c. The mean of each
axis over a run of length T has the variance

    sigma_mean^2 = 2 s^2 (T_c / T) (1 - (T_c / T) (1 - exp(-T / T_c)))

so |mean|^2 / sigma_mean^2 over two axes is chi-square with 2 degrees of freedom. An offset beyond the 95 % quantile
that hardly changes is not multipath: the map, the survey, the datum or a lever arm is wrong; the data do not show
which. For height the limit is 3 sigmas, since a mix-up of geoid and ellipsoid gives far more.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from graphloc.build import mount_of
from graphloc.chi2 import chi2_95
from graphloc.config import SlowErrorConfig, VesselConfig
from graphloc.eval.metrics import Levers, receiver_errors
from graphloc.frames import Array, Datum, heading_deg_from_yaw
from graphloc.measurements import GnssPosition
from graphloc.recording import Recording
from graphloc.time import NS_PER_S, duration_ns
from graphloc.trajectory import Trajectory

_STEADY = 0.5  # largest RMS about the mean, as a share of the mean, of an offset that hardly changes
_HEIGHT_SIGMAS = 3.0
_FAR_OFF = 3.0  # sigmas of the mean from which no pose with that receiver is called good
_BLOCK_S, _FEWEST = 10.0, 3  # length of a block; with fewer blocks it is not known whether an offset changes
_PLACES = ("pose", "aerial", "apriltag", "gnss")


class GnssOffset(NamedTuple):
    """A constant offset of a receiver from the other position sensors; as text: `said`.

    Attributes:
        said: a line for users. doubt: why no pose is called good; empty if the offset may be chance or is only
            vertical.
    """

    said: str
    doubt: str = ""

    def __str__(self) -> str:
        return self.said


def gnss_offsets(
    track: Trajectory, datum: Datum, recording: Recording, config: VesselConfig, antennas_off_m: Levers
) -> list[GnssOffset]:
    """Return the constant offset of each receiver from a solved track, where its slow error does not explain it.

    Args:
        track: of the body. datum: origin of world.
        recording: the measurements; only receivers beside another position sensor are checked.
        config: sensors, their slow errors and mounts.
        antennas_off_m: (3,) m, by receiver, how far from its mount the track has the antenna, where it estimates that.
    """
    offsets = list[GnssOffset]()
    measured = {m.sensor for m in recording.measurements if m.seq >= 0}
    for name, sensor in config.of_kind("gnss").items():
        others = [
            n for kind in _PLACES for n in config.of_kind(kind) if n not in config.by_turns(name) and n in measured
        ]
        fixes = recording.of(GnssPosition, name)
        if sensor.slow_error.enabled is False or not others:
            continue
        lever_m = mount_of(name, sensor, recording.mounts)[0] + antennas_off_m.get(name, np.zeros(3))
        found = receiver_errors(track, fixes, datum, {name: lever_m})
        if found is None:
            continue
        stamps, off = found.stamps_ns, _means(found.stamps_ns, -found.position_m)
        if len(off) < _FEWEST:
            continue
        process, lasts_s = sensor.slow_error, float(stamps[-1] - stamps[0]) / NS_PER_S
        offsets += _horizontal(name, off[:, :2], process, lasts_s, others)
        if all(m.has_height for m in fixes):
            tell = [n for n in others if config.sensors[n].tells_height] + list(config.of_kind("height"))
            offsets += _vertical(name, off[:, 2:], process, lasts_s, tell)
    return offsets


def _horizontal(
    name: str, off_m: Array, process: SlowErrorConfig, lasts_s: float, others: Sequence[str]
) -> Iterator[GnssOffset]:
    """Yield the horizontal offset, if the receiver's slow error does not explain it.

    Args:
        name: of the receiver. off_m: (N, 2) its errors. process: its slow error. lasts_s: length of the run.
        others: the other position sensors.
    """
    size, mean = _steady(off_m)
    variance = _mean_variance(process.horizontal_sigma_m, process.time_constant_s, lasts_s)
    if size**2 >= chi2_95(2) * variance:
        towards = float(heading_deg_from_yaw(np.arctan2(mean[1], mean[0])))
        seen = f"{name} has a constant offset of {size:.1f} m (towards {towards:.0f} deg) from {', '.join(others)}"
        said = (
            f"{seen}, more than its slow error of {process.horizontal_sigma_m:.1f} m (1 sigma) explains: the map, the survey, the datum "
            "or a lever arm is off by that much, or the receiver is; the track follows the others"
        )
        yield GnssOffset(said, seen if size**2 > _FAR_OFF**2 * variance else "")


def _vertical(
    name: str, off_m: Array, process: SlowErrorConfig, lasts_s: float, others: Sequence[str]
) -> Iterator[GnssOffset]:
    """Yield the vertical offset, if the slow error does not explain it.

    Args:
        name, process, lasts_s: as of `_horizontal`. off_m: (N, 1) errors in height. others: what else tells the height.
    """
    size, mean = _steady(off_m)
    variance = _mean_variance(process.vertical_sigma_m, process.time_constant_s, lasts_s)
    if others and size**2 >= _HEIGHT_SIGMAS**2 * variance:
        said = (
            f"{name} has a constant offset of {size:.1f} m ({'up' if mean[0] > 0.0 else 'down'}) from {', '.join(others)}, more "
            f"than its slow error of {process.vertical_sigma_m:.1f} m in height (1 sigma) explains: one may be above the geoid, "
            "the other above the ellipsoid"
        )
        yield GnssOffset(said)


def _steady(off_m: Array) -> tuple[float, Array]:
    """Return the length of the mean of blocks (N, k), m, and the mean (k,); length 0 if they scatter too much."""
    mean = off_m.mean(axis=0)
    size = float(np.linalg.norm(mean))
    moves = float(np.sqrt(((off_m - mean) ** 2).sum(axis=1).mean()))
    return (size if moves <= _STEADY * size else 0.0), mean


def _means(stamps_ns: NDArray[np.int64], off_m: Array) -> Array:
    """Return the means (B, k) of errors (N, k), m, over blocks of ten seconds, in which white noise averages out."""
    _, block = np.unique((stamps_ns - stamps_ns[0]) // duration_ns(_BLOCK_S), return_inverse=True)
    count = np.bincount(block)
    return np.column_stack([np.bincount(block, weights=column) / count for column in off_m.T])


def _mean_variance(sigma_m: float, time_constant_s: float, lasts_s: float) -> float:
    """Return the variance of the mean of a Gauss-Markov process, m^2 (see the module)."""
    share = time_constant_s / lasts_s
    return 2.0 * sigma_m**2 * share * (1.0 - share * (1.0 - float(np.exp(-1.0 / share))))
