# SPDX-License-Identifier: Apache-2.0
"""Factors that GTSAM has no native one for: linearised by hand, anew at every pass.

Measured: a `CustomFactor` calls back into Python at every linearisation, 25 times the cost (style.md rule 14).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import gtsam
import numpy as np

from graphloc.config import KernelConfig
from graphloc.frames import Array
from graphloc.graph import Decision, GraphUpdate, Residual


@cache
def _unit(rows: int) -> Any:
    return gtsam.noiseModel.Unit.Create(rows)


def linear_update(residual: Residual, terms: Sequence[tuple[int, Any, Array]], decision: Decision) -> GraphUpdate:
    """Return the factor of a residual that is linear in some states.

    A linear factor carries no kernel: the weight that the kernel gives the residual stands in.

    Args:
        residual: raw (k,) and its covariance, at the estimate.
        terms: of each state its key, its value in the estimate, and d raw / d tangent (k, dim).
        decision: of this pass.
    """
    kernel = decision.kernel or KernelConfig(kind="none")
    weight = decision.weight * max(kernel.weight(residual.nis()), 1e-6)
    cov = residual.cov / weight
    # Most residuals here are of one row (headings, heights), and at every pass: two calls into LAPACK for a root show.
    single = len(cov) == 1
    whiten = 1.0 / np.sqrt(cov) if single else np.linalg.inv(np.linalg.cholesky(cov))
    point = gtsam.Values()
    arguments: list[Any] = []
    for key, value, jacobian in terms:
        point.insert(key, value)
        arguments += [key, whiten * jacobian if single else whiten @ jacobian]
    make: Any = gtsam.JacobianFactor  # the stubs know one overload per number of states
    linear = make(*arguments, -whiten @ residual.raw, _unit(len(residual.raw)))
    return GraphUpdate(factors=(gtsam.LinearContainerFactor(linear, point),))
