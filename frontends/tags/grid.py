# SPDX-License-Identifier: Apache-2.0
"""Conversion of a survey in a map grid, as surveyors give it, to world: its tags, docks and berths."""

from __future__ import annotations

import numpy as np
from pyproj import CRS
from pyproj.exceptions import ProjError

from graphloc.frames import Array, Datum
from graphloc.frontends._crs import check_metric, ties_near, warn_of_loose_tie
from graphloc.survey import WORLD, Survey

_AHEAD_M = 10.0  # distance over which the direction of grid north is computed
_FAR_M = 50e3  # farther from the datum, the zone is wrong, or northing and easting are swapped


def in_world(survey: Survey, datum: Datum) -> Survey:
    """Return a survey whose positions are east, north, up from a datum; one without a grid is returned as it is.

    Grid north is not true north, and a metre of a grid is not always a metre: each position is converted by itself, and
    each direction by that of grid north at its position. Positions and directions on a dock stay in the dock's frame.

    Raises:
        ValueError: the grid is unknown, does not count metres east and north, or has heights of its own; or a position
            is not in it, or is farther than 50 km from the datum.
    """
    if not survey.grid:
        return survey
    grid = _Grid(survey.grid, datum)
    tags, docks, berths = [], [], []
    for tag in survey.tags:
        if tag.frame == WORLD:
            xyz_m, north_deg = grid.placed(f"tag {tag.id}", tag.xyz_m)
            turned = {"rpy_deg": _yawed(tag.rpy_deg, north_deg)} if tag.rpy_deg else {}
            facing = {"facing_deg": tag.facing_deg + north_deg} if tag.facing_deg is not None else {}
            tag = tag.model_copy(update={"xyz_m": xyz_m, **turned, **facing})
        tags.append(tag)
    for dock in survey.docks:
        xyz_m, north_deg = grid.placed(f"dock {dock.name}", dock.xyz_m)
        docks.append(dock.model_copy(update={"xyz_m": xyz_m, "rpy_deg": _yawed(dock.rpy_deg, north_deg)}))
    for berth in survey.berths:
        if berth.frame == WORLD:
            xyz_m, north_deg = grid.placed(f"berth {berth.name}", berth.xyz_m)
            berth = berth.model_copy(update={"xyz_m": xyz_m, "facing_deg": berth.facing_deg + north_deg})
        berths.append(berth)
    return survey.model_copy(update={"grid": "", "tags": tuple(tags), "docks": tuple(docks), "berths": tuple(berths)})


class _Grid:
    """A map grid, seen from a datum."""

    def __init__(self, name: str, datum: Datum) -> None:
        try:
            crs = CRS.from_user_input(name)
            ties = ties_near(datum, crs, 4326)
        except ProjError:
            raise ValueError(f"grid {name} is not known") from None
        check_metric(f"grid {name}", crs)
        if not ties:
            raise ValueError(f"grid {name} ({crs.name}) is tied to no place on Earth")
        if crs.is_compound:  # its heights are above sea level
            flat = crs.sub_crs_list[0].name
            raise ValueError(
                f"grid {name} ({crs.name}) has heights of its own: name that of {flat} alone, and give heights above the ellipsoid"
            )
        self._to_geodetic = ties[0]
        warn_of_loose_tie(f"grid {name}", crs, self._to_geodetic.accuracy)
        self._name, self._datum = name, datum

    def placed(self, what: str, xyz_m: tuple[float, float, float]) -> tuple[tuple[float, float, float], float]:
        """Return a position in world, and the direction of grid north at it, deg clockwise from true north.

        Args:
            what: its name, for errors. xyz_m: easting, northing, height above the ellipsoid.
        """
        east, north, height = xyz_m
        here, ahead = self._world(np.array([[east, north, height], [east, north + _AHEAD_M, height]]))
        if not np.isfinite([here, ahead]).all():
            raise ValueError(f"{what}: {east:g}, {north:g} is not in the grid {self._name}")
        if (away_m := float(np.linalg.norm(here))) > _FAR_M:
            raise ValueError(
                f"{what}: {east:.0f} east, {north:.0f} north in {self._name} is {away_m / 1000.0:.0f} km from the datum: swapped, or "
                "another grid or datum"
            )
        x, y, z = here.tolist()
        way = ahead - here
        return (x, y, z), float(np.degrees(np.arctan2(way[0], way[1])))

    def _world(self, in_grid_m: Array) -> Array:
        longitude, latitude = self._to_geodetic.transform(in_grid_m[:, 0], in_grid_m[:, 1])
        return self._datum.enu_from_geodetic(np.asarray(latitude), np.asarray(longitude), in_grid_m[:, 2])


def _yawed(rpy_deg: tuple[float, float, float], north_deg: float) -> tuple[float, float, float]:
    """Return an attitude in world from one in a grid whose north is `north_deg` clockwise of true north."""
    roll, pitch, yaw = rpy_deg
    return roll, pitch, yaw - north_deg
