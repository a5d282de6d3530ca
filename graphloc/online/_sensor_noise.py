# SPDX-License-Identifier: Apache-2.0
"""Noise of fixes, poses and matches that scatter more from one to the next than they state (offline: `solve/_sensor_noise.py`)."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping

from graphloc.graph import Residual
from graphloc.measurements import Measurement
from graphloc.online._lag import Lag
from graphloc.solve._sensor_noise import Step, steps_of, times_stated
from graphloc.solve._warnings import scale_warning

_EVERY_S = 5.0
_SETTLED_S = 1.5  # after so long a measurement has been judged again
_REMEMBERED = 100  # steps
# Of the steps since the last look, so that the remembered ones are of a minute or more: factors only grow, and ten seconds of multipath
# are as many steps of a fast receiver.
_AT_ONCE = 6


class SensorNoise:
    """Factors on the sigmas that measurements come with; they only grow.

    Attributes:
        times: by sensor and key of its configuration.
    """

    def __init__(self, times: Mapping[str, Mapping[str, float]] | None = None) -> None:
        self.times = {name: dict(own) for name, own in (times or {}).items()}
        self._looked_ns = 0
        self._last: dict[str, tuple[Measurement, Residual]] = {}
        self._steps: dict[str, dict[tuple[tuple[str, int], ...], deque[tuple[Step, ...]]]] = {}

    def forget_clock(self) -> None:
        """Forget stamps of a clock that was set back: by these, nothing would be newer until it has caught up."""
        self._looked_ns, self._last = 0, {}

    def raised(self, lag: Lag) -> str:
        """Raise the factors of a sensor that clearly scatters more than it states; return a line on that, or empty."""
        at_ns = lag.newest.stamp_ns
        if 0 <= at_ns - self._looked_ns < _EVERY_S * 1e9:
            return ""
        self._looked_ns = at_ns
        for name, stream in lag.problem.streams.items():
            steps, last = self._steps.setdefault(name, {}), self._last.get(name)
            judged = lag.judged(name, last[0].stamp_ns if last else 0, at_ns - int(_SETTLED_S * 1e9))
            if not judged or not stream.row.scaled(judged[0][0]):
                continue
            for key, new in steps_of(stream, [last, *judged] if last else judged).items():
                steps.setdefault(key, deque(maxlen=_REMEMBERED)).extend(new[:: -(-len(new) // _AT_ONCE)])
            self._last[name] = judged[-1]
            if times := times_stated(steps):
                own = self.times.setdefault(name, {})
                stated = stream.config
                own |= {key: own.get(key, 1.0) * by for key, by in times.items()}
                del self._steps[name], self._last[name]  # of another sigma
                return "; ".join(scale_warning(name, stated, stated.scaled(times)))
        return ""
