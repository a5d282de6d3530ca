# SPDX-License-Identifier: Apache-2.0
"""Online, in a loop of one's own: feed what arrives, ask for the pose when it is needed."""

from graphloc import ImuSample, arrivals, online_smoother
from graphloc.eval.simulate import find_scenario, simulate

run = simulate(find_scenario("bl1-drift", {"duration_s": "30"}), seed=1)  # a vessel has its drivers instead
smoother = online_smoother(run.config)

for number, measurement in enumerate(arrivals(run.recording)):  # in order of arrival, late ones among them
    estimate = smoother.feed(measurement)  # a new state about ten times a second, else None
    if estimate is not None and estimate.health != "good":
        print(f"{estimate.health}: {estimate.reason}")
    if isinstance(measurement, ImuSample) and number % 600 == 0:
        now = smoother.predict(measurement.stamp_ns)  # carried on by the IMU, for a controller
        if now is None:
            print("waiting for", smoother.waiting_for)
        else:
            east, north, _ = now.p_world_m
            print(f"{east:.2f} m east, {north:.2f} m north, +- {now.bound_95_m:.2f} m, {now.health}")
    for row in smoother.rows():  # what became of messages; ask now and then, or they pile up
        if row.outcome == "rejected":
            print(f"{row.sensor}: rejected, {row.reason}")
smoother.finish()
