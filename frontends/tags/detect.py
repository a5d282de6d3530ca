# SPDX-License-Identifier: Apache-2.0
"""AprilTags in grey images: their ids, their corners, and the covariance of the corners.

Steps: find dark quadrilaterals (`_quads`); keep those whose bits are nearly in the codebook (`_decode`); fit the whole
tag (`_edges`), with edges curved by the lens if that is known (`_bow`); read the bits again at the fitted corners.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from graphloc.frames import Array
from graphloc.frontends.tags._bow import unbowed
from graphloc.frontends.tags._decode import Codebook, codebook, read, spots
from graphloc.frontends.tags._edges import fit_tag
from graphloc.frontends.tags._quads import quads_in
from graphloc.frontends.tags.camera import CameraModel

_THREADS = 2
_STRIPS, _OVERLAP_PX = 3, 96  # tags that are taller than the overlap are found at half the resolution
_MORE_BITS = 2  # so many more bits may be wrong as long as the corners are rough
_LEAST_EXPLAINED = 0.4  # least share of the variance of a tag's pixels that the fit explains


@dataclass(frozen=True, slots=True, eq=False)
class Detection:
    """A tag in an image.

    Attributes:
        number: its id in its family. family: e.g. "36h11".
        corners_px: (4, 2) u, v; the centre of the top-left pixel is (0, 0). In the order of the tag's own axes (x
            right, y up, z out of the print): (-,+), (+,+), (+,-), (-,-), which is top-left, top-right, bottom-right,
            bottom-left of the print as AprilTag's own images stand.
        cov_px2: (8, 8) covariance of u0, v0, u1, v1, ...
        hamming: number of corrected bits. margin: AprilTag's decision margin, grey levels.
    """

    number: int
    family: str
    corners_px: Array
    cov_px2: Array
    hamming: int
    margin: float


class _Candidate(NamedTuple):
    """A quadrilateral (4, 2), px, that starts at the first corner of tag `tag` of `book`; `off`: different bits."""

    book: Codebook
    tag: int
    corners_px: Array
    off: int


class Detector:
    """Finds AprilTags. It has no state between images and can be shared by threads.

    Args:
        families: of `16h5`, `25h9`, `36h10`, `36h11`. 16h5 has so few bits that any dark square may match: give
            `numbers`, and no bits to correct.
        max_hamming: number of bits that may be wrong.
        min_margin: least decision margin, grey levels.
        min_side_px: tags with shorter sides on average are not sought.
        numbers: by family, the ids to seek, if not all.

    Raises:
        ConfigError: a family is unknown, or has no such number.
    """

    def __init__(
        self,
        families: Sequence[str] = ("36h11",),
        *,
        max_hamming: int = 1,
        min_margin: float = 1.5,
        min_side_px: float = 10.0,
        numbers: Mapping[str, Collection[int]] | None = None,
    ) -> None:
        self._books = [codebook(family, (numbers or {}).get(family)) for family in dict.fromkeys(families)]
        self._max_hamming, self._min_margin, self._min_side_px = max_hamming, min_margin, min_side_px

    def detect(self, grey: NDArray[np.uint8], lens: CameraModel | None = None) -> list[Detection]:
        """Return the tags that are wholly visible in an image (rows, columns), on two threads; lowest number first.

        Args:
            grey: the image. lens: of an image with distortion: the edges of a tag are then fitted as curves. Corners
                stay points of the image.
        """
        if min(grey.shape, default=0) < self._min_side_px or not self._books:
            return []
        grey = _read_only(np.ascontiguousarray(grey))
        with ThreadPoolExecutor(_THREADS) as pool:
            candidates = itertools.chain(*pool.map(lambda part: self._candidates(*part), parts_of(grey)))
            settled = pool.map(lambda candidate: self._settled(grey, lens, candidate), _distinct(candidates))
            found = [detection for detection in settled if detection is not None]
        return sorted(found, key=lambda d: (d.family, d.number, d.corners_px[0, 0]))

    def _candidates(self, grey: NDArray[np.uint8], scale: float, top: int) -> list[_Candidate]:
        """Return the quadrilaterals of a part of an image whose bits are nearly those of a tag.

        Args:
            grey: the part, reduced by the factor `scale`. top: its first row in the image.
        """
        found = []
        for quad in quads_in(grey, self._min_side_px / scale, max(book.side for book in self._books)):
            for book in self._books:
                tag, turned, off, _ = read(grey, spots(quad, book.side), book.side, book.codes)
                if off <= self._max_hamming + _MORE_BITS:
                    # A pixel of the half image has its centre between those of four pixels.
                    corners = scale * np.roll(quad, turned, axis=0) + 0.5 * (scale - 1.0) + np.array([0.0, top])
                    found.append(_Candidate(book, tag, corners, off))
        return found

    def _settled(self, grey: NDArray[np.uint8], lens: CameraModel | None, candidate: _Candidate) -> Detection | None:
        """Return the tag fitted to the image; None if it does not fit, or if the bits at its corners are no tag's."""
        book = candidate.book
        straight = unbowed(lens, candidate.corners_px)
        fitted = fit_tag(grey, candidate.corners_px, book.cells[candidate.tag], straight)
        if fitted is None or fitted.explained < _LEAST_EXPLAINED:
            return None
        px = spots(fitted.corners_px, book.side)
        if straight is not None:
            px = straight.bowed(spots(straight.flat(fitted.corners_px), book.side))
        tag, turned, off, margin = read(grey, px, book.side, book.codes)
        if (tag, turned) != (candidate.tag, 0) or off > self._max_hamming or margin < self._min_margin:
            return None
        number = int(book.numbers[tag])
        return Detection(number, book.family, fitted.corners_px, fitted.cov_px2, int(off), float(margin))


def _read_only(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a read-only view, as images of a bag are: else loops would be compiled again for writable arrays."""
    image = image.view()
    image.flags.writeable = False
    return image


def parts_of(grey: NDArray[np.uint8]) -> list[tuple[NDArray[np.uint8], float, int]]:
    """Return the parts of an image that threads search: the image at half the resolution, and strips of it.

    The former is for tall tags, noise and blur. Each part comes with its reduction and its first row in the image.
    """
    half = np.asarray(cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    half = _read_only(half)
    edges = np.linspace(0, len(grey), _STRIPS + 1).astype(int).tolist()
    strips = [(max(a - _OVERLAP_PX // 2, 0), b + _OVERLAP_PX // 2) for a, b in itertools.pairwise(edges)]
    return [(half, 2.0, 0), *((grey[a:b], 1.0, a) for a, b in strips)]


def _distinct(candidates: Iterable[_Candidate]) -> list[_Candidate]:
    """Return the candidates without those at the position of another one with fewer different bits."""
    kept: list[_Candidate] = []
    for candidate in sorted(candidates, key=lambda c: c.off):
        middle, width = candidate.corners_px.mean(axis=0), np.ptp(candidate.corners_px, axis=0).max()
        if all(np.abs(middle - other.corners_px.mean(axis=0)).max() > 0.5 * width for other in kept):
            kept.append(candidate)
    return kept
