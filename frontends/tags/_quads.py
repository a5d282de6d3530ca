# SPDX-License-Identifier: Apache-2.0
"""Candidates for tags: dark quadrilaterals on a brighter background."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from graphloc.frames import Array
from graphloc.frontends.tags._decode import bilinear, compiled

_TONE = np.rint(255.0 * (np.arange(256) / 255.0) ** 1.6).astype(np.uint8)  # half way from encoded to linear light
_WINDOW_PX = 11  # window of the local darkest and brightest level
# A window with a smaller range of levels is uniform: the median range in the image, limited to these.
_LEAST_CONTRAST, _MOST_NOISE = 4, 40
_FULL = 0.75  # least share of a component's hull that its largest quadrilateral fills
_LEAST_SLOPE = 1.5  # least mean slope across each side, grey levels per pixel
_MOST_UNEQUAL = 0.15  # least ratio of a side's contrast to that of the strongest side
_OFF_PX, _STRAIGHT = 1.0, 0.5  # a side is straight if at least this share of its edge points is so near to a line


def quads_in(grey: NDArray[np.uint8], min_side_px: float, cells: int) -> Array:
    """Return dark quadrilaterals (Q, 4, 2), px, aligned with their edges; clockwise as seen in the image.

    Args:
        grey: image. min_side_px: shorter sides are not sought. cells: largest number of cells along a side of a tag.
    """
    toned = cv2.LUT(grey, _TONE)
    box = np.ones((_WINDOW_PX, _WINDOW_PX), dtype=np.uint8)
    low, high = cv2.erode(toned, box), cv2.dilate(toned, box)
    noise = float(np.median(cv2.subtract(high[::8, ::8], low[::8, ::8])))
    contrast = int(np.clip(noise, _LEAST_CONTRAST, _MOST_NOISE))
    # Not compiled as one function: a compiled function contains, and optimises again, all that it calls.
    found = _hulls(*_runs(toned, low, high, contrast), 0.7 * min_side_px)
    return np.asarray(found[_aligned(grey, found, cells)])


@compiled
def _aligned(grey, found, cells):  # type: ignore[no-untyped-def]
    """Align quadrilaterals (n, 4, 2) with their edges, in place; return (n,) whether each has four edges."""
    has = np.zeros(len(found), dtype=np.bool_)
    for k in range(len(found)):
        has[k] = _has_sides(grey, found[k]) and _straighten(grey, found[k], cells)
    return has


@compiled
def _runs(toned, low, high, contrast):  # type: ignore[no-untyped-def]
    """Return runs of dark pixels along rows, and their connected components.

    There is no branch per pixel: at some 10^6 ends of runs, mispredicted branches would take most of the time.

    Returns:
        First column and the one after the last (n, 2); row (n,); parent (n,), another run of the component.
    """
    rows, columns = toned.shape
    ends = np.empty(2 * rows * (columns // 2 + 1), dtype=np.int32)
    row, parent = np.empty(len(ends) // 2, dtype=np.int32), np.empty(len(ends) // 2, dtype=np.int32)
    n = above = here = 0  # indices of the runs of the row above are [above, here)
    for v in range(rows):
        inside, m = 0, 2 * n
        for u in range(columns):
            top, bottom = np.int32(high[v, u]), np.int32(low[v, u])
            dark = int(top - bottom > contrast) & int(2 * np.int32(toned[v, u]) <= top + bottom)
            ends[m] = u
            m += inside ^ dark
            inside = dark
        if inside:
            ends[m] = columns
            m += 1
        above, here, n = here, n, m // 2
        j = above
        for i in range(here, n):
            row[i], parent[i] = v, i
            while j < here and ends[2 * j + 1] <= ends[2 * i]:
                j += 1
            k = j
            while k < here and ends[2 * k] < ends[2 * i + 1]:
                a, b = _root(parent, i), _root(parent, k)
                parent[max(a, b)] = min(a, b)
                k += 1
    return ends[: 2 * n].reshape(-1, 2), row[:n], parent[:n]


@compiled
def _root(parent, k):  # type: ignore[no-untyped-def]
    while parent[k] != k:
        parent[k] = parent[parent[k]]
        k = parent[k]
    return k


@compiled
def _hulls(ends, row, parent, least):  # type: ignore[no-untyped-def]
    """Return the largest quadrilaterals (n, 4, 2) in the convex hulls of the components that may be tags."""
    n = len(row)
    left, right, bottom, area = ends[:, 0].copy(), ends[:, 1].copy(), row.copy(), np.zeros(n, dtype=np.int64)
    for i in range(n):
        k = _root(parent, i)
        parent[i] = k
        left[k], right[k], bottom[k] = min(left[k], ends[i, 0]), max(right[k], ends[i, 1]), row[i]
        area[k] += ends[i, 1] - ends[i, 0]
    # Index, in `begin` and `end`, of a component's first row, which is the row of its first run.
    place = np.full(n, -1, dtype=np.int64)
    total = count = 0
    for k in range(n):
        width, height = right[k] - left[k], bottom[k] - row[k] + 1
        if parent[k] == k and min(width, height) >= least and area[k] >= 2 * max(width, height):
            place[k] = total
            total += height
            count += 1
    begin, end = np.full(total, 1 << 30, dtype=np.int32), np.full(total, -1, dtype=np.int32)
    for i in range(n):
        k = parent[i]
        if place[k] >= 0:
            at = place[k] + row[i] - row[k]
            begin[at], end[at] = min(begin[at], ends[i, 0]), max(end[at], ends[i, 1] - 1)
    found = np.empty((count, 4, 2))
    count = 0
    for k in range(n):
        if place[k] >= 0:
            at, height = place[k], bottom[k] - row[k] + 1
            hull = _hull(begin[at : at + height], end[at : at + height], row[k])
            if _largest(hull, found[count], area[k], least):
                count += 1
    return found[:count]


@compiled
def _hull(begin, end, top):  # type: ignore[no-untyped-def]
    """Return the convex hull (n, 2), clockwise in the image, of pixel rows from `top` on, each from begin to end."""
    height = len(begin)
    hull = np.empty((2 * height, 2))
    n = low = np.int64(0)  # a literal 0 has its own type, for which `_append` would be compiled again
    for v in range(height):  # down the right side
        n = _append(hull, low, n, end[v], top + v)
    low = n
    for v in range(height - 1, -1, -1):  # up the left one
        n = _append(hull, low, n, begin[v], top + v)
    return hull[:n]


@compiled
def _append(hull, low, n, u, v):  # type: ignore[no-untyped-def]
    """Append a point to a hull, after removing points since `low` that it makes concave; return the new length."""
    while n > low + 1 and (hull[n - 1, 0] - hull[n - 2, 0]) * (v - hull[n - 2, 1]) <= (
        hull[n - 1, 1] - hull[n - 2, 1]
    ) * (u - hull[n - 2, 0]):
        n -= 1
    hull[n, 0], hull[n, 1] = u, v
    return n + 1


@compiled
def _farthest(hull, i, j):  # type: ignore[no-untyped-def]
    """Return the vertex of a clockwise hull that is farthest outside the line from vertex i to vertex j."""
    best, at = -1.0, i
    du, dv = hull[j, 0] - hull[i, 0], hull[j, 1] - hull[i, 1]
    for k in range(len(hull)):
        d = (hull[k, 0] - hull[i, 0]) * dv - (hull[k, 1] - hull[i, 1]) * du
        if d > best:
            best, at = d, k
    return at


@compiled
def _largest(hull, quad, dark, least):  # type: ignore[no-untyped-def]
    """Write a hull's largest quadrilateral, found by moving one corner at a time; return whether it may be a tag."""
    c = np.zeros(4, dtype=np.int64)  # start: the first vertex, the one farthest from it, the farthest to either side
    far = 0.0
    for k in range(len(hull)):
        away = np.hypot(hull[k, 0] - hull[0, 0], hull[k, 1] - hull[0, 1])
        if away > far:
            far, c[2] = away, k
    c[1], c[3] = _farthest(hull, c[0], c[2]), _farthest(hull, c[2], c[0])
    for _ in range(6):
        moved = False
        for m in range(4):
            at = _farthest(hull, c[m - 1], c[(m + 1) % 4])
            moved |= at != c[m]
            c[m] = at
        if not moved:
            break
    for m in range(4):
        quad[m, 0], quad[m, 1] = hull[c[m], 0], hull[c[m], 1]
    inside = _area(quad)
    return _shortest(quad) >= 0.7 * least and inside >= max(least**2, _FULL * _area(hull)) and dark < 1.3 * inside


@compiled
def _area(p):  # type: ignore[no-untyped-def]
    """Return the area of a polygon (n, 2), positive if clockwise in the image."""
    total = 0.0
    for k in range(len(p)):
        total += p[k - 1, 0] * p[k, 1] - p[k, 0] * p[k - 1, 1]
    return 0.5 * total


@compiled
def _shortest(quad):  # type: ignore[no-untyped-def]
    """Return the length of the shortest side of a quadrilateral (4, 2)."""
    shortest = 1e9
    for k in range(4):
        shortest = min(shortest, np.hypot(quad[k, 0] - quad[k - 1, 0], quad[k, 1] - quad[k - 1, 1]))
    return shortest


@compiled
def _has_sides(grey, quad):  # type: ignore[no-untyped-def]
    """Return whether it is brighter outside each side of a quadrilateral (4, 2), by similar amounts."""
    least, most = 1e9, -1e9
    for k in range(4):
        du, dv = quad[(k + 1) % 4, 0] - quad[k, 0], quad[(k + 1) % 4, 1] - quad[k, 1]
        long = np.hypot(du, dv)
        out_u, out_v = dv / long, -du / long
        contrast = 0.0
        for i in range(6):
            u, v = quad[k, 0] + (i + 1) / 7.0 * du, quad[k, 1] + (i + 1) / 7.0 * dv
            contrast += bilinear(grey, u + 1.5 * out_u, v + 1.5 * out_v) - bilinear(grey, u - out_u, v - out_v)
        least, most = min(least, contrast), max(most, contrast)
    return least > max(6.0 * _LEAST_SLOPE, _MOST_UNEQUAL * most)


@compiled
def _straighten(grey, quad, cells):  # type: ignore[no-untyped-def]
    """Align a quadrilateral (4, 2), dark inside, with the edges next to it, in place; return whether each side has one.

    Each side becomes a line through the steepest points of profiles across it. The profiles reach a cell to either
    side, within which a tag has no other edge from dark to bright.
    """
    before = _area(quad)
    reach = min(max(_shortest(quad) / cells, 1.5), 6.0)
    lines = np.empty((4, 4))  # a point and a direction
    for k in range(4):
        if not _line(grey, quad[k], quad[(k + 1) % 4], reach, lines[k]):
            return False
    for k in range(4):
        a, b = lines[k - 1], lines[k]
        det = a[2] * b[3] - a[3] * b[2]
        if abs(det) < 0.05:
            return False
        s = ((b[0] - a[0]) * b[3] - (b[1] - a[1]) * b[2]) / det
        u, v = a[0] + s * a[2], a[1] + s * a[3]
        if np.hypot(u - quad[k, 0], v - quad[k, 1]) > 2.0 * reach:
            return False
        quad[k, 0], quad[k, 1] = u, v
    return _area(quad) >= 0.5 * before


@compiled
def _line(grey, p, q, reach, line):  # type: ignore[no-untyped-def]
    """Write the line (4,), point and direction, of an edge near the segment from p to q; return if it is straight."""
    long = np.hypot(q[0] - p[0], q[1] - p[1])
    du, dv = (q[0] - p[0]) / long, (q[1] - p[1]) / long
    n = max(8, min(32, int(long)))
    u, v, weight = np.empty(n), np.empty(n), np.zeros(n)
    steps = int(4.0 * reach)
    for i in range(n):
        s = long * (0.06 + 0.88 * i / (n - 1))
        u0, v0 = p[0] + s * du, p[1] + s * dv
        behind = here = -1.0
        for j in range(steps + 2):  # a profile in steps of half a pixel, outwards
            o = 0.5 * (j - steps // 2)
            ahead = bilinear(grey, u0 + o * dv, v0 - o * du)
            if behind >= 0.0 and ahead - behind > weight[i]:
                weight[i] = ahead - behind
                u[i], v[i] = u0 + (o - 0.5) * dv, v0 - (o - 0.5) * du
            behind, here = here, ahead
    if weight.sum() < n * _LEAST_SLOPE:
        return False
    w = weight.copy()
    for _ in range(3):
        mu, mv, uu, uv, vv = 0.0, 0.0, 0.0, 0.0, 0.0
        for i in range(n):
            if w[i] > 0.0:
                mu += w[i] * u[i]
                mv += w[i] * v[i]
        mu /= w.sum()
        mv /= w.sum()
        for i in range(n):
            if w[i] > 0.0:
                uu += w[i] * (u[i] - mu) ** 2
                uv += w[i] * (u[i] - mu) * (v[i] - mv)
                vv += w[i] * (v[i] - mv) ** 2
        angle = 0.5 * np.arctan2(2.0 * uv, uu - vv)
        line[0], line[1], line[2], line[3] = mu, mv, np.cos(angle), np.sin(angle)
        near = 0
        for i in range(n):
            if weight[i] > 0.0:
                off = (u[i] - mu) * line[3] - (v[i] - mv) * line[2]
                w[i] = weight[i] / (1.0 + (off / 0.5) ** 2)
                near += abs(off) < _OFF_PX
    return near >= _STRAIGHT * n
