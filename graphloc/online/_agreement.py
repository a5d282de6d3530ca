# SPDX-License-Identifier: Apache-2.0
"""Agreement of the absolute sensors with the estimate: when each agreed last, and for how long all have disagreed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import copy
from typing import Any, NamedTuple

import numpy as np
from scipy.special import expit

from graphloc.graph import Attachment
from graphloc.judge.decide import AGREES, CREDIBLE, Verdict, far_sigmas
from graphloc.judge.health import FAR_OFF
from graphloc.measurements import Measurement
from graphloc.online._live import LiveStream, LiveTimeline
from graphloc.signals.position_jumps import MEAN_S

_FEW = 8  # absolute measurements that must disagree before the estimate may be lost
# Disagreement (s) after which the estimate is lost; measurements of one sensor that must disagree in a row by then.
_LOST_S, _DENIES = 15.0, 3
_JUMPED_S = (60.0, 200.0)  # longest duration of a jump, after a short and after a long time at the level before it
_BENT_S = 20.0  # after so long without a position, dead reckoning may be as far off as a slow error
# Matches are believed against a receiver that is far off once a receiver has agreed beside them for so long (s), by a
# slow error of at most so many sigmas. "Beside" means that the newest match that agreed is at most so old (s).
_CONFIRMS_S, _CONFIRMS, _BESIDE_S = 15.0, 2.0, 5.0


class _Standing(NamedTuple):
    """How a sensor stands to the estimate.

    Attributes:
        stamp_ns: stamp of its last measurement that agreed. far: whether that agreed only by an unlikely large slow
            error.
        confirmed_s: for how long it has agreed by a slow error of usual size while matches agreed, too.
        doubted: whether it ever agreed only by an unlikely large slow error while matches agreed.
    """

    stamp_ns: int = 0
    far: bool = False
    confirmed_s: float = 0.0
    doubted: bool = False

    def then(self, stamp_ns: int, far_sigmas: float, beside: bool) -> _Standing:
        """Return how the sensor stands after a further measurement that agrees.

        Args:
            far_sigmas: size of the slow error by which it agrees, in sigmas. beside: whether matches agree, too.
        """
        if stamp_ns <= self.stamp_ns:  # an older measurement, judged again after newer ones
            return self
        since_s = min((stamp_ns - self.stamp_ns) * 1e-9, 1.0)
        confirmed_s = self.confirmed_s + (since_s if beside and far_sigmas <= _CONFIRMS else 0.0)
        far = far_sigmas > FAR_OFF
        doubted = self.doubted or (beside and far)
        return _Standing(stamp_ns, far, confirmed_s, doubted)


class Agreement:
    """Notes how each absolute measurement was judged.

    Attributes:
        agreed_ns: stamp of the last measurement that agreed, by sensor.
    """

    def __init__(self, timeline: LiveTimeline) -> None:
        self._timeline = timeline
        self.agreed_ns: dict[str, int] = {}
        self._standing: dict[str, _Standing] = {}
        self._matched_ns = 0  # stamp of the newest match that agreed
        # Stamps of the first few absolute measurements that disagreed since the last one that agreed.
        self._refused: list[int] = []
        self._denied: dict[str, int] = {}  # by sensor: measurements in a row that disagreed in spite of any slow error
        # First and last stamp at which a sensor agreed by a usual slow error
        self._usual_ns: tuple[int, int] | None = None
        self._jumped_ns: int | None = None  # since when sensors agree only by a slow error that has jumped
        self._told_ns = 0  # stamp of the last measurement that agreed, by a slow error of any size

    def note(self, stream: LiveStream, m: Measurement, verdict: Verdict | None) -> None:
        """Note how a measurement was judged; verdict None: it was rejected without being judged."""
        if not stream.row.absolute:
            return
        agrees = verdict is not None and verdict.weight >= AGREES
        self._denied[stream.name] = 0 if agrees else self._denied.get(stream.name, 0) + 1
        if verdict is not None and agrees:
            far = far_sigmas(stream.slow, verdict.at)
            # With a larger slow error, the level before the jump may be the wrong one instead.
            self._note_level(m.stamp_ns, usual=far <= FAR_OFF)
            if stream.row.false is not None and stream.row.false(m, stream.config).news < 1.0:
                self._matched_ns = max(self._matched_ns, m.stamp_ns)
            # Sensors without an error that may jump neither confirm nor contradict matches; matches themselves are
            # among them.
            jumps = stream.slow is not None and bool(stream.slow.far_axes.any())
            beside = jumps and abs(m.stamp_ns - self._matched_ns) < _BESIDE_S * 1e9
            self._standing[stream.name] = self._standing.get(stream.name, _Standing()).then(m.stamp_ns, far, beside)
        if verdict is not None and agrees and _credible(stream, verdict.at):
            self.agreed_ns[stream.name] = max(m.stamp_ns, self.agreed_ns.get(stream.name, m.stamp_ns))
            self._refused = [stamp for stamp in self._refused if stamp > m.stamp_ns]
            self._denied.clear()
            return
        if len(self._refused) < _FEW:
            self._refused.append(m.stamp_ns)

    def _note_level(self, stamp_ns: int, *, usual: bool) -> None:
        if stamp_ns - self._told_ns > _BENT_S * 1e9 and self._jumped_ns is None:
            # After such an outage the estimate follows any level: how long one was held before does not make it the
            # usual one.
            self._usual_ns = None
        if usual:
            self._usual_ns = (self._usual_ns or (stamp_ns, stamp_ns))[0], stamp_ns
            self._jumped_ns = None
        elif self._jumped_ns is None:
            self._jumped_ns = stamp_ns
        self._told_ns = max(stamp_ns, self._told_ns)

    def forget_refused(self) -> None:
        """Forget disagreement, which is no evidence against the estimate: a receiver turned out to be frozen."""
        self._refused = []
        self._denied.clear()
        self._jumped_ns = None

    def unlikely(self, receiver_of: Callable[[str], str]) -> list[str]:
        """Return the sensors whose newest measurement that agrees does so only by an unlikely large slow error.

        Args:
            receiver_of: gives the name of a sensor's receiver (`VesselConfig.receiver_of`). Of sensors that read one
                receiver by turns, only the one that agreed last counts.
        """
        return sorted(name for standing, name in self._newest(receiver_of) if standing.far)

    def doubted(self, receiver_of: Callable[[str], str]) -> list[str]:
        """Return the receivers that have been far off beside matches that no receiver confirms: either may be wrong.

        Args:
            receiver_of: as for `unlikely`.
        """
        if any(standing.confirmed_s >= _CONFIRMS_S for standing in self._standing.values()):
            return []
        return [name for standing, name in self._newest(receiver_of) if standing.doubted]

    def _newest(self, receiver_of: Callable[[str], str]) -> list[tuple[_Standing, str]]:
        newest: dict[str, tuple[_Standing, str]] = {}
        for name, standing in self._standing.items():
            receiver = receiver_of(name)
            newest[receiver] = max(newest.get(receiver, (_Standing(), "")), (standing, name))
        return list(newest.values())

    def marked(self) -> dict[str, Any]:
        """Return all that is noted, for `back_to`."""
        return {name: copy(noted) for name, noted in vars(self).items() if name != "_timeline"}

    def back_to(self, mark: Mapping[str, Any]) -> None:
        """Forget what was noted since `marked`: it was judged under choices of modes that were given up."""
        vars(self).update(mark)

    def inherit(self, before: Agreement) -> None:
        """Take over when each sensor last agreed, and since when the usual level or a jump has been held.

        Args:
            before: that of the window that is replaced. Measurements in the new window are noted anew; without this, a
                level that was held before it would seem to begin with it.
        """
        self.agreed_ns.update(before.agreed_ns)
        self._standing = self._standing | before._standing
        self._matched_ns = max(self._matched_ns, before._matched_ns)
        self._usual_ns, self._told_ns = before._usual_ns, before._told_ns
        begin_ns = self._timeline.stamps_ns[self._timeline.first]
        if before._jumped_ns is not None and before._jumped_ns < begin_ns:
            self._jumped_ns = before._jumped_ns

    def wrong_level(self, now_ns: int) -> float:
        """Return the probability that the present jump is in truth the end of one: the level before it was wrong.

        It follows from how long each level has been held, as jumps last `MEAN_S` on average.
        """
        if self._jumped_ns is None:
            return 0.0
        begin_ns, end_ns = self._usual_ns or (self._jumped_ns, self._jumped_ns)
        longer_s = (end_ns - begin_ns - (now_ns - self._jumped_ns)) * 1e-9
        return float(expit(-longer_s / MEAN_S))

    @property
    def denied(self) -> bool:
        """Whether the absolute sensors disagree with the estimate at present."""
        return len(self._refused) >= _FEW and any(in_a_row >= _DENIES for in_a_row in self._denied.values())

    def lost_s(self, now_ns: int) -> float:
        """Return for how long (s) the absolute sensors have disagreed with the estimate; 0 while it is not lost.

        If they agree, but only by a slow error that has jumped, the estimate counts as right for as long as a jump may
        last. That is longer, the longer the level before the jump was held (`_JUMPED_S`).
        """
        seconds = self._timeline.seconds
        if self.denied:
            denied_s = seconds(now_ns) - seconds(self._refused[0])
            if denied_s > _LOST_S:
                return denied_s
        if self._jumped_ns is None:
            return 0.0
        begin, end = (seconds(ns) for ns in self._usual_ns or (self._jumped_ns, self._jumped_ns))
        jumped_s = seconds(now_ns) - seconds(self._jumped_ns)
        return jumped_s if jumped_s > float(np.clip(end - begin, *_JUMPED_S)) else 0.0


def _credible(stream: LiveStream, at: Attachment) -> bool:
    """Return whether the slow error by which a sensor agrees is of plausible size."""
    if stream.slow is None or at.slow_value is None:
        return True
    return bool((np.abs(at.slow_value) <= CREDIBLE * stream.slow.sigma).all())
