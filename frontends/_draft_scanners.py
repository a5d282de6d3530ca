# SPDX-License-Identifier: Apache-2.0
"""Blocks of a drafted `vessel.yaml` on LiDARs and cameras."""

from __future__ import annotations

import json
from collections.abc import Iterator

from graphloc.frontends._draft_clock import recorded_lines, scan_clock_lines
from graphloc.frontends._draft_lines import numbered
from graphloc.frontends._reports import Inspection, MountedTopic

_LISTED_EDGE_PX = 0.3  # AprilTag 3 finds corners 0.3 to 0.5 px too far inside, in images with gamma
_MOST_TURNS_HZ = 25.0  # LiDARs turn 5 to 20 times a second; if more clouds come, the driver publishes each packet
_TURN_S = 0.1  # nearly all LiDARs turn ten times a second
_MOST_PARTS = 100  # most clouds of a submap


def scanner_blocks(inspection: Inspection) -> Iterator[list[str]]:
    """Yield drafts of LiDARs, then of cameras, switched off; of topics that are not read, a comment that says why."""
    lidars, cameras = (tuple(m for m in every if not m.left_out) for every in (inspection.lidars, inspection.cameras))
    if lidars:
        block = _aerial_block(lidars, _clouds_hz(inspection, lidars))
        yield [*block, *recorded_lines(inspection, lidars), *scan_clock_lines(inspection, lidars)]
    if cameras:
        yield [*_tags_block(cameras), *recorded_lines(inspection, cameras)]
    for other in (m for m in (*inspection.lidars, *inspection.cameras) if m.left_out):
        yield [f"# {other.topic}: left out; {other.left_out}"]


def _clouds_hz(inspection: Inspection, lidars: tuple[MountedTopic, ...]) -> float:
    """Return how many clouds a second the busiest LiDAR publishes, over the run."""
    span_s = max((t.span_s for t in inspection.topics if t.span_s is not None), default=0.0)
    counts = {t.topic: t.count for t in inspection.topics}
    return max(counts[lidar.topic] for lidar in lidars) / span_s if span_s > 0.0 else 0.0


def _aerial_block(lidars: tuple[MountedTopic, ...], clouds_hz: float) -> list[str]:
    lines = [
        "aerial:",
        "  kind: aerial",
        "  enabled: false  # guess: true once there is a map: `image`, `vector`, or both",
        "  image: ''  # an aerial image of the place: GeoTIFF, MBTiles, or a folder of tiles",
        "  vector: ''  # GeoJSON of quays and piers",
        "  hull_m: []  # guess: corners of the vessel's outline, [forward, port], m: points inside are its own; 'smooth' suggests some",
        "  waterline_m: 0.0  # guess: height of the waterline in the body frame, m",
    ]
    if clouds_hz > _MOST_TURNS_HZ:
        parts = min(round(_TURN_S * clouds_hz), _MOST_PARTS)
        lines.append(f"  submap: {parts}  # guess: {clouds_hz:.0f} clouds a second are parts of turns")
    lines.append("  lidars:")
    for k, lidar in enumerate(lidars):
        lines.append(f"    {numbered('lidar', k)}:")
        lines.append(f"      topic: {lidar.topic}")
        if lidar.tf_frame is not None:
            lines.append(f"      mount: {{tf_frame: {json.dumps(lidar.tf_frame)}}}  # from tf")
        else:
            lines.append(
                f"      mount: {{xyz_m: [0.0, 0.0, 0.0]}}  # guess: where '{lidar.frame_id}' sits is not in the bag; measure it"
            )
    return lines


def _tags_block(cameras: tuple[MountedTopic, ...]) -> list[str]:
    lines = [
        "tags:",
        "  kind: apriltag",
        "  enabled: false  # guess: true once there is a survey of the tags",
        "  survey: tags.yaml  # positions and sizes of the tags: docs/tags.md",
    ]
    if any(camera.listed for camera in cameras):
        lines.append(f"  edge_sigma_px: {_LISTED_EDGE_PX}  # guess: an external detector, on images with gamma")
    lines.append("  cameras:")
    for k, camera in enumerate(cameras):
        lines.append(f"    {numbered('camera', k)}:")
        lines.append(f"      topic: {camera.topic}")
        if camera.info_topic:
            why = f"  # guess: {camera.info_why}, as none lies beside it" if camera.info_why else ""
            lines.append(f"      info_topic: {camera.info_topic}{why}")
        else:
            lines.append("      info_topic: ''  # guess: there is no CameraInfo beside it; name its topic")
        if camera.optical is not None:
            xyz, rpy = (
                ", ".join(f"{round(x, n) + 0.0:.{n}f}" for x in v) for v, n in zip(camera.optical, (3, 1), strict=True)
            )
            lines.append(
                f"      mount: {{xyz_m: [{xyz}], rpy_deg: [{rpy}]}}  # guess: by tf '{camera.tf_frame}' would look at the sky: taken "
                "for one with x ahead, z up; this is its optical frame"
            )
        elif camera.tf_frame is not None:
            lines.append(
                f"      mount: {{tf_frame: {json.dumps(camera.tf_frame)}}}  # from tf; it must be the optical frame"
            )
        else:
            lines.append(
                f"      mount: {{xyz_m: [0.0, 0.0, 0.0], rpy_deg: [-90.0, 0.0, -90.0]}}  # guess: '{camera.frame_id}' looks "
                "ahead; where it sits is not in the bag; measure it"
            )
    return lines
