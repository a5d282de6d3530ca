# SPDX-License-Identifier: Apache-2.0
"""Checks of each receiver before its fixes are judged: does it repeat a fix, is it frozen, does its position jump?"""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np

from graphloc import gauss
from graphloc.build import allowed_jump_m
from graphloc.frames import Array
from graphloc.graph import TIME_OFFSET, Attachment, Hint, Residual, antenna_off_m, corrections
from graphloc.measurements import Measurement
from graphloc.online._agreement import Agreement
from graphloc.online._entries import Entries
from graphloc.online._frozen_receiver import WINDOW_S
from graphloc.online._live import LiveProblem, LiveStream
from graphloc.online._states import States, silent_within
from graphloc.signals.frozen_receiver import FROZEN, FROZEN_VELOCITY
from graphloc.signals.heading_steps import step_warnings
from graphloc.signals.position_jumps import (
    OffPrediction,
    jump_warnings,
    largest_sigma,
    only_position_sensor,
)
from graphloc.time import NS_PER_S, duration_ns

_FITS = 3.0  # sigmas of a fix alone, within which no prediction is needed
FROZEN_ONLINE = f"{FROZEN}: it repeats one position while the vessel moves"
_OLD = "it repeats the fix before it while the vessel moves"
_OFF = "off what the IMU predicts: an outlier, or a position jump too short to tell"


class ReceiverChecks:
    """Feeds the detectors of each stream without hypotheses (GNSS), and rejects measurements by what they find.

    Args:
        problem, states, entries: of the window. agreement: it is told where a receiver turns out to be frozen.
    """

    def __init__(self, problem: LiveProblem, states: States, entries: Entries, agreement: Agreement) -> None:
        self._problem, self._states, self._entries, self._agreement = problem, states, entries, agreement
        self._warnings: list[str] = []

    def reject(self, stream: LiveStream, m: Measurement, at: Attachment, residual: Residual) -> str:
        """Return why a measurement is left out; empty: it is used.

        It is left out if it repeats an old fix or velocity, is of a frozen receiver, or may begin a jump. Once a jump
        is found, the window is rebuilt with the fixes since its beginning.
        """
        if stream.row.has_hypotheses:
            return ""
        hint = stream.row.hint(m, 0.0, self._problem.datum)
        if np.isfinite(hint.v_world_mps).all():
            repeated = stream.receiver.repeated_velocity
            repeated.note(m.stamp_ns, hint.v_world_mps)
            return FROZEN_VELOCITY if repeated.is_old(m.stamp_ns, hint.v_world_mps) else ""
        if np.isfinite(hint.yaw_rad) and stream.slow is not None and stream.slow.stepped:
            self._check_heading(stream, m.stamp_ns, at, hint)
        told_m = hint.p_world_m[:2]
        if not stream.row.absolute or not np.isfinite(told_m).all():
            return ""
        estimated_m, v_mps = _antenna(stream, at)
        if self._repeats(stream, m, at, told_m, v_mps):
            return FROZEN_ONLINE if stream.receiver.repeated_fix.frozen else _OLD
        sigma_m = largest_sigma(residual.white_cov)
        if self._is_frozen(stream, m, told_m, estimated_m, sigma_m):
            return FROZEN_ONLINE
        if not self._is_alone(stream):
            stream.receiver.jump.let_go()
            return ""
        self._check_jump(stream, m.stamp_ns, told_m, sigma_m, self._off(stream, at, residual, told_m - estimated_m))
        return _OFF if stream.receiver.jump.suspects(m.stamp_ns) else ""

    def _repeats(self, stream: LiveStream, m: Measurement, at: Attachment, told_m: Array, antenna_mps: Array) -> bool:
        newest, detector = self._states.newest, stream.receiver.repeated_fix
        # The slower of IMU and antenna: the antenna swings in waves, and the vessel may turn about it.
        slower_mps = min(newest.velocity, antenna_mps, key=lambda v: float(np.linalg.norm(v[:2])))
        v_mps = np.asarray(at.T_world_body.rotation().matrix().T @ slower_mps)[:2]
        since_ns = detector.note(m.stamp_ns, told_m, v_mps, largest_sigma(newest.velocity_cov))
        if since_ns is not None:
            self._reject_since(stream, since_ns, m.stamp_ns)
            self._warnings.append(
                f"{stream.name}: {FROZEN_ONLINE}: for {(m.stamp_ns - since_ns) / NS_PER_S:.1f} s until now"
            )
        return detector.is_old(m.stamp_ns, told_m)

    def _is_frozen(self, stream: LiveStream, m: Measurement, told_m: Array, estimated_m: Array, sigma_m: float) -> bool:
        """Return whether the receiver is frozen; when that is found, take its fixes since then out of the window."""
        detector, newest, at_s = stream.frozen_detector, self._states.newest, self._problem.timeline.seconds(m.stamp_ns)
        before = detector.frozen
        detector.note(at_s, told_m, estimated_m, sigma_m, newest.velocity[:2], largest_sigma(newest.velocity_cov))
        if detector.frozen and not before:
            since_s = min(at_s - WINDOW_S, detector.stands_s)
            self._reject_since(stream, m.stamp_ns - duration_ns(at_s - since_s), m.stamp_ns)
        if detector.for_long(at_s):
            self._agreement.note(stream, m, None)
        return detector.frozen

    def _is_alone(self, stream: LiveStream) -> bool:
        """Return whether no other sensor measures position now; a silent one, as a camera far from tags, does not."""
        heard = [s for s in self._problem.others_of_place(stream.name) if len(s.measurements) > s.measurements.first]
        return only_position_sensor(stream, [stream, *heard])

    def _off(self, stream: LiveStream, at: Attachment, residual: Residual, off_m: Array) -> OffPrediction | None:
        """Return how far the newest fix lies from its prediction.

        None where the receiver's slow error is switched off or cannot jump. None also from a found jump until the
        window is rebuilt with it: until then the window predicts fixes as before the jump.

        Args:
            off_m: (2,) from the estimated position to the fix, slow error not removed.
        """
        slow = stream.left_out or (stream.slow if self._problem.others_of_place(stream.name) else None)
        if slow is None or not slow.jumps or stream.receiver.jumps != stream.jumps:
            return None
        without = residual.raw
        if stream.slow is not None and at.slow_value is not None and residual.slow_jacobian is not None:
            far = stream.slow.far_axes
            off_m = off_m - at.slow_value[far] * stream.slow.scale[far]
            without = without - residual.slow_jacobian() @ np.where(far, at.slow_value, 0.0)
        if residual.nis() <= _FITS**2:  # saves the prediction, which takes time
            return OffPrediction(off_m, 0.0, 0.0)
        predicted = self._states.prediction(stream, at, stream.state[len(stream.measurements) - 1], residual).cov
        if not predicted.any():
            return None
        squares = residual.nis(predicted), gauss.square(without, residual.cov + predicted)
        return OffPrediction(off_m, *np.sqrt(squares).tolist())

    def _check_jump(
        self, stream: LiveStream, stamp_ns: int, told_m: Array, sigma_m: float, off: OffPrediction | None
    ) -> None:
        slow = stream.left_out or stream.slow
        allowed = slow is not None
        found = stream.receiver.jump.note(stamp_ns, told_m, sigma_m, allowed_m=allowed_jump_m(slow), off=off)
        self._warnings += jump_warnings(stream.name, *found, allowed=allowed, followed=not allowed)

    def _check_heading(self, stream: LiveStream, stamp_ns: int, at: Attachment, hint: Hint) -> None:
        """Look for a step of the headings that the gyroscope does not show; the window is rebuilt with it.

        Not while the absolute sensors deny the estimate: the turn is about its vertical, and a window that is rebuilt
        again and again never restarts.
        """
        detector, links = stream.receiver.heading, self._problem.links
        first_ns, last_ns, turned_rad = self._problem.timeline.stamps_ns.kept[0], detector.last_ns, None
        follows = last_ns is not None and first_ns <= last_ns < stamp_ns and not self._agreement.denied
        if last_ns is not None and follows and not silent_within(links, last_ns, stamp_ns):
            turn = links.integrate(last_ns, stamp_ns, self._states.newest.bias).deltaRij()
            turned_rad = float(gtsam.Rot3.Logmap(turn) @ at.T_world_body.rotation().matrix()[2])
        found = detector.note(stamp_ns, hint.yaw_rad, turned_rad, hint.yaw_sigma_rad)
        self._warnings += step_warnings(stream.name, found)

    def _reject_since(self, stream: LiveStream, since_ns: int, until_ns: int) -> None:
        """Take the fixes of an interval out of the graph: they have pulled the estimate along."""
        self._agreement.forget_refused()
        stream.receiver.jump.forget_since(since_ns)
        for entry in self._entries.of(stream):
            if since_ns <= entry.measurement.stamp_ns < until_ns:
                self._entries.change(entry, replace(entry.verdict, decision=None, weight=0.0, reason=FROZEN_ONLINE))

    def warnings(self) -> list[str]:
        """Return a line on each position jump, and each receiver that had been frozen, as found since the last call."""
        warnings, self._warnings = self._warnings, []
        return warnings


def _antenna(stream: LiveStream, at: Attachment) -> tuple[Array, Array]:
    """Return the estimated position (2,), m, and velocity (3,), m/s, of the antenna in world, when a fix was measured.

    They include the estimated corrections of the antenna's place and of the fix's delay: else, if the antenna is far
    from where it is configured, a vessel that turns about it looks like one with a frozen receiver.
    """
    values = (value for _, value in at.constants)
    found = corrections(zip(stream.constants, values, strict=False), gtsam.Pose3())  # in the antenna's own axes
    off_m = antenna_off_m(found)
    off_m = np.zeros(3) if off_m is None else off_m
    v_mps = at.sensor_velocity_mps(off_m)
    place = at.sensor_m(off_m)
    return place[:2] + v_mps[:2] * found.get(TIME_OFFSET, 0.0), v_mps
