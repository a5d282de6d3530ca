# SPDX-License-Identifier: Apache-2.0
"""Ranges to three beacons against GNSS that drifts: python use_a_new_sensor.py (docs/adding-a-sensor.md)."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).parent / "range_beacon"))  # or: pip install ./range_beacon
from graphloc_range_beacon import ROW, BeaconRange, RangeBeaconConfig

from graphloc.eval.metrics import compare_to_truth
from graphloc.eval.simulate import find_scenario, simulate
from graphloc.factors import INERTIAL, KINDS, SENSORS
from graphloc.frames import Datum
from graphloc.solve import smooth

BEACONS = {"pier": (-80.0, 120.0, 4.0), "light": (150.0, -60.0, 9.0), "crane": (60.0, 180.0, 30.0)}

run = simulate(find_scenario("bl1-drift", {"pose_hz": "0", "lidar_hz": "0", "duration_s": "60"}), seed=1)
rng, truth, seq = np.random.default_rng(2), run.truth, run.recording.message_count
ranges = []
for name, place in BEACONS.items():
    for k in range(0, len(truth), 100):  # once a second, with 0.3 m of noise
        away_m = float(np.linalg.norm(truth.p_world_m[k] - place)) + rng.normal(0.0, 0.3)
        seq += 1
        ranges.append(BeaconRange(stamp_ns=int(truth.stamps_ns[k]), sensor=name, seq=seq, range_m=away_m))
measured = sorted([*run.recording.measurements, *ranges], key=lambda m: (m.stamp_ns, m.seq))
recording = replace(run.recording, measurements=tuple(measured))
beacons = {name: RangeBeaconConfig(beacon_m=place) for name, place in BEACONS.items()}
config = run.config.model_copy(update={"sensors": {**run.config.sensors, **beacons}})

rows = SENSORS if ROW.kind in KINDS else (*SENSORS, ROW)  # an installed package is in the table already
for what, given, kept in (("GNSS alone", run.config, run.recording), ("with ranges", config, recording)):
    solution = smooth(kept, given, Datum(given.datum.geodetic), rows=rows, inertial=INERTIAL)
    print(f"{what}: RMSE {compare_to_truth(solution.trajectory, truth).position_rmse_m:.2f} m")
