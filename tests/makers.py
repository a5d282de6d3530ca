# SPDX-License-Identifier: Apache-2.0
"""Messages of makers' own packages for tests: fields that are not given are zero."""

from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype

from graphloc.frontends._vendor_types import VENDOR_TYPES
from tests.bagfactory import Messages

_ROS1_NAMES = {"i_tow": "iTOW"}
_NOVATEL_HEADER = f"""{"=" * 80}
MSG: novatel_msgs/CommonHeader
uint16 id
uint8 msg_type
uint8 port_addr
uint16 length
uint16 sequence
uint8 idle_time
uint8 time_status
uint16 gps_week
uint32 gps_week_seconds
uint32 receiver_status
uint16 reserved
uint16 software_version
"""
_NOVATEL_PLACE = """float64 latitude
float64 longitude
float64 altitude
float32 undulation
"""
_NOVATEL_SIGMAS = """float32 latitude_std
float32 longitude_std
float32 altitude_std
"""
# Of packages of ROS 1 alone, whose bags carry their own.
_ROS1_ALONE = {
    "novatel_msgs/msg/INSPVAX": f"""novatel_msgs/CommonHeader header
uint32 ins_status
uint32 position_type
{_NOVATEL_PLACE}float64 north_velocity
float64 east_velocity
float64 up_velocity
float64 roll
float64 pitch
float64 azimuth
{_NOVATEL_SIGMAS}float32 north_velocity_std
float32 east_velocity_std
float32 up_velocity_std
float32 roll_std
float32 pitch_std
float32 azimuth_std
uint32 extended_status
uint16 seconds_since_update
{_NOVATEL_HEADER}""",
    "novatel_msgs/msg/INSPVA": f"""novatel_msgs/CommonHeader header
int32 week
float64 gpssec
float64 latitude
float64 longitude
float64 altitude
float64 velx
float64 vely
float64 velz
float64 roll
float64 pitch
float64 azimuth
uint32 insstatus
{_NOVATEL_HEADER}""",
    "novatel_msgs/msg/BESTPOS": f"""novatel_msgs/CommonHeader header
uint32 solution_status
uint32 position_type
{_NOVATEL_PLACE}uint32 datum_id
{_NOVATEL_SIGMAS}char[4] stn_id
float32 diff_age
float32 sol_age
uint8[8] satellites
{_NOVATEL_HEADER}""",
    "novatel_msgs/msg/BESTVEL": f"""novatel_msgs/CommonHeader header
uint32 solution_status
uint32 position_type
float32 latency
float32 age
float64 hor_spd
float64 trk_gnd
float64 vert_spd
float32 reserved
{_NOVATEL_HEADER}""",
    "irp_sen_msgs/msg/vrs": """std_msgs/Header header
string GPGGA
float64 longitude
float64 latitude
float64 x_coordinate
float64 y_coordinate
float64 altitude
int8 fix_state
string fix_state_str
float64 horizental_precision
float64 lat_std
float64 lon_std
float64 altitude_std
int8 number_of_sat
""",
}
DEFINITIONS = {**VENDOR_TYPES, **{msgtype: (text,) for msgtype, text in _ROS1_ALONE.items()}}


def ros1_definition(msgtype: str) -> str:
    """Return the newest definition; of u-blox with names as ROS 1 writes them: hAcc for h_acc."""
    text = DEFINITIONS[msgtype][0]
    if not msgtype.startswith("ublox_msgs"):
        return text
    return "".join(f"{' '.join([kind, _camel(name)])}\n" for kind, name in (line.split() for line in text.splitlines()))


def _camel(name: str) -> str:
    first, *rest = name.split("_")
    return _ROS1_NAMES.get(name, first + "".join(word.title() for word in rest))


def said(make: Messages, msgtype: str, version: int = 0, **fields: Any) -> Any:
    """Return a message; nested ones are given as dictionaries, `ublox_msgs` by ROS 2 names in either ROS."""
    if msgtype not in make.t:
        text = ros1_definition(msgtype) if make.ros == 1 else DEFINITIONS[msgtype][version]
        make.register(text, msgtype)
    if make.ros == 1 and msgtype.startswith("ublox_msgs"):
        fields = {_camel(name): value for name, value in fields.items()}
    return _filled(make, msgtype, fields)


def _filled(make: Messages, msgtype: str, given: dict[str, Any]) -> Any:
    values: dict[str, Any] = {}
    kinds: Any
    for name, (node, kinds) in make.store.fielddefs[msgtype][1]:
        value = given.get(name)
        if node == Nodetype.NAME:
            plain = value is None or isinstance(value, dict)
            values[name] = _filled(make, str(kinds), value or {}) if plain else value
        elif node == Nodetype.BASE:
            values[name] = ("" if kinds[0] == "string" else 0) if value is None else value
        else:
            (of, inner), length = kinds
            length = 0 if node == Nodetype.SEQUENCE else length
            if of == Nodetype.NAME:
                values[name] = [_filled(make, str(inner), one) for one in value or [{}] * length]
            else:
                kind = "uint8" if inner[0] == "char" else inner[0]
                values[name] = np.zeros(length, dtype=kind) if value is None else np.array(value, dtype=kind)
    assert set(given) <= set(values), set(given) - set(values)
    return make.t[msgtype](**values)
