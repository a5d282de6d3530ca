# SPDX-License-Identifier: Apache-2.0
"""Constants that measurements of a sensor share. Survey errors of tags are in the graph while observed, and remembered afterwards."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import gtsam
import numpy as np

from graphloc.build import CONSTANT_TAILS, constant_keys
from graphloc.errors import SolveError
from graphloc.frames import Array
from graphloc.graph import PLACE, Constant
from graphloc.online._anchor import Anchor, ConditionalGaussian
from graphloc.online._live import LiveProblem, LiveStream
from graphloc.online._window import Window
from graphloc.solve.warnings import FAR_OFF, far_off

Number = tuple[str, int]
"""Name of a sensor, and number of one of its constants."""


class Constants:
    """The constants of all sensors.

    Args:
        known: estimates from before the window.

    Raises:
        SolveError: one of them is of another size (from a snapshot, by another configuration).
    """

    def __init__(self, problem: LiveProblem, window: Window, known: Mapping[Number, ConditionalGaussian]) -> None:
        self._problem, self._window = problem, window
        self._known: dict[int, ConditionalGaussian] = {}
        for stream in problem.streams.values():
            for n, (key, constant) in enumerate(zip(constant_keys(stream), stream.constants, strict=True)):
                if (found := known.get((stream.name, n))) is None:
                    continue
                if len(found.value) != len(constant.sigma):
                    raise SolveError(f"{stream.name}: what its measurements share is of another size")
                self._known[key] = found

    def begin(self, anchor: Anchor, state: Sequence[int]) -> None:
        """Stage those that are known only together with the anchor's state, by the keys of its pose, velocity and bias."""
        for key, known in [*self._known.items()]:
            if known.gain.any():
                del self._known[key]
                self._window.guess(key, known.value, 0.0)
                self._window.add([anchor.conditional_factor(known, state, key)])

    def _keys(self) -> Iterator[tuple[Number, int]]:
        for stream in self._problem.streams.values():
            if stream.shares is None:
                for n, key in enumerate(constant_keys(stream)):
                    yield (stream.name, n), key

    def use(self, stream: LiveStream, used: set[int]) -> None:
        """Stage those constants of a stream that are among the `used` keys of new factors, and keep them in the window."""
        window, timeline = self._window, self._problem.timeline
        now_s = timeline.page_s(timeline.stamps_ns[timeline.last])
        for key, constant in zip(constant_keys(stream), stream.constants, strict=True):
            if key not in used:
                continue
            if not window.values.exists(key):
                known = self._known.pop(key, None)
                if known is None:
                    value = np.zeros(len(constant.sigma))
                    tails = gtsam.noiseModel.mEstimator.Cauchy.Create(float(np.sqrt(CONSTANT_TAILS)))
                    model: Any = gtsam.noiseModel.Robust.Create(tails, gtsam.noiseModel.Diagonal.Sigmas(constant.sigma))
                else:
                    value, model = known.value, gtsam.noiseModel.Gaussian.Covariance(known.cov)
                window.guess(key, value, now_s)
                window.add([gtsam.PriorFactorVector(key, value, model)])
            window.touch(key, now_s)

    def marked(self) -> dict[int, ConditionalGaussian]:
        """Return the remembered estimates, for `back_to`."""
        return dict(self._known)

    def back_to(self, mark: Mapping[int, ConditionalGaussian]) -> None:
        """Restore the remembered estimates: what was taken into the graph since `marked` has left it again."""
        self._known = dict(mark)

    def remember(self, now_s: float) -> None:
        """Remember the constants that the next commit would marginalise; those that correct a setting stay in the window instead.

        These are known together with the position, and would tell of it again, as after a restart: of a vessel that lay still, four
        outages of 8 s (lag 4 s) made the bound 0.66 m instead of 1.23 m.
        """
        for stream in self._problem.streams.values():
            for constant, key in zip(stream.constants, constant_keys(stream), strict=True):
                if not self._window.leaving([key], now_s):
                    continue
                if constant.corrects:
                    self._window.touch(key, now_s)
                else:
                    value = self._window.values.atVector(key)
                    self._known[key] = ConditionalGaussian.independent(value, self._window.covariance([key]))

    def of(self, stream: LiveStream) -> Iterator[tuple[Constant, Array]]:
        """Yield the constants of a stream that measurements have told of, and their values (k,)."""
        for constant, key in zip(stream.constants, constant_keys(stream), strict=True):
            if self._window.is_committed(key):
                yield constant, self._window.values.atVector(key)
            elif key in self._known:
                yield constant, self._known[key].value

    def far_off(self, stream: LiveStream) -> Iterator[tuple[str, float, str]]:
        """Yield each setting of a stream that is clearly far from where the window has it, by how much, and a line on that.

        Of what it shares another sensor says it.
        """
        if stream.shares is not None:
            return
        for constant, key in zip(stream.constants, constant_keys(stream), strict=True):
            if constant.corrects and self._window.is_committed(key):
                value = self._window.values.atVector(key)
                for setting, by, said in far_off(stream.name, constant, value, stream.mount):
                    sigma = np.sqrt(np.diag(self._window.covariance([key])))
                    # Of a place the largest: a mount may turn its axes.
                    unsure = sigma[-3:].max() if setting in PLACE else sigma[constant.corrects.index(setting)]
                    if abs(by) > FAR_OFF * unsure:
                        yield setting, by, said

    def seen(self) -> dict[Number, int]:
        """Return the keys of the constants in the graph."""
        return {number: key for number, key in self._keys() if self._window.is_committed(key)}

    def remembered(self) -> dict[Number, ConditionalGaussian]:
        """Return the estimates of the constants that are not in the graph."""
        return {number: self._known[key] for number, key in self._keys() if key in self._known}
