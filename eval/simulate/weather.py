# SPDX-License-Identifier: Apache-2.0
"""Digerud's six conditions (D 3.4.4.2): the light, and what the air and the lens do to it.

The unit of radiance is that of a white surface on the ground on an overcast day. Figures are chosen so that tags are
lost near the ranges of D table 4.13; docs/results.md says how near.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Condition = Literal["optimal", "fog", "counterlight", "droplet", "darkness", "illuminated"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Weather:
    """One condition.

    Attributes:
        daylight: light of the sky; 1: an overcast day. fog_per_m: extinction of the air (Koschmieder).
        sun_elevation_deg: of a low sun behind the tags; None: overcast. drops: whether there is water on the lens.
        stray: factor on the stray light of a clean lens with the light behind it.
        tag_glow: radiance of the white of a tag lit from behind. lamps: whether harbour lamps are on.
    """

    daylight: float = 1.0
    fog_per_m: float = 0.0
    sun_elevation_deg: float | None = None
    drops: bool = False
    stray: float = 1.0
    tag_glow: float = 0.0
    lamps: bool = False


WEATHER: dict[Condition, Weather] = {
    "optimal": Weather(),
    "fog": Weather(fog_per_m=0.1),
    "counterlight": Weather(sun_elevation_deg=14.0, stray=4.0),
    "droplet": Weather(drops=True),
    "darkness": Weather(daylight=0.0015, lamps=True),
    "illuminated": Weather(daylight=0.0015, lamps=True, tag_glow=2.0),
}
