"""Images of robot maps: brightness 0 to 255 whatever the file's depth, and which pixels are opaque."""

from __future__ import annotations

import re
import struct
import zlib
from pathlib import Path

import numpy as np

from polyexplore_gym.errors import InvalidFloorPlanError
from polyexplore_gym.robot_map import MAX_PIXELS

MAX_BYTES = 1_000_000_000
"""Largest image file read."""
_PNG = b"\x89PNG\r\n\x1a\n"
_COLOURS = {b"P1": 1, b"P2": 1, b"P3": 3, b"P4": 1, b"P5": 1, b"P6": 3}
_NUMBER = re.compile(rb"(?:\s|#[^\n]*\n)*(\d{1,9})(?=\s)")


def read_image(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Brightness (h, w), uint8 or float32 in 0 to 255, colours averaged; and which pixels are opaque, None: all.

    Raises:
        InvalidFloorPlanError: the file is missing, no image, damaged, truncated or too large.
    """
    try:
        if path.stat().st_size > MAX_BYTES:
            raise InvalidFloorPlanError(f"image {path}: larger than {MAX_BYTES // 10**6} MB")
        data = path.read_bytes()
    except OSError as error:
        raise InvalidFloorPlanError(f"image {path}: cannot be read: {error.strerror or error}") from error
    except ValueError as error:  # a zero byte in the name
        raise InvalidFloorPlanError(f"image {str(path)!r}: cannot be read: {error}") from error
    try:
        values = _netpbm(data) if data[:2] in _COLOURS else _others(data)
    except _ImageError as error:
        raise InvalidFloorPlanError(f"image {path}: {error}") from error
    if values.ndim == 2:
        return values, None
    alpha = values.shape[2] in (2, 4)
    colours = values[:, :, :-1] if alpha else values
    opaque = values[:, :, -1] > 127.0 if alpha else None
    if (colours == colours[:, :, :1]).all():
        return colours[:, :, 0], opaque
    return colours.mean(axis=2, dtype=np.float32), opaque


class _ImageError(Exception):
    """What is wrong with an image."""


def _check_size(width: int, height: int) -> None:
    if width <= 0 or height <= 0:
        raise _ImageError(f"damaged: {width} x {height} pixels")
    if width * height > MAX_PIXELS:
        raise _ImageError(f"{width} x {height} pixels, more than {MAX_PIXELS}")


def _netpbm(data: bytes) -> np.ndarray:
    """PBM, PGM and PPM, plain and raw, with any maxval (OpenCV takes other maxvals than 255 for 255)."""
    kind, position = data[:2], 2
    header: list[int] = []
    bits = kind in (b"P1", b"P4")
    while len(header) < (2 if bits else 3):
        match = _NUMBER.match(data, position)
        if match is None:
            raise _ImageError("truncated, or a damaged PNM header")
        header.append(int(match[1]))
        position = match.end()
    width, height, maxval = (*header, 1)[:3]
    _check_size(width, height)
    if not 0 < maxval < 65_536:
        raise _ImageError(f"damaged PNM header: maxval {maxval}")
    count = width * height * _COLOURS[kind]
    if kind in (b"P5", b"P6"):
        dtype = np.dtype(">u2" if maxval > 255 else "u1")
        body = data[position + 1 :]
        if len(body) < count * dtype.itemsize:
            raise _ImageError("the file is truncated")
        samples = np.frombuffer(body, dtype, count)
    elif kind == b"P4":
        row = -(-width // 8)
        body = data[position + 1 :]
        if len(body) < row * height:
            raise _ImageError("the file is truncated")
        packed = np.frombuffer(body, np.uint8, row * height).reshape(height, row)
        samples = 1 - np.unpackbits(packed, axis=1)[:, :width].ravel()
    else:
        samples = _plain(data[position:], count, bits, maxval)
    values = samples.reshape((height, width) if _COLOURS[kind] == 1 else (height, width, 3))
    if maxval == 255:
        return values
    if int(samples.max()) > maxval:
        raise _ImageError(f"damaged: a sample of {int(samples.max())} where maxval is {maxval}")
    scale = (np.arange(maxval + 1) * (255.0 / maxval)).astype(np.float32)
    return scale[values]


def _plain(body: bytes, count: int, bits: bool, maxval: int) -> np.ndarray:
    """The samples of a plain (text) file."""
    text = re.sub(rb"#[^\n]*", b"", body)
    if bits:  # the digits of a bitmap need no space between them
        text = re.sub(rb"\s", b"", text)
        if set(text[:count]) - {48, 49}:
            raise _ImageError("damaged: not a number")
        samples = 49 - np.frombuffer(text, np.uint8)[:count]
    else:
        words = text.split(None, count)[:count]
        if any(not word.isdigit() or len(word) > 5 for word in words):
            raise _ImageError("damaged: not a number")
        samples = np.array(words, dtype="S5").astype(np.int64) if words else np.zeros(0, np.int64)
        if len(samples) and samples.max() > maxval:
            raise _ImageError(f"damaged: a sample of {int(samples.max())} where maxval is {maxval}")
    if len(samples) < count:
        raise _ImageError("the file is truncated")
    return samples.astype(np.uint8 if maxval < 256 else np.uint16)


def _others(data: bytes) -> np.ndarray:
    """What OpenCV reads: png, bmp, jpg, tiff."""
    import cv2

    size = _declared_size(data)
    if size is not None:
        _check_size(*size)
    # OpenCV fills the missing rows of a truncated file, and those of a damaged one, without a word.
    if data[:8] == _PNG:
        _check_png(data)
    if data[:2] == b"\xff\xd8" and b"\xff\xd9" not in data[-1024:]:
        raise _ImageError("the file is truncated")
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if data else None
    except (cv2.error, MemoryError):
        image = None
    if image is None or image.size == 0:
        raise _ImageError("not an image, or damaged")
    _check_size(image.shape[1], image.shape[0])
    if image.dtype == np.uint8:
        return image
    values = image.astype(np.float32)
    full = {"uint16": 65_535.0, "float32": 1.0, "float64": 1.0}.get(str(image.dtype))
    if full is None or not np.isfinite(values).all():
        raise _ImageError(f"samples of {image.dtype} that are no brightness")
    return values * np.float32(255.0 / full)


def _check_png(data: bytes) -> None:
    """Every chunk of a png has a checksum; the last is IEND."""
    position = 8
    while position + 12 <= len(data):
        length = int.from_bytes(data[position : position + 4])
        end = position + 8 + length
        if end + 4 > len(data):
            break
        if zlib.crc32(data[position + 4 : end]) != int.from_bytes(data[end : end + 4]):
            raise _ImageError("damaged: a checksum is wrong")
        if data[position + 4 : position + 8] == b"IEND":
            return
        position = end + 4
    raise _ImageError("the file is truncated")


def _declared_size(data: bytes) -> tuple[int, int] | None:
    """Width and height by the header of a png, bmp or jpg, before it is unpacked; None: another format."""
    try:
        if data[:8] == _PNG:
            return struct.unpack(">II", data[16:24])
        if data[:2] == b"BM":
            width, height = struct.unpack("<ii", data[18:26])
            return width, abs(height)
        if data[:2] == b"\xff\xd8":
            position = 2
            while position < len(data):
                marker, length = data[position + 1], struct.unpack(">H", data[position + 2 : position + 4])[0]
                if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
                    height, width = struct.unpack(">HH", data[position + 5 : position + 9])
                    return width, height
                position += 2 + max(length, 2)
    except (struct.error, IndexError) as error:
        raise _ImageError("the file is truncated") from error
    return None
