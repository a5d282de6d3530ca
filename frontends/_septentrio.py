# SPDX-License-Identifier: Apache-2.0
"""Messages of Septentrio."""

from __future__ import annotations

from math import degrees
from typing import Any

from graphloc.frontends._rejections import Rejection, rejected
from graphloc.frontends._said import (
    DO_NOT_USE,
    Part,
    SaidHeading,
    SaidPlace,
    SaidVelocity,
    as_filtered,
    heading_as_told,
    place_of,
    sigma_of,
)

_SBF_STATUS = {1: 0, 2: 1, 4: 2, 5: 2, 6: 1, 7: 0, 8: 0, 10: 1}  # of a moving base the place is as good as the base's
_SBF_NONE = {0: "none", 3: "a position that was set, not measured"}
_SBF_MODE, _SBF_2D, _SBF_UNKNOWN = 0x0F, 0x80, 65535
_SBF_FIXED = (2, 4)
_SBF_BASELINE = 3  # bits, in an attitude's error, of the first baseline


def _sbf_trouble(msg: Any) -> Rejection | None:
    return _sbf_without("no fix", int(msg.mode), int(msg.error))


def _sbf_without(what: str, mode: int, error: int) -> Rejection | None:
    mode &= _SBF_MODE
    if error == 0 and mode in _SBF_STATUS:
        return None
    return rejected(f"{what} (error {error}, mode {_SBF_NONE.get(mode, mode)})")


def _sbf_place(msg: Any) -> SaidPlace | Rejection:
    if trouble := _sbf_trouble(msg):
        return trouble
    height = float("nan") if int(msg.mode) & _SBF_2D else float(msg.height)
    # The fields are twice the RMS of the horizontal distance, and two sigmas of the height, in cm.
    horizontal, vertical = (
        0.0 if int(cm) == _SBF_UNKNOWN else 0.005 * float(cm) for cm in (msg.h_accuracy, msg.v_accuracy)
    )
    place = degrees(float(msg.latitude)), degrees(float(msg.longitude)), height
    return place_of(place, _SBF_STATUS[int(msg.mode) & _SBF_MODE], horizontal / 2.0**0.5, vertical)


def _sbf_velocity(msg: Any) -> SaidVelocity | Rejection:
    said = _sbf_trouble(msg) or _sbf_up(msg)
    return said if isinstance(said, Rejection) else SaidVelocity(said)


def _sbf_up(msg: Any) -> tuple[float, float, float] | Rejection:
    """Return a velocity east, north, up, m/s."""
    v = float(msg.ve), float(msg.vn), float(msg.vu)
    return rejected("no velocity") if max(map(abs, v)) > DO_NOT_USE else v


def _sbf_heading(msg: Any) -> SaidHeading | Rejection:
    mode, error = int(msg.mode), int(msg.error) & _SBF_BASELINE
    if mode == 0 or error:
        return rejected(f"no heading (error {error}, mode {mode})")
    if mode not in _SBF_FIXED:
        return rejected("a heading with float ambiguities")
    return heading_as_told(float(msg.heading), 0.0)


def _sbf_ins_trouble(msg: Any) -> Rejection | None:
    return _sbf_without("no GNSS in it", int(msg.gnss_mode), int(msg.error))


def _sbf_ins_place(msg: Any) -> SaidPlace | Rejection:
    if trouble := _sbf_ins_trouble(msg):
        return trouble
    place = degrees(float(msg.latitude)), degrees(float(msg.longitude)), float(msg.height)
    horizontal = max(float(msg.latitude_std_dev), float(msg.longitude_std_dev))
    return as_filtered(
        place_of(place, _SBF_STATUS[int(msg.gnss_mode) & _SBF_MODE], horizontal, float(msg.height_std_dev))
    )


def _sbf_ins_velocity(msg: Any) -> SaidVelocity | Rejection:
    said = _sbf_ins_trouble(msg) or _sbf_up(msg)
    if isinstance(said, Rejection):
        return said
    sigmas = sigma_of(max(float(msg.ve_std_dev), float(msg.vn_std_dev))), sigma_of(float(msg.vu_std_dev))
    return SaidVelocity(said, *sigmas, filtered=True)


def _sbf_ins_heading(msg: Any) -> SaidHeading | Rejection:
    return as_filtered(_sbf_ins_trouble(msg) or heading_as_told(float(msg.heading), float(msg.heading_std_dev)))


SEPTENTRIO: dict[str, tuple[Part, ...]] = {
    "septentrio_gnss_driver/msg/INSNavGeod": (
        Part("gnss", _sbf_ins_place), Part("gnss_velocity", _sbf_ins_velocity),
        Part("compass", _sbf_ins_heading, told=False, antennas=False, usual="enu"),
    ),
    "septentrio_gnss_driver/msg/PVTGeodetic": (Part("gnss", _sbf_place), Part("gnss_velocity", _sbf_velocity)),
    "septentrio_gnss_driver/msg/AttEuler": (Part("compass", _sbf_heading, told=False, usual="enu"),),
}  # fmt: skip
