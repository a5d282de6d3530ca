# SPDX-License-Identifier: Apache-2.0
"""Smooth a bag and read the track: python smooth_a_bag.py my.bag vessel.yaml."""

import sys
from collections import Counter
from pathlib import Path

from graphloc import Scans, load, smooth_recording
from graphloc.time import utc_text
from graphloc.trajectory import bounds_95

bag, config_path = Path(sys.argv[1]), Path(sys.argv[2])
recording, config = load(bag, config_path)
run = smooth_recording(recording, config, scans=Scans((bag,), config_path.parent))
solution = run.solution  # graphloc.write(run, folder) makes the run folder with the report

track = solution.trajectory  # body in world (east, north, up), about ten poses a second
places = solution.datum.geodetic_from_enu(track.p_world_m)
bounds = bounds_95(track.cov)
headings = solution.datum.true_heading_deg(track.yaw_rad, track.p_world_m)
for k in range(0, len(track), 50):
    lat, lon, _ = places[k]
    print(f"{utc_text(int(track.stamps_ns[k]))}  {lat:.7f}  {lon:.7f}  {headings[k]:.1f} deg  +- {bounds[k, 0]:.2f} m")

print("health:", dict(Counter(state.value for state in solution.health)))
for sensor, outcomes in solution.ledger.counts().items():  # of every message, what became of it
    print(f"{sensor}: {outcomes}")
