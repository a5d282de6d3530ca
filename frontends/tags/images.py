# SPDX-License-Identifier: Apache-2.0
"""Conversion of image messages to grey images."""

from __future__ import annotations

import struct
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Grey = NDArray[np.uint8]
_MOST_PIXELS = 100_000_000
# By encoding: channels, and OpenCV's conversion to grey, None if it is grey. Encodings of 16 bits are the same with 16
# for 8 in the name.
_ENCODINGS: dict[str, tuple[int, int | None]] = {
    "mono8": (1, None), "8UC1": (1, None),
    "rgb8": (3, cv2.COLOR_RGB2GRAY), "bgr8": (3, cv2.COLOR_BGR2GRAY), "8UC3": (3, cv2.COLOR_BGR2GRAY),
    "rgba8": (4, cv2.COLOR_RGBA2GRAY), "bgra8": (4, cv2.COLOR_BGRA2GRAY), "8UC4": (4, cv2.COLOR_BGRA2GRAY),
    # OpenCV names a Bayer pattern by its second row's second and third pixel, ROS by the first of all.
    "bayer_rggb8": (1, cv2.COLOR_BayerBG2GRAY), "bayer_bggr8": (1, cv2.COLOR_BayerRG2GRAY),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGR2GRAY), "bayer_grbg8": (1, cv2.COLOR_BayerGB2GRAY),
    "yuv422": (2, cv2.COLOR_YUV2GRAY_UYVY), "uyvy": (2, cv2.COLOR_YUV2GRAY_UYVY),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2GRAY_YUY2), "yuyv": (2, cv2.COLOR_YUV2GRAY_YUY2),
}  # fmt: skip


def grey_image(msg: Any, msgtype: str) -> Grey:
    """Return the grey image (rows, columns) of a message decoded by rosbags.

    Images of 16 bits are scaled to the brightest pixel.

    Raises:
        ValueError: it has no image, or one in an unsupported format.
    """
    if msgtype == "sensor_msgs/msg/Image":
        return _raw(msg)
    if msgtype == "sensor_msgs/msg/CompressedImage":
        return _compressed(np.asarray(msg.data, dtype=np.uint8))
    raise ValueError(f"{msgtype} is not an image")


def _checked(width: int, height: int) -> None:
    if min(width, height) <= 0:
        raise ValueError(f"an image of {width} x {height} pixels")
    if width * height > _MOST_PIXELS:
        raise ValueError(
            f"an image of {width} x {height} pixels: more than {_MOST_PIXELS / 1e6:g} million are not read"
        )


def _raw(msg: Any) -> Grey:
    width, height, step = int(msg.width), int(msg.height), int(msg.step)
    deep = msg.encoding.startswith("16") or msg.encoding.endswith("16")
    shallow = msg.encoding.replace("16", "8") if deep else msg.encoding
    if shallow not in _ENCODINGS:
        raise ValueError(f"encoding {msg.encoding!r} is not known")
    _checked(width, height)
    numbers, to_grey = _ENCODINGS[shallow]
    size = numbers * (2 if deep else 1)
    if step < width * size:
        raise ValueError(f"step {step} is less than {width} pixels of {msg.encoding}")
    data = np.asarray(msg.data, dtype=np.uint8)
    if data.size < height * step:
        raise ValueError(f"{data.size} bytes of data where {height} rows of {step} were announced")
    rows = data[: height * step].reshape(height, step)[:, : width * size]
    if deep:
        rows = _eight_bits(np.ascontiguousarray(rows).view(">u2" if msg.is_bigendian else "<u2"))
    pixels = np.ascontiguousarray(rows if numbers == 1 else rows.reshape(height, width, numbers))
    if to_grey is None:
        return pixels
    return np.asarray(cv2.cvtColor(pixels, to_grey), dtype=np.uint8)


def _eight_bits(pixels: NDArray[np.uint16]) -> Grey:
    """Return pixels scaled to the brightest one: cameras of 10 to 14 bits leave the upper bits empty."""
    scale = 255.0 / max(int(pixels.max()), 255)
    return np.asarray(cv2.convertScaleAbs(pixels.astype(np.float32), alpha=scale), dtype=np.uint8)


def _compressed(data: Grey) -> Grey:
    header = data[: 1 << 20].tobytes()
    if header.startswith(b"\x89PNG\r\n\x1a\n") and len(header) >= 24:
        _checked(*struct.unpack(">II", header[16:24]))
    elif header.startswith(b"\xff\xd8"):
        size = _jpeg_size(header)
        if size is not None:
            _checked(*size)
    else:
        raise ValueError("compressed data is neither JPEG nor PNG")
    try:
        pixels = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        pixels = None
    if pixels is None:
        raise ValueError("compressed data cannot be decoded")
    return _eight_bits(pixels.astype(np.uint16)) if pixels.dtype == np.uint16 else np.asarray(pixels, dtype=np.uint8)


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    """Return the width and height in a JPEG's frame header; None if it has none."""
    at = 2
    while at + 9 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack(">HH", data[at + 5 : at + 9])
            return width, height
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big") if marker != 0xFF else 1
    return None
