# SPDX-License-Identifier: Apache-2.0
"""Deficiencies of fixes: repeated positions, stamps that are truncated or made on arrival, understated noise."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from graphloc.config import GnssConfig
from graphloc.frames import Array, Datum, Geodetic
from graphloc.measurements import GnssPosition, world_from_fixes
from graphloc.signals.white_noise import white_noise_of_thirds
from graphloc.time import NS_PER_S, stamps_of

_HELD_S = 2.5
"""A position that is repeated for less, then changes, was held by a driver; for longer, the receiver stands still."""
_OFTEN, _CUT = 0.2, 0.6  # shares of messages, held, and with repeated stamps or in bursts, from which a warning is due
_ORIGIN_DEG = 0.1  # positions so near to (0, 0) are a simulator's
_AT_ONCE, _BURST_S = 0.1, 0.3  # largest step within a burst, as a share of the mean; closer bursts are harmless
# For the scatter, s: steps below the first hide no motion; above the second they do; largest relative deviation of a
# step; least number of steps.
_FAST_S, _SLOW_S, _EVEN, _FEWEST = 0.25, 1.5, 0.2, 100
# For uneven stamps: largest relative deviation of a step; least number of steps; share of the unevenness that must show
# in the positions if the stamps are right.
_STEADY, _ENOUGH, _MEASURED = 0.5, 30, 0.5
_USUALLY = 90  # percentile of the speed at which an error of stamps counts
_UNSTEADY_MPS2 = 4.0  # of slow fixes: twice the usual change of a craft's acceleration from step to step
_STORED_M, _ANY_MPS = 100.0, 50.0  # least distance of stored positions from the rest; a speed that no craft has
STORED = "a position that the receiver had stored: it repeats it from the first fix on, and the next one is far off"
NOTHING_M = 100.0
"""Claimed sigma from which a fix is of no use."""
SCATTERS = 2.0
"""Ratio of scatter to claimed sigma from which the claim is not believed."""
RTK_SIGMA_M = 0.1
"""Horizontal sigma: fixed RTK claims less, float more."""


def held(fixes: Sequence[GnssPosition]) -> NDArray[np.bool_]:
    """Return (N,) which fixes repeat the preceding position under a new stamp; if that is rare, none.

    Only short repetitions that end with a change count: at rest, a receiver's filter may repeat a position for long.
    """
    bad = np.zeros(len(fixes), dtype=bool)
    order = sorted(range(len(fixes)), key=lambda i: (fixes[i].stamp_ns, fixes[i].seq))
    first = 0
    for k in range(1, len(order)):
        if fixes[order[k]].position != fixes[order[first]].position:
            if fixes[order[k]].stamp_ns - fixes[order[first]].stamp_ns <= _HELD_S * NS_PER_S:
                bad[order[first + 1 : k]] = True
            first = k
    return bad if len(bad) and bad.mean() >= _OFTEN else np.zeros_like(bad)


def stored(stamps_ns: NDArray[np.int64], lla: Array) -> NDArray[np.bool_]:
    """Return (N,) which fixes of one receiver repeat the position where it was last switched off.

    Drivers may say that they are fixes. One position is repeated from the first fix on, the next fix is farther than
    any craft goes meanwhile, and none comes back. At rest, a receiver that holds its position, or has multipath, jumps
    by less.

    Args:
        stamps_ns: (N,), increasing. lla: (N, 3) deg, deg, m, as received.
    """
    bad = np.zeros(len(stamps_ns), dtype=bool)
    changes = np.flatnonzero((lla[1:, :2] != lla[:-1, :2]).any(axis=1)) + 1
    if len(changes) < 2 or changes[0] < 2:
        return bad
    after = int(changes[0])
    places = Datum(Geodetic(*lla[0])).enu_from_geodetic(*lla[after:].T)
    silent_s = float(stamps_ns[after] - stamps_ns[after - 1]) / NS_PER_S
    bad[:after] = np.linalg.norm(places[:, :2], axis=1).min() > _STORED_M + _ANY_MPS * silent_s
    return bad


def stored_warning(sensor: str, lla: Array, bad: NDArray[np.bool_]) -> list[str]:
    """Return a warning on what `stored` found in fixes (N, 3), deg, deg, m."""
    if not bad.any():
        return []
    (old, new), count = lla[[0, int(bad.sum())], :2], int(bad.sum())
    said = f"{sensor}: its first {count} fixes repeat {old[0]:.5f}, {old[1]:.5f}, and the next is at {new[0]:.5f}, {new[1]:.5f}"
    return [f"{said}: {STORED}; they are rejected"]


def radians_warning(sensor: str, lla: Array) -> list[str]:
    """Return a warning if all positions (N, 3), deg, deg, m, lie where coordinates in rad do.

    That is a corner of the Gulf of Guinea without land. Positions near (0, 0) are excepted: simulators have their
    origin there.
    """
    most = np.abs(lla[:, :2]).max(axis=0) if len(lla) else np.zeros(2)
    if most.max() < _ORIGIN_DEG or most[0] > np.pi / 2.0 or most[1] > np.pi:
        return []
    lat, lon = np.median(lla[:, :2], axis=0)
    said = f"{sensor}: all fixes lie near {lat:.5f}, {lon:.5f} deg, in the Gulf of Guinea: unless the vessel was there, its driver writes rad"
    return [
        f"{said} ({np.degrees(lat):.5f}, {np.degrees(lon):.5f} deg), and the track is 57 times too short: convert them"
    ]


def held_warning(sensor: str, bad: NDArray[np.bool_]) -> list[str]:
    """Return a warning if a driver repeats positions, as `held` found."""
    if not bad.any():
        return []
    said = f"{sensor}: {int(bad.sum())} of {len(bad)} fixes repeat the previous position under a new stamp: the driver "
    return [f"{said}publishes faster than the receiver measures; each position is used once, at its first stamp"]


def stamp_warning(sensor: str, stamps_ns: NDArray[np.int64]) -> list[str]:
    """Return a warning if stamps (N,) of different measurements come in bursts, or are often equal, as if truncated."""
    moments = np.unique(stamps_ns)
    steps_s = np.diff(moments) / NS_PER_S
    if len(moments) > 3 and float((steps_s < _AT_ONCE * steps_s.mean()).mean()) > _CUT:
        apart_s = float(np.median(steps_s[steps_s >= _AT_ONCE * steps_s.mean()]))
        if apart_s < _BURST_S:
            return []
        said = f"{sensor}: its measurements are stamped in bursts, {apart_s:.1f} s apart: with their time of arrival, not of measurement"
        return [f"{said}; times are off by up to that, positions by that times the speed, which no bound includes"]
    if len(moments) < 3 or 1.0 - len(moments) / len(stamps_ns) < _CUT:
        return []
    step_s = float(np.median(np.diff(moments))) / NS_PER_S
    said = f"{sensor}: {len(stamps_ns)} measurements have {len(moments)} stamps, {step_s:g} s apart: the driver truncates them"
    said += (
        "; times are off by up to that, positions by that times the speed, which no bound includes: fix the driver, or "
    )
    return [f"{said}set `stamps: recorded`, as `inspect` drafts it for whole seconds"]


def height_warning(sensor: str, fixes: Sequence[GnssPosition]) -> list[str]:
    """Return a warning if fixes have no height, or 0 instead of one."""
    if len(fixes) >= _FEWEST and all(m.has_height and m.position.height_m == 0.0 for m in fixes):
        said = f"{sensor}: all {len(fixes)} fixes have a height of 0, as from a receiver that has none"
        return [f"{said}: the track's height is off by an amount that no bound includes; let the driver write NaN"]
    flat = sum(not m.has_height for m in fixes)
    if not flat:
        return []
    said = f"{sensor}: {flat} of {len(fixes)} fixes have no height (altitude is NaN) and are used as horizontal fixes"
    if flat < len(fixes):
        return [said]
    return [f"{said}: without another source of height (kind: height, poses, tags) the track's height is a guess"]


def scatter_warning(sensor: str, fixes: Sequence[GnssPosition], config: GnssConfig) -> list[str]:
    """Return a warning if fixes scatter by far more than they claim, or claim so large a sigma as to be useless."""
    if len(fixes) < _FEWEST:
        return []
    ordered = sorted(fixes, key=lambda m: (m.stamp_ns, m.seq))
    lla = np.array([m.position for m in ordered])
    places = Datum(ordered[0].position).enu_from_geodetic(lla[:, 0], lla[:, 1], lla[:, 2])[:, :2]
    found = scatter_m(stamps_of(ordered), places)
    variances = np.array([np.diagonal(m.cov_enu_m2)[:2] for m in ordered])
    reported = float(np.sqrt(np.median(variances, axis=0).max()))
    claimed = max(config.sigma_scale * reported, config.min_horizontal_sigma_m)
    if claimed > NOTHING_M:
        scatter = "" if found is None else f", though consecutive fixes scatter by {found:.2f} m"
        said = f"{sensor}: its fixes claim a sigma of {claimed:.0f} m, so they have almost no weight{scatter}"
        return [f"{said}: check the covariance that the driver writes, and sigma_scale"]
    if found is None or found < SCATTERS * claimed:
        return []
    said = f"{sensor}: consecutive fixes scatter by {found:.2f} m but claim a sigma of {claimed:.2f} m"
    return [f"{said}: set sigma_scale: {found / reported:.1f}"]


def uneven_warning(sensor: str, fixes: Sequence[GnssPosition], config: GnssConfig) -> list[str]:
    """Return a warning if fixes are stamped so unevenly that their error along the way is far more than they claim."""
    if len(fixes) < _ENOUGH:
        return []
    moments = {m.stamp_ns: m for m in sorted(fixes, key=lambda m: (m.stamp_ns, m.seq))}
    places = world_from_fixes(list(moments.values()), Datum(fixes[0].position))[:, :2]
    found = uneven(np.array(list(moments)), places)
    reported = float(np.sqrt(np.median([np.diagonal(m.cov_enu_m2)[:2] for m in fixes], axis=0).max()))
    claimed = max(config.sigma_scale * reported, config.min_horizontal_sigma_m)
    if found is None or found.along_m < SCATTERS * claimed:
        return []
    said = f"{sensor}: its {found.said}, more than its sigma of {claimed:.2f} m"
    return [f"{said}: set min_horizontal_sigma_m: {found.along_m:.2g}"]


class Uneven(NamedTuple):
    """By how much stamps of fixes are off even times, 1 sigma, and the speed at which that counts."""

    stamps_s: float
    speed_mps: float

    @property
    def along_m(self) -> float:
        """Error of the fixes along the way, m, 1 sigma."""
        return self.stamps_s * self.speed_mps

    @property
    def said(self) -> str:
        """The unevenness in words."""
        return (
            f"stamps are uneven by {self.stamps_s:.3f} s, as where fixes are stamped on arrival: {self.along_m:.2f} m "
            f"at {self.speed_mps:.1f} m/s"
        )


def uneven(stamps_ns: NDArray[np.int64], p_m: Array) -> Uneven | None:
    """Return how unevenly a receiver's fixes are stamped; None of too few, or if the stamps are right.

    A receiver measures at even times. A driver that stamps on arrival adds the latency of each message, which the speed
    turns into metres. Stamps may also be right though uneven: then the positions are as uneven, times the velocity.

    Args:
        stamps_ns: (N,), increasing. p_m: (N, 2) or more columns, m, east, north.
    """
    t = (stamps_ns - stamps_ns[:1]) / NS_PER_S
    steps = np.diff(t)
    if len(steps) < _ENOUGH:
        return None
    good = _three_usual(steps, float(np.median(steps)), _STEADY)
    if good.sum() < _ENOUGH:
        return None
    thirds = np.diff(t, n=3)[good]
    v = ((p_m[3:, :2] - p_m[:-3, :2]) / (t[3:] - t[:-3])[:, None])[good]
    by_stamps, by_places = v * thirds[:, None], np.diff(p_m[:, :2], n=3, axis=0)[good]
    power = float((by_stamps**2).sum())
    if power == 0.0 or float((by_stamps * by_places).sum()) > _MEASURED * power:
        return None
    speed = float(np.percentile(np.hypot(v[:, 0], v[:, 1]), _USUALLY))
    return Uneven(float(white_noise_of_thirds(thirds)), speed)


def _three_usual(steps: Array, usual: float, share: float) -> NDArray[np.bool_]:
    """Return which third differences (N - 2,) span three of N steps that are all usual, to within a share of that."""
    even = np.abs(steps - usual) < share * usual
    return np.asarray(even[:-2] & even[1:-1] & even[2:])


def scatter_m(stamps_ns: NDArray[np.int64], p_m: Array) -> float | None:
    """Return the white noise of positions (N, 2), m, 1 sigma of the worst axis; None of few, or if it may be motion."""
    steps = np.diff(stamps_ns) / NS_PER_S
    if len(steps) < _FEWEST:
        return None
    usual = float(np.median(steps))
    good = _three_usual(steps, usual, _EVEN)
    if usual > _SLOW_S or good.sum() < _FEWEST:
        return None
    thirds = np.diff(p_m, n=3, axis=0)[good]
    if usual > _FAST_S and np.median(np.abs(thirds), axis=0).max() < _UNSTEADY_MPS2 * usual**2:
        return None
    return float(white_noise_of_thirds(thirds).max())
