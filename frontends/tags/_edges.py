# SPDX-License-Identifier: Apache-2.0
"""Corners of a decoded tag, by fitting the image of the whole tag, all edges at once.

A pixel's grey level is (D black^g + (1 - D) white^g)^(1/g). D: share of its light from black cells, by the tag's cells
under a homography and a Gaussian blur; black and white: planes over the tag; g: gamma, the camera's encoding of light.
A tag has edges from dark to bright and from bright to dark, so effects that widen white (gamma, glare, exposure) are
separated from a shift of a corner.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from graphloc.frames import Array
from graphloc.frontends.tags._bow import Unbowed
from graphloc.frontends.tags._decode import compiled, homography, mapped

_ROUNDS = (1200, 5000)  # about how many pixels are used, in the first fit and the second; of a wide tag a sample
# Least 1 sigma of a corner: in any image, and as a factor of (blur / cell)^2.
_FLOOR_PX, _BLENDED_PX = 0.015, 0.15
_QUIET = 0.8  # width of the surely white zone around a tag, cells
_START_BLUR_PX2, _START_GAMMA = 0.25, 1.8
_GAMMA_SIGMA, _BLUR_SIGMA_PX2 = 0.5, 1.0  # prior sigmas
_SLOPE_SIGMA = 0.3  # prior sigma of the slopes of black and white over a tag, as a share of the contrast
_BLURS_PX2, _GAMMAS = (0.08, 60.0), (0.8, 3.0)  # allowed ranges; a pixel itself blurs by 1/12
# Level from which a pixel is saturated; least level of black; least variance of a level, by eight bits.
_CLIPPED, _LEAST_BLACK, _ROUNDING = 254.0 / 255.0, 0.002, 1e-6
_ASTRAY_PX, _ASTRAY_CELLS = 2.0, 1.5  # a fit that ends farther away has left the tag
_TOO_SURE = 1.4  # factor on the covariance: glare and motion are no Gaussian blur
_BLOCKS = 4  # blocks along a side: errors of the pixels of a block are correlated
_N = 17  # corners u0 v0 .. u3 v3, blur along rows and columns, black, its slopes, white, its slopes, gamma
_STEP_PX, _SETTLED_PX, _TURNS, _MOST_DAMPED = 1e-4, 0.02, 14, 1e4
_CELLS = 24  # most cells along a side from which the light of a pixel comes
_EVEN_U, _EVEN_V = 0.7548776662466927, 0.5698402909980532  # multiples of them fill the unit square evenly (Roberts' R2)
_PEAK = 1.0 / math.sqrt(2.0 * math.pi)


class TagFit(NamedTuple):
    """Corners (4, 2) of a tag, their covariance (8, 8), and the share of its pixels' variance that is explained."""

    corners_px: Array
    cov_px2: Array
    explained: float


def fit_tag(
    grey: NDArray[np.uint8], about_px: Array, cells: NDArray[np.uint8], straight: Unbowed | None
) -> TagFit | None:
    """Return the fit of a tag to an image; None if it does not converge near the given corners.

    It is fitted to some of its pixels, then to more.

    Args:
        grey: image.
        about_px: (4, 2) approximate corners: left and right end of the cells' first row, then clockwise.
        cells: (side, side), 1 is white.
        straight: image in which the tag's sides are straight; None: this one.
    """
    about = about_px if straight is None else straight.flat(about_px)
    prior: _Prior | None = None
    rest: _Rest | None = None
    for most in _ROUNDS:
        pixels, step = _pixels(grey, about_px, about if rest is None else rest.corners, len(cells), most, straight)
        prior = prior or _prior(pixels, about, cells)
        rest = None if prior is None else _settle(pixels, cells, prior, rest)
        if prior is None or rest is None:
            return None
        if step == 1:
            break
    assert prior is not None
    assert rest is not None
    theta, variance, A, b = rest.theta, rest.variance, rest.A, rest.b
    cell_px = math.sqrt(_area(rest.corners)) / len(cells)
    inverse = np.linalg.inv(A.sum(axis=0) / variance + np.diag(prior.info))
    floor_px = _FLOOR_PX + _BLENDED_PX * 0.5 * (theta[8] + theta[9]) / cell_px**2
    cov = _TOO_SURE * max(_together(A, b, inverse, variance), 1.0) * inverse[:8, :8] + floor_px**2 * np.eye(8)
    explained = 1.0 - variance / float(pixels[:, 2].var())
    if straight is None:
        return TagFit(rest.corners, cov, explained)
    bow = block_diag(*straight.slope(rest.corners))
    corners = straight.bowed(rest.corners)
    return TagFit(corners, bow @ cov @ bow.T, explained) if np.isfinite(corners).all() else None


def _pixels(
    grey: NDArray[np.uint8], about_px: Array, corners: Array, side: int, most: int, straight: Unbowed | None
) -> tuple[Array, int]:
    """Return undistorted u, v and level (n, 3) of pixels of a tag and its quiet zone, and the step between pixels."""
    chosen, step = _chosen(grey.shape, about_px, side, most)
    flat = chosen if straight is None else straight.flat(chosen)
    return _inside(grey, chosen, flat, np.linalg.inv(homography(corners, side)), side), step


class _Prior(NamedTuple):
    """Prior of the parameters: values (17,), inverse variances (17,); and the contrast, white's level minus black's."""

    theta: Array
    info: Array
    contrast: float


def _prior(pixels: Array, about_px: Array, cells: NDArray[np.uint8]) -> _Prior | None:
    at = np.column_stack([pixels[:, :2], np.ones(len(pixels))]) @ np.linalg.inv(homography(about_px, len(cells))).T
    x, y = np.floor(at[:, :2] / at[:, 2:]).astype(int).T
    white = np.pad(cells, 1, constant_values=1)[y + 1, x + 1] == 1
    if len(pixels) < 2 * _N or white.all() or not white.any():
        return None
    levels = pixels[:, 2]
    black_level, contrast = levels[~white].mean(), levels[white].mean() - levels[~white].mean()
    if contrast <= 0.0:
        return None
    theta, info = np.zeros(_N), np.full(_N, 1e-9)
    theta[:8] = about_px.ravel()
    theta[8:10] = _START_BLUR_PX2
    theta[10] = max(black_level - 0.1 * contrast, _LEAST_BLACK)  # blur has mixed black and white
    theta[13] = black_level + 1.1 * contrast
    theta[16] = _START_GAMMA
    info[8:10] = 1.0 / _BLUR_SIGMA_PX2**2
    info[[11, 12, 14, 15]] = 1.0 / (_SLOPE_SIGMA * contrast) ** 2
    info[13] = 1.0 / contrast**2
    info[16] = 1.0 / _GAMMA_SIGMA**2
    return _Prior(theta, info, float(contrast))


class _Rest(NamedTuple):
    """Fitted parameters (17,), variance of a pixel, and normal equations by block (n, 17, 17), (n, 17)."""

    theta: Array
    variance: float
    A: Array
    b: Array

    @property
    def corners(self) -> Array:
        return self.theta[:8].reshape(4, 2)


def _settle(pixels: Array, cells: NDArray[np.uint8], prior: _Prior, start: _Rest | None) -> _Rest | None:
    """Return the fit by Levenberg-Marquardt from the prior, or an earlier result; None if the corners leave the tag."""
    side, info = len(cells), prior.info
    astray_px = max(_ASTRAY_PX, _ASTRAY_CELLS * math.sqrt(_area(prior.theta[:8].reshape(4, 2))) / side)
    theta, variance = (prior.theta, (0.1 * prior.contrast) ** 2) if start is None else (start.theta, start.variance)
    best, cost, damp = theta, np.inf, 1e-3
    A, b = np.empty((0, _N, _N)), np.empty((0, _N))
    for turn in range(_TURNS):
        moved = np.repeat(theta[None, :8], 9, axis=0) + _STEP_PX * np.eye(9, 8)
        X = np.linalg.inv(np.array([homography(corners.reshape(4, 2), side) for corners in moved]))
        slopes = (X[:8] - X[8]).reshape(8, 9) / _STEP_PX
        A_here, b_here, squares, count = _gather(pixels, cells, theta, X[8], slopes, prior.contrast**2 / variance)
        strain = float(info @ (theta - prior.theta) ** 2)
        if squares / variance + strain < cost:
            settled = turn > 0 and np.abs(theta[:8] - best[:8]).max() < _SETTLED_PX
            best, A, b = theta, A_here, b_here
            variance = max(squares / max(count - _N, 0.3 * count), _ROUNDING)
            cost = squares / variance + strain
            damp *= 0.2
            if settled:
                break
        else:
            damp *= 8.0
            if damp > _MOST_DAMPED:
                break
        M = A.sum(axis=0) / variance + np.diag(info)
        step = np.linalg.solve(M + damp * np.diag(np.diag(M)), b.sum(axis=0) / variance + info * (prior.theta - best))
        theta = best + step
        if not np.abs(theta[:8] - prior.theta[:8]).max() < astray_px:
            return None
        theta[8:10] = np.clip(theta[8:10], *_BLURS_PX2)
        theta[16] = np.clip(theta[16], *_GAMMAS)
    return _Rest(best, variance, A, b)


def _together(A: Array, b: Array, inverse: Array, variance: float) -> float:
    """Return the variance of the blocks' pull on the corners over that of independent pixels (Huber's sandwich)."""
    P = inverse[:8] @ A / variance
    alone = np.trace(inverse[:8] @ A @ inverse[:, :8] / variance - P @ inverse @ P.transpose(0, 2, 1), axis1=1, axis2=2)
    return float(((b @ inverse[:, :8] / variance) ** 2).sum() / alone.sum())


def _area(corners: Array) -> float:
    (du, dv), (eu, ev) = corners[2] - corners[0], corners[3] - corners[1]
    return 0.5 * abs(float(du * ev - dv * eu))


@compiled
def _normal(t):  # type: ignore[no-untyped-def]
    """Return density and distribution of a standard normal, to 1e-7 (Abramowitz and Stegun 7.1.26)."""
    p = _PEAK * math.exp(-0.5 * t * t)
    z = 1.0 / (1.0 + 0.2316418882 * abs(t))
    tail = (
        0.5
        * p
        / _PEAK
        * z
        * (0.254829592 + z * (-0.284496736 + z * (1.421413741 + z * (-1.453152027 + z * 1.061405429))))
    )
    return p, tail if t < 0.0 else 1.0 - tail


@compiled
def _shares(x, s, first, w, dx, ds):  # type: ignore[no-untyped-def]
    """Write the shares w of the light at x from the cells from `first` on, blurred by s cells, and dw / dx, dw / ds."""
    t0 = (first - x) / s
    p0, c0 = _normal(t0)
    for i in range(len(w)):
        t = (first + i + 1 - x) / s
        p, c = _normal(t)
        w[i], dx[i], ds[i] = c - c0, (p0 - p) / s, (t0 * p0 - t * p) / s
        t0, c0, p0 = t, c, p


@compiled
def _model(theta, X, slopes, cells, u, v, J, w):  # type: ignore[no-untyped-def]
    """Return a pixel's level, and the share of its light from beyond the quiet zone; write the level's derivatives.

    Args:
        theta: (17,) parameters. X: (3, 3) homography from px to cells. slopes: (8, 9) its derivatives by the corners'
            coordinates, row by row. cells: (side, side). u, v: the pixel. J: (17,) output. w: (6, 24) workspace.
    """
    side = len(cells)
    x, y, z = mapped(X, u, v)
    xu, xv = (X[0, 0] - x * X[2, 0]) * z, (X[0, 1] - x * X[2, 1]) * z
    yu, yv = (X[1, 0] - y * X[2, 0]) * z, (X[1, 1] - y * X[2, 1]) * z
    sx, sy = math.sqrt(theta[8] * (xu * xu + xv * xv)), math.sqrt(theta[9] * (yu * yu + yv * yv))
    left, top = math.floor(x - 3.0 * sx), math.floor(y - 3.0 * sy)
    nx = min(math.floor(x + 3.0 * sx) - left + 1, _CELLS)
    ny = min(math.floor(y + 3.0 * sy) - top + 1, _CELLS)
    _shares(x, sx, left, w[0, :nx], w[1, :nx], w[2, :nx])
    _shares(y, sy, top, w[3, :ny], w[4, :ny], w[5, :ny])
    D, Dx, Dy, Dsx, Dsy = 0.0, 0.0, 0.0, 0.0, 0.0
    for r in range(max(-top, 0), min(ny, side - top)):
        for c in range(max(-left, 0), min(nx, side - left)):
            if cells[top + r, left + c] == 0:
                D += w[0, c] * w[3, r]
                Dx += w[1, c] * w[3, r]
                Dy += w[0, c] * w[4, r]
                Dsx += w[2, c] * w[3, r]
                Dsy += w[0, c] * w[5, r]
    a, b = 2.0 * x / side - 1.0, 2.0 * y / side - 1.0
    gamma = theta[16]
    black = max(theta[10] + theta[11] * a + theta[12] * b, _LEAST_BLACK)
    white = max(theta[13] + theta[14] * a + theta[15] * b, 2.0 * _LEAST_BLACK)
    black_log, white_log = math.log(black), math.log(white)
    black_light, white_light = math.exp(gamma * black_log), math.exp(gamma * white_log)
    light = D * black_light + (1.0 - D) * white_light
    light_log = math.log(light)
    level = math.exp(light_log / gamma)
    slope = level / (light * gamma)
    by_D = slope * (black_light - white_light)
    by_z = -(Dx * x + Dy * y)
    for k in range(8):
        by_x = slopes[k, 0] * u + slopes[k, 1] * v + slopes[k, 2]
        by_y = slopes[k, 3] * u + slopes[k, 4] * v + slopes[k, 5]
        J[k] = by_D * z * (Dx * by_x + Dy * by_y + by_z * (slopes[k, 6] * u + slopes[k, 7] * v + slopes[k, 8]))
    J[8], J[9] = 0.5 * by_D * Dsx * sx / theta[8], 0.5 * by_D * Dsy * sy / theta[9]
    by_black, by_white = slope * D * gamma * black_light / black, slope * (1.0 - D) * gamma * white_light / white
    J[10], J[11], J[12] = by_black, by_black * a, by_black * b
    J[13], J[14], J[15] = by_white, by_white * a, by_white * b
    mean_log = D * black_light * black_log + (1.0 - D) * white_light * white_log
    J[16] = slope * mean_log - level * light_log / gamma**2
    out_x, out_y = (abs(x - 0.5 * side) - 0.5 * side - _QUIET) / sx, (abs(y - 0.5 * side) - 0.5 * side - _QUIET) / sy
    strange = 0.0
    if max(out_x, out_y) > -3.0:
        strange = 1.0 - _normal(-out_x)[1] * _normal(-out_y)[1]
    return level, strange


@compiled
def _chosen(shape, corners, side, most):  # type: ignore[no-untyped-def]
    """Return pixels (n, 2) of the box around a tag and its quiet zone, one per square, and the side of a square.

    The position in the square is quasi-random: otherwise all pixels of a column would have equal distances to an edge
    that is nearly vertical, and corners would be 0.073 px off instead of 0.044 (1600 pixels, 3 to 5 m, optimal light).
    """
    low_u, high_u, low_v, high_v = 1e9, -1e9, 1e9, -1e9
    area = 0.0
    for k in range(4):
        before, here, after = corners[k - 1], corners[k], corners[(k + 1) % 4]
        u = here[0] + _QUIET / side * (2.0 * here[0] - before[0] - after[0])
        v = here[1] + _QUIET / side * (2.0 * here[1] - before[1] - after[1])
        low_u, high_u, low_v, high_v = min(low_u, u), max(high_u, u), min(low_v, v), max(high_v, v)
        area += 0.5 * (before[0] * here[1] - here[0] * before[1])
    u0, u1 = max(math.ceil(low_u), 0), min(int(high_u), shape[1] - 1)
    v0, v1 = max(math.ceil(low_v), 0), min(int(high_v), shape[0] - 1)
    step = max(1, int(math.sqrt(area * (1.0 + 2.0 * _QUIET / side) ** 2 / most) + 0.5))
    columns, rows = max((u1 - u0) // step + 1, 0), max((v1 - v0) // step + 1, 0)
    found = np.empty((rows * columns, 2))
    n = 0
    for i in range(rows):
        for j in range(columns):
            k = i * columns + j
            u, v = u0 + j * step + int(step * (k * _EVEN_U % 1.0)), v0 + i * step + int(step * (k * _EVEN_V % 1.0))
            if u <= u1 and v <= v1:
                found[n, 0], found[n, 1] = u, v
                n += 1
    return found[:n], step


@compiled
def _inside(grey, px, flat, X, side):  # type: ignore[no-untyped-def]
    """Return (n, 3) undistorted position and level in [0, 1] of the pixels (m, 2) that are in the tag or quiet zone."""
    found = np.empty((len(px), 3))
    n = 0
    for i in range(len(px)):
        x, y, _ = mapped(X, flat[i, 0], flat[i, 1])
        if min(x, y) >= -_QUIET and max(x, y) <= side + _QUIET:
            found[n, 0], found[n, 1], found[n, 2] = flat[i, 0], flat[i, 1], grey[int(px[i, 1]), int(px[i, 0])] / 255.0
            n += 1
    return found[:n]


@compiled
def _gather(pixels, cells, theta, X, slopes, doubt):  # type: ignore[no-untyped-def]
    """Return the normal equations by block, (n, 17, 17) and (n, 17), for pixels of unit variance.

    Args:
        pixels: (m, 3). cells, theta, X, slopes: see `_model`.
        doubt: ratio of the variance of light from beyond the quiet zone to that of a pixel.

    Returns:
        The equations, the weighted sum of squared errors, and the sum of weights.
    """
    side = len(cells)
    A, b = np.zeros((_BLOCKS * _BLOCKS, _N, _N)), np.zeros((_BLOCKS * _BLOCKS, _N))
    J, work = np.empty(_N), np.empty((6, _CELLS))
    squares, count = 0.0, 0.0
    for i in range(len(pixels)):
        u, v = pixels[i, 0], pixels[i, 1]
        level, strange = _model(theta, X, slopes, cells, u, v, J, work)
        if pixels[i, 2] >= _CLIPPED and level >= pixels[i, 2]:
            continue  # a saturated pixel whose model is at least as bright tells no more
        weight = 1.0 / (1.0 + doubt * strange * strange)
        off = pixels[i, 2] - level
        x, y, _ = mapped(X, u, v)
        column, row = int(_BLOCKS * x / side), int(_BLOCKS * y / side)
        block = _BLOCKS * min(max(row, 0), _BLOCKS - 1) + min(max(column, 0), _BLOCKS - 1)
        squares += weight * off * off
        count += weight
        for m in range(_N):
            b[block, m] += weight * J[m] * off
            for n in range(m + 1):
                A[block, m, n] += weight * J[m] * J[n]
    for k in range(len(A)):
        for m in range(_N):
            for n in range(m):
                A[k, n, m] = A[k, m, n]
    return A, b, squares, count
