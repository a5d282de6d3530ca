# SPDX-License-Identifier: Apache-2.0
"""What takes more than a message to measure: sightings of tags (images and a survey), matches of scans (an image and a track).

Matches are made around the track of a solved run (`with_matches`), or scan by scan while a smoother runs (`LiveMatching`).
"""

from graphloc.gather._gathering import Gathering
from graphloc.gather._live import LiveMatching, with_busy_warning
from graphloc.gather._matches import Matches, Scans, with_matches
from graphloc.gather._sightings import with_sightings, with_surveys

__all__ = [
    "Gathering",
    "LiveMatching",
    "Matches",
    "Scans",
    "with_busy_warning",
    "with_matches",
    "with_sightings",
    "with_surveys",
]
