# SPDX-License-Identifier: Apache-2.0
"""GNSS errors as in BL section 3.1.5: white noise, a gradual drift, a sudden constant jump."""

from __future__ import annotations

from typing import Literal

import numpy as np

from graphloc.frames import Array

GnssNoise = Literal["clean", "drift", "jump", "drift_jump", "varied"]

# BL tables 4.1 and 4.2, per case: RMSE of the drifting signal; RMSE and max of the jumping one, m.
BL_DRIFT_RMSE_M = {1: 1.3567, 2: 1.3658, 3: 1.2847}
BL_JUMP_RMSE_M = {1: 2.4596, 2: 2.4428, 3: 3.6406}
BL_JUMP_MAX_M = {1: 14.5443, 2: 14.5115, 3: 9.9748}
_QUIET_DRIFT = 0.5  # 'a slight reduction of noise' beside the jump


def drift_m(rng: np.random.Generator, t: Array, rmse_m: float) -> Array:
    """Draw a horizontal drift (N, 2): it grows, levels out near 1.25 times its RMSE, and turns slowly."""
    span = float(np.ptp(t)) or 1.0
    size = 1.0 - np.exp(-(t - t[0]) / (span * rng.uniform(0.08, 0.2)))
    size = size + 0.08 * np.sin(2.0 * np.pi * (t - t[0]) / (span * rng.uniform(0.4, 0.8)) + rng.uniform(0, 6.28))
    angle = rng.uniform(0.0, 2.0 * np.pi) + rng.uniform(-0.8, 0.8) * (t - t[0]) / span
    curve = size[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    return np.asarray(curve * rmse_m / np.sqrt((curve**2).sum(axis=1).mean()))


def _varied_m(rng: np.random.Generator, t: Array, case: int) -> Array:
    """Return the errors (N, 2) of a long run: clear sky, a drift that comes and goes, a jump, a drift to the end."""
    share, out = (t - t[0]) / (float(np.ptp(t)) or 1.0), np.zeros((len(t), 2))
    for begin, end, fades in ((0.2, 0.4, True), (0.6, 1.0, False)):
        (k,) = np.nonzero((share >= begin) & (share <= end))
        if len(k):
            out[k] += drift_m(rng, t[k], BL_DRIFT_RMSE_M[case])
            if fades:
                out[k] *= np.clip((end - share[k]) / 0.03, 0.0, 1.0)[:, None]
    at, angle = rng.uniform(0.44, 0.5), rng.uniform(0.0, 2.0 * np.pi)
    out[(share >= at) & (share < at + 0.015)] += 10.0 * np.array([np.cos(angle), np.sin(angle)])
    return out


def reported_sigma_m(rng: np.random.Generator, t: Array, sigma_m: float, spread: float) -> Array:
    """Draw the sigmas (N,), m, that fixes state: their mean square is `sigma_m` squared, and they wander over 20 s."""
    log = np.zeros(len(t))
    step = float(np.median(np.diff(t))) if len(t) > 1 else 1.0
    keep = np.exp(-step / 20.0)
    kicks = rng.normal(0.0, spread, len(t))
    log[0] = kicks[0]
    for k in range(1, len(t)):
        log[k] = keep * log[k - 1] + np.sqrt(1.0 - keep**2) * kicks[k]
    claimed = np.exp(log)
    return np.asarray(sigma_m * claimed / np.sqrt((claimed**2).mean()))


def gnss_error_m(rng: np.random.Generator, t: Array, kind: GnssNoise, case: int, white_sigma_m: float) -> Array:
    """Return the error (N, 3) of fixes at t (N,), white noise included; height drifts 1.5 times as far as east."""
    error = rng.normal(0.0, white_sigma_m, (len(t), 3)) * np.array([1.0, 1.0, 2.0])
    if kind == "clean":
        return np.asarray(error)
    if kind == "varied":
        error[:, :2] += _varied_m(rng, t, case)
        return np.asarray(error)
    white = np.sqrt(2.0) * white_sigma_m
    scale = _QUIET_DRIFT if kind == "jump" else 1.0
    size = scale * float(np.sqrt(max(BL_DRIFT_RMSE_M[case] ** 2 - white**2, 0.01)))
    drift = drift_m(rng, t, size)
    error[:, :2] += drift
    error[:, 2] += 1.5 * drift[:, 0]
    if kind in ("jump", "drift_jump"):
        base = float((error[:, :2] ** 2).sum(axis=1).mean())
        height = BL_JUMP_MAX_M[case] - size - 2.0 * white
        share = (BL_JUMP_RMSE_M[case] ** 2 - base) / height**2
        if kind == "drift_jump":
            share = 0.04
        length = share * float(np.ptp(t))
        start = t[0] + rng.uniform(0.3, 0.7) * (float(np.ptp(t)) - length)
        during = (t >= start) & (t < start + length)
        # About along the drift, so that jump and drift add up to the table's largest error.
        along = drift[int(np.argmax(during))]
        direction = float(np.arctan2(along[1], along[0])) + rng.normal(0.0, 0.3)
        error[during, :2] += height * np.array([np.cos(direction), np.sin(direction)])
    return np.asarray(error)
