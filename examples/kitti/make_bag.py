# SPDX-License-Identifier: Apache-2.0
"""Write the KITTI run that comes with gtsam as a ROS 2 bag: a real car, 470 s, IMU 100 Hz, GPS 1 Hz.

Source: `KittiEquivBiasedImu.txt` and `KittiGps_converted.txt` of gtsam's example data, as installed
with its wheel. The files hold seconds since midnight and local metres without an origin, so the date
and the datum are made up (Karlsruhe, where the car drove). The first IMU row is dropped: its interval
is 1.9 s. The body is the car's: x forward, y left, z up, gravity included; the GPS positions are those
of the IMU, with 0.07 m of noise per axis (the sigma that gtsam's own example takes).
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

import gtsam
import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from graphloc.frames import Array, Datum, Geodetic

DATUM = Datum(Geodetic(49.0, 8.4, 115.0))
MIDNIGHT_NS = 1_317_254_400_000_000_000  # 2011-09-29, a day on which KITTI was recorded
GPS_SIGMA_M = 0.07


def stamp_ns(seconds_of_day: float) -> int:
    """Return the stamp of a time of day, as whole ns."""
    return MIDNIGHT_NS + round(seconds_of_day * 1e9)


def read_imu() -> Array:
    """Return (N, 7): time of day s, acceleration m/s^2, angular rate rad/s."""
    rows = np.loadtxt(gtsam.findExampleDataFile("KittiEquivBiasedImu.txt"), skiprows=1)
    return np.asarray(rows[1:, [0, 2, 3, 4, 5, 6, 7]])


def read_gps() -> Array:
    """Return (N, 4): time of day s, local x, y, z m."""
    return np.asarray(np.loadtxt(gtsam.findExampleDataFile("KittiGps_converted.txt"), skiprows=1, delimiter=","))


def write_bag(folder: Path, *, mcap: bool = False) -> None:
    """Write the bag into a new folder: /imu (`sensor_msgs/Imu`) and /gps/fix (`sensor_msgs/NavSatFix`)."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    t = store.types
    time, header, vector = t["builtin_interfaces/msg/Time"], t["std_msgs/msg/Header"], t["geometry_msgs/msg/Vector3"]

    def head(at_ns: int, frame: str) -> object:
        return header(stamp=time(sec=at_ns // 10**9, nanosec=at_ns % 10**9), frame_id=frame)

    absent = np.array([-1.0] + [0.0] * 8)  # REP 145: the orientation is not known
    messages: list[tuple[int, str, object]] = []
    for row in read_imu():
        at_ns = stamp_ns(row[0])
        msg = t["sensor_msgs/msg/Imu"](
            header=head(at_ns, "base_link"),
            orientation=t["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
            orientation_covariance=absent,
            angular_velocity=vector(x=row[4], y=row[5], z=row[6]),
            angular_velocity_covariance=np.zeros(9),
            linear_acceleration=vector(x=row[1], y=row[2], z=row[3]),
            linear_acceleration_covariance=np.zeros(9),
        )
        messages.append((at_ns, "/imu", msg))
    gps = read_gps()
    status = t["sensor_msgs/msg/NavSatStatus"](status=2, service=1)  # GBAS: differential, from the ground
    covariance = (GPS_SIGMA_M**2 * np.eye(3)).ravel()
    for seconds, lla in zip(gps[:, 0], DATUM.geodetic_from_enu(gps[:, 1:4]), strict=True):
        at_ns = stamp_ns(seconds)
        fix = t["sensor_msgs/msg/NavSatFix"](
            header=head(at_ns, "base_link"),
            status=status,
            latitude=float(lla[0]),
            longitude=float(lla[1]),
            altitude=float(lla[2]),
            position_covariance=covariance,
            position_covariance_type=2,
        )
        messages.append((at_ns, "/gps/fix", fix))
    messages.sort(key=lambda m: m[0])
    plugin = StoragePlugin.MCAP if mcap else StoragePlugin.SQLITE3
    with Writer(folder, version=9, storage_plugin=plugin) as writer:
        connections = {
            "/imu": writer.add_connection("/imu", "sensor_msgs/msg/Imu", typestore=store),
            "/gps/fix": writer.add_connection("/gps/fix", "sensor_msgs/msg/NavSatFix", typestore=store),
        }
        for at_ns, topic, msg in messages:
            connection = connections[topic]
            writer.write(connection, at_ns, store.serialize_cdr(msg, connection.msgtype))


def main() -> None:
    """Parse the command line and write the bag."""
    parser = argparse.ArgumentParser(description="Write gtsam's KITTI example as a ROS 2 bag.")
    parser.add_argument("folder", type=Path, help="folder of the bag; must not exist unless --overwrite")
    parser.add_argument("--mcap", action="store_true", help="MCAP instead of sqlite3")
    parser.add_argument("--overwrite", action="store_true", help="replace a bag that lies there")
    options = parser.parse_args()
    if options.folder.exists():
        if not (options.overwrite and (options.folder / "metadata.yaml").exists()):
            parser.error(f"{options.folder} exists; give another name, or --overwrite if it is a bag")
        shutil.rmtree(options.folder)
    options.folder.parent.mkdir(parents=True, exist_ok=True)
    write_bag(options.folder, mcap=options.mcap)


if __name__ == "__main__":
    main()
