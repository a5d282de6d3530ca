# SPDX-License-Identifier: Apache-2.0
"""Constants that measurements of a sensor share.

Survey errors of tags are in the graph while measurements observe them, and are remembered outside it afterwards.
Constants that correct a setting (a delay, the place of an antenna) stay in the graph.

All derivatives by these are taken at attitudes with one and the same error of the heading: that which the first factors
had, which are marginalised by now. The place of an antenna is told by how the fixes turn with the vessel. If the
estimate of the heading turns instead, from a factor that is marginalised to the next one, the two contradict each other
in whatever that place is; together they seem to tell it: by 10 deg and fixes of a centimetre, to 6 cm of a vessel that
drives straight (first-estimates Jacobian: Huang, Mourikis & Roumeliotis 2010; Dong-Si & Mourikis 2011).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import gtsam
import numpy as np

from graphloc import keys
from graphloc.build import constant_keys, never_revised, revisable
from graphloc.errors import SolveError
from graphloc.frames import Array
from graphloc.graph import CONSTANT_TAILS, PLACE, Constant
from graphloc.judge.health import FAR_OFF
from graphloc.judge.warnings import far_off
from graphloc.online._anchor import Anchor, ConditionalGaussian
from graphloc.online._live import LiveProblem, LiveStream
from graphloc.online._window import Held, Window

_ASTRAY_RAD = 0.7  # a step is then 0.8 of what it should be, and 0.6 of it goes aside; a choice
_CHANGED = 0.05  # relative change of a prior's sigma from which the prior is replaced

Number = tuple[str, int]
"""Name of a sensor, and number of one of its constants."""


class Constants:
    """The constants of all sensors.

    Args:
        problem, window: where the constants are. known: estimates from before the window.

    Raises:
        SolveError: a known estimate is of another size, as it is from a snapshot that another configuration wrote.
    """

    def __init__(self, problem: LiveProblem, window: Window, known: Mapping[Number, ConditionalGaussian]) -> None:
        self._problem, self._window = problem, window
        self._known: dict[int, ConditionalGaussian] = {}
        # By key: the revisable part of the prior, and its sigmas (see `revisable`)
        self._priors: dict[int, tuple[Held, Array]] = {}
        # By state: its yaw (rad) when states before it were last marginalised, turned by `turned_rad` of that time
        self._first_yaw_rad: dict[int, float] = {}
        self._guessed = False
        for stream in problem.streams.values():
            for n, (key, constant) in enumerate(zip(constant_keys(stream), stream.constants, strict=True)):
                if (found := known.get((stream.name, n))) is None:
                    continue
                if len(found.value) != len(constant.sigma):
                    raise SolveError(f"{stream.name}: what its measurements share is of another size")
                self._known[key] = found

    def begin(self, anchor: Anchor, state: Sequence[int]) -> None:
        """Stage the known constants that are correlated with the anchor's state, and those that correct a setting.

        Args:
            anchor: where the window begins. state: keys of its pose, velocity and bias.
        """
        self._first_yaw_rad = {self._problem.timeline.first: anchor.pose.rotation().yaw() + anchor.turned_rad}
        settings = {key: constant for constant, key in self._settings()}
        for key, known in [*self._known.items()]:
            if key in settings or known.gain.any():
                del self._known[key]
                self._window.guess(key, known.value, 0.0)
                self._window.add([anchor.conditional_factor(known, state, key)])
            if key in settings:
                self._hold(settings[key], key, known.value)

    @property
    def turned_rad(self) -> float:
        """Angle about the vertical from the estimated attitudes to those at which derivatives by constants are taken.

        0 after a correction by so much that steps along these would lead the constants astray.
        """
        first = self._problem.timeline.first
        if first not in self._first_yaw_rad:  # there are no constants
            return 0.0
        turned_rad = math.remainder(self._first_yaw_rad[first] - self._yaw_rad(first), math.tau)
        return turned_rad if abs(turned_rad) < _ASTRAY_RAD and not self._guessed else 0.0

    def _yaw_rad(self, k: int) -> float:
        return float(self._window.values.atPose3(keys.pose(k)).rotation().yaw())

    def first_attitude(self, pose: Any) -> Array:
        """Return the attitude (3, 3) at which derivatives by constants are taken, at an estimated pose."""
        return np.asarray((gtsam.Rot3.Rz(self.turned_rad) * pose.rotation()).matrix())

    def hold_turn(self, *, guessed: bool) -> None:
        """Hold the attitudes for derivatives by constants, before states are marginalised.

        Args:
            guessed: whether the heading is a guess. They are then those of the estimate: held, they kept a guess from being
                corrected.
        """
        if not any(stream.constants for stream in self._problem.streams.values()):
            return
        self._guessed = guessed
        turned_rad, timeline = self.turned_rad, self._problem.timeline
        states = range(timeline.first, len(timeline))
        self._first_yaw_rad = {k: self._yaw_rad(k) + turned_rad for k in states}

    def _settings(self) -> Iterator[tuple[Constant, int]]:
        """Yield the constants that correct a setting, each once, with their keys."""
        for stream in self._problem.streams.values():
            if stream.shares is None:
                pairs = zip(stream.constants, constant_keys(stream), strict=True)
                yield from ((constant, key) for constant, key in pairs if constant.corrects)

    def _hold(self, constant: Constant, key: int, value: Array) -> None:
        """Stage the revisable part of a constant's prior, with the sigmas that it has at an estimate (k,)."""
        sigma = revisable(constant.sigma, constant.widened(value))
        self._priors[key] = self._window.add([_about_zero(key, sigma)]), sigma

    def revise(self) -> None:
        """Replace the priors of constants that correct a setting, where their sigmas at the present estimate differ."""
        for constant, key in self._settings():
            if key in self._priors:
                (held, was), value = self._priors[key], self._window.values.atVector(key)
                now = revisable(constant.sigma, constant.widened(value))
                if np.abs(now / was - 1.0).max() > _CHANGED and self._window.remove(held):
                    self._hold(constant, key, value)

    def revisable_variance(self, key: int) -> Array:
        """Return the variance (k,) of the revisable part of a prior, which anchors leave out; inf: there is none."""
        if key in self._priors:
            return self._priors[key][1] ** 2
        return np.full(len(self._window.values.atVector(key)), np.inf)

    def _keys(self) -> Iterator[tuple[Number, int]]:
        for stream in self._problem.streams.values():
            if stream.shares is None:
                for n, key in enumerate(constant_keys(stream)):
                    yield (stream.name, n), key

    def use(self, stream: LiveStream, used: set[int]) -> None:
        """Stage the constants of a stream that new factors use, and keep them; `used`: keys of these factors."""
        window, timeline = self._window, self._problem.timeline
        now_s = timeline.page_s(timeline.stamps_ns[timeline.last])
        for key, constant in zip(constant_keys(stream), stream.constants, strict=True):
            if key not in used:
                continue
            if not window.values.exists(key):
                known = self._known.pop(key, None)
                value = np.zeros(len(constant.sigma)) if known is None else known.value
                window.guess(key, value, now_s)
                if known is not None:
                    model: Any = gtsam.noiseModel.Gaussian.Covariance(known.cov)
                elif constant.corrects:
                    model = gtsam.noiseModel.Diagonal.Sigmas(never_revised(constant.sigma))
                else:
                    tails = gtsam.noiseModel.mEstimator.Cauchy.Create(float(np.sqrt(CONSTANT_TAILS)))
                    model = gtsam.noiseModel.Robust.Create(tails, gtsam.noiseModel.Diagonal.Sigmas(constant.sigma))
                window.add([gtsam.PriorFactorVector(key, value, model)])
                if known is None and constant.corrects:
                    self._hold(constant, key, value)
            window.touch(key, now_s)

    def marked(self) -> Callable[[], None]:
        """Return a function that restores what is known outside the graph; the window must be restored alike."""
        known, priors = dict(self._known), dict(self._priors)

        def back() -> None:
            self._known, self._priors = known, priors

        return back

    def remember(self, now_s: float) -> None:
        """Remember constants that the next commit would marginalise; those that correct a setting stay in the graph.

        Constants that correct a setting are correlated with the position. If they were remembered without it, they
        would tell of the position again later: of a vessel that lay still, four outages of 8 s (lag 4 s) made the bound
        0.66 m instead of 1.23 m.
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
        """Yield the constants of a stream that measurements have observed, and their values (k,)."""
        for constant, key in zip(stream.constants, constant_keys(stream), strict=True):
            if self._window.is_committed(key):
                yield constant, self._window.values.atVector(key)
            elif key in self._known:
                yield constant, self._known[key].value

    def far_off(self, stream: LiveStream) -> Iterator[tuple[str, float, str]]:
        """Yield each setting of a stream that is clearly far from its estimate in the window.

        Yields:
            Key of the setting, by how much it is off, and a line on that.
        """
        for constant, key in zip(stream.constants, constant_keys(stream), strict=True):
            if constant.corrects and self._window.is_committed(key):
                value = self._window.values.atVector(key)
                for setting, by, said in far_off(stream.name, constant, value, stream.mount):
                    sigma = np.sqrt(np.diag(self._window.covariance([key])))
                    # Of a place, take the largest sigma of its axes: a mount may turn these.
                    same = PLACE if setting in PLACE else (setting,)
                    unsure = max(sigma[n] for n, key_of in constant.settings if key_of in same)
                    if abs(by) > FAR_OFF * unsure:
                        yield setting, by, said

    def seen(self) -> dict[Number, int]:
        """Return the keys of the constants in the graph."""
        return {number: key for number, key in self._keys() if self._window.is_committed(key)}

    def remembered(self) -> dict[Number, ConditionalGaussian]:
        """Return the estimates of the constants that are not in the graph."""
        return {number: self._known[key] for number, key in self._keys() if key in self._known}


def _about_zero(key: int, sigma: Array) -> Any:
    return gtsam.PriorFactorVector(key, np.zeros(len(sigma)), gtsam.noiseModel.Diagonal.Sigmas(sigma))
