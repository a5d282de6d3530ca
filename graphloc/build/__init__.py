# SPDX-License-Identifier: Apache-2.0
"""From a recording to the graph of any stretch of it.

A `Problem` holds what does not change while solving: timeline, preintegrated links, and per sensor a
`Stream` of measurements with the state that each attaches to. `build_graph` turns a stretch of it into
factors, at the current estimate and with the current decisions. It knows sensors only as rows.

The states stand where the IMU stands, with the axes of the body: inertial data then need no lever arm,
whose Euler term GTSAM's preintegration leaves out. Every other mount is taken from there, and the
solution is moved to the body's origin at the end (`graphloc.solve`).
"""

from graphloc.build._attach import (
    Carry,
    Estimates,
    Judged,
    Sited,
    asks_for_delay,
    attach,
    constant_keys,
    every_constant,
    nav_state,
    solved_constants,
    state_of,
)
from graphloc.build._chains import (
    CONSTANT_TAILS,
    JUMP,
    at_level,
    bias_step,
    closing_variance,
    silent_s,
    slow_begin,
    slow_end,
    slow_step,
    standing_cost,
    walk_between_nodes,
    without_drift,
)
from graphloc.build._graph import (
    Decided,
    Decisions,
    Level,
    Made,
    Past,
    StartPrior,
    build_graph,
    cost_of_constants,
    state_keys,
)
from graphloc.build._layout import (
    company_of,
    jumping,
    make_problem,
    mount_of,
    rows_of,
    shared_constants,
    slow_or_left_out,
)
from graphloc.build._problem import (
    Problem,
    Stream,
    bridged,
    noisier_imu,
    with_imu_noise,
    with_imu_turned,
    with_noise_scale,
    with_sensor_noise,
    with_usual_motion,
    without_imu,
    without_sensor,
)
from graphloc.build._thinned import Thinned, thinned

__all__ = [
    "CONSTANT_TAILS",
    "JUMP",
    "Carry",
    "Decided",
    "Decisions",
    "Estimates",
    "Judged",
    "Level",
    "Made",
    "Past",
    "Problem",
    "Sited",
    "StartPrior",
    "Stream",
    "Thinned",
    "asks_for_delay",
    "at_level",
    "attach",
    "bias_step",
    "bridged",
    "build_graph",
    "closing_variance",
    "company_of",
    "constant_keys",
    "cost_of_constants",
    "every_constant",
    "jumping",
    "make_problem",
    "mount_of",
    "nav_state",
    "noisier_imu",
    "rows_of",
    "shared_constants",
    "silent_s",
    "slow_begin",
    "slow_end",
    "slow_or_left_out",
    "slow_step",
    "solved_constants",
    "standing_cost",
    "state_keys",
    "state_of",
    "thinned",
    "walk_between_nodes",
    "with_imu_noise",
    "with_imu_turned",
    "with_noise_scale",
    "with_sensor_noise",
    "with_usual_motion",
    "without_drift",
    "without_imu",
    "without_sensor",
]
