# SPDX-License-Identifier: Apache-2.0
"""The full step from where a graph is linearised, and the covariances of all its variables there."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple

import gtsam
import numpy as np
from scipy.linalg.lapack import dtrtri

from graphloc.errors import not_solved
from graphloc.frames import Array

Pair = tuple[int, int]
"""Keys of two variables."""

_UNIT = gtsam.noiseModel.Unit.Create(1)


class Marginals(NamedTuple):
    """Estimate and covariances of a graph.

    Attributes:
        values: after a full step.
        cov: (n, n) of each variable, in the tangent of the value that the graph was linearised at.
        joint: (n, n) of the pairs that were asked for, the two variables in the order of the pair.
    """

    values: gtsam.Values
    cov: dict[int, Array]
    joint: dict[Pair, Array]


class _Recovered:
    """The joint covariances of cliques of a Bayes tree, recovered from the root towards the leaves."""

    def __init__(self, dim: Mapping[int, int], order: Sequence[int]) -> None:
        self._dim, self._when = dim, {key: n for n, key in enumerate(order)}
        # By frontal variable: the covariance of its clique, and the rows of the clique's variables in it.
        self._cliques: dict[int, tuple[Array, dict[int, range]]] = {}

    def __contains__(self, key: int) -> bool:
        return key in self._cliques

    def of(self, names: Sequence[int]) -> Array:
        """Return the joint covariance of variables that are in one clique.

        That is the clique in which the variable that was eliminated first is frontal.
        """
        cov, rows = self._cliques[min(names, key=self._when.__getitem__)]
        picked = np.array([row for key in names for row in rows[key]])
        return cov.take(picked, axis=0).take(picked, axis=1)

    def add(self, conditional: Any) -> None:
        """Add a clique by its conditional: frontal variables given its separator, whose covariance is known already."""
        names, (root, singular) = conditional.keys(), dtrtri(conditional.R())
        if singular:
            raise np.linalg.LinAlgError("a variable is not determined")
        rows, n, m = dict[int, range](), 0, len(root)
        for name in names:
            rows[name] = range(n, n := n + self._dim[name])
        own = [name for name in names if rows[name].stop <= m]
        cov = np.zeros((n, n))
        if m < n:
            cov[m:, m:] = self.of(names[len(own) :])
        A = -root @ conditional.S()
        across = A @ cov[m:, m:]
        spread = root @ root.T + across @ A.T
        cov[:m, m:], cov[m:, :m] = across, across.T
        cov[:m, :m] = 0.5 * (spread + spread.T)  # else the asymmetry grows, tenfold in a second
        self._cliques |= dict.fromkeys(own, (cov, rows))


def marginals(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, together: Collection[Pair] = ()) -> Marginals:
    """Eliminate a graph linearised at `values` by QR, and go back from the root of its Bayes tree to the leaves.

    The frontal variables x of a clique are R x = d - S y in white noise, given its separator y, which its parent has,
    too. So with A = -R^-1 S

        cov(x, y) = A cov(y)   cov(x) = R^-1 R^-T + A cov(y) A^T

    (Kaess and Dellaert, Covariance recovery from a square root information matrix for data association, 2009). GTSAM's
    own marginals eliminate anew for each variable, and take five times as long.

    Args:
        together: pairs of variables whose joint covariance is wanted.

    Raises:
        SolveError: a state is not determined.
    """
    try:
        linear = graph.linearize(values)
        dim = values.dims()
        for a, b in together:  # a factor without information puts both into one clique
            linear.add(gtsam.JacobianFactor(a, np.zeros((1, dim[a])), b, np.zeros((1, dim[b])), np.zeros(1), _UNIT))
        ordering = gtsam.Ordering.ColamdGaussianFactorGraph(linear)
        tree = linear.eliminateMultifrontal(ordering, gtsam.EliminateQR)
        found = values.retract(tree.optimize())
        order = [ordering.at(n) for n in range(ordering.size())]
        recovered = _Recovered(dim, order)
        for key in reversed(order):  # parents before their children
            if key not in recovered:
                recovered.add(tree[key].conditional())
    except (RuntimeError, np.linalg.LinAlgError) as error:
        raise not_solved("the covariance could not be computed", error) from error
    cov = {key: recovered.of((key,)) for key in order}
    return Marginals(found, cov, {pair: recovered.of(pair) for pair in together})
