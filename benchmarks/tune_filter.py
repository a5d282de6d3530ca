# SPDX-License-Identifier: Apache-2.0
"""Choose the honest EKF's three numbers: position RMSE over scenarios, on seeds that no figure uses.

After an outage it is that of the last 30 s, 10 s after the return: getting back counts, dead reckoning does not.
"""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from itertools import product

import numpy as np

from graphloc import app
from graphloc.eval.ekf import _honest, run_honest
from graphloc.eval.metrics import compare_to_truth
from graphloc.eval.simulate import Scenario, bl_scenario, simulate

CHOICES = list(product((0.1, 0.2, 0.3), (0.9, 0.95, 0.99, 0.999), (3.0, 10.0, 1e9)))
SEEDS = range(100, 105)


def scenarios() -> dict[str, Scenario]:
    found: dict[str, Scenario] = {}
    for noise in ("clean", "drift", "jump"):
        for case in (1, 2, 3):
            found[f"{noise} {case}"] = bl_scenario(case, noise)  # type: ignore[arg-type]
        found[f"{noise} 1, no matches"] = replace(bl_scenario(1, noise), pose_hz=0.0)  # type: ignore[arg-type]
    for length in (20.0, 60.0, 120.0):
        away = (60.0, 60.0 + length)
        found[f"outage {length:.0f} s"] = replace(
            Scenario(path="loops", noise="drift"), duration_s=away[1] + 40.0, outage_s=away
        )
    return found


def run(job: tuple[Scenario, int]) -> list[float]:
    simulated = simulate(*job)
    datum = app.choose_datum(simulated.recording, simulated.config)
    errors = []
    for choice in CHOICES:
        _honest._ACCEL, _honest._GATE, _honest._PATIENCE_S = choice  # noqa: SLF001
        track = run_honest(simulated.recording, simulated.config, datum).trajectory
        truth = simulated.truth
        back = truth.stamps_ns >= truth.stamps_ns[-1] - 30 * 10**9 if job[0].outage_s else slice(None)
        errors.append(compare_to_truth(track, truth.where(back)).position_rmse_m)
    return errors


def main() -> None:
    jobs = [(scenario, seed) for scenario in scenarios().values() for seed in SEEDS]
    with ProcessPoolExecutor() as pool:
        errors = np.array(list(pool.map(run, jobs))).reshape(len(scenarios()), len(SEEDS), len(CHOICES)).mean(axis=1)
    print("accel, gate, patience:", ", ".join(scenarios()))
    for k in np.argsort(np.exp(np.log(errors).mean(axis=0))):
        print(CHOICES[k], " ".join(f"{e:.2f}" for e in errors[:, k]))


if __name__ == "__main__":
    main()
