# SPDX-License-Identifier: Apache-2.0
"""Messages of makers' own packages for tests: fields that are not given are zero."""

from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype

from graphloc.frontends._vendor_types import VENDOR_TYPES
from tests.bagfactory import Messages

_ROS1_NAMES = {"i_tow": "iTOW"}


def ros1_definition(msgtype: str) -> str:
    """Return the newest definition; of u-blox with names as ROS 1 writes them: hAcc for h_acc."""
    text = VENDOR_TYPES[msgtype][0]
    if not msgtype.startswith("ublox_msgs"):
        return text
    return "".join(f"{' '.join([kind, _camel(name)])}\n" for kind, name in (line.split() for line in text.splitlines()))


def _camel(name: str) -> str:
    first, *rest = name.split("_")
    return _ROS1_NAMES.get(name, first + "".join(word.title() for word in rest))


def said(make: Messages, msgtype: str, version: int = 0, **fields: Any) -> Any:
    """Return a message; nested ones are given as dictionaries, `ublox_msgs` by ROS 2 names in either ROS."""
    if msgtype not in make.t:
        text = ros1_definition(msgtype) if make.ros == 1 else VENDOR_TYPES[msgtype][version]
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
                values[name] = np.zeros(length, dtype=inner[0]) if value is None else np.array(value, dtype=inner[0])
    assert set(given) <= set(values), set(given) - set(values)
    return make.t[msgtype](**values)
