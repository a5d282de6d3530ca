# SPDX-License-Identifier: Apache-2.0
"""Position jumps of a receiver (multipath, wrong RTK fix) where no other sensor measures position.

The track follows such jumps, and the stated sigma does not show them: a wrong RTK fix is stated to a centimetre, as a
right one is. They are found in the positions themselves, by comparing each step with those before and after it: no
vessel changes its acceleration by so much at once. Offline, smaller jumps are found in a solution, too. There the IMU
keeps the track from following a jump at once, so the fixes lie to one side of the track before the jump, and to the
other side after it.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Collection
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from graphloc.frames import Array
from graphloc.signals.level_steps import FEWEST_BESIDE, level_steps
from graphloc.time import NS_PER_S, duration_ns, utc_text

LASTS_S = 200.0
"""Time (s) before and after a jump in which either side may be the wrong one: about as long as a slow error lasts."""
# Size that counts whatever the stated sigma, at a fix per second: as motion, 4 m/s^2 that come and go within three
# seconds.
_JUMP_M = 3.0
_JUMP = 10.0  # least size, in usual differences between a step and those beside it
_FEWEST = 10  # fixes that are needed for the usual difference; its neighbourhood has so many on either side
_AROUND = 0.75  # factor on the median of a neighbourhood, which is usually above that of the whole run
_SIGMAS = 10.0  # least size in stated sigmas of a fix: less is its noise
_BRAKES_MPS2 = 10.0  # emergency braking of a car to a stop between two fixes: a smaller difference is motion
_EVEN = 1.5  # steps that last longer or shorter than usual by more than this factor are not compared
_BURST_S = 1.0  # fixes that are off for no longer are outliers
_FAST_S = 0.25  # time between fixes up to which the motion within a second is even
# Of `jumps_off_track`, which compares the medians of the fixes on either side of a jump.
_SLOW_S = 2.5  # time between fixes from which two on either side are enough: the track follows after these
_OFF_M = 1.0  # least difference of the two medians
_KEPT = 200  # fixes and jumps kept online, to bound memory: ten seconds of a receiver at 20 Hz; a choice
_FITS_SIGMAS = 5.0  # off its prediction, up to which the fix before a jump fits
_CERTAIN_SIGMAS = 8.0  # off its prediction, from which the fix after a jump does not fit
_SAME, _SAME_SIGMAS = 0.25, 3.0  # fixes are off by the same if they differ by less than this share plus so many sigmas
_ENDS = 10.0  # odds from which a jump counts as over
_IMU_OFF_MPS2 = 1.0  # by how much an IMU may be wrong: gravity, where it is tilted by 6 deg

MEAN_S = 30.0
"""Mean duration of a jump, s."""


def only_position_sensor(stream: Any, absolute: Collection[Any]) -> bool:
    """Return whether a stream is the only one that measures position, and may jump.

    That holds also beside a sensor of velocity, where its slow error is estimated: a window still follows a jump that
    the steps of that error do not allow for, because no other sensor holds the place.

    Args:
        absolute: the streams of the run that measure position.
    """
    alone = len(absolute) == 1 and stream.row.absolute and not stream.row.has_hypotheses
    return bool(alone and (stream.slow is None or stream.left_out is not None or stream.slow.jumps))


def position_jumps(
    stamps_ns: NDArray[np.int64], places_m: Array, sigma_m: Array, *, allowed_m: float
) -> tuple[NDArray[np.int64], Array]:
    """Return stamps (K,), ns, and sizes (K,), m, of the position jumps: steps unlike those before and after.

    The stamp is that of the first fix after the jump. A single outlier, or a burst of them, is no jump: the track does
    not follow it.

    Args:
        stamps_ns: (N,), increasing. places_m: (N, 2), in a local level frame. sigma_m: (N,) as stated.
        allowed_m: size up to which the bounds already include a jump (`build.allowed_jump_m`).
    """
    if len(stamps_ns) < _FEWEST:
        return _none()
    steps, dt = np.diff(places_m, axis=0), np.diff(stamps_ns) / NS_PER_S
    usual_s = float(np.median(dt))
    # Steps are proportional to the time between stamps if these are of the measurements, but not if they are of
    # arrival.
    by_time = _parts(steps * (usual_s / np.maximum(dt, 1e-9))[:, None])
    parts = _parts(steps)
    off_m = np.minimum(np.linalg.norm(parts, axis=1), np.linalg.norm(by_time, axis=1))
    padded = np.pad(off_m, 1)
    beside = np.maximum(padded[:-2], padded[2:])  # the steps beside a jump differ by half of it
    # Two steps together against those before and after: an outlier goes there and back, so it disappears in them.
    both = np.linalg.norm(steps[1:-2] + steps[2:-1] - steps[:-3] - steps[3:], axis=1)
    both = np.minimum(np.append(both, np.inf), np.append(np.inf, both))
    window = np.lib.stride_tricks.sliding_window_view
    even = (window(dt, 3).max(axis=1) < _EVEN * usual_s) & (window(dt, 3).min(axis=1) * _EVEN > usual_s)
    # In a gap the vessel may have gone anywhere; where fixes are seconds apart, any turn or stop makes steps differ by
    # metres.
    believed_m = np.maximum(_BRAKES_MPS2 * usual_s**2 / 2.0, _SIGMAS * window(sigma_m, 4).max(axis=1))
    least_m = np.minimum(_JUMP_M * max(usual_s, 1.0) ** 2, np.maximum(believed_m, allowed_m))
    large = even & (off_m >= beside) & (off_m > least_m) & (both > off_m / 2.0)
    if not large.any():  # what is usual takes most of the time, and online there is a fix several times a second
        return _none()
    far = np.flatnonzero(large & (off_m > _JUMP * _usual(off_m)))
    far = far[(far > 0) & (far < len(off_m) - 1)]  # at either end an outlier looks like half a jump
    near = np.abs(np.subtract.outer(stamps_ns[far], stamps_ns[far])) <= _BURST_S * NS_PER_S
    back = np.linalg.norm(parts[far][:, None] + parts[far][None], axis=2) < off_m[far] / 2.0
    far = far[~(near & back).any(axis=1)]
    if usual_s <= _FAST_S:
        far = far[[_stays(places_m, int(n) + 2, float(off_m[n]), usual_s) for n in far]]
    return stamps_ns[far + 2], off_m[far]


def _stays(places_m: Array, at: int, off_m: float, usual_s: float) -> bool:
    """Return whether the places (N, 2) from index `at` on lie off those before, as after a jump of `off_m`.

    Two outliers close to each other, with right fixes between them, look like a jump there and another one back by another way. The medians
    of some fixes on either side are compared, less the usual motion between them.
    """
    n = max(round(_BURST_S / 2.0 / usual_s), FEWEST_BESIDE)
    before, after = places_m[max(at - n, 0) : at], places_m[at : at + n]
    if min(len(before), len(after)) < FEWEST_BESIDE:
        return True
    steps = np.diff(np.concatenate([before, after]), axis=0)
    moved_m = np.median(steps, axis=0) * (len(before) + len(after)) / 2.0
    change_m = np.median(after, axis=0) - np.median(before, axis=0) - moved_m
    return bool(np.linalg.norm(change_m) > off_m / 2.0)


def jumps_off_track(stamps_ns: NDArray[np.int64], off_m: Array, *, allowed_m: float) -> tuple[NDArray[np.int64], Array]:
    """Return stamps (K,), ns, and sizes (K,), m, of the position jumps that an estimated track does not follow at once.

    The medians of some fixes before and after are compared, so that outliers do not count.

    Args:
        stamps_ns: (N,), increasing. off_m: (N, 2) fixes less the track.
        allowed_m: size up to which the bounds already include a jump (`build.allowed_jump_m`).
    """
    dt_s = np.diff(stamps_ns) / NS_PER_S
    slow = len(dt_s) > 0 and float(np.median(dt_s)) >= _SLOW_S
    at_ns, changes_m = level_steps(stamps_ns, off_m, max(_OFF_M, allowed_m), fewest=2 if slow else FEWEST_BESIDE)
    return at_ns, np.linalg.norm(changes_m, axis=1)


def _parts(steps_m: Array) -> Array:
    """Return the difference (N - 2, 2) between each inner step (N, 2) and the mean of the steps beside it."""
    return np.asarray(steps_m[1:-1] - (steps_m[:-2] + steps_m[2:]) / 2.0)


def _usual(off_m: Array) -> Array:
    """Return the usual step difference (N,): the median of all, or of the neighbourhood where that is larger.

    The scatter of fixes may grow for a while.
    """
    around = np.lib.stride_tricks.sliding_window_view(np.pad(off_m, _FEWEST, mode="reflect"), 2 * _FEWEST + 1)
    return np.asarray(np.maximum(np.median(around, axis=1) * _AROUND, np.median(off_m)))


def jump_warnings(
    sensor: str, stamps_ns: NDArray[np.int64], off_m: Array, *, allowed: bool, followed: bool = True
) -> list[str]:
    """Return a warning on the jumps that `position_jumps` found, or none.

    Args:
        stamps_ns, off_m: (K,) stamps and sizes, m. allowed: whether the bounds include them.
        followed: whether the track follows the jumps; else they are attributed to the receiver's slow error.
    """
    if not len(stamps_ns):
        return []
    n = int(np.argmax(off_m))
    size = f"{off_m[n]:.0f}" if off_m[n] >= 1.0 else f"{off_m[n]:.1g}"
    others = f", and {len(off_m) - 1} more" if len(off_m) > 1 else ""
    bounds = "" if allowed else "; the bounds do not cover it, because its slow_error is switched off"
    where = f"{size} m at {utc_text(int(stamps_ns[n]))}{others}"
    if not followed:
        return [f"{sensor}: position jump of {where}: treated as its error (multipath) where the IMU contradicts it"]
    said = f"{sensor}: position jump of {where}: the track follows it, and the IMU and the compass may look wrong there"
    return [f"{said}{bounds}"]


def largest_sigma(cov: Array) -> float:
    """Return the largest standard deviation in the plane of the first two axes of cov (>= 2, >= 2)."""
    return float(np.sqrt(np.linalg.eigvalsh(cov[:2, :2])[-1]))


def why_in_doubt(sensor: str) -> str:
    """Return the reason why the health of a pose near a position jump is not good."""
    return f"position jump of {sensor}, and no other sensor measures position"


def _none() -> tuple[NDArray[np.int64], Array]:
    return np.zeros(0, dtype=np.int64), np.zeros(0)


class PositionJump(NamedTuple):
    """A position jump.

    Attributes:
        after_ns: stamp of the first fix after it. east_m, north_m: the positions after it less those before.
    """

    after_ns: int
    east_m: float
    north_m: float

    @property
    def parts(self) -> tuple[float, ...]:
        """The jump in the unit in which the receiver's slow error is written, m."""
        return self.east_m, self.north_m

    @property
    def until_ns(self) -> int:
        """Stamp at which it is over."""
        return self.after_ns

    @property
    def at_once(self) -> bool:
        """Whether positions move at once, not little by little."""
        return True

    @property
    def size_m(self) -> float:
        """Length of the jump, m."""
        return math.hypot(self.east_m, self.north_m)


class OffPrediction(NamedTuple):
    """A fix against its prediction.

    Attributes:
        off_m: (2,) fix less prediction. sigmas: size of that in sigmas.
        sigmas_without: the same against the prediction without the slow error, as if that were over.
    """

    off_m: Array
    sigmas: float
    sigmas_without: float


class JumpDetector:
    """Finds the position jumps of one receiver online, about a second late, by its fixes or by what the IMU predicts.

    The fixes alone do not show a jump among steps of its size: noise, or a vessel that goes metres between two fixes. A
    receiver that is off its prediction by the same vector for a second has jumped; the error of an IMU that is wrong
    would grow.

    Attributes:
        jumps: the last of the jumps found since the estimate started.
    """

    def __init__(self) -> None:
        self.jumps: tuple[PositionJump, ...] = ()
        self._seen: deque[tuple[int, Array, float]] = deque(maxlen=_KEPT)
        self._judged_ns = 0
        self._last_ns: int | None = None
        self._before: tuple[int, OffPrediction] | None = None  # of the last fix
        self._off: list[tuple[int, Array]] = []  # of the fixes since a suspected jump began

    def suspects(self, stamp_ns: int) -> bool:
        """Return whether a fix belongs to a suspected jump, or a burst of outliers: within seconds it is known.

        Fixes from before it do not belong to it, even if they come late, or once more as the window is rebuilt.
        """
        return bool(self._off) and stamp_ns >= self._off[0][0]

    def forget(self) -> None:
        """Forget the jumps, found and suspected: the estimate that they are off is given up."""
        self.jumps, self._off, self._before = (), [], None

    def let_go(self) -> None:
        """Forget a suspected jump, because another sensor measures position now, and shows what is right.

        Nor are jumps looked for later among the fixes so far.
        """
        self._off, self._before = [], None
        if self._seen:
            self._judged_ns = max(self._judged_ns, self._seen[-1][0])

    def forget_since(self, stamp_ns: int) -> None:
        """Forget the fixes since a stamp, and the jumps found in them.

        The receiver was frozen since then, or the IMU that predicted them was wrong, so they may be none.
        """
        self._seen = deque((kept for kept in self._seen if kept[0] < stamp_ns), maxlen=_KEPT)
        self.jumps = tuple(jump for jump in self.jumps if jump.after_ns < stamp_ns)
        if self._last_ns is not None and self._last_ns >= stamp_ns:
            self._last_ns = self.jumps[-1].after_ns if self.jumps else None
        self._off, self._before = [], None

    def note(
        self, stamp_ns: int, place_m: Array, sigma_m: float, *, allowed_m: float, off: OffPrediction | None = None
    ) -> tuple[NDArray[np.int64], Array]:
        """Take in a fix, unless it is late, and return new jumps as `position_jumps` does.

        While an earlier jump leaves the position in doubt, no further ones are returned.

        Args:
            place_m: (2,) in a local level frame. sigma_m: as stated. allowed_m: as of `position_jumps`.
            off: the fix against its prediction; None: nothing predicts it.
        """
        if self._seen and stamp_ns <= self._seen[-1][0]:
            return _none()
        self._seen.append((stamp_ns, np.array(place_m), sigma_m))
        jumped = self._by_prediction(stamp_ns, off, sigma_m, allowed_m)
        return self._by_steps(stamp_ns, allowed_m) if jumped is None else self._found([jumped], stamp_ns)

    def _by_prediction(
        self, stamp_ns: int, off: OffPrediction | None, sigma_m: float, allowed_m: float
    ) -> PositionJump | None:
        """Return a jump that is certain by now, or None.

        The fixes went off their predictions at once, and have been off by the same vector for a second.
        """
        before, self._before = self._before, None if off is None else (stamp_ns, off)
        if off is None or before is None:
            self._off = []
            return None
        off_m, dt_s = off.off_m, (stamp_ns - before[0]) / NS_PER_S
        if self._off:
            mean_m = np.mean([m for _, m in self._off], axis=0)
            most_m = _SAME * float(np.linalg.norm(mean_m)) + _SAME_SIGMAS * sigma_m
            # A fix nearer to its prediction than to the mean is not off by the same, however large its sigma.
            if float(np.linalg.norm(off_m - mean_m)) > min(most_m, float(np.linalg.norm(off_m))):
                self._off = []
        # A jump back is off by just the slow error, which no wrong IMU is. Its odds are those of the fix, times those
        # of a jump to end in this time. The latter are even at most: if no jump is going on, or the prediction tells
        # nothing, a silence ends none.
        odds = math.expm1(min(dt_s / MEAN_S, math.log(2.0)))
        ends = off.sigmas**2 - off.sigmas_without**2 > 2.0 * (math.log(_ENDS) - math.log(odds))
        least_m = max(allowed_m, _JUMP_M, _IMU_OFF_MPS2 * dt_s**2 / 2.0)
        # A fix that was off but used pulls the estimate along, so that a right fix after it is off, too: so the fix
        # before must fit.
        jumps = before[1].sigmas < _FITS_SIGMAS and off.sigmas > _CERTAIN_SIGMAS and np.linalg.norm(off_m) > least_m
        if self._off or ends or jumps:
            self._off.append((stamp_ns, off_m))
        if not self._off or stamp_ns - self._off[0][0] < _BURST_S * NS_PER_S:
            return None
        begun_ns, jump_m = self._off[0][0], np.mean([m for _, m in self._off], axis=0)
        # From now on the jump is part of the prediction.
        self._off, self._before = [], (stamp_ns, OffPrediction(off_m - jump_m, 0.0, 0.0))
        return PositionJump(begun_ns, *jump_m.tolist())

    def _by_steps(self, stamp_ns: int, allowed_m: float) -> tuple[NDArray[np.int64], Array]:
        if len(self._seen) < _FEWEST:
            return _none()
        stamps_ns, sigmas_m = np.array([at for at, _, _ in self._seen]), np.array([s for _, _, s in self._seen])
        places_m = np.array([p for _, p, _ in self._seen])
        at_ns, _ = position_jumps(stamps_ns, places_m, sigmas_m, allowed_m=allowed_m)
        until_ns = min(stamps_ns[-3], stamp_ns - duration_ns(_BURST_S))  # a later jump may turn out to be a burst
        new = (at_ns > self._judged_ns) & (at_ns <= until_ns)
        self._judged_ns = max(int(until_ns), self._judged_ns)
        known_ns = [jump.after_ns for jump in self.jumps]
        new &= ~(np.abs(np.subtract.outer(at_ns, known_ns)) <= _BURST_S * NS_PER_S).any(axis=1)
        if not new.any():
            return _none()
        off = _parts(np.diff(places_m, axis=0))[np.searchsorted(stamps_ns, at_ns[new]) - 2]
        return self._found(list(map(PositionJump, at_ns[new].tolist(), *off.T.tolist())), stamp_ns)

    def _found(self, jumps: list[PositionJump], stamp_ns: int) -> tuple[NDArray[np.int64], Array]:
        self.jumps = (*self.jumps, *jumps)[-_KEPT:]
        again = self.doubtful(stamp_ns)
        self._last_ns = jumps[-1].after_ns
        if again:
            return _none()
        return np.array([jump.after_ns for jump in jumps], dtype=np.int64), np.array([jump.size_m for jump in jumps])

    def drawn_anew(self, stamp_ns: int) -> None:
        """Note that the slow error is drawn anew at a stamp: which level was right before no longer matters."""
        if self._last_ns is not None and self._last_ns < stamp_ns:
            self._last_ns = None

    def doubtful(self, stamp_ns: int, settled_ns: int = 0) -> bool:
        """Return whether a jump leaves the position in doubt at a stamp: it came within the last `LASTS_S`.

        Args:
            settled_ns: stamp at which the position was last known without this receiver: a jump before it leaves no
                doubt.
        """
        last_ns = self._last_ns
        return last_ns is not None and last_ns > settled_ns and 0 <= stamp_ns - last_ns < LASTS_S * NS_PER_S
