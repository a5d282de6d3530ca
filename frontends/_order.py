# SPDX-License-Identifier: Apache-2.0
"""The order of stamps: repeated, backward and bursty ones, sections between holes, periods that are there twice."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Hashable, Sequence

import numpy as np
from numpy.typing import NDArray

from graphloc.errors import InputError
from graphloc.time import NS_PER_S, duration_ns, utc_text

Stamps = NDArray[np.int64]
HOLE_LIMIT_S = 600.0
"""A time without any message that nothing can bridge: the run is split there."""
SET_BACK_S = 0.5
"""A larger step back is a clock that was set, not samples that overtook each other; a choice."""

_FOLLOW, _MOST_TRIED = 50, 100  # samples that must follow where a clock was set back; most places that are tried
_AT_ONCE, _AFTER_GAP = 0.1, 1.3  # in median steps: the largest within a burst, the least at a gap
_BURSTS = 0.3  # least share of samples in bursts from which bursts are laid out evenly
_HOLE = 0.7  # in periods of the IMU: a sample is missing if both neighbours are farther away, as online
_BEFORE_S = 1.0  # late samples may be so much older than the first one in order
_IN_ORDER = 0.8  # least share, in order, of the samples after a clock was set back: others come late


def longest_increasing(stamps_ns: Stamps) -> NDArray[np.bool_]:
    """Return (N,) which readings to keep: the longest subsequence with strictly increasing stamps.

    If each stamp only had to be later than the last kept one, a single jump ahead would remove all readings until the
    clock has caught up; this removes only the jump. Patience sorting, N log N.
    """
    n = len(stamps_ns)
    if n < 2 or bool((np.diff(stamps_ns) > 0).all()):
        return np.ones(n, dtype=bool)
    tails: list[int] = []  # smallest last stamp of an increasing run of length k + 1
    last: list[int] = []  # its index
    before = np.full(n, -1, dtype=np.int64)
    for i, stamp in enumerate(stamps_ns.tolist()):
        k = bisect_left(tails, stamp)
        if k < len(tails) and tails[k] == stamp:
            continue  # of repeated stamps the first arrival stays
        before[i] = last[k - 1] if k else -1
        if k == len(tails):
            tails.append(stamp)
            last.append(i)
        else:
            tails[k], last[k] = stamp, i
    keep = np.zeros(n, dtype=bool)
    i = last[-1]
    while i >= 0:
        keep[i] = True
        i = int(before[i])
    return keep


def evened(stamps_ns: Stamps, values: NDArray[np.float64]) -> Stamps:
    """Return the stamps (N,) of IMU samples, with bursts laid out evenly; the argument itself if few come in bursts.

    A driver that reads a buffer stamps all its samples at once. The last sample of a burst keeps its stamp. The others
    precede it in equal steps that fill the time since the burst before; after a gap, in median steps. Copies of a
    sample are no burst.

    Args:
        stamps_ns: (N,) in order of arrival. values: (N, k) of the samples.
    """
    if len(stamps_ns) <= 2 * _FOLLOW:
        return stamps_ns
    usual_ns = float(np.median(stamps_ns[_FOLLOW:] - stamps_ns[:-_FOLLOW])) / _FOLLOW
    steps_ns = np.diff(stamps_ns)
    together = (steps_ns >= 0) & (steps_ns < _AT_ONCE * usual_ns) & (values[1:] != values[:-1]).any(axis=1)
    if float(together.mean()) < _BURSTS:
        return stamps_ns
    burst = np.concatenate([[0], np.cumsum(~together)])
    counts = np.bincount(burst)
    last = np.cumsum(counts) - 1
    since_ns = np.diff(stamps_ns[last], prepend=stamps_ns[last[0]] - round(usual_ns * counts[0]))
    step_ns = np.maximum(since_ns / counts, 0.0)
    step_ns[step_ns > _AFTER_GAP * usual_ns] = usual_ns
    before = last[burst] - np.arange(len(stamps_ns))
    return np.asarray(stamps_ns[last][burst] - np.rint(before * step_ns[burst]).astype(np.int64))


def in_order_or_late(stamps_ns: Stamps) -> NDArray[np.bool_]:
    """Return (N,) which IMU samples to keep: those in order, and late ones that fill a gap.

    A late stamp close to another stamp is a repetition, or from another clock.
    """
    keep = longest_increasing(stamps_ns)
    kept, late = stamps_ns[keep], np.flatnonzero(~keep)
    if len(kept) < 2:
        return keep
    hole_ns = _HOLE * np.quantile(np.diff(kept), 0.1)
    late = late[np.argsort(stamps_ns[late], kind="stable")]
    taken_ns = 0
    for i, n in zip(late.tolist(), np.searchsorted(kept, stamps_ns[late]).tolist(), strict=True):
        stamp_ns = int(stamps_ns[i])
        # Before the first sample in order, only samples little older than it belong to the run.
        before_ns = int(kept[n - 1]) if n else int(kept[0]) - duration_ns(_BEFORE_S)
        if n < len(kept) and min(stamp_ns - max(before_ns, taken_ns), kept[n] - stamp_ns) >= hole_ns:
            keep[i], taken_ns = True, stamp_ns
    return keep


def set_backs(stamps_ns: Stamps) -> list[int]:
    """Return the indices, in order of arrival, from which stamps repeat a period: the clock was set back there.

    Samples that were only delayed fill a gap instead.
    """
    found: list[int] = []
    tries = np.flatnonzero(np.diff(stamps_ns) < -duration_ns(SET_BACK_S)) + 1
    for i in tries[:_MOST_TRIED].tolist():
        after, before = stamps_ns[i : i + _FOLLOW], stamps_ns[found[-1] if found else 0 : i]
        if len(after) < _FOLLOW:
            continue
        after = after[longest_increasing(after)]
        if len(after) < _IN_ORDER * _FOLLOW:
            continue
        again = int(((before >= after[1]) & (before <= after[-1])).sum())
        if again >= _FOLLOW // 2:
            found.append(i)
    return found


def refuse_woven(
    topic: str, stamps_ns: Stamps, logs_ns: Stamps, contents: Sequence[Hashable], files: Sequence[str]
) -> None:
    """Refuse files, or parts of one, that overlap by stamps and by recording times, since they cannot be separated.

    Copies of the same messages are accepted.

    Args:
        topic: of an IMU. stamps_ns, logs_ns, contents, files: (N,) of its messages, in order of arrival.

    Raises:
        InputError: files or parts overlap.
    """
    names = list(dict.fromkeys(files))
    if not set_backs(stamps_ns) and len(names) < 2:
        return
    of_file: dict[str, dict[tuple[int, Hashable], int]] = {}
    for i, (stamp_ns, content, file) in enumerate(zip(stamps_ns.tolist(), contents, files, strict=True)):
        of_file.setdefault(file, {}).setdefault((stamp_ns, content), i)
    first: dict[tuple[int, Hashable], int] = {}
    reached_ns = -1
    for own in of_file.values():
        shared = [key in first for key in own if key[0] <= reached_ns]
        # If most messages are shared, a second recorder has the same clock: what it alone has, the first recorder lost.
        again = 2 * sum(shared) > len(shared)
        first |= {key: i for key, i in own.items() if key not in first and not (again and key[0] <= reached_ns)}
        reached_ns = max(stamp_ns for stamp_ns, _ in first)
    order = np.array(list(first.values()), dtype=np.int64)
    stamps, logs = stamps_ns[order], logs_ns[order]
    for k in set_backs(stamps):
        if logs[k] < logs[k - 1]:
            back_s, before, after = float(stamps[k - 1] - stamps[k]) / NS_PER_S, files[order[k - 1]], files[order[k]]
            raise InputError(
                f"{after}: {topic} goes back by {back_s:.1f} s there, to {utc_text(int(stamps[k]))}, into times that {before} has "
                "too, by the stamps and by the recording times: a clock was set back between them, and as one run they "
                "would be interleaved; give them one at a time"
            )


def refuse_set_back(topic: str, file: str, logs_ns: Stamps) -> None:
    """Refuse a file in which the recorder's clock was set back: readers sort by time, and so mix the two parts.

    Duplicated messages are accepted.

    Args:
        topic, file: of the messages. logs_ns: (N,) recording times of an IMU's messages, in the order of writing.

    Raises:
        InputError: the clock was set back.
    """
    for k in set_backs(logs_ns):
        after = logs_ns[k:]
        woven = after[after <= logs_ns[:k].max()]
        if 2 * int(np.isin(woven, logs_ns[:k]).sum()) > len(woven):
            continue
        back_s = float(logs_ns[k - 1] - logs_ns[k]) / NS_PER_S
        raise InputError(
            f"{file}: {topic} goes back by {back_s:.1f} s within the file, from {utc_text(int(logs_ns[k - 1]))} to "
            f"{utc_text(int(logs_ns[k]))}, by the recording times: the recorder's clock was set back, and what was recorded "
            "before and after it would be interleaved; take a part of the bag before the latter time or after the "
            "former (--start, --duration)"
        )


def busiest_section(stamps_ns: Stamps) -> tuple[int, int]:
    """Return the first and last stamp of the section with most readings; gaps over `HOLE_LIMIT_S` separate sections."""
    ordered = np.sort(stamps_ns)
    cuts = np.flatnonzero(np.diff(ordered) > duration_ns(HOLE_LIMIT_S)) + 1
    section = max(np.split(ordered, cuts), key=len)
    return int(section[0]), int(section[-1])
