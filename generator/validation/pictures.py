"""Image files: whole, readable, of the camera's size."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from synthetless.io.files import read_bytes
from synthetless.io.images import decode_rgb
from synthetless.validation.report import Finding, Kind, bare

_PNG, _JPEG, _EXR = b"\x89PNG\r\n\x1a\n", b"\xff\xd8", b"\x76\x2f\x31\x01"
_JPEG_END = b"\xff\xd9"
_PLAIN_RGB = (8, 2, 0, 0, 0)
"""The end of a PNG's header: 8 bits, RGB, and no interlacing."""
_LAST_FILTER = 4

Decoder = Callable[[bytes, Path], NDArray[Any]]


class Pictures:
    """Reads the files of one image and keeps what is wrong with them.

    A file whose bytes were read before, as those of the two masks of an instance that nothing hides, is not decoded
    again.
    """

    def __init__(self, im_id: int, shape: tuple[int, int]) -> None:
        """Begin with the image ``im_id``; ``shape`` is its rows and columns."""
        self._im_id, self._shape = im_id, shape
        self._decoded: dict[tuple[Decoder, bytes], NDArray[Any]] = {}
        self.findings: list[Finding] = []

    def read(self, path: Path, decode: Decoder, gt_id: int | None = None) -> NDArray[Any] | None:
        """An image, or None if it is missing, which the listing of the files tells, or unusable."""
        if not path.exists():
            return None
        data = read_bytes(path)
        fault = container_fault(data)
        if fault:
            self._fault("unreadable", path, fault, gt_id)
            return None
        key = decode, data
        if key not in self._decoded:
            try:
                self._decoded[key] = decode(data, path)
            except ValueError as error:
                self._fault("picture", path, bare(error, path), gt_id)
                return None
        pixels = self._decoded[key]
        if pixels.shape[:2] != self._shape:
            (rows, columns), (height, width) = pixels.shape[:2], self._shape
            self._fault("picture", path, f"is {columns}x{rows} pixels; {width}x{height} are expected", gt_id)
            return None
        return pixels

    def _fault(self, kind: Kind, path: Path, message: str, gt_id: int | None) -> None:
        self.findings.append(Finding(kind, path, message, self._im_id, gt_id))


def container_fault(data: bytes) -> str | None:
    """Why a file is no whole PNG, JPEG or OpenEXR file, as far as that shows without decoding it; None if it is one.

    PNG: every chunk is there with its checksum (https://www.w3.org/TR/png/#5Chunk-layout).
    """
    if not data:
        return "is empty: zero bytes"
    if data.startswith(_PNG):
        return _png_fault(data)
    if data.startswith(_JPEG):
        return None if data.endswith(_JPEG_END) else f"is cut off: a JPEG of {len(data)} bytes without its end marker"
    return None if data.startswith(_EXR) else f"begins with {data[:4]!r}: no PNG, JPEG or OpenEXR file"


def check_rgb(path: Path, im_id: int, shape: tuple[int, int]) -> Iterator[Finding]:
    """Whether a colour image of 8 bits and this many rows and columns can be decoded."""
    if not path.exists():
        return
    data = read_bytes(path)
    fault = container_fault(data)
    if fault:
        yield Finding("unreadable", path, fault, im_id)
    elif data.startswith(_PNG):
        fault = _pixels_fault(data, shape)
        if fault:
            yield Finding("picture", path, fault, im_id)
    else:
        pictures = Pictures(im_id, shape)
        pictures.read(path, decode_rgb)
        yield from pictures.findings


def check_exr(path: Path, im_id: int, shape: tuple[int, int]) -> Iterator[Finding]:
    """Decode a linear image; where the OpenEXR package is not installed, only look whether it is one."""
    if not path.exists():
        return
    fault = container_fault(read_bytes(path))
    if fault:
        yield Finding("unreadable", path, fault, im_id)
        return
    try:
        import OpenEXR
    except ImportError:
        return
    try:
        with OpenEXR.File(str(path)) as content:
            pixels = np.asarray(content.channels()["RGB"].pixels)
    except (RuntimeError, KeyError, ValueError) as error:
        yield Finding("unreadable", path, f"cannot be decoded ({' '.join(str(error).split())})", im_id)
        return
    if pixels.shape != (*shape, 3):
        yield Finding("picture", path, f"has shape {pixels.shape}; {(*shape, 3)} is expected", im_id)
    elif not np.isfinite(pixels).all():
        yield Finding("picture", path, "holds values that are not finite", im_id)


def _png_fault(data: bytes) -> str | None:
    name, end = b"", len(_PNG)
    for name, start, end in _chunks(data):
        label = name.decode("latin-1")
        if end > len(data):
            return f"is cut off inside its {label} chunk, after {len(data)} bytes"
        if zlib.crc32(data[start - 4 : end - 4]) != int.from_bytes(data[end - 4 : end]):
            return f"is damaged: the checksum of its {label} chunk is wrong"
    if name != b"IEND":
        return f"is cut off after {len(data)} bytes: it has no end chunk"
    return None if end == len(data) else f"has {len(data) - end} bytes after its end"


def _chunks(data: bytes) -> Iterator[tuple[bytes, int, int]]:
    """Name of each chunk of a PNG, where its content starts, and where its checksum ends."""
    at, name = len(_PNG), b""
    while name != b"IEND" and at + 8 <= len(data):
        start, name = at + 8, data[at + 4 : at + 8]
        at = start + int.from_bytes(data[at : at + 4]) + 4
        yield name, start, at


def _pixels_fault(data: bytes, shape: tuple[int, int]) -> str | None:
    """Why a whole PNG is no colour image of 8 bits and this shape, if it is none.

    What inflates to one valid filter number and all pixels for each row can be decoded; undoing the filters, which is
    most of a decoder's work, cannot fail (https://www.w3.org/TR/png/#4Concepts.EncodingFiltering).
    """
    height, width = shape
    header = data[len(_PNG) + 8 : len(_PNG) + 21]
    size = int.from_bytes(header[:4]), int.from_bytes(header[4:8])
    if size != (width, height):
        return f"is {size[0]}x{size[1]} pixels; {width}x{height} are expected"
    if tuple(header[8:]) != _PLAIN_RGB:
        return f"has {header[8]} bits, colour type {header[9]}, interlacing {header[12]}; plain RGB of 8 bits is needed"
    packed = b"".join(data[start : end - 4] for name, start, end in _chunks(data) if name == b"IDAT")
    try:
        rows = np.frombuffer(zlib.decompress(packed, bufsize=height * (3 * width + 1)), np.uint8)
    except zlib.error as error:
        return f"cannot be decoded ({error})"
    if rows.size != height * (3 * width + 1) or rows[:: 3 * width + 1].max() > _LAST_FILTER:
        return f"cannot be decoded: it holds {rows.size} bytes for {height} rows of {width} pixels"
    return None
