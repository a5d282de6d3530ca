# SPDX-License-Identifier: Apache-2.0
"""Sentences of NMEA 0183 (`nmea_msgs/Sentence`, `std_msgs/String`): position, heading, velocity, speed.

Velocities are over ground. Speeds are a log's, along the vessel, through the water or (VBW) over ground. Only requested
sentences are parsed, by pynmeagps.
"""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import dataclass
from math import cos, isfinite, nan, radians, sin
from typing import Any

from pynmeagps import VALCKSUM, NMEAReader, exceptions

from graphloc.frontends._rejections import Rejection, ignored, malformed, rejected

PLACES = ("GGA", "GNS", "RMC", "GLL")
HEADINGS = ("HDT", "THS", "HDG", "HDM", "SHR")  # PASHR, which makers of INSs share
VELOCITIES = ("VTG", "RMC")
SPEEDS = ("VHW", "VBW")
_SENTENCE = re.compile(r"\$([A-Z]{2})([A-Z]{3}),[^\r\n$]*\*[0-9A-Fa-f]{2}")  # without the tag block before it
_FOREIGN = re.compile(r"!|\$P")
_NAMED = re.compile(r"[$!]([A-Z][A-Z0-9]{2,9}),([^\r\n$!]*)")  # a sentence of any kind, with a checksum or without
_CLOCK = re.compile(r"([0-2]\d)([0-5]\d)([0-6]\d(?:\.\d{0,9})?)")
_SEALED = re.compile(r"\*[0-9A-Fa-f]{2}")
_NO_HEADING = re.compile(r"PASHR,(?!ATT,)([A-Z]\w*)")  # PASHR of satellites, positions and the like
_UNREADABLE = (
    exceptions.NMEAParseError, exceptions.NMEAMessageError, exceptions.NMEATypeError, exceptions.NMEAStreamError,
    ValueError, TypeError, KeyError, IndexError, AttributeError,
)  # fmt: skip
KNOT_MPS, KM_PER_H_MPS = 1852.0 / 3600.0, 1.0 / 3.6
SLOW_MPS = 0.1
"""A receiver may leave out the course of a slower speed. Then the velocity is zero: with a course of 0 the noise of the
speed would be a drift to the north."""
_HEADING_FIELDS = {"HDT": "headingT", "THS": "headt", "HDM": "headingM", "HDG": "headingM", "ASHR": "trueHdg"}
# From the mode letters of GNS, RMC and GLL to the quality of a fix as GGA has it.
_QUALITIES = {"N": 0, "A": 1, "D": 2, "P": 3, "R": 4, "F": 5, "E": 6, "M": 7, "S": 8}
_NOT_MEASURED = {0: "no fix", 6: "dead reckoned by the receiver", 7: "typed in by hand", 8: "simulated by the receiver"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Fix:
    """A fix; its height is above the ellipsoid, NaN if unknown, its quality as in GGA; hdop: horizontal dilution."""

    latitude_deg: float
    longitude_deg: float
    height_m: float
    quality: int
    hdop: float


def text_of(msg: Any) -> str:
    """Return the text of a Sentence or String message."""
    return str(msg.sentence if hasattr(msg, "sentence") else msg.data)


def identities(text: str) -> list[tuple[str, str]]:
    """Return talker and kind ('GP', 'GGA') of each distinct sentence in a message, which may hold a whole burst."""
    telling = (found for found in _SENTENCE.finditer(text) if not _NO_HEADING.match(found[0], 1))
    return list(dict.fromkeys((found[1], found[2]) for found in telling))


def unread(text: str) -> list[str]:
    """Return the names of the sentences that no sensor reads ('GPGSV', 'PSAT', 'AIVDM', 'PASHR,SAT').

    The name of a readable kind is followed by why it is not read ('GPGGA without a checksum').
    """
    names = []
    for found in _NAMED.finditer(text):
        name = found[1]
        if name[2:] not in (*PLACES, *HEADINGS, *VELOCITIES, *SPEEDS):
            names.append(name)
        elif other := _NO_HEADING.match(found[0], 1):
            names.append(f"{name},{other[1]}")
        elif not _SEALED.search(found[2]):
            names.append(f"{name} without a checksum")
    return names


def time_of_day_s(text: str, sentence: str) -> float:
    """Return the UTC time of day in a sentence of a place ('GPGGA'), s; NaN if it tells none."""
    said = next((f[0] for f in _SENTENCE.finditer(text) if f[1] + f[2] == sentence), "")
    fields = said.partition("*")[0].split(",")
    place = 5 if sentence.endswith("GLL") else 1
    clock = _CLOCK.fullmatch(fields[place]) if len(fields) > place else None
    return nan if clock is None else 3600.0 * int(clock[1]) + 60.0 * int(clock[2]) + float(clock[3])


def fix(text: str, wanted: Collection[str]) -> Fix | Rejection:
    """Return the fix of the first accepted sentence.

    Args:
        text: of the message. wanted: accepted sentences, of one talker ('GPGGA') or of any ('GGA').
    """
    said = _read(text, wanted, PLACES, "place")
    if isinstance(said, Rejection):
        return said
    quality = _field(said, "quality") if said.msgID == "GGA" else _quality(said)
    if not isinstance(quality, int):
        return malformed(f"{said.msgID}: no quality: it ends early")
    if quality in _NOT_MEASURED:
        return rejected(f"{said.msgID}: {_NOT_MEASURED[quality]}")
    if _field(said, "NS") not in ("N", "S") or _field(said, "EW") not in ("E", "W"):
        return malformed(f"{said.msgID}: no hemisphere (N or S, E or W)")
    # Heights in NMEA are above the geoid; without the separation the ellipsoid's is not known.
    return Fix(
        latitude_deg=_number(said, "lat"),
        longitude_deg=_number(said, "lon"),
        height_m=_number(said, "alt") + _number(said, "sep"),
        quality=quality,
        hdop=_number(said, "HDOP"),
    )


def heading_deg(text: str, wanted: Collection[str]) -> float | Rejection:
    """Return the heading, deg, clockwise from true north, or from magnetic north (HDM, and HDG without a variation)."""
    said = _read(text, wanted, HEADINGS, "heading")
    if isinstance(said, Rejection):
        return said
    if said.msgID == "THS" and _field(said, "mi") != "A":
        return rejected("THS: its mode is not 'A': the heading is not measured")
    if said.msgID == "ASHR" and _field(said, "trueHdgInd") != "T" and _field(said, "msgId") != "ATT":
        return ignored("PASHR: of a kind that tells no heading")
    if said.msgID == "ASHR" and _field(said, "ambiguity"):
        return rejected("PASHR: its ambiguities are not fixed")
    value = _number(said, _HEADING_FIELDS[said.msgID])
    if said.msgID == "HDG":
        value += _east(said, "deviation") + _east(said, "variation")
    return value if isfinite(value) else rejected(f"{'PASHR' if said.msgID == 'ASHR' else said.msgID}: no heading")


def velocity_mps(text: str, wanted: Collection[str]) -> tuple[float, float] | Rejection:
    """Return the velocity over ground, east and north, m/s."""
    said = _read(text, wanted, VELOCITIES, "velocity")
    if isinstance(said, Rejection):
        return said
    if (quality := _quality(said)) in _NOT_MEASURED:
        return rejected(f"{said.msgID}: {_NOT_MEASURED[quality]}")
    if said.msgID == "RMC":
        speed, course = KNOT_MPS * _number(said, "spd"), _number(said, "cog")
    else:
        speed, course = _speed_mps(said, "sogn", "sogk"), _number(said, "cogt")
    if not isfinite(speed) or (speed > SLOW_MPS and not isfinite(course)):
        return rejected(f"{said.msgID}: no {'course' if isfinite(speed) else 'speed'}")
    east = radians(course)
    return (speed * sin(east), speed * cos(east)) if isfinite(course) else (0.0, 0.0)


def log_velocity_mps(text: str, wanted: Collection[str], through: str) -> tuple[float, ...] | Rejection:
    """Return the velocity by a log, m/s: ahead and, if told, to port.

    Args:
        text, wanted: see `fix`. through: 'ground' or 'water', which of the two velocities of VBW.
    """
    said = _read(text, wanted, SPEEDS, "speed by a log")
    if isinstance(said, Rejection):
        return said
    if said.msgID == "VHW":
        speed = _speed_mps(said, "spdN", "spdK")
        return (speed,) if isfinite(speed) else rejected(f"{said.msgID}: no speed")
    if _field(said, f"{through}spdstatus") != "A":
        return rejected(f"VBW: its speed {'over ground' if through == 'ground' else 'through the water'} is not valid")
    ahead, starboard = (KNOT_MPS * _number(said, f"{axis}{through}spd") for axis in ("long", "trans"))
    if not isfinite(ahead):
        return rejected("VBW: no speed")
    return (ahead, -starboard) if isfinite(starboard) else (ahead,)


def _read(text: str, wanted: Collection[str], kinds: Collection[str], what: str) -> Any | Rejection:
    """Return the first accepted sentence as pynmeagps parses it, or its rejection.

    Args:
        text, wanted: see `fix`. kinds: sentences that are read for `what`.
    """
    sentences = list(_SENTENCE.finditer(text))
    if not sentences and (foreign := _FOREIGN.search(text)):
        return ignored(f"{foreign[0]}...: AIS or a maker's own sentence: not read")
    if not sentences:
        return malformed(f"no sentence of NMEA 0183 with a checksum: {text.strip()[:20]!r}")
    fitting = [f for f in sentences if f[2] in wanted or f[1] + f[2] in wanted] or sentences[:1]
    found = next((f for f in fitting if not _NO_HEADING.match(f[0], 1)), fitting[0])
    talker, kind = found[1], found[2]
    if kind not in wanted and talker + kind not in wanted:
        return ignored(f"{kind}: not among the sentences that are read ({', '.join(wanted)})")
    if kind not in kinds:
        return ignored(f"{kind}: read for a {what} are {', '.join(kinds)}")
    try:
        said = NMEAReader.parse(found[0], validate=VALCKSUM)
    except _UNREADABLE as error:
        return malformed(f"{kind}: {' '.join(str(error).split())}")
    return said if said is not None else malformed(f"{kind}: it cannot be read")


def _quality(said: Any) -> int:
    """Return the best quality of a sentence's mode letters, one per constellation; of old receivers, of the status."""
    if getattr(said, "status", "A") != "A":
        return 0
    modes = [_QUALITIES[letter] for letter in str(_field(said, "posMode")) if letter in _QUALITIES]
    return max((q for q in modes if q not in _NOT_MEASURED), default=modes[0] if modes else 1)


def _field(said: Any, name: str) -> Any:
    """Return a field; '' if the sentence ends before it."""
    return getattr(said, name, "")


def _number(said: Any, name: str) -> float:
    value = _field(said, name)
    return float(value) if isinstance(value, int | float) else nan


def _speed_mps(said: Any, knots: str, km_per_h: str) -> float:
    """Return a speed, m/s, of which a sentence gives knots or km/h; NaN if it gives neither."""
    in_knots = _number(said, knots)
    return KNOT_MPS * in_knots if isfinite(in_knots) else KM_PER_H_MPS * _number(said, km_per_h)


def _east(said: Any, name: str) -> float:
    """Return a deviation or variation, deg, positive east; 0 if it is not given."""
    size = _number(said, name)
    return (-size if _field(said, f"{name}EW") == "W" else size) if isfinite(size) else 0.0
