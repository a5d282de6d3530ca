# SPDX-License-Identifier: Apache-2.0
"""Blocks of a drafted `vessel.yaml` on receivers: which one is used, its antenna, and the size of its errors."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

from graphloc.chi2 import chi2_95
from graphloc.config import GnssConfig, OutputConfig, SlowErrorConfig
from graphloc.frontends._assess_wander import slow_error_by
from graphloc.frontends._draft_lines import FILTERED, antenna_lines, filtered_lines, numbered, topic_lines
from graphloc.frontends._fixes import NOTHING_M, RTK_SIGMA_M, SCATTERS
from graphloc.frontends._reports import GnssReport, Inspection, OdometryReport, PartOfFixes, filtered

_RTK_SLOW_ERROR = "horizontal_sigma_m: 0.03, vertical_sigma_m: 0.06"  # on: without it a wrong fix draws the track along
# Correlation time of the error of a float or single fix. After RTK is lost, the growth of this error is the bound.
_FLOAT_S = 60.0
_INS = "it tells its speed, as an INS or a filter does: it has used the IMU already, and its errors are correlated, so it gets too much weight"
_HEIGHT_WANDERS_M = 10.0  # more than a vessel's heave and tide within a run


def receiver_blocks(inspection: Inspection) -> Iterator[list[str]]:
    """Yield drafts of the receivers, the first one enabled; without receivers, of positions in a map grid."""
    for k, gnss in enumerate(inspection.gnss):
        yield _gnss_block(numbered("gnss", k), gnss, enabled=k == 0)
        if gnss.by_turns:
            yield _other_block(numbered("gnss", k), gnss, gnss.by_turns[1], enabled=k == 0)
    for k, item in enumerate(inspection.in_a_grid):
        yield _grid_block(numbered("gnss", k), item, enabled=k == 0)


def _gnss_block(name: str, gnss: GnssReport, *, enabled: bool) -> list[str]:
    lines = [f"{name}:", "  kind: gnss", *topic_lines(gnss.topic)]
    if gnss.by_turns:
        share = 100.0 * gnss.by_turns[0].share
        lines.append(f"  fixes: rtk  # guess: {share:.0f} % of the fixes; the rest is {name}_other's")
    if not enabled:
        why = gnss.elsewhere or (
            FILTERED
            if filtered(gnss.topic)
            else "one receiver is used: RTK throughout, else the most accurate by its claims and the drift of its height, of equal ones that with heights, then with most fixes"
        )
        lines.append(f"  enabled: false  # guess: {why}")
    else:
        lines += filtered_lines(gnss.topic)
    lines += antenna_lines(gnss.tf_frame, "from tf", gnss.keeps_m)
    lines += _scatter_lines(_of_part(gnss, gnss.by_turns[0]) if gnss.by_turns else gnss)
    lines += _rtk_lines(gnss)
    lines += _uneven_lines(gnss)
    wanders = gnss.height_range_m > _HEIGHT_WANDERS_M and gnss.slow_error and not gnss.by_turns
    if wanders:
        lines.append(_wandering(gnss))
    if gnss.by_turns or not gnss.slow_error:
        why = f"status gbas (RTK) and less than {RTK_SIGMA_M:g} m" if gnss.by_turns else gnss.why
        lines.append(f"  slow_error: {{{_RTK_SLOW_ERROR}}}  # guess: {why}")
    else:
        # Left to the default: on, if a second sensor of position or velocity can tell the error from motion.
        slow_m, large, said = _slow_error(gnss)
        vertical = max(SlowErrorConfig().vertical_sigma_m, gnss.height_range_m / 3.3)
        more = ", ".join([*([f"vertical_sigma_m: {vertical:.1f}"] if wanders else []), *large])
        fixed = f"; {{{_RTK_SLOW_ERROR}}} where RTK is fixed throughout" if gnss.rtk_sigma_m else ""
        if gnss.reported_sigma_m and max(gnss.reported_sigma_m[:2]) < RTK_SIGMA_M:
            fixed = f"; {{{_RTK_SLOW_ERROR}}} if RTK makes them as good as they claim, which their status does not say"
        lines.append(f"  slow_error: {{{more}}}  # guess: {gnss.why}{said}{fixed}")
        lines += _never_good(slow_m) if enabled else []
    return lines


def _never_good(slow_m: float) -> list[str]:
    """Return a comment if no pose is called good with this receiver alone, as its slow error is large.

    Args:
        slow_m: the slow error, 1 sigma of an axis.
    """
    within_m, good_m = math.sqrt(chi2_95(2)) * slow_m, OutputConfig().good_bound_m
    if within_m <= good_m:
        return []
    return [
        f"  # by that error alone 95 % of all poses are within {within_m:.1f} m, and above output.good_bound_m ({good_m:g} m) they are 'degraded': raise it, or add a sensor of position"
    ]


def _other_block(name: str, gnss: GnssReport, others: PartOfFixes, *, enabled: bool) -> list[str]:
    """Return a draft of a receiver's fixes without RTK: a second sensor, with a slow error that RTK does not have."""
    own, slow_m = _of_part(gnss, others), others.slow_m
    if slow_m >= SlowErrorConfig().horizontal_sigma_m:
        slow_m = max(slow_m, _as_large(own)[0])
    wanders = gnss.height_range_m > _HEIGHT_WANDERS_M
    vertical_m = max(2.0 * slow_m, gnss.height_range_m / 3.3 if wanders else 0.0)
    keys = f"horizontal_sigma_m: {slow_m:.2g}, vertical_sigma_m: {vertical_m:.2g}, time_constant_s: {_FLOAT_S:g}"
    return [
        f"{name}_other:",
        "  kind: gnss",
        "  fixes: other  # those without RTK: a sensor of its own, whose error is slow",
        *topic_lines(gnss.topic),
        *([] if enabled else [f"  enabled: false  # guess: as {name}"]),
        *antenna_lines(gnss.tf_frame, "from tf", gnss.keeps_m),
        *_scatter_lines(own),
        *([_wandering(gnss)] if wanders else []),
        f"  slow_error: {{{keys}}}  # guess: as large as float fixes claim, metres for other fixes; it changes from minute to minute",
    ]


def _grid_block(name: str, item: OdometryReport, *, enabled: bool) -> list[str]:
    lines = [f"{name}:", "  kind: gnss", f"  topic: {item.topic}"]
    lines += [] if enabled else ["  enabled: false  # guess: one receiver is used"]
    lines += [f"  # guess: {_INS}"] if item.role == "check_speed" else []
    zone = "EPSG:32632 for UTM zone 32 north, EPSG:32732 for zone 32 south"
    return [
        *lines,
        f"  grid: ''  # set it, the zone is not in the bag: {zone}; {item.world}",
        "  mount: {xyz_m: [0.0, 0.0, 0.0]}  # guess: of base_link, if /tf_static was applied; else of the antenna",
        "  slow_error: {}  # guess: where RTK is fixed throughout, {" + _RTK_SLOW_ERROR + "}",
    ]


def _of_part(gnss: GnssReport, part: PartOfFixes) -> GnssReport:
    """Return the report with the claimed sigma and the scatter of a part of the fixes."""
    scatter = None if part.white_m is None else (part.white_m, part.white_m, part.white_m)
    return replace(gnss, reported_sigma_m=part.sigma_m, white_m=part.white_m, scatter_m=scatter)


def _wandering(gnss: GnssReport) -> str:
    return f"  min_vertical_sigma_m: 5.0  # guess: height ranges over {gnss.height_range_m:.0f} m"


def _slow_error(gnss: GnssReport) -> tuple[float, list[str], str]:
    """Return the horizontal slow error (m), its keys that differ from the default, and why.

    It is as large and changes as fast as wheels or a velocity show. Otherwise they contradict the fixes, and the
    heading gives way.
    """
    default_m = SlowErrorConfig().horizontal_sigma_m
    sigma_m, why = _as_large(gnss)
    found = slow_error_by(gnss.wander, sigma_m)
    if found is None:
        return sigma_m, ([f"horizontal_sigma_m: {sigma_m:.1f}"] if sigma_m > default_m else []), why
    seen = ", ".join(f"{change.m:.1f} m in {change.span_s:.0f} s" for change in gnss.wander)
    keys = [f"horizontal_sigma_m: {found[0]:.1f}", f"time_constant_s: {found[1]:.0f}"]
    return found[0], keys, f"; by {gnss.wander_by} it changes by {seen}{why}"


def _as_large(gnss: GnssReport) -> tuple[float, str]:
    """Return the sigma of a slow error, m, at least the default, and why, if it is larger.

    It is told by another receiver, or by what the fixes claim if their scatter is far less.
    """
    claimed_m = max(gnss.reported_sigma_m[:2]) if gnss.reported_sigma_m else 0.0
    white_m = max(gnss.scatter_m[:2]) if gnss.scatter_m else claimed_m
    slow_m = claimed_m if SCATTERS * white_m < claimed_m <= NOTHING_M else 0.0
    if gnss.differs and gnss.apart_m >= slow_m:
        return gnss.apart_m, f"; so far it and {gnss.apart_from} wander against each other"
    if slow_m <= SlowErrorConfig().horizontal_sigma_m:
        return SlowErrorConfig().horizontal_sigma_m, ""
    said = f"; scatter from fix to fix is {white_m:.1f} m, so most of the error that they claim is slow"
    return slow_m, said


def _scatter_lines(gnss: GnssReport) -> list[str]:
    """Return keys on the noise of the fixes, if they scatter by far more than they claim, or claim a placeholder."""
    default = GnssConfig()
    claimed = max(gnss.reported_sigma_m[:2]) if gnss.reported_sigma_m else default.default_horizontal_sigma_m
    if claimed > NOTHING_M:
        taken = max(default.default_horizontal_sigma_m, max(gnss.scatter_m[:2]) if gnss.scatter_m else 0.0)
        said = f"guess: fixes claim {claimed:.0f} m, which looks like a placeholder: taken as good to {taken:.1f} m"
        return [f"  sigma_scale: {taken / claimed:.2g}  # {said}"]
    if gnss.white_m is None or gnss.white_m <= SCATTERS * claimed:
        return []
    scatter, times = f"guess: fixes scatter by {gnss.white_m:.2f} m from one to the next", gnss.white_m / claimed
    if gnss.reported_sigma_m:
        return [f"  sigma_scale: {times:.1f}  # {scatter}, and claim {claimed:.2f} m"]
    vertical = f"  default_vertical_sigma_m: {times * default.default_vertical_sigma_m:.1f}  # guess: as many times"
    return [f"  default_horizontal_sigma_m: {gnss.white_m:.1f}  # {scatter}, and claim nothing", vertical]


def _rtk_lines(gnss: GnssReport) -> list[str]:
    """Return keys on the noise of RTK that reports no covariance: it would count as good to metres."""
    if gnss.rtk_sigma_m is None or gnss.scatter_m is None:
        return []
    horizontal, vertical = gnss.rtk_sigma_m
    said = f"guess: status gbas (RTK, or DGPS), and consecutive fixes scatter by {max(gnss.scatter_m[:2]):.3f} m"
    return [
        f"  default_horizontal_sigma_m: {horizontal:.2f}  # {said}",
        f"  default_vertical_sigma_m: {vertical:.2f}  # guess: likewise, {gnss.scatter_m[2]:.3f} m",
    ]


def _uneven_lines(gnss: GnssReport) -> list[str]:
    """Return the least sigma by uneven stamps, if their error along the way is larger than is assumed of the fixes."""
    default = GnssConfig()
    taken_m = gnss.rtk_sigma_m[0] if gnss.rtk_sigma_m else default.default_horizontal_sigma_m
    if gnss.reported_sigma_m:
        taken_m = max(*gnss.reported_sigma_m[:2], default.min_horizontal_sigma_m)
    if gnss.uneven is None or gnss.uneven.along_m <= taken_m:
        return []
    return [f"  min_horizontal_sigma_m: {gnss.uneven.along_m:.2g}  # guess: {gnss.uneven.said}"]
