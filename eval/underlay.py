# SPDX-License-Identifier: Apache-2.0
"""Aerial image under the map of a report: the part around a run, at a resolution that suits a page."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from graphloc.config import VesselConfig
from graphloc.errors import InputError
from graphloc.eval.plots import Underlay
from graphloc.frames import Array, Datum
from graphloc.frontends.aerial.image import AerialImage

_SIDE_PX = 1200  # about 400 kB
_AROUND = 0.12  # margin around the track, as a share of its size; to which `_AROUND_M` is added
_AROUND_M = 15.0
_WIDER, _LONGEST = 1.2, 1.8  # least and largest width over height of the picture, so that a screen shows it large
_FINEST_M = 0.1
_LARGEST_M = 20_000.0  # half the size of the map from which no image is drawn: nothing beside the track could be seen
_QUALITY = 72


def underlay(config: VesselConfig, folder: Path, datum: Datum, p_world_m: Array) -> tuple[Underlay | None, str]:
    """Return the image around a track, or None and the reason; the reason is empty if no image is configured.

    Args:
        config: its `output.map_image` is used, or the image of its first aerial sensor.
        folder: base of relative paths.
        p_world_m: (N, 2 or 3) positions to show.
    """
    images = [config.output.map_image, *(sensor.image for sensor in config.of_kind("aerial").values())]
    name = next((image for image in images if image), "")
    if not name or not len(p_world_m):
        return None, ""
    low, high = p_world_m[:, :2].min(axis=0), p_world_m[:, :2].max(axis=0)
    around = _AROUND_M + _AROUND * float((high - low).max())
    size = high - low + 2.0 * around
    size = np.maximum(size, size[::-1] * np.array([_WIDER, 1.0 / _LONGEST]))
    low, high = 0.5 * (low + high - size), 0.5 * (low + high + size)
    half_m = 0.5 * float((high - low).max())
    if half_m > _LARGEST_M:
        return None, f"{name}: not under the map of the report, which is {2e-3 * half_m:.0f} km wide"
    cell_m = max(2.0 * half_m / _SIDE_PX, _FINEST_M)
    try:
        patch = AerialImage(folder / name, datum).patch(0.5 * (low + high), half_m, cell_m)
    except InputError as error:
        return None, f"no image under the map of the report: {error}"
    corners = patch.cells(np.array([[low[0], high[1]], [high[0], low[1]]]))
    (left, top), (right, bottom) = np.clip(np.rint(corners + 0.5).astype(int), 0, patch.inside.shape[0])
    window = (slice(top, bottom), slice(left, right))
    shown = np.where(patch.inside[..., None], patch.pixels, 255)[window]
    coded = cv2.imencode(".jpg", np.ascontiguousarray(shown[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1]
    west, north = patch.west_m - 0.5 * cell_m, patch.north_m + 0.5 * cell_m  # outer edge of the patch
    return Underlay(
        jpeg=coded.tobytes(), west_m=west + left * cell_m, east_m=west + right * cell_m,
        north_m=north - top * cell_m, south_m=north - bottom * cell_m,
    ), ""  # fmt: skip
