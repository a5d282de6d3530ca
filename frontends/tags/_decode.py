# SPDX-License-Identifier: Apache-2.0
"""Bits of a tag, and their look-up in the codebook."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from graphloc.errors import ConfigError
from graphloc.frontends import _compiled

FAMILIES = {
    "16h5": cv2.aruco.DICT_APRILTAG_16h5,
    "25h9": cv2.aruco.DICT_APRILTAG_25h9,
    "36h10": cv2.aruco.DICT_APRILTAG_36h10,
    "36h11": cv2.aruco.DICT_APRILTAG_36h11,
}
Cells = NDArray[np.uint8]
# Without the GIL, so that threads run side by side. With numpy's error model, as degenerate quadrilaterals divide by 0:
# the results are NaN, and fail all comparisons.
compiled = _compiled.compiled(nogil=True, error_model="numpy")
_SHARPEN = 0.25  # share of a cell's excess over each of its neighbours that is added to the cell, as in AprilTag 3
_SPREAD = 0.25  # spacing, in cells, of the nine points at which a cell's level is taken


@dataclass(frozen=True, slots=True, eq=False)
class Codebook:
    """The tags of a family.

    Attributes:
        family: its name. side: number of cells along a side, black border included. numbers: (T,) ids.
        cells: (T, side, side), first row on top, as in AprilTag's own images; 1 is white.
        codes: (T, 4) bits of the data cells, row by row, of a tag turned by 0, 1, 2, 3 quarters anticlockwise.
    """

    family: str
    side: int
    numbers: NDArray[np.int64]
    cells: Cells
    codes: NDArray[np.uint64]


def codebook(family: str, numbers: Collection[int] | None) -> Codebook:
    """Return the tags of a family with some numbers; None: all.

    Raises:
        ConfigError: the family is unknown, or has no such number.
    """
    if family not in FAMILIES:
        raise ConfigError(f"tag family {family!r} is not known: use one of {', '.join(FAMILIES)}")
    dictionary = cv2.aruco.getPredefinedDictionary(FAMILIES[family])
    side, known = dictionary.markerSize + 2, len(dictionary.bytesList)
    chosen = sorted(range(known) if numbers is None else set(numbers))
    strange = [number for number in chosen if not 0 <= number < known]
    if strange:
        raise ConfigError(f"tag family {family} has numbers 0 to {known - 1}, not {strange[0]}")
    # OpenCV draws these families upside down.
    drawn = [np.rot90(cv2.aruco.generateImageMarker(dictionary, number, side), 2) > 127 for number in chosen]
    cells = np.array(drawn, dtype=np.uint8).reshape(len(chosen), side, side)
    data = cells[:, 1:-1, 1:-1]
    bits = np.stack([np.rot90(data, k, axes=(1, 2)).reshape(len(data), data.shape[1] ** 2) for k in range(4)], axis=1)
    weight = np.uint64(1) << np.arange(bits.shape[2] - 1, -1, -1, dtype=np.uint64)
    codes = (bits.astype(np.uint64) * weight).sum(axis=2, dtype=np.uint64)
    return Codebook(family, side, np.array(chosen, dtype=np.int64), cells, codes)


@compiled
def homography(corners, side):  # type: ignore[no-untyped-def]
    """Return the homography (3, 3) from cells to px.

    Args:
        corners: (4, 2), px, clockwise. side: of the tag, in cells: x right, y down from the first corner, in [0, side].
    """
    au, av, bu, bv = corners[0, 0], corners[0, 1], corners[1, 0], corners[1, 1]
    cu, cv, du, dv = corners[2, 0], corners[2, 1], corners[3, 0], corners[3, 1]
    su, sv = au - bu + cu - du, av - bv + cv - dv
    det = (bu - cu) * (dv - cv) - (du - cu) * (bv - cv)
    g, h = (su * (dv - cv) - (du - cu) * sv) / det, ((bu - cu) * sv - su * (bv - cv)) / det
    H = np.empty((3, 3))
    H[0, 0], H[0, 1], H[0, 2] = (bu - au + g * bu) / side, (du - au + h * du) / side, au
    H[1, 0], H[1, 1], H[1, 2] = (bv - av + g * bv) / side, (dv - av + h * dv) / side, av
    H[2, 0], H[2, 1], H[2, 2] = g / side, h / side, 1.0
    return H


@compiled
def mapped(H, x, y):  # type: ignore[no-untyped-def]
    """Return the image of (x, y) under a homography (3, 3), and 1 / its denominator."""
    z = 1.0 / (H[2, 0] * x + H[2, 1] * y + H[2, 2])
    return (H[0, 0] * x + H[0, 1] * y + H[0, 2]) * z, (H[1, 0] * x + H[1, 1] * y + H[1, 2]) * z, z


@compiled
def bilinear(grey, u, v):  # type: ignore[no-untyped-def]
    """Return the interpolated grey level at a point; -1 outside the image."""
    j, i = int(np.floor(u)), int(np.floor(v))
    if not (0 <= j < grey.shape[1] - 1 and 0 <= i < grey.shape[0] - 1):
        return -1.0
    a, b = u - j, v - i
    top = (1.0 - a) * grey[i, j] + a * grey[i, j + 1]
    return (1.0 - b) * top + b * ((1.0 - a) * grey[i + 1, j] + a * grey[i + 1, j + 1])


@compiled
def spots(corners, side):  # type: ignore[no-untyped-def]
    """Return nine points in each cell of a quadrilateral (4, 2), px, and of the ring of cells around it, row by row.

    They are (9 (side + 2)^2, 2), px.
    """
    H = homography(corners, side)
    found = np.empty((9 * (side + 2) ** 2, 2))
    n = 0
    for r in range(-1, side + 1):
        for c in range(-1, side + 1):
            for k in range(9):
                x, y = c + 0.5 + _SPREAD * (k % 3 - 1), r + 0.5 + _SPREAD * (k // 3 - 1)
                found[n, 0], found[n, 1], _ = mapped(H, x, y)
                n += 1
    return found


@compiled
def _cell(grey, px, first):  # type: ignore[no-untyped-def]
    """Return the mean level of nine points from index `first` on; -1 if not all are in the image."""
    total = 0.0
    for k in range(first, first + 9):
        level = bilinear(grey, px[k, 0], px[k, 1])
        if not level >= 0.0:
            return -1.0
        total += level
    return total / 9.0


@compiled
def _over(grey, px, side, values):  # type: ignore[no-untyped-def]
    """Write into values (side, side) each cell's level above the local mean of black and white.

    Black is a plane through the levels of the border cells, white a plane through those of the ring around it. Both
    sets of cells are symmetric, so three sums give a plane. If the image cuts off cells of the ring, white has the
    slope of black; if no cell of the ring is left, the brightest cell is white.

    Returns:
        Whether the whole tag is visible, and white is brighter than black.
    """
    half = 0.5 * side
    sums, squares, counts = np.zeros((2, 3)), np.zeros(2), np.zeros(2)
    brightest, cut = 0.0, False
    for r in range(-1, side + 1):
        for c in range(-1, side + 1):
            x, y = c + 0.5, r + 0.5
            level = _cell(grey, px, 9 * ((r + 1) * (side + 2) + c + 1))
            rim = min(r, c, side - 1 - r, side - 1 - c)
            if level < 0.0:
                if rim >= 0:
                    return False
                cut = True
                continue
            if rim >= 0:
                values[r, c] = level
                brightest = max(brightest, level)
            if rim <= 0:
                sums[-rim, 0] += level
                sums[-rim, 1] += level * (x - half)
                sums[-rim, 2] += level * (y - half)
                squares[-rim] += (x - half) ** 2
                counts[-rim] += 1.0
    black, white = sums[0, 0] / counts[0], brightest
    if counts[1] > 0.0:
        white = sums[1, 0] / counts[1]
    slope_x, slope_y = sums[0, 1] / squares[0], sums[0, 2] / squares[0]
    if not cut:
        slope_x, slope_y = 0.5 * (slope_x + sums[1, 1] / squares[1]), 0.5 * (slope_y + sums[1, 2] / squares[1])
    for r in range(side):
        for c in range(side):
            values[r, c] -= 0.5 * (black + white) + slope_x * (c + 0.5 - half) + slope_y * (r + 0.5 - half)
    return white > black


@compiled
def _bits_off(a, b):  # type: ignore[no-untyped-def]
    """Return the number of different bits, by sums over 2, 4, 8 neighbours, then over all bytes."""
    x = a ^ b
    x = x - ((x >> np.uint64(1)) & np.uint64(0x5555555555555555))
    x = (x & np.uint64(0x3333333333333333)) + ((x >> np.uint64(2)) & np.uint64(0x3333333333333333))
    x = (x + (x >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return np.int64((x * np.uint64(0x0101010101010101)) >> np.uint64(56))


@compiled
def read(grey, px, side, codes):  # type: ignore[no-untyped-def]
    """Return the tag nearest to the bits in a quadrilateral.

    Args:
        grey: image. px: `spots` of the quadrilateral. side: in cells. codes: (T, 4) of the codebook.

    Returns:
        Index of the tag, or -1; its quarter turns anticlockwise; number of different bits; decision margin, grey levels
        (as in AprilTag 3: mean distance of the white or the black data cells to the threshold, whichever is smaller).
    """
    values = np.empty((side, side))
    if not _over(grey, px, side, values):
        return -1, 0, 99, 0.0
    code = np.uint64(0)
    sums = np.zeros(2)
    counts = np.full(2, 1e-9)
    for r in range(1, side - 1):
        for c in range(1, side - 1):
            around = values[r - 1, c] + values[r + 1, c] + values[r, c - 1] + values[r, c + 1]
            value = values[r, c] + _SHARPEN * (4.0 * values[r, c] - around)
            bit = 1 if value > 0.0 else 0
            code = (code << np.uint64(1)) | np.uint64(bit)
            sums[bit] += abs(values[r, c])
            counts[bit] += 1.0
    best, index, turned = 99, -1, 0
    for t in range(len(codes)):
        for k in range(4):
            off = _bits_off(code, codes[t, k])
            if off < best:
                best, index, turned = off, t, k
    return index, turned, best, min(sums[0] / counts[0], sums[1] / counts[1])
