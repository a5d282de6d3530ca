# SPDX-License-Identifier: Apache-2.0
"""Measurements in, estimates out, as lines of JSON: the online mode for any program (docs/online-stream.md)."""

from __future__ import annotations

import contextlib
import gc
import json
import logging
import os
import signal
import sys
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import BinaryIO, Protocol, TextIO

import numpy as np
from scipy.spatial.transform import Rotation

from graphloc.config import VesselConfig, load_config
from graphloc.estimate import Estimate, Event
from graphloc.factors import INERTIAL, KINDS, SENSORS
from graphloc.frames import Array, Datum, rpy_from_rotation
from graphloc.frontends.lines import MAX_LINE, Request, Trouble, parse
from graphloc.ledger import LedgerRow, Outcome
from graphloc.measurements import ImuSample, Measurement
from graphloc.online import OnlineSmoother
from graphloc.origin import refuse_world_without_datum
from graphloc.plain import plain
from graphloc.time import NS_PER_S, seconds_text

log = logging.getLogger(__name__)


def _place(p_m: Array, R: Array) -> dict[str, object]:
    return {"xyz_m": p_m.tolist(), "quaternion_xyzw": Rotation.from_matrix(R).as_quat().tolist()}


def as_json(estimate: Estimate, datum: Datum) -> dict[str, object]:
    """Return an estimate as plain data without NaN and infinities (None); its keys are in docs/online-stream.md."""
    ((lat, lon, height),) = datum.geodetic_from_enu(estimate.p_world_m).tolist()
    roll, pitch, _ = np.degrees(rpy_from_rotation(estimate.R_world_body)).tolist()
    told = {
        "type": "estimate",
        "stamp": seconds_text(estimate.stamp_ns),
        "stamp_ns": estimate.stamp_ns,
        "lat_deg": lat,
        "lon_deg": lon,
        "height_m": height,
        "heading_deg": float(datum.true_heading_deg(estimate.yaw_rad, estimate.p_world_m)),
        "roll_deg": roll,
        "pitch_deg": pitch,
        "map": {**_place(estimate.p_world_m, estimate.R_world_body), "velocity_mps": estimate.v_world_mps.tolist()},
        "odom": _place(estimate.p_odom_m, estimate.R_odom_body),
        "map_from_odom": _place(*estimate.map_from_odom),
        "gyro_radps": estimate.gyro_radps.tolist(),
        "gyro_cov_rad2ps2": estimate.gyro_cov.tolist(),
        "cov_m_rad": estimate.cov.tolist(),
        "velocity_cov_m2ps2": estimate.v_cov.tolist(),
        "bound_95_m": estimate.bound_95_m,
        "heading_bound_95_deg": float(np.degrees(estimate.heading_bound_95_rad)),
        "health": estimate.health.value,
        "reason": estimate.reason.text,
        "since_agreed_s": {name: round(s, 3) for name, s in estimate.since_agreed_s.items()},
    }
    return {key: plain(value) for key, value in told.items()}


class Smoother(Protocol):
    """The part of an `OnlineSmoother` that a stream uses; docstrings are there."""

    @property
    def waiting_for(self) -> str: ...  # noqa: D102
    @property
    def datum(self) -> Datum | None: ...  # noqa: D102
    def feed(self, m: Measurement) -> Estimate | None: ...  # noqa: D102
    def predict(self, stamp_ns: int | None = None) -> Estimate | None: ...  # noqa: D102
    def rows(self) -> list[LedgerRow]: ...  # noqa: D102
    def finish(self) -> list[LedgerRow]: ...  # noqa: D102
    def events(self) -> list[Event]: ...  # noqa: D102


class _Session:
    """Writes the lines that go out, and counts ledger rows."""

    def __init__(self, out: TextIO, smoother: Smoother, ledger: bool) -> None:
        self._out, self._smoother, self._ledger = out, smoother, ledger
        self._waiting = ""
        self.counts: dict[str, Counter[str]] = {}

    def say(self, kind: str, content: Mapping[str, object]) -> None:
        """Write one line, at once."""
        line = json.dumps({"type": kind, **content}, allow_nan=False, separators=(",", ":"))
        self._out.write(line + "\n")
        self._out.flush()

    def estimate(self, estimate: Estimate, **more: object) -> None:
        """Write an estimate."""
        datum = self._smoother.datum
        assert datum is not None  # there is no estimate without
        self.say("estimate", {**as_json(estimate, datum), **more})

    def account(self, rows: Sequence[LedgerRow]) -> None:
        """Count rows; write them if asked to."""
        for row in rows:
            self.counts.setdefault(row.sensor or row.topic, Counter())[row.outcome.value] += row.count
        if rows and self._ledger:
            self.say("ledger", {"rows": [plain(asdict(row)) for row in rows]})

    def events(self) -> None:
        """Write what happened."""
        for event in self._smoother.events():
            self.say("event", {"text": event.text, "warns": event.warns})

    def news(self) -> None:
        """Write what happened, and what the start waits for where that changed."""
        self.events()
        if self._smoother.waiting_for != self._waiting:
            self._waiting = self._smoother.waiting_for
            if self._waiting:
                self.say("waiting", {"for": self._waiting})


def run(
    lines: Iterable[bytes],
    out: TextIO,
    smoother: Smoother,
    config: VesselConfig,
    *,
    rate_hz: float | None = None,
    ledger: bool = False,
) -> None:
    """Feed lines to a smoother until they end, and write what it answers.

    Args:
        rate_hz: estimates a second, predicted at stamps of IMU samples; None: one at each new state.
        ledger: whether to write ledger rows as they become final.
    """
    session = _Session(out, smoother, ledger)
    session.news()
    number, seq, slot = 0, 0, -1
    period_ns = round(NS_PER_S / rate_hz) if rate_hz else 0
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        said = parse(line, number, seq, config)
        if isinstance(said, Request):
            found = smoother.predict(said.stamp_ns)
            if found is not None:
                session.estimate(found, line=number)
            else:
                session.say("waiting", {"for": smoother.waiting_for or "IMU data nearer to that stamp", "line": number})
            continue
        seq += 1
        if isinstance(said, Trouble):
            if said.row.outcome is Outcome.MALFORMED:
                session.say("error", {"line": number, "reason": said.row.reason})
            session.account([said.row])
            continue
        found = smoother.feed(said)
        session.news()
        if period_ns:
            found = None
            if isinstance(said, ImuSample) and said.stamp_ns // period_ns != slot:
                slot, found = said.stamp_ns // period_ns, smoother.predict()
        if found is not None:
            session.estimate(found)
        session.account(smoother.rows())
    session.account(smoother.finish())
    session.events()  # at the end nothing is waited for
    session.say("end", {"lines": number, "counts": session.counts})


class _Stopped(Exception):
    """A signal came while a line was waited for."""


class Lines:
    """Lines of a binary stream until it ends or is told to stop.

    One that is longer than `MAX_LINE` is cut, and its rest skipped: it is never held whole.
    """

    def __init__(self, stream: BinaryIO) -> None:
        self._stream, self._waiting, self._over = stream, False, False

    def stop(self, *_: object) -> None:
        """End, as a signal handler: at once while a line is waited for, else after the work on the one that came."""
        self._over = True
        if self._waiting:
            self._waiting = False  # a second signal finds nothing to break off
            raise _Stopped

    def __iter__(self) -> Iterator[bytes]:
        line = b"\n"
        while line:
            try:
                self._waiting = True  # before the look at `_over`, or a signal between the two would wait for a line
                line = b"" if self._over else self._read()
                self._waiting = False
            except _Stopped:
                return
            if line:
                yield line

    def _read(self) -> bytes:
        line = rest = self._stream.readline(MAX_LINE + 1)
        while len(rest) > MAX_LINE and not rest.endswith(b"\n"):
            rest = self._stream.readline(MAX_LINE + 1)
        return line


def serve(
    config_path: Path,
    *,
    rate_hz: float | None = None,
    ledger: bool = False,
    lag_s: float = 10.0,
    snapshot: Path | None = None,
) -> None:
    """Run from standard input to standard output, until the input ends, SIGTERM or Ctrl-C.

    Raises:
        GraphlocError: the vessel.yaml cannot be used, or asks for what only a bag has.
    """
    config = load_config(config_path, KINDS)
    _refuse(config, str(config_path))
    smoother = OnlineSmoother(config, rows=SENSORS, inertial=INERTIAL, lag_s=lag_s, snapshot=snapshot)
    lines = Lines(sys.stdin.buffer)
    gc.freeze()  # what is loaded stays: to look through it for garbage takes a tenth of a second, in the midst of an update
    before = {number: signal.signal(number, lines.stop) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        # Ours alone: whatever a library may print goes to stderr. A reader that went away is no error.
        with contextlib.suppress(BrokenPipeError), os.fdopen(os.dup(1), "w", encoding="utf-8") as out:
            os.dup2(2, 1)
            run(lines, out, smoother, config, rate_hz=rate_hz, ledger=ledger)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _refuse(config: VesselConfig, where: str) -> None:
    refuse_world_without_datum(config, where, SENSORS)
    for name, sensor in config.sensors.items():
        if sensor.enabled and sensor.kind in ("aerial", "apriltag"):
            log.warning("%s: sensors.%s: a stream has no line for kind %s; it stays silent", where, name, sensor.kind)
