# SPDX-License-Identifier: Apache-2.0
"""What map grids and images share of coordinate reference systems: their axes, and how well they are tied to WGS 84."""

from __future__ import annotations

import logging
import warnings
from typing import Any

from pyproj.transformer import AreaOfInterest, TransformerGroup

from graphloc.frames import Datum

_LOOSE_M = 1.5  # a tie to WGS 84 with a larger uncertainty is warned of; ties of ETRS 89 state 1 m
_ALIKE = ("WGS 84", "GRS 1980")  # ellipsoids of datums that are within a metre or two of WGS 84

log = logging.getLogger(__name__)


def check_metric(what: str, crs: Any) -> None:
    """Check that a CRS (pyproj) counts metres east and north.

    Raises:
        ValueError: it counts other units, or angles.
    """
    axes = {(axis.direction, axis.unit_name) for axis in crs.axis_info[:2]}
    if not crs.is_projected or axes != {("east", "metre"), ("north", "metre")}:
        raise ValueError(f"{what} ({crs.name}) does not count metres east and north")


def ties_near(datum: Datum, source: Any, target: Any) -> list[Any]:
    """Return the transformations (pyproj) between two CRS, the best near the datum first; east and longitude come first.

    Raises:
        pyproj.exceptions.ProjError: one of the CRS cannot be used.
    """
    lon, lat = datum.origin.longitude_deg, datum.origin.latitude_deg
    lon -= 360.0 if lon > 180.0 else 0.0  # a datum may say 190 deg, PROJ's areas may not
    here = AreaOfInterest(lon, lat, lon, lat)  # which tie to WGS 84 is best depends on where
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # a better tie needs a grid file; `warn_of_loose_tie` says so
        return list(TransformerGroup(source, target, always_xy=True, area_of_interest=here).transformers)


def warn_of_loose_tie(what: str, crs: Any, accuracy_m: float) -> None:
    """Warn where a CRS (pyproj) is tied to WGS 84 loosely, or by nothing that PROJ knows.

    Args:
        accuracy_m: of the tie, as PROJ states it; negative: it knows none, and takes its datum for WGS 84. So it does with some
            well-known datums, as Norway's EUREF 89 in a WKT; these are not warned of.
    """
    if accuracy_m > _LOOSE_M:
        log.warning("%s (%s) is tied to WGS 84 to %g m only", what, crs.name, accuracy_m)
    elif accuracy_m < 0.0 and crs.datum.name.lower().startswith("unknown") and crs.ellipsoid.name not in _ALIKE:
        log.warning(
            "%s (%s): nothing ties its datum to WGS 84, it may lie 100 m and more off: name it by its EPSG code", what, crs.name
        )  # fmt: skip
