# SPDX-License-Identifier: Apache-2.0
"""A frozen receiver (or driver): it repeats one position, exactly or but for noise, while the vessel moves on.

It is detected over a whole run before that is solved, because with few other sensors the graph would follow the frozen
position by a false tilt and bias. At rest a receiver may rightly repeat one position for minutes, so the vessel must
have been under way. Then either of two signs tells. Usually, the next different position is a jump away. Where there is
no next position, or it comes so late that the vessel may have gone there from rest, or is so far off that the vessel
may have turned back meanwhile, the sign is that the vessel stopped from one fix to the next, faster than it can brake.
Online: `online/_frozen_receiver.py`, `online/_repeated_fix.py`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from types import MappingProxyType
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from graphloc.frames import Array, Datum
from graphloc.ledger import Outcome
from graphloc.measurements import GnssPosition, GnssVelocity, Measurement, world_from_fixes
from graphloc.recording import Recording
from graphloc.signals.frozen_imu import stretches
from graphloc.signals.series import line_fit, runs
from graphloc.time import NS_PER_S, stamps_of

_M = TypeVar("_M", bound=Measurement)
FROZEN = "frozen receiver"
"""Begin of the reason for which fixes of a frozen receiver are rejected, offline and online."""
FROZEN_FIX = f"{FROZEN} or driver: it repeats one position while the vessel moves"
FROZEN_VELOCITY = f"{FROZEN} or driver: it repeats one velocity bit for bit"
# Least duration, and number of fixes, of a stretch of one position; a driver that publishes each fix several times
# repeats it for less (`frontends/_fixes.py`).
HELD_S, FEWEST = 2.5, 3
_NOISE_M = 0.5  # farthest that the fixes of one position may be from their mean
BEFORE_S = 3.0  # length of the time before a stretch whose fixes give the speed
_SIGMAS = 3.0  # a speed must exceed what it is compared with by so many of its sigmas
UNDER_WAY_MPS = 0.5  # less is no way: a moored vessel surges and swings, and fixes at rest drift; a choice
_JUMP_M, _SHARE = 2.0, 0.5  # least jump after a stretch, and least share of it in the way at the speed before
_FAR_M = 20.0  # a vessel may have turned back before a farther jump, or it is multipath at rest
# Of velocities: least share of values that come once (if fewer do, they are rounded); number of equal ones in a row
# that is too many; speed up to which they may repeat, at rest.
MOSTLY, MANY, REST_MPS = 0.9, 5, 0.1
# A receiver is known to scatter at rest once it has done so for this time, this often.
REST_S, SEEN = 5.0, 2
# A vessel cannot stop between two fixes from a speed above the first number plus what it loses by braking with the
# second; nor does it set off with a larger acceleration.
_STOPS_MPS, _BRAKES_MPS2 = 1.5, 3.0


def frozen_fixes(stamps_ns: NDArray[np.int64], lat_lon_deg: Array, places_m: Array) -> NDArray[np.bool_]:
    """Return a mask (N,) of the fixes that a frozen receiver repeats.

    Args:
        stamps_ns: (N,), in order of time. lat_lon_deg: (N, 2), as received.
        places_m: (N, 2), the same positions in a local level frame.
    """
    bad = np.zeros(len(stamps_ns), dtype=bool)
    if not len(bad):
        return bad
    t_s = (stamps_ns - stamps_ns[0]) / NS_PER_S
    changes = (lat_lon_deg[1:] != lat_lon_deg[:-1]).any(axis=1)
    firsts = np.concatenate([[0], np.flatnonzero(changes) + 1])
    scatters_from = _scatters_from(t_s, places_m, np.append(True, changes))
    for first, after in zip(firsts, [*firsts[1:], len(bad)], strict=True):
        if after - first >= FEWEST and t_s[after - 1] - t_s[first] >= HELD_S:
            bad[first + 1 : after] = _is_frozen(
                t_s[: after + 1], places_m[: after + 1], int(first), int(after), scatters=first >= scatters_from
            )
    return bad | _frozen_but_for_noise(t_s, places_m, bad)


def under_way(t_s: Array, places_m: Array) -> float | None:
    """Return the speed (m/s) over fixes at times (N,), s, and places (N, 2), m; None if the vessel may be at rest."""
    if len(t_s) < FEWEST:
        return None
    speed, sigma = speed_of(t_s, places_m)
    return speed if speed - _SIGMAS * sigma > UNDER_WAY_MPS else None


def _frozen_but_for_noise(t_s: Array, places_m: Array, known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return a mask (N,) of the fixes that repeat one position but for its noise.

    Any receiver does so at rest, and multipath may jump from there. So the vessel must have been under way until the
    stretch begins, and again after the jump that ends it.

    Args:
        known: (N,) exact repetitions of a frozen receiver; a stretch that has any is left out.
    """
    bad = np.zeros(len(t_s), dtype=bool)
    held = np.searchsorted(t_s, t_s + HELD_S)  # index of the first fix that is so much later
    before = np.searchsorted(t_s, t_s - BEFORE_S)
    there = held[held < len(t_s)]
    stays = np.linalg.norm(places_m[there] - places_m[: len(there)], axis=1) < 2.0 * _NOISE_M
    first = 0
    while first < len(there):
        if not stays[first] or held[first] - first < FEWEST:
            first += 1
            continue
        after = _gone(places_m, first, int(held[first]))
        if after == len(t_s) or known[first:after].any():
            first = after
        elif after <= held[first]:  # the vessel was under way
            first += 1
        elif (
            _stopped_at_once(t_s, places_m, first, UNDER_WAY_MPS)
            and _jumps_on(t_s, places_m, first, after)
            and under_way(*(of[after : np.searchsorted(t_s, t_s[after] + BEFORE_S)] for of in (t_s, places_m)))
            is not None
        ):
            bad[first + 1 : after] = True
            first = after
        else:
            # At rest if it was there before, too.
            at_rest = np.linalg.norm(places_m[before[first]] - places_m[first]) < 2.0 * _NOISE_M
            first = after if at_rest else first + 1
    return bad


def _scatters_from(t_s: Array, places_m: Array, changes: NDArray[np.bool_]) -> int:
    """Return the index of the fix from which on the receiver is known to scatter at rest; N if that is never known.

    It is known once the receiver has been at rest several times without repeating a position.

    Args:
        changes: (N,), whether a position differs from that of the fix before.
    """
    seen, first = 0, 0
    while first < len(t_s):
        after = int(np.searchsorted(t_s, t_s[first] + REST_S, side="right"))
        seen += (
            bool(changes[first + 1 : after].all())
            and after < len(t_s)
            and stands(t_s[first:after], places_m[first:after])
        )
        if seen >= SEEN:
            return after
        first = max(int(np.searchsorted(t_s, t_s[first] + REST_S / 2.0)), first + 1)
    return len(t_s)


def stands(t_s: Array, places_m: Array) -> bool:
    """Return whether fixes at times (N,), s, and places (N, 2), m, are of a vessel at rest."""
    return len(t_s) >= MANY and speed_of(t_s, places_m)[0] < REST_MPS


def _gone(places_m: Array, first: int, held: int) -> int:
    """Return the index of the first fix after `first` that is farther than noise from the mean of [first, held).

    The number of fixes where there is none.
    """
    middle, long = places_m[first:held].mean(axis=0), held - first
    while True:
        away = np.linalg.norm(places_m[first : first + long] - middle, axis=1) > _NOISE_M
        if away.any():
            return first + int(np.argmax(away))
        if first + long >= len(places_m):
            return len(places_m)
        long *= 2


def _is_frozen(t_s: Array, places_m: Array, first: int, after: int, *, scatters: bool) -> bool:
    """Return whether a stretch of one position, fixes [first, after), is of a frozen receiver.

    Args:
        after: fix at which the position changes, or N where the run ends.
        scatters: whether the receiver is known to scatter at rest, so that it does not repeat a position there.
    """
    if after < len(t_s):
        silent_s = t_s[after] - t_s[after - 1]
        jump_m = float(np.linalg.norm(places_m[after] - places_m[first]))
        if scatters and jump_m > max(_JUMP_M, _set_off_m(silent_s)):
            return True
        if _jumps_on(t_s, places_m, first, after):
            return True
        if jump_m <= _FAR_M and (silent_s < HELD_S or jump_m > _set_off_m(silent_s)):
            return False
    return _stopped_at_once(t_s, places_m, first, _STOPS_MPS)


def _jumps_on(t_s: Array, places_m: Array, first: int, after: int) -> bool:
    """Return whether the vessel was under way before fix `first`, and jumps on at fix `after` (`goes_on`)."""
    before = np.append(_before(t_s, first), first)
    speed = under_way(t_s[before], places_m[before])
    if speed is None:
        return False
    jump_m = float(np.linalg.norm(places_m[after] - places_m[first]))
    return goes_on(jump_m, speed, t_s[after] - t_s[first], t_s[after] - t_s[after - 1])


def goes_on(jump_m: float, speed_mps: float, held_s: float, silent_s: float) -> bool:
    """Return whether a position that was repeated jumps on as far as that of a frozen receiver does.

    Args:
        jump_m: size of the jump. speed_mps: before the position was repeated.
        held_s: from the first fix at that position to the jump. silent_s: from the last fix there to the jump.
    """
    return jump_m > max(_JUMP_M, _set_off_m(silent_s), _SHARE * speed_mps * held_s)


def _set_off_m(silent_s: float) -> float:
    """Return how far (m) a vessel may have gone from rest while the receiver was silent."""
    return _BRAKES_MPS2 * silent_s**2 / 2.0


def _stopped_at_once(t_s: Array, places_m: Array, first: int, least_mps: float) -> bool:
    """Return whether the vessel was under way before fix `first`, too fast to have stopped there by braking.

    Args:
        least_mps: speed that is allowed besides what braking between the two fixes explains.
    """
    before = _before(t_s, first)
    if len(before) < 2:
        return False
    way = np.append(before, first)
    later = way[len(way) // 2 :]  # a vessel that brakes is slower there, and its whole way fits no line
    (speed, sigma), (last, noise) = (speed_of(t_s[of], places_m[of]) for of in (way, later))
    step_s = t_s[first] - t_s[before[-1]]
    return bool(min(speed, last) - _SIGMAS * max(sigma, noise) > least_mps + _BRAKES_MPS2 * step_s)


def _before(t_s: Array, first: int) -> NDArray[np.int64]:
    """Return the indices of the fixes before fix `first` that give the speed."""
    return np.arange(*np.searchsorted(t_s, [t_s[first] - BEFORE_S, t_s[first]]))


def speed_of(t_s: Array, places_m: Array) -> tuple[float, float]:
    """Return the speed (m/s) of a straight line through places (N, 2), m, at times (N,), s, and its sigma.

    The sigma is that which the residuals of the line give.
    """
    line = line_fit(t_s, places_m)
    scatter_m = float(np.sqrt((line.left**2).sum() / max(2 * len(t_s) - 4, 1)))
    return float(np.linalg.norm(line.slope)), scatter_m * line.sigma


def frozen_velocities(stamps_ns: NDArray[np.int64], v_mps: Array) -> NDArray[np.bool_]:
    """Return a mask (N,) of the velocities that a frozen receiver repeats.

    A velocity measured under way does not stay the same for seconds, unless it is rounded; at rest it may.

    Args:
        stamps_ns: (N,), in order of time. v_mps: (N, 3), as received.
    """
    bad = np.zeros(len(stamps_ns), dtype=bool)
    if not len(bad):
        return bad
    firsts = np.concatenate([[0], np.flatnonzero((v_mps[1:] != v_mps[:-1]).any(axis=1)) + 1, [len(bad)]])
    if np.mean(np.diff(firsts) == 1) < MOSTLY:
        return bad
    for first, after in pairwise(firsts.tolist()):
        long = after - first >= MANY and stamps_ns[after - 1] - stamps_ns[first] >= HELD_S * NS_PER_S
        bad[first + 1 : after] = long and float(np.linalg.norm(v_mps[first])) > REST_MPS
    return bad


def frozen_fixes_warning(sensor: str, stamps_ns: NDArray[np.int64], bad: NDArray[np.bool_]) -> list[str]:
    """Return a warning on the fixes `bad` (N,) that `frozen_fixes` found, or none."""
    if not bad.any():
        return []
    return [f"{sensor}: for {stretches(stamps_ns, bad)} {FROZEN_FIX}; {int(bad.sum())} fixes rejected"]


def without_frozen_fixes(
    recording: Recording, datum: Datum, receivers: Mapping[str, str]
) -> tuple[Recording, list[str]]:
    """Return a recording without what frozen receivers repeat, and a warning on each such receiver.

    The repeated fixes and velocities get ledger rows instead.

    Args:
        receivers: by sensor, one name for all sensors that read one receiver by turns (`VesselConfig.receiver_of`):
            after a receiver hung with RTK, its next fix may be one without.
    """
    gone: dict[int, str] = {}
    said = []
    # (K, 2) first and last stamp of each run of repeated velocities, where the vessel was under way.
    hung = np.zeros((0, 2), dtype=np.int64)
    for sensor, velocities in _by_sensor(recording, GnssVelocity).items():
        stamps_ns, v_mps = stamps_of(velocities), np.array([m.v_enu_mps for m in velocities])
        bad = frozen_velocities(stamps_ns, v_mps)
        hanging = runs(bad & (np.linalg.norm(v_mps, axis=1) > UNDER_WAY_MPS))
        hung = np.vstack([hung, stamps_ns[hanging - [0, 1]]])
        gone |= {m.seq: FROZEN_VELOCITY for m, b in zip(velocities, bad, strict=True) if b}
        if bad.any():
            said.append(
                f"{sensor}: for {stretches(stamps_ns, bad)} {FROZEN_VELOCITY}; {int(bad.sum())} velocities rejected"
            )
    for sensor, fixes in _by_sensor(recording, GnssPosition, receivers).items():
        stamps_ns, lat_lon = stamps_of(fixes), np.array([m.position[:2] for m in fixes])
        bad = frozen_fixes(stamps_ns, lat_lon, world_from_fixes(fixes, datum)[:, :2])
        # Where a velocity is frozen, repeated fixes are, too: one receiver, or its driver, gives both.
        meanwhile = np.any((stamps_ns[:, None] >= hung[:, 0]) & (stamps_ns[:, None] <= hung[:, 1]), axis=1)
        bad[1:] |= np.all(lat_lon[1:] == lat_lon[:-1], axis=1) & meanwhile[1:]
        gone |= {m.seq: FROZEN_FIX for m, b in zip(fixes, bad, strict=True) if b}
        said += frozen_fixes_warning(sensor, stamps_ns, bad)
    if not gone:
        return recording, said
    rows = (recording.row_of(m, Outcome.REJECTED, gone[m.seq]) for m in recording.measurements if m.seq in gone)
    left = recording.where(lambda m: m.seq not in gone)
    return replace(left, rows=(*recording.rows, *rows)), said


def _by_sensor(
    recording: Recording, kind: type[_M], receivers: Mapping[str, str] = MappingProxyType({})
) -> dict[str, list[_M]]:
    found: dict[str, list[_M]] = {}
    for m in recording.of(kind):
        found.setdefault(receivers.get(m.sensor, m.sensor), []).append(m)
    return found
