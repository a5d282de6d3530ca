# SPDX-License-Identifier: Apache-2.0
"""Simulated run of a scenario and a seed: truth, measurements, and a correct vessel.yaml."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import shapely

from graphloc.config import (
    AerialConfig,
    AprilTagConfig,
    BodyVelocityConfig,
    CameraConfig,
    CompassConfig,
    DatumConfig,
    GnssConfig,
    HeightConfig,
    ImuConfig,
    LidarConfig,
    PoseConfig,
    SensorConfig,
    StartConfig,
    VesselConfig,
)
from graphloc.errors import ConfigError
from graphloc.eval.simulate._readings import (
    compass_headings,
    gnss_fixes,
    imu_series,
    log_speeds,
    made_up_matches,
    stamps,
    times,
)
from graphloc.eval.simulate._scenario import Scenario
from graphloc.eval.simulate._truth import Motion
from graphloc.eval.simulate._voyage import harbour_motion, open_motion
from graphloc.eval.simulate.docks import MovingDock, moving_docks
from graphloc.eval.simulate.harbour import Harbour, load_harbour
from graphloc.eval.simulate.rig import RigConfig, load_rig
from graphloc.frames import Datum, Geodetic, heading_deg_from_yaw
from graphloc.measurements import Measurement
from graphloc.recording import Recording
from graphloc.trajectory import Trajectory

_DATUM = Geodetic(57.7, 11.7, 36.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SimulatedRun:
    """A simulated run: measurements, truth, and (`config`) the vessel.yaml that a careful engineer would write."""

    scenario: Scenario
    seed: int
    recording: Recording
    truth: Trajectory
    config: VesselConfig
    motion: Motion
    rig: RigConfig
    harbour: Harbour | None
    docks: tuple[MovingDock, ...]


def simulate(scenario: Scenario, seed: int) -> SimulatedRun:
    """Simulate a scenario; a seed always gives the same run."""
    rng = np.random.default_rng([seed, 7])
    harbour = load_harbour(scenario.harbour) if scenario.harbour else None
    rig = load_rig(scenario.rig)
    slow = [name for name, lidar in rig.lidars.items() if lidar.scan_s * scenario.lidar_hz > 1.0]
    if slow:
        raise ConfigError(
            f"lidar_hz={scenario.lidar_hz:g}: {slow[0]} takes {rig.lidars[slow[0]].scan_s:g} s for a turn"
        )
    motion = open_motion(scenario, rng) if harbour is None else harbour_motion(scenario, harbour, rig, rng)
    datum = Datum(_DATUM) if harbour is None else harbour.datum
    config = _config(scenario, rig, motion, datum)
    t = times(scenario.duration_s, scenario.imu_hz)
    imu = imu_series(scenario, motion, datum, t, (rig.imu.t_body_sensor_m, rig.imu.R_body_sensor), rng)
    drafts: list[Measurement] = []
    drafts += gnss_fixes(scenario, motion, datum, rig.gnss.t_body_sensor_m, rng)
    drafts += compass_headings(scenario, motion, rng)
    drafts += made_up_matches(scenario, motion, rng)
    drafts += log_speeds(scenario, motion, np.random.default_rng([seed, 23]))
    drafts.sort(key=lambda m: (m.stamp_ns, m.sensor))
    measurements = tuple(replace(m, seq=len(imu) + i) for i, m in enumerate(drafts))
    p, R, v = motion.pose(t)
    truth = Trajectory(stamps_ns=stamps(t), p_world_m=p, R_world_body=R, v_world_mps=v)
    recording = Recording(
        source="(simulated)",
        imu=imu,
        measurements=measurements,
        message_count=len(imu) + len(measurements),
        topics={name: sensor.topic for name, sensor in config.sensors.items()},
        truth=truth,
    )
    docks = () if harbour is None else moving_docks(harbour, scenario.tide_m, np.random.default_rng([seed, 19]))
    return SimulatedRun(
        scenario=scenario, seed=seed, recording=recording, truth=truth, config=config, motion=motion, rig=rig,
        harbour=harbour, docks=docks,
    )  # fmt: skip


def _config(s: Scenario, rig: RigConfig, motion: Motion, datum: Datum) -> VesselConfig:
    start = StartConfig()
    if s.start_heading_error_deg is not None:
        true = float(heading_deg_from_yaw(motion.yaw(0.0)))
        start = StartConfig(heading_deg=(true + s.start_heading_error_deg) % 360.0)
    sensors: dict[str, SensorConfig] = {
        "imu": ImuConfig(
            topic="/imu/data",
            mount=rig.imu,
            gyro_noise_mdps_per_sqrt_hz=s.gyro_noise_mdps_per_sqrt_hz,
            accel_noise_ug_per_sqrt_hz=s.accel_noise_ug_per_sqrt_hz,
        ),
        "height": HeightConfig(height_m=datum.origin.height_m),
    }
    if s.gnss_hz > 0.0:
        sensors["gnss"] = GnssConfig(topic="/gnss/fix", mount=rig.gnss)
    if s.compass_hz > 0.0:
        sensors["compass"] = CompassConfig(topic="/gnss/heading", sigma_deg=s.compass_sigma_deg)
    if s.log_hz > 0.0:
        sensors["log"] = BodyVelocityConfig(topic="/log/velocity", through=s.log_through, sigma_mps=s.log_sigma_mps)
    if s.pose_hz > 0.0:
        sensors["matcher"] = PoseConfig(topic="/matcher/pose", axes=("x", "y", "yaw"))
    elif s.harbour and s.lidar_hz > 0.0 and rig.lidars:
        sensors["aerial"] = _matcher(rig)
    if s.harbour and s.camera_hz > 0.0 and rig.cameras and load_harbour(s.harbour).config.tags:
        sensors["tags"] = _tags(rig, s)
    return VesselConfig(
        vessel=rig.vessel,
        datum=DatumConfig(
            latitude_deg=datum.origin.latitude_deg,
            longitude_deg=datum.origin.longitude_deg,
            height_m=datum.origin.height_m,
        ),
        sensors=sensors,
        truth_topic="/truth",
        start=start,
    )


def _tags(rig: RigConfig, s: Scenario) -> AprilTagConfig:
    """Return the configuration of the tag sensor for the rig's cameras."""
    topic = "/{}/image_raw" if s.camera_raw else "/{}/image_raw/compressed"
    cameras = {name: CameraConfig(topic=topic.format(name), mount=camera.mount) for name, camera in rig.cameras.items()}
    return AprilTagConfig(survey="tags.yaml", cameras=cameras)


def _matcher(rig: RigConfig) -> AerialConfig:
    """Return the configuration of the aerial sensor for the rig's LiDARs, with a small margin around the hull."""
    hull = shapely.Polygon(rig.hull.outline).buffer(0.3, join_style="mitre")
    return AerialConfig(
        image="aerial.tif",
        hull_m=tuple((round(x, 2), round(y, 2)) for x, y in hull.exterior.coords[:-1]),
        lidars={name: LidarConfig(topic=f"/{name}/points", mount=lidar.mount) for name, lidar in rig.lidars.items()},
    )
