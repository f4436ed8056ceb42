"""The files of one image: whole, readable, of the right size, and in agreement with each other and with the counts."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pycocotools import mask as coco_mask

from synthetless import extras
from synthetless.annotation.instances import NO_BOX, Box, Window, bounding_box
from synthetless.dataset.layout import ScenePaths
from synthetless.dataset.records import MIN_VISIB_FRACT, CocoAnnotation, GtInfoEntry, amodal_box, uncompressed_rle
from synthetless.errors import UserError
from synthetless.io.files import read_bytes
from synthetless.io.images import DamagedImageError, decode_mask
from synthetless.validation.report import Finding, bare

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Decoder = Callable[[bytes, Path], NDArray[Any]]

_PNG, _JPEG, _EXR, _TIFF = b"\x89PNG\r\n\x1a\n", b"\xff\xd8", b"\x76\x2f\x31\x01", (b"II*\0", b"MM\0*")
_JPEG_SCAN, _JPEG_END = b"\xff\xda", b"\xff\xd9"


_EYES = ("cv2", "embreex")


# Reading


class Pictures:
    """Reads the files of one image and keeps what is wrong with them.

    A file whose bytes were read before, as those of the two masks of an instance that nothing hides, is not decoded
    again.
    """

    def __init__(self, im_id: int | None, shape: tuple[int, int] | None) -> None:
        """Begin with the image ``im_id``; ``shape`` is its rows and columns, None if any will do."""
        self._im_id, self._shape = im_id, shape
        self._decoded: dict[tuple[Decoder, bytes], NDArray[Any]] = {}
        self.findings: list[Finding] = []

    def read(self, path: Path, decode: Decoder, gt_id: int | None = None) -> NDArray[Any] | None:
        """An image, or None if it is missing, which the listing of the files tells, or unusable."""
        if not path.exists():
            return None
        try:
            return self._read(path, decode)
        except DamagedImageError as error:
            self.findings.append(Finding("unreadable", path, bare(error, path), self._im_id, gt_id))
        except ValueError as error:
            self.findings.append(Finding("picture", path, bare(error, path), self._im_id, gt_id))
        return None

    def _read(self, path: Path, decode: Decoder) -> NDArray[Any]:
        try:
            data = read_bytes(path)
        except ValueError as error:
            raise DamagedImageError(str(error)) from None
        if fault := container_fault(data):
            raise DamagedImageError(fault)
        key = decode, data
        if key not in self._decoded:
            self._decoded[key] = decode(data, path)
        pixels = self._decoded[key]
        if self._shape is not None and pixels.shape[:2] != self._shape:
            (rows, columns), (height, width) = pixels.shape[:2], self._shape
            raise UserError(f"is {columns}x{rows} pixels; {width}x{height} are expected")
        return pixels


def can_decode_exr() -> bool:
    """Whether the OpenEXR package is installed."""
    return extras.has("OpenEXR")


def can_see() -> bool:
    """Whether what decodes images and casts rays is installed."""
    return all(extras.has(module) for module in _EYES)


def see() -> None:
    """Refuse in one line where ``can_see`` does not hold.

    Raises:
        UserError: something is not installed.
    """
    for module in _EYES:
        extras.need(module)


def not_seen() -> str:
    """The note on what is not checked where ``can_see`` does not hold."""
    return f"pictures, depth and masks were not looked at; for that, {extras.remedy('images')}"


def decode_exr(data: bytes, path: Path) -> NDArray[Any]:
    """(H, W, 3) linear light."""
    import OpenEXR

    try:
        with OpenEXR.File(str(path)) as content:
            pixels = np.asarray(content.channels()["RGB"].pixels)
    except (RuntimeError, KeyError, ValueError) as error:
        raise DamagedImageError(f"{path}: cannot be decoded ({' '.join(str(error).split())})") from None
    if pixels.ndim != 3 or pixels.shape[2] != 3 or not np.isfinite(pixels).all():
        raise UserError(f"{path}: has the shape {pixels.shape} or numbers that are not finite; RGB is needed")
    return pixels


def container_fault(data: bytes) -> str | None:
    """Why a file is no whole PNG, JPEG, TIFF or OpenEXR file, as far as that shows without decoding it; None if it is.

    PNG: every chunk is there with its checksum (https://www.w3.org/TR/png/#5Chunk-layout).
    """
    if not data:
        return "is empty: zero bytes"
    if data.startswith(_PNG):
        return _png_fault(data)
    if data.startswith(_JPEG):  # a thumbnail may come before the scan, a camera's own data behind the end
        whole = data.rfind(_JPEG_END) > data.rfind(_JPEG_SCAN)
        return None if whole else f"is cut off: a JPEG of {len(data)} bytes without its end marker"
    return None if data.startswith((_EXR, *_TIFF)) else f"begins with {data[:4]!r}: no PNG, JPEG, TIFF or OpenEXR file"


def _png_fault(data: bytes) -> str | None:
    at, name = len(_PNG), b""
    while name != b"IEND":
        name, end = data[at + 4 : at + 8], at + 12 + int.from_bytes(data[at : at + 4], "big")
        if len(name) < 4:
            return f"is cut off after {len(data)} bytes: it has no end chunk"
        label = name.decode("latin-1")
        if end > len(data):
            return f"is cut off inside its {label} chunk, after {len(data)} bytes"
        if zlib.crc32(data[at + 4 : end - 4]) != int.from_bytes(data[end - 4 : end], "big"):
            return f"is damaged: the checksum of its {label} chunk is wrong"
        at = end
    return None if at == len(data) else f"has {len(data) - at} bytes after its end"


# Masks, counts and boxes


@dataclass(frozen=True)
class Tolerance:
    """By how much counts, fractions and boxes may be off.

    Attributes:
        share, px: a count may be off by this share of it, and so many pixels.
        box_px: each side of a box.
        fraction: a visible fraction.
    """

    share: float = 0.0
    px: int = 0
    box_px: int = 0
    fraction: float = 1e-9

    def allows(self, count: int, expected: int) -> bool:
        """Whether a count is close enough."""
        return abs(count - expected) <= self.allowed(expected)

    def allowed(self, expected: int) -> float:
        """By how much a count may be off."""
        return self.px + self.share * expected

    def allows_box(self, box: Sequence[int], expected: Sequence[int]) -> bool:
        """Whether all sides of a box are close enough."""
        return self.contains(box, expected) and self.contains(expected, box)

    def contains(self, outer: Sequence[int], inner: Sequence[int]) -> bool:
        """Whether a box [x, y, w, h], grown by the tolerance, contains another; w = xmax - xmin."""
        return all(
            outer[axis] - self.box_px <= inner[axis]
            and inner[axis] + inner[axis + 2] <= outer[axis] + outer[axis + 2] + self.box_px
            for axis in (0, 1)
        )


EXACT = Tolerance()
"""For what was derived from the files themselves."""
AS_RENDERED = Tolerance(share=0.01, px=2, box_px=1, fraction=1e-4)
"""bop_toolkit renders masks and counts apart, on canvases of two sizes, and they differ in a few pixels."""


@dataclass(frozen=True, eq=False)
class InstanceMasks:
    """The masks of one instance, (H, W); None where a file is missing or unusable, or not asked for."""

    whole: Mask | None = None
    visible: Mask | None = None


def read_masks(scene: ScenePaths, im_id: int, n_instances: int, pictures: Pictures) -> list[InstanceMasks]:
    """The two mask files of every instance of an image."""
    return [
        InstanceMasks(
            pictures.read(scene.mask(im_id, gt_id), decode_mask, gt_id),
            pictures.read(scene.mask_visib(im_id, gt_id), decode_mask, gt_id),
        )
        for gt_id in range(n_instances)
    ]


def check_masks(scene: ScenePaths, im_id: int, masks: Sequence[InstanceMasks], exact: bool) -> Iterator[Finding]:
    """The visible part is part of the whole, and, if visibility is exact, no pixel shows two instances."""
    owner: NDArray[np.int16] | None = None
    for gt_id, mask in enumerate(masks):
        if mask.visible is None:
            continue
        path = scene.mask_visib(im_id, gt_id)
        if mask.whole is not None and mask.whole is not mask.visible:
            outside = int(np.count_nonzero(mask.visible & ~mask.whole))
            if outside:
                yield Finding("mask", path, f"{outside} pixels are not in the whole silhouette, mask/", im_id, gt_id)
        if exact:
            owner = np.full(mask.visible.shape, -1, dtype=np.int16) if owner is None else owner
            others = owner[mask.visible]
            if (others >= 0).any():
                shared, other = int(np.count_nonzero(others >= 0)), int(others.max())
                message = f"{shared} pixels are visible of instance {other}, too; a pixel shows one instance"
                yield Finding("mask", path, message, im_id, gt_id)
            owner[mask.visible] = gt_id


def check_info(
    info: GtInfoEntry,
    masks: InstanceMasks,
    where_depth: Mask | None,
    shape: tuple[int, int] | None,
    inside: bool,
    tolerance: Tolerance,
) -> Iterator[str]:
    """Counts, fraction and boxes of an instance against each other and, as bop_toolkit counts, against its masks.

    Args:
        info: its entry in scene_gt_info.json.
        masks: its masks, as far as there are any.
        where_depth: (H, W) where the image has depth, everywhere if depth is not asked for; None if unknown.
        shape: rows and columns of the image; None if unknown.
        inside: whether the silhouette is known not to leave the image, so that the mask has all of it.
        tolerance: what is allowed.
    """
    seen, whole = info["px_count_visib"], info["px_count_all"]
    for name, count in (("visib", seen), ("valid", info["px_count_valid"])):
        if count > whole:
            yield f"px_count_{name} {count} is more than px_count_all {whole}"
    fraction = seen / whole if whole else 0.0
    if abs(info["visib_fract"] - fraction) > tolerance.fraction:
        yield f"visib_fract is {info['visib_fract']}; {seen} of {whole} pixels are {fraction}"
    for name, box in (("bbox_obj", info["bbox_obj"]), ("bbox_visib", info["bbox_visib"])):
        if (tuple(box) == NO_BOX) != (seen == 0):
            yield f"{name} is {box}; it is [-1, -1, -1, -1] where nothing is visible, and only there"
    if shape is not None and tuple(info["bbox_obj"]) != NO_BOX:
        canvas = (-shape[1], -shape[0], 3 * shape[1] - 1, 3 * shape[0] - 1)
        if not EXACT.contains(canvas, info["bbox_obj"]):
            yield f"bbox_obj is {info['bbox_obj']}, beyond bop_toolkit's canvas of three times the image"
    if masks.visible is not None:
        yield from _recount_visible(info, masks.visible, tolerance)
    if masks.whole is not None:
        yield from _recount_whole(info, masks.whole, where_depth, inside, tolerance)


def _recount_visible(info: GtInfoEntry, visible: Mask, tolerance: Tolerance) -> Iterator[str]:
    count, box = int(np.count_nonzero(visible)), box_of(visible)
    if not tolerance.allows(info["px_count_visib"], count):
        yield f"px_count_visib is {info['px_count_visib']}; mask_visib/ has {count}"
    elif count and info["px_count_visib"] and not tolerance.allows_box(info["bbox_visib"], box):
        yield f"bbox_visib is {info['bbox_visib']}; mask_visib/ has {list(box)}"


def _recount_whole(
    info: GtInfoEntry, whole: Mask, where_depth: Mask | None, inside: bool, tolerance: Tolerance
) -> Iterator[str]:
    count, box = int(np.count_nonzero(whole)), box_of(whole)
    if where_depth is not None:
        valid = int(np.count_nonzero(whole & where_depth))
        if not tolerance.allows(info["px_count_valid"], valid):
            yield f"px_count_valid is {info['px_count_valid']}; mask/ has {valid} where there is depth"
    if (inside or info["px_count_all"] < count) and not tolerance.allows(info["px_count_all"], count):
        yield f"px_count_all is {info['px_count_all']}; mask/ has {count}"
    stated = info["bbox_obj"]
    fits = tolerance.allows_box(stated, box) if inside else tolerance.contains(stated, box)
    if tuple(stated) != NO_BOX and count and not fits:
        yield f"bbox_obj is {stated}; mask/ has {list(box)}"


def box_of(mask: Mask) -> Box:
    """[x, y, w, h] of a mask with w = xmax - xmin; NO_BOX if it is empty."""
    return bounding_box(mask, Window(0, 0, mask.shape[1], mask.shape[0]))


# COCO annotations


def check_annotation(
    annotation: CocoAnnotation, obj_id: int, info: GtInfoEntry, masks: InstanceMasks, shape: tuple[int, int]
) -> Iterator[str]:
    """An annotation of scene_gt_coco.json against its instance.

    Args:
        annotation: to check.
        obj_id: of the instance.
        info: its entry in scene_gt_info.json.
        masks: its masks, as far as there are any.
        shape: rows and columns of the image.
    """
    expected: dict[str, object] = {
        "category_id": obj_id,
        "area": info["px_count_visib"],
        "ignore": info["visib_fract"] < MIN_VISIB_FRACT,
        "iscrowd": 0,
        "height": shape[0],
        "width": shape[1],
    }
    if masks.whole is not None and masks.whole.any():
        expected["bbox"] = amodal_box(masks.whole)
    found: dict[str, object] = {**annotation}
    for name, value in expected.items():
        if found[name] != value:
            yield f"{name} is {found[name]}; {value} is expected"
    yield from _check_segmentation(annotation, info["px_count_visib"], masks.visible, shape)


def _check_segmentation(
    annotation: CocoAnnotation, n_visible: int, visible: Mask | None, shape: tuple[int, int]
) -> Iterator[str]:
    rle = annotation["segmentation"]
    if visible is not None and rle == uncompressed_rle(visible):
        return
    mask = decode_segmentation(annotation, shape)
    if mask is None:
        yield f"its run lengths do not fill an image of {list(shape)}, but {sum(rle['counts'])} pixels of {rle['size']}"
    elif visible is not None and (mask != visible).any():
        yield f"its segmentation differs from mask_visib/ in {np.count_nonzero(mask != visible)} pixels"
    elif np.count_nonzero(mask) != n_visible:
        yield f"its segmentation has {np.count_nonzero(mask)} pixels; {n_visible} are visible"


def decode_segmentation(annotation: CocoAnnotation, shape: tuple[int, int]) -> Mask | None:
    """The mask of an annotation; None if its run lengths do not fill the image."""
    rle = annotation["segmentation"]
    if tuple(rle["size"]) != shape or sum(rle["counts"]) != shape[0] * shape[1]:
        return None
    decoded: Mask = coco_mask.decode(coco_mask.frPyObjects(rle, *shape)).astype(bool)
    return decoded
