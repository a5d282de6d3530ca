# SPDX-License-Identifier: Apache-2.0
"""Image messages to grey images: every encoding against pixels known by hand, and messages that are wrong."""

import struct
import zlib
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from graphloc.frontends.tags.images import grey_image

ROWS, COLUMNS = 4, 6
# Levels that OpenCV's weights (0.299, 0.587, 0.114) leave as they are, in a pattern without symmetry.
LEVELS = (np.arange(ROWS * COLUMNS, dtype=np.uint8).reshape(ROWS, COLUMNS) * 9) + 5
RGB = np.stack([LEVELS, LEVELS // 2, 255 - LEVELS], axis=2)
GREY_OF_RGB = np.rint(RGB @ np.array([0.299, 0.587, 0.114]))


def image(
    encoding: str, data: Any, *, width: int = COLUMNS, height: int = ROWS, step: int | None = None, big: int = 0
) -> SimpleNamespace:
    data = np.ascontiguousarray(data)
    step = data.nbytes // height if step is None else step
    flat = np.frombuffer(data.tobytes(), dtype=np.uint8)
    return SimpleNamespace(width=width, height=height, encoding=encoding, is_bigendian=big, step=step, data=flat)


def grey(*args: Any, **more: Any) -> Any:
    return grey_image(image(*args, **more), "sensor_msgs/msg/Image")


def compressed(data: Any) -> Any:
    msg = SimpleNamespace(format="whatever", data=np.frombuffer(bytes(data), dtype=np.uint8))
    return grey_image(msg, "sensor_msgs/msg/CompressedImage")


@pytest.mark.parametrize("encoding", ["mono8", "8UC1"])
def test_grey_stays_as_it_is(encoding: str) -> None:
    assert (grey(encoding, LEVELS) == LEVELS).all()


def test_padding_at_the_end_of_rows_is_skipped() -> None:
    padded = np.hstack([RGB.reshape(ROWS, -1), np.full((ROWS, 5), 77, dtype=np.uint8)])
    assert np.abs(grey("rgb8", padded) - GREY_OF_RGB).max() <= 1


@pytest.mark.parametrize(
    ("encoding", "data"),
    [
        ("rgb8", RGB), ("bgr8", RGB[..., ::-1]), ("8UC3", RGB[..., ::-1]),
        ("rgba8", np.dstack([RGB, LEVELS])), ("bgra8", np.dstack([RGB[..., ::-1], LEVELS])),
    ],
)  # fmt: skip
def test_colours_by_their_order(encoding: str, data: Any) -> None:
    assert np.abs(grey(encoding, data) - GREY_OF_RGB).max() <= 1


@pytest.mark.parametrize(("big", "kind"), [(0, "<u2"), (1, ">u2")])
@pytest.mark.parametrize("encoding", ["mono16", "16UC1"])
def test_sixteen_bits_in_either_order(encoding: str, big: int, kind: str) -> None:
    deep = (LEVELS.astype(np.uint16) * 16).astype(kind)  # a camera of twelve bits
    assert np.abs(grey(encoding, deep, big=big) - 255.0 * LEVELS / LEVELS.max()).max() <= 1


@pytest.mark.parametrize(("big", "kind"), [(0, "<u2"), (1, ">u2")])
@pytest.mark.parametrize(("encoding", "data"), [("rgb16", RGB), ("16UC3", RGB[..., ::-1])])
def test_sixteen_bits_of_colours(encoding: str, data: Any, big: int, kind: str) -> None:
    found = grey(encoding, (data.astype(np.uint16) * 16).astype(kind), big=big)
    assert np.abs(found - 255.0 / RGB.max() * GREY_OF_RGB).max() <= 1


def test_a_bayer_pattern_of_sixteen_bits() -> None:
    mosaic = np.full((16, 16), 20 * 16, dtype=np.uint16)
    mosaic[::2, ::2] = 255 * 16  # a red wall: 0.299 x 255 + 0.701 x 20
    found = grey("bayer_rggb16", mosaic, width=16, height=16)
    assert np.abs(found[4:-4, 4:-4] - 90.3).max() <= 2


@pytest.mark.parametrize(
    ("encoding", "at"),
    [("bayer_rggb8", (0, 0)), ("bayer_grbg8", (0, 1)), ("bayer_gbrg8", (1, 0)), ("bayer_bggr8", (1, 1))],
)
def test_bayer_patterns_by_where_red_is(encoding: str, at: tuple[int, int]) -> None:
    mosaic = np.full((16, 16), 20, dtype=np.uint8)
    mosaic[at[0] :: 2, at[1] :: 2] = 200  # a red wall: 0.299 x 200 + 0.701 x 20
    found = grey(encoding, mosaic, width=16, height=16)
    assert found.shape == (16, 16)
    assert np.abs(found[4:-4, 4:-4] - 73.8).max() <= 2


@pytest.mark.parametrize(("encoding", "first"), [("yuv422", 1), ("uyvy", 1), ("yuv422_yuy2", 0), ("yuyv", 0)])
def test_brightness_of_yuv(encoding: str, first: int) -> None:
    pairs = np.full((ROWS, 2 * COLUMNS), 128, dtype=np.uint8)
    pairs[:, first::2] = LEVELS
    assert (grey(encoding, pairs) == LEVELS).all()


def test_compressed() -> None:
    smooth = cv2.GaussianBlur(np.random.default_rng(1).integers(0, 255, (60, 80), dtype=np.uint8), (0, 0), 4.0)
    assert (compressed(cv2.imencode(".png", smooth)[1]) == smooth).all()
    assert np.abs(compressed(cv2.imencode(".jpg", smooth)[1]).astype(int) - smooth).max() <= 6
    colour = cv2.imencode(".png", np.dstack([smooth] * 3))[1]
    assert compressed(colour).shape == smooth.shape


def test_compressed_sixteen_bits() -> None:
    """Of a camera of twelve bits, whose upper byte alone has sixteen levels: no tag was found in them, and ids were blamed."""
    deep = cv2.imencode(".png", LEVELS.astype(np.uint16) * 16)[1]
    assert np.abs(compressed(deep) - 255.0 * LEVELS / LEVELS.max()).max() <= 1


def png_header(width: int, height: int) -> bytes:
    body = struct.pack(">II5B", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + b"IHDR" + body + struct.pack(">I", zlib.crc32(b"IHDR" + body))


def huge_jpeg() -> bytes:
    data = bytearray(cv2.imencode(".jpg", LEVELS)[1].tobytes())
    at = data.index(b"\xff\xc0")
    data[at + 5 : at + 9] = struct.pack(">HH", 60000, 60000)
    return bytes(data)


@pytest.mark.parametrize(
    ("call", "reason"),
    [
        (lambda: grey("32FC1", LEVELS), "encoding '32FC1' is not known"),
        (lambda: grey("mono8", LEVELS, height=ROWS + 1, step=COLUMNS), "24 bytes of data where 5 rows of 6"),
        (lambda: grey("rgb8", LEVELS), "step 6 is less than 6 pixels of rgb8"),
        (lambda: grey("mono8", LEVELS, width=0), "0 x 4 pixels"),
        (lambda: grey("mono8", LEVELS, width=100_000, height=100_000, step=100_000), "more than 100 million"),
        (lambda: grey_image(None, "sensor_msgs/msg/PointCloud2"), "PointCloud2 is not an image"),
        (lambda: compressed(b""), "neither JPEG nor PNG"),
        (lambda: compressed(b"RVL depth or whatever"), "neither JPEG nor PNG"),
        (lambda: compressed(cv2.imencode(".png", LEVELS)[1][:40]), "cannot be decoded"),
        (lambda: compressed(b"\xff\xd8\xff\xe0\x00\x04ab"), "cannot be decoded"),
        (lambda: compressed(png_header(50_000, 50_000)), "50000 x 50000 pixels: more than 100 million"),
        (lambda: compressed(png_header(0, 10)), "0 x 10 pixels"),
        (lambda: compressed(huge_jpeg()), "60000 x 60000 pixels: more than 100 million"),
    ],
)
def test_a_wrong_message_is_one_short_reason(call: Callable[[], Any], reason: str) -> None:
    with pytest.raises(ValueError, match=reason) as error:
        call()
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 120
