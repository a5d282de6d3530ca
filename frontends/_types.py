# SPDX-License-Identifier: Apache-2.0
"""Message types: definitions in the bag, and standard ones otherwise."""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache

from rosbags.interfaces import Connection, MessageDefinitionFormat
from rosbags.interfaces.typing import Typesdict
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from graphloc.frontends._livox import LIVOX, livox_cloud
from graphloc.frontends._open import text_of
from graphloc.frontends._vendor_types import VENDOR_TYPES

# Types outside of rosbags' stores; bags of ROS 2 Humble and older in sqlite3 carry no definitions.
OTHER_TYPES = {
    "apriltag_msgs/msg/AprilTagDetectionArray": f"""std_msgs/Header header
AprilTagDetection[] detections
{"=" * 80}
MSG: apriltag_msgs/AprilTagDetection
string family
int32 id
int32 hamming
float32 goodness
float32 decision_margin
Point centre
Point[4] corners
float64[9] homography
{"=" * 80}
MSG: apriltag_msgs/Point
float64 x
float64 y
""",
    "nmea_msgs/msg/Sentence": "std_msgs/Header header\nstring sentence\n",
    **{
        f"{package}/msg/GPSFix": f"""std_msgs/Header header
GPSStatus status
float64 latitude
float64 longitude
float64 altitude
float64 track
float64 speed
float64 climb
float64 pitch
float64 roll
float64 dip
float64 time
float64 gdop
float64 pdop
float64 hdop
float64 vdop
float64 tdop
float64 err
float64 err_horz
float64 err_vert
float64 err_track
float64 err_speed
float64 err_climb
float64 err_time
float64 err_pitch
float64 err_roll
float64 err_dip
float64[9] position_covariance
uint8 position_covariance_type
{"=" * 80}
MSG: {package}/GPSStatus
std_msgs/Header header
uint16 satellites_used
int32[] satellite_used_prn
uint16 satellites_visible
int32[] satellite_visible_prn
int32[] satellite_visible_z
int32[] satellite_visible_azimuth
int32[] satellite_visible_snr
int16 status
uint16 motion_source
uint16 orientation_source
uint16 position_source
"""
        for package in ("gps_msgs", "gps_common")
    },
}


class MessageTypes:
    """Definitions of the message types of a bag, each read at first use.

    Args:
        name: of the bag, for warnings. connections: all of its topics. ros1: whether it is of ROS 1.
        warnings: gets a line for each definition that cannot be read.
    """

    def __init__(self, name: str, connections: Iterable[Connection], warnings: list[str], *, ros1: bool) -> None:
        self._name, self._connections, self._warnings, self._ros1 = name, tuple(connections), warnings, ros1
        self._stores: dict[str, list[Typestore]] = {}

    def decode(self, data: bytes, msgtype: str) -> object:
        """Return the deserialised message, a scan of Livox as a cloud.

        Raises whatever rosbags raises on damaged bytes.
        """
        if msgtype in LIVOX:
            return livox_cloud(data, ros1=self._ros1)
        if msgtype not in self._stores:
            self._stores[msgtype] = self._stores_of(msgtype)
        *others, last = self._stores[msgtype]
        for store in others:
            try:
                msg = self._with(store, data, msgtype)
            except Exception:  # noqa: BLE001, S112 - a wrong version may raise nearly anything
                continue
            self._stores[msgtype] = [store]
            return msg
        return self._with(last, data, msgtype)

    def _with(self, store: Typestore, data: bytes, msgtype: str) -> object:
        store.max_sequence_length = len(data) or 1  # a damaged length may state 2^32 elements that take no bytes
        return (store.deserialize_ros1 if self._ros1 else store.deserialize_cdr)(data, msgtype)

    def _stores_of(self, msgtype: str) -> list[Typestore]:
        """Return stores with the definition of a type in the bag; else with the standard one, or all of a maker's."""
        definitions = (c.msgdef for c in self._connections if c.msgtype == msgtype)
        for definition in definitions:
            if definition.format == MessageDefinitionFormat.NONE:
                continue
            try:
                return [_defined(definition.format, definition.data, msgtype)]
            except Exception as error:  # noqa: BLE001 - a definition may be any text
                self._warnings.append(
                    f"{self._name}: its definition of {msgtype} cannot be read ({text_of(error)}); the standard one is used"
                )
            break
        if msgtype in VENDOR_TYPES:
            return [_known(text, msgtype, self._ros1) for text in VENDOR_TYPES[msgtype]]
        return [
            _known(OTHER_TYPES[msgtype], msgtype, self._ros1) if msgtype in OTHER_TYPES else _known("", "", self._ros1)
        ]


@lru_cache(maxsize=64)  # as `_defined`
def _known(text: str, msgtype: str, ros1: bool) -> Typestore:
    """Return the standard definitions, with one of ours added, if any."""
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.LATEST)
    if text:
        store.register(get_types_from_msg(text, msgtype))
    return store


@lru_cache(maxsize=64)  # a run opens its bag several times, and rosbags writes a program for each type
def _defined(form: MessageDefinitionFormat, text: str, msgtype: str) -> Typestore:
    parse = get_types_from_msg if form == MessageDefinitionFormat.MSG else _types_from_idl
    store = get_typestore(Stores.EMPTY)
    store.register(parse(text, msgtype))
    return store


def _types_from_idl(text: str, _msgtype: str) -> Typesdict:
    """Parse the concatenated IDL files of an MCAP schema."""
    separator = "=" * 80 + "\n"
    parts = text.split(separator) if text.startswith(f"{separator}IDL: ") else [text]
    types: Typesdict = {}
    for part in filter(None, parts):
        types.update(get_types_from_idl(part.split("\n", 1)[1] if part.startswith("IDL: ") else part))
    return types
