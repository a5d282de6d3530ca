# SPDX-License-Identifier: Apache-2.0
"""What a hostile input may do: end in one clear line, or in a result that adds up. Everything else is a find."""

from __future__ import annotations

import hashlib
import json
import math
import os
import signal
import sys
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from _rows import ROOT

from graphloc.config import VesselConfig
from graphloc.errors import GraphlocError
from graphloc.frontends.decode import supported_types
from graphloc.recording import Recording
from graphloc.solution import Solution

MOST_MIB = 700  # that a case may take on top; its inputs are smaller than 10 MiB
_LONGEST_LINE = 3000
_LIMIT_S = 250.0  # that a command may take


class Found(Exception):
    """Something that must not be. `kind` is one of crash, warning, message, ledger, loss, nonfinite, escape, memory."""

    def __init__(self, kind: str, text: str) -> None:
        super().__init__(text)
        self.kind = kind


@dataclass(slots=True)
class CaseResult:
    """How a case ended: 'ok', 'refused', or what was found; `where` is the same for one bug's many cases."""

    outcome: str
    text: str = ""
    where: str = ""


@dataclass(slots=True)
class Watch:
    """What the interpreter does, by its audit events: nothing may write but below `room`, nor start or reach anything."""

    room: str = ""
    seen: list[str] = field(default_factory=list)

    def hook(self, event: str, arguments: tuple[Any, ...]) -> None:
        if not self.room:
            return
        itself = event == "ctypes.dlopen" and arguments[0] is None  # the process, for `malloc_trim`: nothing is loaded
        if event in _NEVER and not itself:
            self.seen.append(f"{event} {arguments[:2]!r}"[:200])
        elif event == "open" and isinstance(arguments[0], str | bytes | os.PathLike):
            _, mode, flags = arguments
            if (mode and set(mode) & set("wax+")) or (isinstance(flags, int) and flags & (os.O_WRONLY | os.O_RDWR)):
                self._inside(event, arguments[0])
        elif event in ("os.mkdir", "os.remove", "os.rmdir", "shutil.rmtree"):
            self._inside(event, arguments[0])
        elif event == "os.rename":
            self._inside(event, arguments[0])
            self._inside(event, arguments[1])

    def _inside(self, event: str, path: Any) -> None:
        place = os.path.abspath(os.fsdecode(path))
        if not place.startswith((self.room, "/dev/null", "/proc/self/")):
            self.seen.append(f"{event} {place}"[:200])


_NEVER = {
    "os.system",
    "subprocess.Popen",
    "pickle.find_class",
    "socket.connect",
    "os.exec",
    "os.posix_spawn",
    "ctypes.dlopen",
}


@contextmanager
def judged(watch: Watch, room: Path, inputs: Iterable[Path]) -> Iterator[list[CaseResult]]:
    """Run a case in here; the list gets its verdict. Warnings count, memory counts, inputs must stay as they are."""
    before = _digest(inputs)
    verdicts: list[CaseResult] = []
    _forget_peak()
    at_start = _mib("VmRSS")
    said: list[tuple[str, str]] = []
    watch.room, watch.seen = str(room), []
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("always")
            warnings.showwarning = lambda message, category, *_: said.append(
                (f"{category.__name__}: {message}", _ours(traceback.extract_stack()))
            )
            try:
                yield verdicts
                verdicts.append(CaseResult("ok"))
            except GraphlocError as error:
                verdicts.append(_refusal(error, room))
            except Found as error:
                verdicts.append(CaseResult(error.kind, str(error)[:300], f"{error.kind}: {str(error)[:60]}"))
            except MemoryError as error:
                verdicts.append(CaseResult("memory", _trace(), _place(error)))
            except Exception as error:  # noqa: BLE001 - that is what is looked for
                verdicts.append(CaseResult("crash", _trace(), _place(error)))
    finally:
        watch.room = ""
    grown = _mib("VmHWM") - at_start
    if watch.seen:
        verdicts.append(CaseResult("escape", "; ".join(watch.seen[:3]), f"escape: {watch.seen[0][:50]}"))
    elif _digest(inputs) != before:
        verdicts.append(CaseResult("escape", "an input was changed", "escape: input"))
    elif grown > MOST_MIB:
        verdicts.append(CaseResult("memory", f"{grown:.0f} MiB", "memory: resident"))
    elif said and verdicts[-1].outcome in ("ok", "refused"):
        text, place = said[0]
        verdicts.append(CaseResult("warning", f"{place}: {text}", f"warning: {place}"))


def _refusal(error: GraphlocError, room: Path) -> CaseResult:
    text = str(error)
    if "\n" in text or not text.strip() or len(text) > _LONGEST_LINE:
        return CaseResult("message", text[:300], f"message: {_place(error)}")
    known = (str(room), "sensors.", "/", ".yaml", ": ")
    if not any(part in text for part in known):
        return CaseResult("message", f"names nothing: {text[:300]}", f"message: {_place(error)}")
    return CaseResult("refused", text[:200].replace(str(room), ""), _place(error))


def _place(error: BaseException) -> str:
    """Where it comes from: the innermost line of graphloc, and what was raised."""
    return f"{type(error).__name__} at {_ours(traceback.extract_tb(error.__traceback__))}"


def _ours(stack: traceback.StackSummary) -> str:
    """File and line of the innermost frame of graphloc."""
    rooms = [f for f in stack if f.filename.startswith(str(ROOT)) and "benchmarks" not in f.filename]
    return f"{Path(rooms[-1].filename).name}:{rooms[-1].lineno}" if rooms else "?"


def _trace() -> str:
    return traceback.format_exc()[-1500:]


def _digest(inputs: Iterable[Path]) -> str:
    digest = hashlib.sha256()
    for path in inputs:
        for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
            if file.is_file():
                digest.update(str(file).encode() + file.read_bytes())
    return digest.hexdigest()


def _forget_peak() -> None:
    Path("/proc/self/clear_refs").write_text("5")


def _mib(key: str) -> float:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(key + ":"):
            return int(line.split()[1]) / 1024.0
    return 0.0


def check_recording(recording: Recording, config: VesselConfig, written: Mapping[str, int] | None, total: int) -> None:
    """Hold the account against what was written.

    Args:
        written: messages by topic where the file is whole; None where its bytes were changed. total: of all topics.
    """
    imu = 0 if recording.imu is None else len(recording.imu.stamps_ns)
    rows = sum(r.count for r in recording.rows)
    if imu + len(recording.measurements) + rows != recording.message_count:
        raise Found("ledger", f"{imu} + {len(recording.measurements)} + {rows} != {recording.message_count}")
    seqs = Counter([m.seq for m in recording.measurements] + [r.seq for r in recording.rows if r.seq >= 0])
    if recording.imu is not None:
        seqs.update(recording.imu.seqs.tolist())
    if any(n > 1 for seq, n in seqs.items() if seq >= 0):
        raise Found("ledger", "an arrival is there twice")
    for m in recording.measurements:
        _finite_measurement(m)
    if recording.imu is not None and not (
        np.isfinite(recording.imu.accel_mps2).all() and np.isfinite(recording.imu.gyro_radps).all()
    ):
        raise Found("nonfinite", "IMU samples")
    if written is not None:
        _check_topics(recording, config, written)
    elif (
        not recording.warnings
        and recording.message_count < total
        and not any(r.outcome == "malformed" for r in recording.rows)
    ):
        raise Found("loss", f"{recording.message_count} of {total} messages, and no word")


def _check_topics(recording: Recording, config: VesselConfig, written: Mapping[str, int]) -> None:
    readers = {
        name: sensor.topic for name, sensor in config.sensors.items() if sensor.enabled and supported_types(sensor.kind)
    }
    for name, topic in readers.items():
        got = sum(m.sensor == name for m in recording.measurements)
        got += sum(r.count for r in recording.rows if r.sensor == name)
        if recording.imu is not None and recording.imu.sensor == name:
            got += len(recording.imu.stamps_ns)
        if got != written.get(topic, 0):
            raise Found("ledger", f"{name}: {got} of {written.get(topic, 0)} messages accounted for")
    for topic, count in written.items():
        if topic not in readers.values():
            got = sum(r.count for r in recording.rows if r.topic == topic and not r.sensor)
            if got != count:
                raise Found("ledger", f"{topic}: {got} of {count} messages accounted for")


def _finite_measurement(m: Any) -> None:
    for name in getattr(m, "__slots__", ()):
        value = getattr(m, name, None)
        if isinstance(value, np.ndarray) and value.dtype.kind == "f" and not np.isfinite(value).all():
            raise Found("nonfinite", f"{type(m).__name__}.{name}")
        if isinstance(value, float) and not math.isfinite(value):
            raise Found("nonfinite", f"{type(m).__name__}.{name}")


def check_solution(solution: Solution, recording: Recording) -> None:
    """Hold an estimate against what it must be: finite, with covariances, every message in the ledger."""
    track = solution.trajectory
    columns = {
        "p": track.p_world_m, "R": track.R_world_body, "v": track.v_world_mps, "cov": track.cov, "v_cov": solution.v_cov,
        "gyro": solution.gyro_radps, "accel bias": solution.accel_bias_mps2,
        **{f"slow {n}": s.value for n, s in solution.slow.items()}, **{f"slow sigma {n}": s.sigma for n, s in solution.slow.items()},
    }  # fmt: skip
    for name, value in columns.items():
        if value is not None and not np.isfinite(value).all():
            raise Found("nonfinite", f"{name} of the solution")
    if track.cov is not None and (np.diagonal(track.cov, axis1=1, axis2=2) < 0.0).any():
        raise Found("nonfinite", "a negative variance")
    if not np.allclose(track.R_world_body @ track.R_world_body.transpose(0, 2, 1), np.eye(3), atol=1e-6):
        raise Found("nonfinite", "a rotation that is none")
    if len(solution.ledger) != recording.message_count:
        raise Found("ledger", f"{len(solution.ledger)} rows of {recording.message_count} messages")


def check_folder(folder: Path) -> None:
    """Hold the files of a run against their formats: JSON without NaN, numbers that are numbers."""

    def refuse(constant: str) -> float:
        raise Found("nonfinite", f"{constant} in a JSON file")

    for name in ("run.json", "track.geojson"):
        json.loads((folder / name).read_text(), parse_constant=refuse)
    for line in (folder / "solution.csv").read_text().splitlines()[1:]:
        if any(cell in ("nan", "inf", "-inf") for cell in line.split(",")[1:17]):
            raise Found("nonfinite", f"solution.csv: {line[:120]}")


def install() -> Watch:
    """Look at what the interpreter does from now on (audit hooks cannot be taken off)."""
    watch = Watch()
    sys.addaudithook(watch.hook)
    return watch


def run_command(arguments: list[str], room: Path) -> tuple[int, str]:
    """Run the command line; return exit code and what it said on stderr. By hand, as `Watch` lets no process be started."""
    said = room / "stderr"
    child = os.fork()
    if child == 0:
        os.chdir(room)
        os.dup2(os.open(said, os.O_WRONLY | os.O_CREAT), 2)
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        os.execv(sys.executable, [sys.executable, "-B", "-m", "graphloc", *arguments])
    until = time.monotonic() + _LIMIT_S
    while time.monotonic() < until:
        pid, status = os.waitpid(child, os.WNOHANG)
        if pid:
            return os.waitstatus_to_exitcode(status), said.read_text(errors="replace")
        time.sleep(0.01)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    raise Found("hang", f"graphloc {arguments[0]}: no end after {_LIMIT_S:g} s")
