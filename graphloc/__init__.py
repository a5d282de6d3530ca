# SPDX-License-Identifier: Apache-2.0
"""graphloc: factor-graph localisation for vessels, where GNSS cannot be trusted.

The names in `__all__` are its public interface (docs/api.md). They are imported when they are first used: `import graphloc` is light.
"""

import logging
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from graphloc.app import Run, Scans, configured, load, online_smoother, smooth_recording, write
    from graphloc.config import VesselConfig
    from graphloc.errors import ConfigError, GraphlocError, InputError, OutputError, SolveError
    from graphloc.estimate import Estimate
    from graphloc.frames import Datum, Geodetic
    from graphloc.measurements import (
        BodyVelocity,
        CompassHeading,
        GnssPosition,
        GnssVelocity,
        ImuSample,
        PoseFix,
        TagSighting,
    )
    from graphloc.online import OnlineSmoother
    from graphloc.recording import Recording
    from graphloc.replay import arrivals
    from graphloc.row_check import check_row
    from graphloc.solution import Solution
    from graphloc.trajectory import Trajectory

__version__ = "0.1.0"
_HOMES = {
    "app": ("Run", "Scans", "configured", "load", "online_smoother", "smooth_recording", "write"),
    "config": ("VesselConfig",),
    "errors": ("ConfigError", "GraphlocError", "InputError", "OutputError", "SolveError"),
    "estimate": ("Estimate",),
    "frames": ("Datum", "Geodetic"),
    "measurements": (
        "BodyVelocity", "CompassHeading", "GnssPosition", "GnssVelocity", "ImuSample", "PoseFix", "TagSighting",
    ),
    "online": ("OnlineSmoother",),
    "recording": ("Recording",),
    "replay": ("arrivals",),
    "row_check": ("check_row",),
    "solution": ("Solution",),
    "trajectory": ("Trajectory",),
}  # fmt: skip
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}
__all__ = [
    "BodyVelocity",
    "CompassHeading",
    "ConfigError",
    "Datum",
    "Estimate",
    "Geodetic",
    "GnssPosition",
    "GnssVelocity",
    "GraphlocError",
    "ImuSample",
    "InputError",
    "OnlineSmoother",
    "OutputError",
    "PoseFix",
    "Recording",
    "Run",
    "Scans",
    "Solution",
    "SolveError",
    "TagSighting",
    "Trajectory",
    "VesselConfig",
    "__version__",
    "arrivals",
    "check_row",
    "configured",
    "load",
    "online_smoother",
    "smooth_recording",
    "write",
]

logging.getLogger(__name__).addHandler(logging.NullHandler())


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module 'graphloc' has no attribute {name!r}")
    return getattr(import_module(f"graphloc.{_HOME_OF[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
