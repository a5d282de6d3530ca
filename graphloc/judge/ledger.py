# SPDX-License-Identifier: Apache-2.0
"""Ledger rows: what became of each measurement."""

from __future__ import annotations

from dataclasses import replace

from graphloc.build import Judged, Problem
from graphloc.judge.decide import AGREES, Verdict
from graphloc.ledger import Ledger, LedgerRow, Outcome
from graphloc.measurements import Measurement
from graphloc.recording import Recording

_FALSE = 0.05  # a measurement that is right with less probability is rejected, not just down-weighted


def ledger_of(problem: Problem, recording: Recording, verdicts: dict[tuple[int, int], Verdict]) -> Ledger:
    """Return what became of each message: rows of the recording and of the builder, and one for each verdict."""
    ledger = Ledger(recording.rows)
    for row in problem.rejected:
        if row.seq >= 0:
            ledger.add(replace(row, topic=row.topic or recording.topics.get(row.sensor, "")))
    imu_topic = recording.topics.get(problem.imu.sensor, "")
    for seq, stamp in zip(problem.imu.seqs.tolist(), problem.imu.stamps_ns.tolist(), strict=True):
        ledger.add(LedgerRow(seq=seq, stamp_ns=stamp, sensor=problem.imu.sensor, topic=imu_topic, outcome=Outcome.USED))
    for stream in problem.streams:
        for i, m in enumerate(stream.measurements):
            if m.seq >= 0:  # synthetic measurements are configuration, not messages
                topic = recording.topics.get(stream.name, "")
                ledger.add(row_of(stream, m, topic, verdicts[(stream.number, i)]))
    return ledger


def row_of(stream: Judged, m: Measurement, topic: str, verdict: Verdict) -> LedgerRow:
    """Return the row of a measurement that was judged."""
    residual, weight = verdict.residual, verdict.weight
    nis, dof = residual.nis(), len(residual.raw)
    if weight >= AGREES:
        outcome, reason = Outcome.USED, ""
    elif verdict.reason:
        outcome, reason = Outcome.REJECTED, verdict.reason
    elif stream.row.has_hypotheses and weight < _FALSE:
        outcome, reason = Outcome.REJECTED, "judged false: no mode agrees with the rest"
    else:
        outcome, reason = Outcome.DOWN_WEIGHTED, "disagrees with the rest"
    several = stream.row.has_hypotheses
    return LedgerRow(
        seq=m.seq,
        stamp_ns=m.stamp_ns,
        sensor=stream.name,
        topic=topic,
        outcome=outcome,
        weight=weight,
        mode=verdict.mode if several else None,
        mode_probability=verdict.mode_probability if several else None,
        mode_settled=verdict.settled if several else None,
        residual_m=residual.size_m,
        residual_deg=residual.size_deg,
        nis=nis,
        dof=dof,
        reason=reason,
        detail=stream.row.describe(m),
    )
