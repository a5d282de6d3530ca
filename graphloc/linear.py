# SPDX-License-Identifier: Apache-2.0
"""Factors of residuals that GTSAM has no native factor for. They are linearised here, anew at every pass.

A `CustomFactor` would call back into Python at every linearisation, which takes 25 times as long (measured).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

import gtsam
import numpy as np

from graphloc import gauss
from graphloc.frames import Array
from graphloc.graph import Attachment, Decision, GraphUpdate, Residual, Sensor

_jacobian_factor: Any = gtsam.JacobianFactor  # the stubs know one overload per number of states
_SPLIT = (1 << 62) + 1  # key of a variable that is in no graph


@cache
def _unit(rows: int) -> Any:
    return gtsam.noiseModel.Unit.Create(rows)


class Term(NamedTuple):
    """A state of a linear factor.

    Attributes:
        key: of the state. point: value in whose tangent the factor is written. jacobian: (k, dim) d raw / d tangent.
        offset: (dim,) coordinates of the estimate in that tangent; None: the point is the estimate.
    """

    key: int
    point: Any
    jacobian: Array
    offset: Array | None = None


def pose_term(at: Attachment, jacobian: Array) -> Term:
    """Return the pose's term; jacobian: (k, 6) d raw / d body tangent, at the estimate.

    A solver that keeps older linearisations applies a factor's Jacobian in the tangent of its own, older pose R', even if the factor was
    written at a newer pose R. A shift d of the world is R^T d in one tangent and R'^T d in the other. A factor that only relates two
    places, such as a vessel and the dock that it sees to 3 mm, then seems to tell where both are: with 5 mrad between R and R',
    to 3 mm / 5 mrad = 0.6 m, and again with each sighting. So the factor is written in the solver's own tangent.
    """
    if at.T_solver is None:
        return Term(at.pose_key, at.T_world_body, jacobian)
    turn = at.T_world_body.rotation().matrix().T @ at.T_solver.rotation().matrix()
    carried = np.hstack([jacobian[:, :3] @ turn, jacobian[:, 3:] @ turn])
    return Term(at.pose_key, at.T_solver, carried, at.T_solver.localCoordinates(at.T_world_body))


def factors_of(
    row: Sensor, m: Any, config: Any, at: Attachment, decision: Decision, residual: Residual | None = None
) -> GraphUpdate:
    """Return the factors of a measurement: its row's own, else the linear one of its residual.

    Args:
        residual: of the chosen hypothesis at `at`, where it is known.
    """
    own = row.factors(m, config, at, decision)
    return own or linear_factor(residual or row.residuals(m, config, at)[decision.mode], at, decision)


def linear_factor(residual: Residual, at: Attachment, decision: Decision) -> GraphUpdate:
    """Return the factor of a residual in the states that it has Jacobians for: pose, velocity, slow state and constants."""
    terms = [pose_term(at, residual.jacobian())]
    if residual.velocity_jacobian is not None:
        terms.append(Term(at.velocity_key, at.v_world_mps, residual.velocity_jacobian()))
    if at.slow_key is not None and residual.slow_jacobian is not None:
        terms.append(Term(at.slow_key, np.array(at.slow_value), residual.slow_jacobian()))
    for n, ((key, value), by_own) in enumerate(zip(at.constants, residual.constant_jacobians(), strict=False)):
        jacobian = by_own
        if own := at.own_of(n):
            jacobian = np.zeros((len(by_own), len(value)))
            jacobian[:, own] = by_own
        terms.append(Term(key, np.array(value), jacobian))
    return linear_update(residual, terms, decision)


def linear_update(
    residual: Residual, terms: Sequence[Term], decision: Decision, points: gtsam.Values | None = None
) -> GraphUpdate:
    """Return the factor of a residual that is linearised in any states.

    A linear factor cannot carry a robust kernel, so the information is scaled by the weight that the kernel gives the residual.

    Args:
        residual: raw (k,) and its covariance, at the estimate.
        terms: of the states; that of a pose is made by `pose_term`.
        decision: weight and kernel of this pass.
        points: linearisation points, which factors with the same terms share and fill: GTSAM takes longer to store a pose than to
            make a factor. None: of this factor alone.
    """
    weight = decision.weight
    if decision.kernel is not None:
        weight *= max(decision.kernel.weight(weight * residual.nis()), 1e-6)
    # Most residuals here are of one row (headings, heights), and at every pass.
    cov, single = residual.cov, len(residual.cov) == 1
    whiten = np.sqrt(weight) * (1.0 / np.sqrt(cov) if single else gauss.whitening(cov))
    points, raw = gtsam.Values() if points is None else points, residual.raw
    arguments: list[Any] = []
    for term in terms:
        if not points.exists(term.key):
            points.insert(term.key, term.point)
        arguments += [term.key, whiten * term.jacobian if single else whiten @ term.jacobian]
        if term.offset is not None:
            raw = raw - term.jacobian @ term.offset
    make = _jacobian_factor if len(terms) < 4 else _of_four_states
    linear = make(*arguments, -whiten @ raw, _unit(len(raw)))
    return GraphUpdate(factors=(gtsam.LinearContainerFactor(linear, points),))


def _of_four_states(*arguments: Any) -> Any:
    """Return a `JacobianFactor` of four states, which Python cannot make (0.09 ms instead of 0.01).

    Two factors share a variable, y + A1 x1 + A2 x2 = b and y = A3 x3 + A4 x4, and y is eliminated.
    """
    (*of_two, third, A3, fourth, A4, b, unit), rows = arguments, len(arguments[-2])
    split = gtsam.GaussianFactorGraph()
    split.add(_jacobian_factor(_SPLIT, np.eye(rows), *of_two, b, unit))
    held = gtsam.noiseModel.Constrained.All(rows)
    split.add(gtsam.JacobianFactor(_SPLIT, -np.eye(rows), third, A3, fourth, A4, np.zeros(rows), held))
    order = gtsam.Ordering()
    order.push_back(_SPLIT)
    joined: Any = split.eliminatePartialSequential(order)[1].at(0)
    whitened = joined.whiten()
    whitened.setModel(False, np.ones(rows))  # without one, `dim()` of its container reads a null pointer
    return whitened
