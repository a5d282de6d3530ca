# SPDX-License-Identifier: Apache-2.0
"""In what order the states of a thinned graph are eliminated.

GTSAM's own order (COLAMD) is a good one where every state is measured. Where sensors are thinned to one measurement for
each slow node, most states are held by the IMU alone, and COLAMD halves these chains again and again: a halving joins
two full links, which is dearer than to go along. So here the states between two nodes go first, in turn, and the nodes
after them (measured: docs/decisions/0003-solver.md). The order changes what is found by rounding only.
"""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np
from numpy.typing import NDArray

from graphloc import keys

_LEAVES, _BETWEEN, _AT_NODES = range(3)


def along_nodes(guess: gtsam.Values, slow_of: NDArray[np.int64]) -> gtsam.Ordering:
    """Return the order for the keys of `guess`; `slow_of` is the slow node of each state of the run."""
    names, level, at = _placed(guess, slow_of)
    return gtsam.Ordering([names[n] for n in np.lexsort((at, level)).tolist()])


def nodes_last(guess: gtsam.Values, slow_of: NDArray[np.int64]) -> gtsam.KeyGroupMap:
    """Return the same as a constraint on an order that GTSAM chooses: what stands at a node comes after all others."""
    names, level, _ = _placed(guess, slow_of)
    groups = gtsam.KeyGroupMap()
    for name, last in zip(names, (level == _AT_NODES).tolist(), strict=True):
        groups.insert2(name, int(last))
    return groups


def _placed(
    guess: gtsam.Values, slow_of: NDArray[np.int64]
) -> tuple[Sequence[int], NDArray[np.int64], NDArray[np.float64]]:
    """Return the keys, when each goes (level), and where on the run it stands (a count of states)."""
    names = list(guess.keys())
    letter, index = keys.parts(np.array(names, dtype=np.uint64))
    state, node = np.isin(letter, list(keys.STATES)), np.isin(letter, list(keys.NODES))
    low, high = int(slow_of[index[state].min()]), int(slow_of[index[state].max()])
    first = np.searchsorted(
        slow_of, np.arange(low, high + 1)
    )  # state of each node: of these alone, a run has thousands
    level, at = np.full(len(names), _AT_NODES), np.full(len(names), np.inf)
    at[state] = index[state]
    at[node] = first[index[node] - low] + 0.5
    level[state] = np.where(first[slow_of[index[state]] - low] == index[state], _AT_NODES, _BETWEEN)
    level[np.isin(letter, list(keys.LEAVES))] = _LEAVES
    return names, level, at
