# SPDX-License-Identifier: Apache-2.0
"""States that a sighting of tags depends on beside the pose: docks, camera mounts and clocks, seen edges, survey errors.

The slow state of an apriltag sensor holds, in this order:

- of each floating dock: translation from rest (m) and small rotation (rad), about the axes of world;
- of each camera, as configured: error of the mount's rotation (rad, 3), delay of the stamps (s, 1);
- by how far the edges of tags are seen outside their print (px, 1).

Survey errors of the tags are constants of the run.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from graphloc.config import AprilTagConfig
from graphloc.frames import Array
from graphloc.graph import Constant, SlowProcess
from graphloc.survey import WORLD, DockConfig, Survey

EDGE_TIME_S = 30.0  # time constant of how edges are seen: range and light change in about that time
_FREEDOM = ("east", "north", "up", "roll", "pitch", "yaw")
_LEAST_M, _LEAST_RAD = 1e-3, float(np.radians(0.01))
_LEAST = np.repeat([_LEAST_M, _LEAST_RAD], 3)
_TIDE_S = 3600.0


def docks_of(survey: Survey) -> list[str]:
    """Return the names of the floating docks, in the order of the slow state."""
    return [frame for frame in survey.frames if frame != WORLD]


class SlowRows(NamedTuple):
    """Rows of the slow state that one sighting depends on; each may be empty."""

    dock: range
    mount: range
    stamp: range
    edge: range

    @classmethod
    def of(cls, config: AprilTagConfig, camera: str, frame: str, size: int) -> SlowRows:
        """Return the rows for tags of a frame seen by a camera; `size`: of the whole slow state, 0 where there is none."""
        if not size:
            return cls(range(0), range(0), range(0), range(0))
        docks = docks_of(config.surveyed)
        cameras = _camera_rows(config, 6 * len(docks))
        first = 6 * docks.index(frame) if frame in docks else 0
        mount, stamp = cameras.get(camera, (range(0), range(0)))
        others = max([6 * len(docks), *(stamps.stop for _, stamps in cameras.values())])
        return cls(range(first, first + 6 * (frame in docks)), mount, stamp, range(max(others, size - 1), size))


def _camera_rows(config: AprilTagConfig, first: int) -> dict[str, tuple[range, range]]:
    """Return the rows, from `first` on, that hold each camera's mount and delay; empty where these are not estimated."""
    found = {}
    for name, camera in config.cameras.items():
        stop = first + 3 * (camera.mount_sigma_deg > 0.0)
        found[name] = (range(first, stop), range(stop, stop + (camera.stamp_sigma_s > 0.0)))
        first = found[name][1].stop
    return found


def constants(config: AprilTagConfig) -> tuple[Constant, ...]:
    """Return the survey error of each tag: position (m) and small rotation (rad), about the axes of world."""
    return tuple(
        Constant(
            name=config.surveyed.called(tag.family, tag.id),
            sigma=np.repeat([max(tag.sigma_m, _LEAST_M), max(np.radians(tag.sigma_deg), _LEAST_RAD)], 3),
        )
        for tag in config.surveyed.tags
    )


def slow(config: AprilTagConfig) -> SlowProcess | None:
    """Return the process of dock motion, camera mounts and delays, and seen edges; None if none is modelled.

    A dock that swings with period T and RMS s moves at 2 pi s / T. A Gauss-Markov process whose steps over 1 s are as large has the
    time constant T^2 / 2 pi^2. The configured range of motion is taken as two sigmas. Waves tilt and lift a dock where they sway
    the vessel too: what the model denies the dock, the estimate gives to the camera's mount and delay (docs/decisions/0007).
    """
    docks = [dock for name in docks_of(config.surveyed) if (dock := config.surveyed.dock(name)) is not None]
    cameras = config.cameras if config.surveyed.tags else {}
    edges = [config.edge_sigma_px] if config.edge_sigma_px and config.surveyed.tags else []
    axes = [f"{dock.name} {axis}" for dock in docks for axis in _FREEDOM]
    units = ["m", "m", "m", "deg", "deg", "deg"] * len(docks)
    swings = [dock_process(dock) for dock in docks]
    sigma, time_s = ([value for swing in swings for value in swing[k]] for k in (0, 1))
    for name, camera in cameras.items():
        mount, late = 3 * (camera.mount_sigma_deg > 0.0), int(camera.stamp_sigma_s > 0.0)
        axes += [f"{name} mount {axis}" for axis in _FREEDOM[3:]][:mount] + [f"{name} late"] * late
        units += ["deg"] * mount + ["s"] * late
        sigma += [np.radians(camera.mount_sigma_deg)] * mount + [camera.stamp_sigma_s] * late
        time_s += [np.inf] * (mount + late)
    if not axes and not edges:
        return None
    of_cameras = len(axes) > 6 * len(docks)
    return SlowProcess(
        name=" and ".join(["docks moved"] * bool(docks) + ["cameras off"] * of_cameras + ["edges seen"] * len(edges)),
        offset="camera's mount or clock",
        axes=(*axes, *["outwards"] * len(edges)),
        units=(*units, *["px"] * len(edges)),
        scale=np.array([180.0 / np.pi if unit == "deg" else 1.0 for unit in units] + [1.0] * len(edges)),
        sigma=np.array([*sigma, *edges]),
        time_constant_s=np.array([*time_s, *[EDGE_TIME_S] * len(edges)]),
    )


def dock_process(dock: DockConfig) -> tuple[Array, Array]:
    """Return sigmas (6,), m and rad, and time constants (6,), s, of a dock's motion."""
    wander_s, wave_s = (max(period_s**2 / (2.0 * np.pi**2), 1.0) for period_s in (dock.period_s, dock.wave_period_s))
    turns = np.radians([dock.tilts_deg, dock.tilts_deg, dock.moves_deg])
    sigma = np.maximum(np.concatenate([[dock.moves_m, dock.moves_m, dock.rises_m], turns]) / 2.0, _LEAST)
    sigma[2], rise_s = _sum_of((sigma[2], _TIDE_S), (dock.heaves_m / 2.0, wave_s))
    return sigma, np.array([wander_s, wander_s, rise_s, wave_s, wave_s, wander_s])


def _sum_of(slow: tuple[float, float], quick: tuple[float, float]) -> tuple[float, float]:
    """Return sigma and time constant of one Gauss-Markov process that stands for the sum of two.

    It has the same variance of steps over a short time, and the same variance of means over a long time.
    """
    step = sum(sigma**2 / time_s for sigma, time_s in (slow, quick))
    lasting = sum(sigma**2 * time_s for sigma, time_s in (slow, quick))
    return float((step * lasting) ** 0.25), float(np.sqrt(lasting / step))
