# SPDX-License-Identifier: Apache-2.0
"""Coordinate reference systems: what is not metres is refused, and what nothing ties to WGS 84 is said."""

import logging

import pytest
from pyproj import CRS
from pyproj.transformer import TransformerGroup

from graphloc.frontends._crs import check_metric, warn_of_loose_tie
from graphloc.frontends._standard import _from_grid


def test_positions_in_feet_or_degrees_are_no_metres() -> None:
    """100 m in EPSG:32118 were 30.48 m in EPSG:2263, which counts US survey feet, without a word."""
    for grid in ("EPSG:2263", "EPSG:4326"):
        with pytest.raises(ValueError, match="does not count metres east and north"):
            _from_grid(grid)
        with pytest.raises(ValueError, match="does not count metres"):
            check_metric(grid, CRS.from_user_input(grid))
    lon, lat = _from_grid("EPSG:32632").transform(500_000.0, 6_429_000.0)
    assert (lon, lat) == (pytest.approx(9.0), pytest.approx(58.0, abs=0.01))


@pytest.mark.parametrize(
    ("crs", "accuracy_m", "said"),
    [
        ("EPSG:32632", 0.0, ""),
        ("EPSG:25832", 1.0, ""),  # ETRS 89
        ("EPSG:5972", -1.0, ""),  # what PROJ states of the same in a GeoTIFF's WKT, though it lies within a metre
        ("EPSG:31467", 3.0, "to 3 m only"),
        ("+proj=utm +zone=32 +ellps=GRS80", -1.0, ""),
        ("+proj=utm +zone=32 +ellps=intl", -1.0, "nothing ties its datum to WGS 84"),  # as ED50 is exported: 110 m off
    ],
)
def test_a_loose_tie_is_said(crs: str, accuracy_m: float, said: str, caplog: pytest.LogCaptureFixture) -> None:
    """PROJ states -1 m where it knows no tie and takes the datum for WGS 84."""
    found = CRS.from_user_input(crs)
    with caplog.at_level(logging.WARNING):
        warn_of_loose_tie("a map", found, accuracy_m)
    assert [said in record.getMessage() for record in caplog.records] == [True] * bool(said)
    if accuracy_m <= 0.0 and crs != "EPSG:5972":
        assert TransformerGroup(found, 4326, always_xy=True).transformers[0].accuracy == accuracy_m
