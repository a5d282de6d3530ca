# SPDX-License-Identifier: Apache-2.0
"""Constants that measurements of a sensor share: in the graph while they are seen, remembered when they are not."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import gtsam
import numpy as np

from graphloc.build import CONSTANT_TAILS, constant_keys
from graphloc.online._anchor import Beside
from graphloc.online._live import LiveProblem, LiveStream
from graphloc.online._window import Window

Number = tuple[str, int]
"""A sensor, and which of its constants."""


class Constants:
    """The constants of all sensors.

    Args:
        known: what is known of them from before.
    """

    def __init__(self, problem: LiveProblem, window: Window, known: Mapping[Number, Beside]) -> None:
        self._problem, self._window = problem, window
        self._known: dict[int, Beside] = {key: known[number] for number, key in self._keys() if number in known}

    def _keys(self) -> Iterator[tuple[Number, int]]:
        for stream in self._problem.streams.values():
            for n, key in enumerate(constant_keys(stream)):
                yield (stream.name, n), key

    def use(self, stream: LiveStream, used: set[int]) -> None:
        """Stage those of a stream that are among the keys that new factors hold on to, and keep them from leaving."""
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

    def marked(self) -> dict[int, Beside]:
        """Return what is remembered, for `back_to`."""
        return dict(self._known)

    def back_to(self, mark: Mapping[int, Beside]) -> None:
        """Remember what was remembered then: what was taken from there since has left the graph again."""
        self._known = dict(mark)

    def remember(self, now_s: float) -> None:
        """Remember those that the next commit lets go."""
        for key in self._window.leaving([key for _, key in self._keys()], now_s):
            value = np.atleast_1d(self._window.values.atVector(key))
            self._known[key] = Beside.apart(value, self._window.covariance([key]))

    def seen(self) -> dict[Number, int]:
        """Return the keys of those that are in the graph."""
        return {number: key for number, key in self._keys() if self._window.is_committed(key)}

    def remembered(self) -> dict[Number, Beside]:
        """Return what is known of those that are not."""
        return {number: self._known[key] for number, key in self._keys() if key in self._known}
