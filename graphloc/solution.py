# SPDX-License-Identifier: Apache-2.0
"""What a solver returns: the trajectory, what was estimated besides, and how the solving went."""

from __future__ import annotations

import enum
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from graphloc.berths import BerthTrack
from graphloc.frames import Array, Datum
from graphloc.ledger import Ledger
from graphloc.offsets import Offsets
from graphloc.trajectory import Trajectory

CONTRADICTING_COST = 3.0
"""Ratio of cost to expected cost above which measurements contradict each other: noise that is merely configured too small gives less."""


LOST_BOUND_M = 25.0
"""95 % bound of the position, m, beyond which it is of no use in a harbour."""


class Health(enum.StrEnum):
    """How far an estimate can be trusted, at one time."""

    GOOD = "good"  # position sigma small, absolute sensors agree
    DEGRADED = "degraded"  # usable, but one absolute sensor is missing or disagrees, or sigma is large
    DEAD_RECKONING = "dead_reckoning"  # no absolute position agreed for a while
    LOST = "lost"  # by the covariance position or heading is not known


class Cause(enum.Enum):
    """What keeps an estimate's health from being good."""

    BOUND = enum.auto()  # the 95 % bound of its position is too large
    HEADING = enum.auto()  # only the bound of its heading is too large
    NO_POSITION = enum.auto()  # no absolute sensor agrees
    SENSORS = enum.auto()  # some absolute sensors are missing or do not agree
    GUESSED_HEADING = enum.auto()  # no sensor measures the heading, and the motion does not tell it yet
    CONTRADICTION = enum.auto()  # measurements contradict each other or the motion, as a warning says


@dataclass(frozen=True, slots=True)
class HealthReason:
    """Why an estimate's health is not good; `str()` of it is its text.

    Attributes:
        text: for a reader; empty where health is good. cause: what would have to change; None where health is good.
        sensors: those that are missing or do not agree, if that is the cause.
    """

    text: str = ""
    cause: Cause | None = None
    sensors: tuple[str, ...] = ()

    def __str__(self) -> str:
        return self.text


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SlowEstimate:
    """A slow state of one sensor over time. The error of fixes or poses is to be subtracted from them.

    Attributes:
        name: what it is, for axis labels, e.g. 'GNSS error'.
        axes: names of the k columns. units: of each, such as 'm', 'deg' or 's'.
        stamps_ns: (M,); value, sigma: (M, k).
    """

    name: str
    axes: tuple[str, ...]
    units: tuple[str, ...]
    stamps_ns: NDArray[np.int64]
    value: Array
    sigma: Array

    def surest(self, axes: Sequence[str]) -> Array | None:
        """Return the values (k,) of some constant axes at the time at which they are known best; None where it lacks one of them.

        They differ over a long run, because each leg estimates them anew.
        """
        if not set(axes) <= set(self.axes):
            return None
        columns = [self.axes.index(axis) for axis in axes]
        return np.asarray(self.value[np.argmin(self.sigma[:, columns].sum(axis=1)), columns])


class Graded(str):
    """A warning with a figure in it, which differs between the legs of a run; it reads as a plain line.

    Attributes:
        about: what the warning is about, the same in all legs. figure: the larger, the worse.
    """

    __slots__ = ("about", "figure")
    about: str
    figure: float

    def __new__(cls, line: str, about: str = "", figure: float = 0.0) -> Self:
        """Return the line. What copies a string gives the line alone, hence the defaults."""
        made = super().__new__(cls, line)
        made.about, made.figure = about, figure
        return made


@dataclass(frozen=True, slots=True, kw_only=True)
class SolveStats:
    """How the solver fared.

    Attributes:
        passes: outer passes over the whole run; each chooses weights and modes anew.
        iterations: iterations of the non-linear solver, all passes and windows together.
        states: poses in the graph; factors: factors in the graph.
        cost: 2 x the final weighted cost without that of outliers: a chi-square if the model holds. expected_cost: its degrees of
            freedom.
        converged: whether the last pass moved no state noticeably.
        warnings: one line each, for the report.
        online: whether each pose is as it was known at its time; passes, factors and cost then mean nothing.
        events: what happened on the way: online, or that a long run was solved in legs.
    """

    passes: int
    iterations: int
    states: int
    factors: int
    cost: float
    expected_cost: float
    converged: bool
    warnings: tuple[str, ...] = ()
    online: bool = False
    events: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Solution:
    """The estimate of a whole run.

    Attributes:
        datum: origin of world.
        trajectory: poses, velocities and pose covariances of the states.
        v_cov: (N, 3, 3) covariance of velocity, world axes, m^2/s^2.
        accel_bias_mps2, gyro_bias_radps: (N, 3) in IMU axes.
        gyro_radps: (N, 3) angular rate of the body, body axes, bias removed. gyro_cov: (N, 3, 3) of it, rad^2/s^2.
        health, health_reason: N each.
        since_agreed_s: by absolute sensor, (N,) s since it last agreed (inf: never).
        slow: slow states, by sensor.
        berths: the vessel seen from each berth that it comes near.
        ledger: every message of the run.
        stats: how the solver fared.
        offsets: what the run says of lever arms, mounts and stamps; None where that was not computed.
        time_offsets_s: by sensor, what is to be added to its stamps beyond the configured offset, s, where the run estimates it.
        antennas_off_m: by receiver, estimated place of its antenna less the configured one (3,), body axes, where the run estimates it.
        doubts: why no pose is called good.
    """

    datum: Datum
    trajectory: Trajectory
    v_cov: Array
    accel_bias_mps2: Array
    gyro_bias_radps: Array
    gyro_radps: Array
    gyro_cov: Array
    health: tuple[Health, ...]
    health_reason: tuple[HealthReason, ...]
    since_agreed_s: Mapping[str, Array]
    slow: Mapping[str, SlowEstimate]
    berths: tuple[BerthTrack, ...]
    ledger: Ledger
    stats: SolveStats
    offsets: Offsets | None = None
    time_offsets_s: Mapping[str, float] = field(default_factory=dict)
    antennas_off_m: Mapping[str, Array] = field(default_factory=dict)
    doubts: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """What tables and pictures call it."""
        return "graphloc online" if self.stats.online else "graphloc"

    def doubted(self, why: str) -> Solution:
        """Return the solution with no pose's health good; `why`: a sentence."""
        good = [health is Health.GOOD for health in self.health]
        doubt = HealthReason(why, Cause.CONTRADICTION)
        return replace(
            self,
            doubts=(*self.doubts, why),
            health=tuple(Health.DEGRADED if g else health for g, health in zip(good, self.health, strict=True)),
            health_reason=tuple(doubt if g else reason for g, reason in zip(good, self.health_reason, strict=True)),
        )
