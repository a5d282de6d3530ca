# SPDX-License-Identifier: Apache-2.0
"""A thinned run: few states and measurements, enough for a rough track by which hypotheses can be judged.

Sensors without hypotheses keep one measurement per slow node; those with hypotheses keep all. Between the states that
the kept measurements need, one preintegrated IMU link carries the same information as ten.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise

import gtsam
import numpy as np
from numpy.typing import NDArray

from graphloc import keys
from graphloc.build._attach import every_constant, nav_state
from graphloc.build._problem import Problem, Stream, with_links
from graphloc.time import duration_ns
from graphloc.timeline import Timeline

_LONGEST_NS = duration_ns(1.0)  # longest link: up to here the first-order bias correction is accurate enough


@dataclass(frozen=True, slots=True, eq=False)
class Thinned:
    """A thinned run, and which states and measurements of the whole one it has.

    Attributes:
        problem: the run; its slow nodes are those of the whole one.
        states: (N,) number of each of its states in the whole run.
        chosen: by the sensor's number, (M,) index of each of its measurements in the whole run.
    """

    problem: Problem
    states: NDArray[np.int64]
    chosen: Mapping[int, NDArray[np.int64]]

    def of(self, values: gtsam.Values) -> gtsam.Values:
        """Return the values of the thinned run, taken from those of the whole run."""
        nodes = range(len(self.problem.timeline.slow_stamps_ns))
        kept = values.extract(_shared_keys(self.problem, nodes, values))
        for k, whole in enumerate(self.states.tolist()):
            kept.insert(keys.pose(k), values.atPose3(keys.pose(whole)))
            kept.insert(keys.velocity(k), values.atVector(keys.velocity(whole)))
        return kept

    def filled(self, whole: Problem, values: gtsam.Values) -> gtsam.Values:
        """Return the values of the whole run from those of the thinned one; the other states are dead-reckoned."""
        nodes = range(len(whole.timeline.slow_stamps_ns))
        filled = values.extract(_shared_keys(whole, nodes, values))
        for k, (first, following) in enumerate(pairwise([*self.states.tolist(), len(whole.timeline)])):
            state = nav_state(values, k)
            bias = values.atConstantBias(keys.bias(int(whole.timeline.slow_of[first])))
            for at in range(first, following):
                if at > first:
                    state = whole.preintegrated[at - 1].predict(state, bias)
                filled.insert(keys.pose(at), state.pose())
                filled.insert(keys.velocity(at), np.asarray(state.velocity()))
        return filled


def thinned(problem: Problem) -> Thinned:
    """Return a run reduced to what a rough track needs."""
    chosen = {stream.number: _chosen(problem, stream) for stream in problem.streams}
    states = _states(problem, chosen)
    timeline = problem.timeline
    few = Timeline(timeline.stamps_ns[states], timeline.slow_of[states], timeline.slow_stamps_ns)
    links = tuple(
        problem.preintegrated[a]
        if b == a + 1
        else problem.links.integrate(
            int(timeline.stamps_ns[a]), int(timeline.stamps_ns[b]), gtsam.imuBias.ConstantBias()
        )
        for a, b in pairwise(states.tolist())
    )
    streams = tuple(_thin(stream, chosen[stream.number], states) for stream in problem.streams)
    return Thinned(with_links(replace(problem, timeline=few, streams=streams), links), states, chosen)


def _chosen(problem: Problem, stream: Stream) -> NDArray[np.int64]:
    """Return the indices of the measurements of a stream that are kept."""
    if stream.row.has_hypotheses:
        return np.arange(len(stream.measurements))
    return np.flatnonzero(np.diff(problem.timeline.slow_of[stream.state], prepend=-1) > 0)


def _states(problem: Problem, chosen: Mapping[int, NDArray[np.int64]]) -> NDArray[np.int64]:
    """Return the states that are kept.

    These are both ends; the first state of each slow node and of each second; the state of each kept measurement, and
    that from which its motion is preintegrated; and all states about an IMU gap.
    """
    timeline, last = problem.timeline, len(problem.timeline) - 1
    second = (timeline.stamps_ns - timeline.stamps_ns[0]) // _LONGEST_NS
    kept = [np.array([0, last]), *(np.flatnonzero(np.diff(n, prepend=-1) > 0) for n in (timeline.slow_of, second))]
    for stream in problem.streams:
        indices = chosen[stream.number]
        kept.append(stream.state[indices])
        kept.append(np.array([c[0] for i in indices.tolist() if (c := stream.carry[i]) is not None], dtype=np.int64))
    for start_ns, stop_ns in problem.links.gaps():  # gaps are bridged link by link
        kept.append(np.arange(timeline.floor(start_ns), min(timeline.floor(stop_ns) + 1, last) + 1))
    return np.unique(np.concatenate(kept))


def _thin(stream: Stream, indices: NDArray[np.int64], states: NDArray[np.int64]) -> Stream:
    """Return a stream with the kept measurements, on the kept states."""
    few = stream.only(indices)
    return replace(
        few,
        state=np.searchsorted(states, few.state),
        carry=tuple(None if c is None else (int(np.searchsorted(states, c[0])), c[1]) for c in few.carry),
    )


def _shared_keys(problem: Problem, nodes: range, values: gtsam.Values) -> list[int]:
    """Return the keys that the whole and the thinned run share: slow nodes and constants."""
    names = [keys.bias(j) for j in nodes]
    names += [keys.slow(s.number, j) for s in problem.streams if s.slow is not None for j in nodes]
    return names + [key for key in every_constant(problem.streams) if values.exists(key)]
