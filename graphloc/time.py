# SPDX-License-Identifier: Apache-2.0
"""Time is an integer number of nanoseconds since the Unix epoch; seconds appear only as differences."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import UTC, datetime
from typing import Protocol

import numpy as np
from numpy.typing import NDArray


class _Stamped(Protocol):
    @property
    def stamp_ns(self) -> int: ...


NS_PER_S = 1_000_000_000
GPS_AHEAD_S = 18.0
"""Seconds by which GPS time is ahead of UTC since 2017: the leap seconds since 1980."""


def seconds_between(start_ns: int, stop_ns: int) -> float:
    """Return `stop_ns - start_ns` in s; exact before the one conversion to float."""
    return (stop_ns - start_ns) / NS_PER_S


def seconds_since(origin_ns: int, stamps_ns: np.ndarray) -> np.ndarray:
    """Return stamps (N,) int64 ns as float s since `origin_ns`."""
    return (np.asarray(stamps_ns, dtype=np.int64) - np.int64(origin_ns)) / NS_PER_S


def stamps_of(items: Iterable[_Stamped]) -> NDArray[np.int64]:
    """Return the stamps (N,) of N measurements or the like."""
    return np.array([item.stamp_ns for item in items], dtype=np.int64)


def duration_ns(duration_s: float) -> int:
    """Return a duration in s as whole ns."""
    return round(duration_s * NS_PER_S)


def seconds_text(stamp_ns: int) -> str:
    """Return a stamp as seconds since the epoch with all nine decimals, e.g. `1432235497.988949113`."""
    whole, rest = divmod(stamp_ns, NS_PER_S)
    return f"{whole}.{rest:09d}"


def utc_text(stamp_ns: int) -> str:
    """Return a stamp as ISO 8601 UTC with all nine decimals, e.g. `2015-05-21T19:11:37.988949113Z`."""
    whole, rest = divmod(stamp_ns, NS_PER_S)
    try:
        text = datetime.fromtimestamp(whole, UTC).strftime("%Y-%m-%dT%H:%M:%S")
    except (OverflowError, ValueError, OSError):
        return f"{seconds_text(stamp_ns)}s"
    return f"{text}.{rest:09d}Z"
