"""A folder of photographs as textures (DTD, ambientCG, Poly Haven or the user's own)."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from synthetless.errors import UserError
from synthetless.extras import cv2

SUFFIXES = (".jpg", ".jpeg", ".png")

JPEG_START, JPEG_SCAN, JPEG_END = b"\xff\xd8\xff", b"\xff\xda", b"\xff\xd9"
PNG_START, PNG_END = b"\x89PNG", b"IEND"


def list_photos(folder: Path) -> tuple[str, ...]:
    """All JPEG and PNG files below a folder, as sorted relative paths with forward slashes.

    Every image counts, normal and roughness maps too: keep those elsewhere. Hidden files are left out.

    Raises:
        UserError: the folder is missing or holds no image.
    """
    if not folder.is_dir():
        raise UserError(f"textures folder {folder}: not a folder; give one with .jpg or .png photographs")
    names = files_below(folder, SUFFIXES)
    if not names:
        raise UserError(f"textures folder {folder}: no {', '.join(SUFFIXES)} file in it or below")
    return names


def files_below(folder: Path, suffixes: Collection[str]) -> tuple[str, ...]:
    """Files with one of these suffixes, as sorted relative paths with forward slashes; hidden ones are left out."""
    found = (path.relative_to(folder) for path in folder.rglob("*") if path.suffix.lower() in suffixes)
    return tuple(sorted(path.as_posix() for path in found if not any(part.startswith(".") for part in path.parts)))


def load_photo(folder: Path, file: str, max_size_px: int = 2048) -> NDArray[np.uint8]:
    """(H, W, 3) RGB, sRGB, neither side longer than max_size_px. Not necessarily seamless.

    16-bit images are reduced to 8 bits, grey ones become RGB, alpha is dropped.

    Raises:
        UserError: the file cannot be read, is cut short, or is no image.
    """
    path = folder / file
    try:
        data = path.read_bytes()
    except OSError as error:
        raise UserError(f"texture {path}: cannot be read ({error.strerror})") from error
    if _cut_short(data):
        raise UserError(f"texture {path}: cut short after {len(data)} bytes; replace or remove it")
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    except cv2.error:
        image = None
    if image is None:
        raise UserError(f"texture {path}: cannot be decoded as an image; replace or remove it")
    return _limited(np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8), max_size_px)


def _cut_short(data: bytes) -> bool:
    """Whether a JPEG or PNG file lacks its end: OpenCV decodes what there is and leaves the rest grey or black."""
    if data.startswith(PNG_START):
        return PNG_END not in data
    # the end after the last scan, because a thumbnail in the header has a start and an end of its own
    return data.startswith(JPEG_START) and data.find(JPEG_END, max(data.rfind(JPEG_SCAN), 0)) < 0


def _limited(image: NDArray[np.uint8], max_size_px: int) -> NDArray[np.uint8]:
    height, width = image.shape[:2]
    scale = max_size_px / max(height, width)
    if scale >= 1:
        return image
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
