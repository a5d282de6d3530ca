# SPDX-License-Identifier: Apache-2.0
"""What a solved run says of what it took as given: lever arms, mounts, stamps, and the IMU's noise.

These are statistics only: `graphloc.eval.calibrate` draws the conclusions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from graphloc.frames import Array

Offset = Literal["x", "y", "yaw", "time"]
"""What may be off of a sensor: its place in body (m), its yaw in body (rad), or its stamps (s, to be added to them)."""

Probe = Mapping[str, Sequence[Offset]]
"""By kind of sensor: the offsets to look at."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Misfit:
    """How far the motion that an IMU measures lies from that by all sensors together.

    Attributes:
        squares: sum of squared residuals of the IMU's factors, in configured standard deviations.
        freedom: expected value of that sum, if the noise is configured right: less than the number of residuals, because the
            solution follows the IMU.
        needed: factor on the noise with which the sum would be as expected, where it is clearly not; else 1. Above 1 it is only as
            far as the samples themselves scatter more.
        sigma: 1 sigma of `needed`.
    """

    squares: float
    freedom: float
    needed: float = 1.0
    sigma: float = 1.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Offsets:
    """How the least cost of the run changes with some offsets theta (k,), each zero as configured.

    Around zero it is the sum over blocks of theta' H theta - 2 g' theta, everything else being free to follow. So the
    best theta is (sum H)^-1 sum g, and how g - H theta scatters from block to block tells how sure that is, whatever the
    run was told of its noise.

    Attributes:
        names: sensor and offset of each of the k.
        block_s: length of a block, s.
        gradient: (n, k) g. curvature: (n, k, k) H; both of n blocks in turn.
        gyroscope, accelerometer: misfit of the IMU, by the noise that the run was solved with in the end.
        noise_scale: that noise over the configured one.
    """

    names: tuple[tuple[str, Offset], ...]
    block_s: float
    gradient: Array
    curvature: Array
    gyroscope: Misfit
    accelerometer: Misfit
    noise_scale: float


def joined(parts: Sequence[Offsets]) -> Offsets:
    """Return the offsets of a run that was solved in parts (one or more)."""
    names = tuple(dict.fromkeys(name for part in parts for name in part.names))
    gradient = np.zeros((sum(len(p.gradient) for p in parts), len(names)))
    curvature = np.zeros((len(gradient), len(names), len(names)))
    first = 0
    for part in parts:
        rows = np.arange(first, first + len(part.gradient))
        own = np.array([names.index(name) for name in part.names], dtype=np.int64)
        gradient[np.ix_(rows, own)] = part.gradient
        curvature[np.ix_(rows, own, own)] = part.curvature
        first += len(rows)

    def together(misfits: Sequence[Misfit]) -> Misfit:
        most = max(misfits, key=lambda m: m.freedom)  # its noise; the same for all parts, so the one that knows best
        squares, freedom = sum(m.squares for m in misfits), sum(m.freedom for m in misfits)
        return Misfit(squares=squares, freedom=freedom, needed=most.needed, sigma=most.sigma)

    return Offsets(
        names=names,
        block_s=parts[0].block_s,
        gradient=gradient,
        curvature=curvature,
        gyroscope=together([p.gyroscope for p in parts]),
        accelerometer=together([p.accelerometer for p in parts]),
        noise_scale=max(p.noise_scale for p in parts),
    )
