# SPDX-License-Identifier: Apache-2.0
"""Noise of fixes, poses and matches that scatter more than they state (offline: `judge/sensor_noise.py`)."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping

from graphloc.config import SensorConfig
from graphloc.graph import Residual
from graphloc.judge.sensor_noise import Pair, pairs_of, times_stated
from graphloc.judge.warnings import scale_warning
from graphloc.measurements import Measurement
from graphloc.online._lag import Lag
from graphloc.time import duration_ns

_EVERY_S = 5.0  # between two looks, to save time: a factor is told by a minute or more of pairs; a choice
_SETTLED_S = 1.5  # age at which a measurement has been judged again
_REMEMBERED = 100  # pairs that are remembered
# Most pairs that are taken of those since the last look, so that the remembered ones cover a minute or more: of a fast
# receiver, ten seconds of multipath have as many pairs.
_AT_ONCE = 6


class SensorNoise:
    """Factors on the sigmas that measurements state, as told by the last minute or more.

    Attributes:
        times: factors, by sensor and key of its configuration; where there is none, sigmas are taken as stated.
    """

    def __init__(self, times: Mapping[str, Mapping[str, float]] | None = None) -> None:
        self.times = {name: dict(own) for name, own in (times or {}).items()}
        self._looked_ns = 0
        self._last: dict[str, tuple[Measurement, Residual]] = {}
        self._pairs: dict[str, deque[Pair]] = {}

    def forget_clock(self) -> None:
        """Forget stamps of a clock that was set back: else nothing is newer until it has caught up with them."""
        self._looked_ns, self._last = 0, {}

    def enlarge(self, by: Mapping[str, Mapping[str, float]]) -> None:
        """Multiply the factors by others; `by`: in the form of `times`."""
        for name, own in by.items():
            times = self.times.setdefault(name, {})
            times |= {key: times.get(key, 1.0) * each for key, each in own.items()}

    def changed(self, lag: Lag) -> str:
        """Change a sensor's factors where others clearly explain its scatter better; return a line on it, or empty."""
        at_ns = lag.newest.stamp_ns
        if 0 <= at_ns - self._looked_ns < _EVERY_S * 1e9:
            return ""
        self._looked_ns = at_ns
        for name, stream in lag.problem.streams.items():
            last, times = self._last.get(name), self.times.get(name, {})
            judged = lag.judged(name, last[0].stamp_ns if last else 0, at_ns - duration_ns(_SETTLED_S))
            if not judged or not stream.row.scaled(judged[0][0]):
                continue
            new = pairs_of(stream, [last, *judged] if last else judged)
            pairs = self._pairs.setdefault(name, deque(maxlen=_REMEMBERED))
            pairs.extend(_as_configured(pair, times) for pair in new[:: max(-(-len(new) // _AT_ONCE), 1)])
            self._last[name] = judged[-1]
            if (found := times_stated(pairs, times)) != times:
                self.times[name] = found
                del self._last[name]  # its residual is by the sigma before
                return _line(name, stream.config, times, found)
        return ""


def _as_configured(pair: Pair, times: Mapping[str, float]) -> Pair:
    """Return a pair with its covariances as they would be stated without factors on the sigmas."""
    return tuple(step._replace(stated=step.stated / times.get(step.key, 1.0) ** 2) for step in pair)


def _line(name: str, taken: SensorConfig, before: Mapping[str, float], now: Mapping[str, float]) -> str:
    """Return a line on factors that have changed; `taken`: the sensor's configuration with the factors `before`."""
    stated = taken.scaled({key: 1.0 / by for key, by in before.items()})
    said = scale_warning(name, stated, stated.scaled(now))
    if said and any(by > before.get(key, 1.0) for key, by in now.items()):
        return said[0]
    factors = ", ".join(f"{key}: {getattr(stated, key) * by:.1f}" for key, by in now.items())
    return f"{name}: its measurements scatter less again; taken " + (f"with {factors}" if factors else "as configured")
