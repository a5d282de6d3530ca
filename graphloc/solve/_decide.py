# SPDX-License-Identifier: Apache-2.0
"""What to believe of each measurement, given an estimate: modes, weights, kernels.

Sensors without hypotheses keep their kernel. Sensors with modes are weighed as a mixture: each mode has
a density, and so has 'false'. The weight is the posterior probability that the chosen mode is right.
While the estimate may be off, its predicted covariance is added to the measurement's, so that a
state that has drifted through an outage does not lock the truth out; and a first stage uses Cauchy.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from scipy.stats import chi2

from graphloc import keys
from graphloc.build import Decisions, Problem, Stream, attach
from graphloc.config import KernelConfig
from graphloc.frames import Array
from graphloc.graph import Attachment, Decision, Residual

# By stage, for every sensor that has a kernel at all: Huber is convex, so a start that is tens of metres
# off still pulls in; Cauchy forgets outliers better and still lets the truth back in.
_STAGE_KERNEL = {"far": KernelConfig(kind="huber", scale=1.5), "open": KernelConfig(kind="cauchy", scale=1.5)}
_CONVEXITY = ("none", "huber", "cauchy", "geman_mcclure", "tukey")
NEGLIGIBLE = 1e-3  # a weight below this leaves the measurement out of the graph

PoseCovariance = Callable[[int], Array]


@dataclass(frozen=True, slots=True)
class Verdict:
    """A decision, and what it was based on.

    Attributes:
        decision: None leaves the measurement out. mode: the chosen one, also then.
        weight: posterior probability that the mode is right (or the kernel's weight).
        mode_probability: of the chosen mode among the modes.
        residual: of the chosen mode. at: where the measurement meets the graph.
    """

    decision: Decision | None
    weight: float
    mode_probability: float
    residual: Residual
    mode: int
    at: Attachment


def _predicted(residual: Residual, P: Array | None) -> Array | None:
    """Covariance (k, k) of the prediction, from that of the pose."""
    if P is None:
        return None
    J = residual.jacobian()
    return np.asarray(J @ P @ J.T)


def kernel_weight(nis: float, kernel: KernelConfig) -> float:
    """Return the weight that a loss gives a squared normalised residual, in [0, 1]."""
    if kernel.kind == "none":
        return 1.0
    u2 = nis / kernel.scale**2
    if kernel.kind == "huber":
        return 1.0 if u2 <= 1.0 else 1.0 / float(np.sqrt(u2))
    if kernel.kind == "cauchy":
        return 1.0 / (1.0 + u2)
    if kernel.kind == "geman_mcclure":
        return 1.0 / (1.0 + u2) ** 2
    return (1.0 - u2) ** 2 if u2 < 1.0 else 0.0


def weigh(
    problem: Problem,
    values: gtsam.Values,
    covariance: PoseCovariance | None,
    *,
    first: int,
    last: int,
    stage: str,
) -> dict[tuple[int, int], Verdict]:
    """Decide about the measurements of states first..last.

    Args:
        problem: the run. values: current estimate.
        covariance: state -> pose covariance (6, 6) in the body tangent, added to the measurement's.
        first: first state. last: last state, inclusive.
        stage: 'far' (Huber at most), 'open' (Cauchy at most) or 'mixture'.
    """
    verdicts = {}
    for stream in problem.streams:
        indices = stream.between(first, last)
        attached = [attach(problem, stream, i, values) for i in indices]
        residuals = [
            stream.row.residuals(stream.measurements[i], stream.config, at)
            for i, at in zip(indices, attached, strict=True)
        ]
        # The norm of k whitened residuals is about sqrt(k) where all is well: bend that much later.
        dof = len(residuals[0][0].raw) if residuals else 1
        nis = [min(r.nis() for r in found) for found in residuals]
        kernel = _stage_kernel(stream.config.kernel, stage, _spread(nis, dof) * float(np.sqrt(dof)))
        for i, found, at, best in zip(indices, residuals, attached, nis, strict=True):
            P = None if covariance is None else covariance(int(stream.state[i]))
            verdicts[(stream.number, i)] = _verdict(stream, i, found, P, stage, kernel, at, best)
    return verdicts


def _stage_kernel(kernel: KernelConfig, stage: str, widening: float) -> KernelConfig:
    """The sensor's own kernel, or the stage's where that one is gentler; its bend `widening` times later."""
    limit = _STAGE_KERNEL.get(stage, kernel)
    gentle = _CONVEXITY.index(kernel.kind) <= _CONVEXITY.index(limit.kind)
    return KernelConfig(kind=kernel.kind if gentle else limit.kind, scale=kernel.scale * widening)


def _spread(nis: list[float], dof: int) -> float:
    """How many times wider than configured the residuals of a sensor are, as a whole; at least 1.

    A loss that bends at 1.5 sigmas around an estimate that is 100 sigmas off sees outliers only, and
    re-weighting then creeps; one that bends too early for noise that is configured too small rejects a
    good sensor (measured on KITTI: 97 % of the fixes lost, 23 m off). So the bend follows the median.
    """
    return max(1.0, float(np.sqrt(np.median(nis) / chi2.median(dof)))) if nis else 1.0


def _verdict(
    stream: Stream,
    i: int,
    found: tuple[Residual, ...],
    P: Array | None,
    stage: str,
    kernel: KernelConfig,
    at: Attachment,
    nis: float,
) -> Verdict:
    false = stream.row.false_log_density
    if false is None:
        residual = found[0]
        return Verdict(Decision(kernel=kernel), kernel_weight(nis, kernel), 1.0, residual, 0, at)
    logs = np.array([r.log_density(_predicted(r, P)) for r in found])
    mode = int(np.argmax(logs))
    among = np.exp(logs - logs.max())
    mode_probability = float(among[mode] / among.sum())
    residual = found[mode]
    if stage != "mixture":
        decision = Decision(mode=mode, kernel=kernel)
        return Verdict(decision, kernel_weight(nis, kernel), mode_probability, residual, mode, at)
    nothing = false(stream.measurements[i], stream.config)
    top = max(logs.max(), nothing)
    weight = float(np.exp(logs[mode] - top) / (np.exp(logs - top).sum() + np.exp(nothing - top)))
    kept = Decision(mode=mode, weight=weight) if weight > NEGLIGIBLE else None
    return Verdict(kept, weight, mode_probability, residual, mode, at)


def decisions(verdicts: dict[tuple[int, int], Verdict]) -> Decisions:
    """Return what the graph builder needs of verdicts."""
    return {key: None if v.decision is None else (v.decision, v.at) for key, v in verdicts.items()}


def pose_covariance(tree: Any) -> PoseCovariance:
    """Return state -> (6, 6) body-tangent covariance of its pose, from a Bayes tree."""
    return lambda k: np.asarray(tree.marginalCovariance(keys.pose(k)))
