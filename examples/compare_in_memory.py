# SPDX-License-Identifier: Apache-2.0
"""How good is it on a run whose truth is known, and what would the filters have made of it?"""

from graphloc import app
from graphloc.eval.metrics import compare_to_truth
from graphloc.eval.simulate import find_scenario, simulate

run = simulate(find_scenario("bl1-jump", {"duration_s": "30", "false_fraction": "0.3"}), seed=1)
done = app.simulated(run, compare=True)

for table in app.tables(done):
    print(table.as_text())
ours = compare_to_truth(done.solution.trajectory, run.truth)
print(f"RMSE {ours.position_rmse_m:.2f} m, inside the 95 % region {100 * ours.coverage_95:.0f} % of the time")
for estimate in done.filters:  # the online mode among them: it, too, knows only what came before
    print(f"{estimate.name}: RMSE {compare_to_truth(estimate.trajectory, run.truth).position_rmse_m:.2f} m")
