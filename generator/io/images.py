"""Images to bytes and back. The same pixels give the same bytes.

Every encoder and decoder works on one image; arrays are (H, W) or (H, W, 3), rows first, RGB.

| image              | file         | a pixel's value                                   | 0 means          |
|--------------------|--------------|---------------------------------------------------|------------------|
| rgb                | 8-bit PNG    | sRGB (or JPEG)                                    |                  |
| depth              | 16-bit PNG   | z / depth_scale, rounded                          | no depth         |
| mask               | 8-bit PNG    | 255 inside                                        | outside          |
| normals            | 16-bit RGB   | 32768 + 32767 n: x red, y green, z blue           | no surface       |
| object coordinates | 16-bit RGB   | 32768 + p / 0.02 mm: x red, y green, z blue       | no object        |
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from synthetless.errors import UserError
from synthetless.extras import MissingExtraError, cv2

COORDINATE_SCALE_MM = 0.02
"""Object coordinates are stored in steps of this size, so the rounding error is at most 0.01 mm."""

_UINT16_MAX = 65535
_ZERO = 32768
_NORMAL_SCALE = 32767
_COORDINATE_LIMIT_MM = COORDINATE_SCALE_MM * _NORMAL_SCALE

# Run-length coding is as small as full deflate on noisy renders, at a third of the time. Masks are written once and
# read by every epoch, export and check: deflate and the search for the best filter, which OpenCV leaves out where no
# level is given, cost 2 ms more to write and a third of the time to read. Depth and coordinates are smooth, where
# deflate's search for repetitions pays.
_COMPRESSION, _STRATEGY, _DEFAULT, _RLE = 16, 17, 0, 3  # OpenCV's IMWRITE_PNG_...
_RUNS = (_COMPRESSION, 1, _STRATEGY, _RLE)
_QUICK_TO_READ = (_COMPRESSION, 1, _STRATEGY, _DEFAULT)
_DEFLATE = (_COMPRESSION, 3)


class DamagedImageError(UserError):
    """A file that cannot be decoded: cut off, damaged, or no image at all."""


def max_depth_mm(depth_scale: float) -> float:
    """The largest depth that a 16-bit depth image can hold, 6553.5 mm for the scale 0.1."""
    return _UINT16_MAX * depth_scale


def encode_png(rgb: NDArray[np.uint8]) -> bytes:
    """An (H, W, 3) uint8 sRGB image as PNG."""
    _require(rgb, np.uint8, channels=3)
    return _encode(".png", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), _RUNS)


def encode_jpeg(rgb: NDArray[np.uint8], quality: int) -> bytes:
    """An (H, W, 3) uint8 sRGB image as JPEG of quality 1..100.

    Raises:
        UserError: the quality is out of range.
    """
    _require(rgb, np.uint8, channels=3)
    if not 1 <= quality <= 100:
        raise UserError(f"JPEG quality {quality} is out of range; give 1..100")
    return _encode(".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), (cv2.IMWRITE_JPEG_QUALITY, quality))


def encode_depth(depth_mm: NDArray[np.float64], depth_scale: float) -> bytes:
    """Depth as 16-bit PNG: png value x depth_scale = millimetres, off by at most half a depth_scale.

    What lies beyond ``max_depth_mm`` (the table near the horizon) is stored as 0, no depth, as a sensor out of
    its range reports it; a value clipped to the limit would be wrong without saying so.

    Args:
        depth_mm: (H, W), 0 where there is no depth.
        depth_scale: millimetres per unit of the image.

    Raises:
        UserError: a depth is negative or not finite.
    """
    if not (np.isfinite(depth_mm).all() and (depth_mm >= 0).all()):
        bad = depth_mm[~(np.isfinite(depth_mm) & (depth_mm >= 0))][0]
        raise UserError(f"depth {bad} mm cannot be stored; depths are finite and >= 0, with 0 for none")
    return _encode(".png", _depth_units(depth_mm, depth_scale), _DEFLATE)


def has_depth(depth_mm: NDArray[np.float64], depth_scale: float) -> NDArray[np.bool_]:
    """(H, W) where a depth image of these depths holds any: what is too far, or rounds to 0, it does not hold."""
    return _depth_units(depth_mm, depth_scale) > 0


def encode_mask(mask: NDArray[np.bool_]) -> bytes:
    """An (H, W) bool mask as 8-bit PNG of 0 and 255."""
    return _encode(".png", mask.astype(np.uint8) * np.uint8(255), _QUICK_TO_READ)


def encode_normals(normals: NDArray[np.floating[Any]]) -> bytes:
    """(H, W, 3) unit normals, camera frame, as 16-bit RGB PNG; zero vectors (no surface) become 0.

    A component is off by at most 1.6e-5, an angle by 0.002 degrees.

    Raises:
        UserError: a component is not within -1..1.
    """
    if not (np.abs(normals) <= 1 + 1e-6).all():
        raise UserError("normals hold a component outside -1..1; unit vectors, or zero for none, are needed")
    return _encode_signed(normals * _NORMAL_SCALE, present=normals.any(axis=2))


def encode_object_coordinates(coordinates_mm: NDArray[np.floating[Any]], present: NDArray[np.bool_]) -> bytes:
    """Model coordinates of the surface behind each pixel, as 16-bit RGB PNG in steps of 0.02 mm.

    Args:
        coordinates_mm: (H, W, 3).
        present: (H, W), where an instance is seen; 0 is stored elsewhere.

    Raises:
        UserError: a coordinate is beyond 655 mm from the model's origin.
    """
    if not (np.abs(coordinates_mm[present]) <= _COORDINATE_LIMIT_MM).all():
        raise UserError(
            f"object coordinates beyond {_COORDINATE_LIMIT_MM:.0f} mm from the model's origin cannot be stored; "
            "leave object_coordinates out of the outputs for a model as large as this"
        )
    return _encode_signed(coordinates_mm / COORDINATE_SCALE_MM, present)


def decode_rgb(data: bytes, name: str | Path = "image") -> NDArray[np.uint8]:
    """(H, W, 3) uint8 RGB of a PNG or JPEG; ``name`` is what an error calls the image.

    Raises:
        UserError: the bytes are no image, are cut off or damaged, or have another number of channels or bits.
    """
    image: NDArray[np.uint8] = np.ascontiguousarray(_decode(data, name, np.uint8, channels=3)[..., ::-1])
    return image


def decode_depth(data: bytes, depth_scale: float, name: str | Path = "depth image") -> NDArray[np.float64]:
    """(H, W) float64 depth in millimetres, 0 for none; errors as in ``decode_rgb``."""
    depth: NDArray[np.float64] = _decode(data, name, np.uint16, channels=1) * float(depth_scale)
    return depth


def decode_mask(data: bytes, name: str | Path = "mask") -> NDArray[np.bool_]:
    """(H, W) bool mask.

    Raises:
        UserError: as in ``decode_rgb``, or a pixel is neither 0 nor 255.
    """
    pixels = _decode(data, name, np.uint8, channels=1)
    mask: NDArray[np.bool_] = pixels == 255
    if not (mask | (pixels == 0)).all():
        raise UserError(f"{name}: holds the value {pixels[~mask & (pixels != 0)][0]}; a mask has only 0 and 255")
    return mask


def decode_normals(data: bytes, name: str | Path = "normals") -> NDArray[np.float64]:
    """(H, W, 3) unit normals, camera frame, 0 where there is no surface; errors as in ``decode_rgb``."""
    return _decode_signed(data, name)[0] / _NORMAL_SCALE


def decode_object_coordinates(
    data: bytes, name: str | Path = "object coordinates"
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """(H, W, 3) model coordinates in millimetres and (H, W) where there are any; errors as in ``decode_rgb``."""
    values, present = _decode_signed(data, name)
    return values * COORDINATE_SCALE_MM, present


def _depth_units(depth_mm: NDArray[np.float64], depth_scale: float) -> NDArray[np.uint16]:
    units = np.rint(depth_mm / depth_scale)
    return np.where(units <= _UINT16_MAX, units, 0).astype(np.uint16)


def _encode_signed(values: NDArray[np.floating[Any]], present: NDArray[np.bool_]) -> bytes:
    shifted = np.where(present[..., None], np.rint(values) + _ZERO, 0).astype(np.uint16)
    return _encode(".png", np.ascontiguousarray(shifted[..., ::-1]), _DEFLATE)


def _decode_signed(data: bytes, name: str | Path) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    pixels = _decode(data, name, np.uint16, channels=3)[..., ::-1]
    present: NDArray[np.bool_] = pixels.any(axis=2)
    return np.where(present[..., None], pixels.astype(np.float64) - _ZERO, 0.0), present


def _encode(extension: str, image: NDArray[Any], parameters: Sequence[int]) -> bytes:
    _, encoded = cv2.imencode(extension, image, list(parameters))
    return encoded.tobytes()


def _decode(data: bytes, name: str | Path, dtype: type[np.generic], channels: int) -> NDArray[Any]:
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if data else None
    if image is None:
        raise DamagedImageError(f"{name}: not a readable image of {len(data)} bytes, cut off or damaged")
    found = 1 if image.ndim == 2 else image.shape[2]
    if image.dtype != dtype or found != channels:
        bits, expected = 8 * image.dtype.itemsize, 8 * np.dtype(dtype).itemsize
        raise UserError(f"{name}: has {found} channel(s) of {bits} bits; {channels} of {expected} are needed")
    return image


def _require(image: NDArray[Any], dtype: type[np.generic], channels: int) -> None:
    if image.dtype != dtype or image.ndim != 3 or image.shape[2] != channels:
        raise UserError(f"an image of shape {image.shape} and type {image.dtype} is not (H, W, {channels}) uint8")


def encode_exr(linear: NDArray[np.float32]) -> bytes:
    """(H, W, 3) linear light, Rec. 709 primaries, as an OpenEXR file of half floats. The same bytes every time."""
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    pixels = np.ascontiguousarray(np.clip(linear, 0, np.finfo(np.float16).max).astype(np.float16))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "image.exr"
        OpenEXR.File(header, {"RGB": pixels}).write(str(path))
        return path.read_bytes()


def read_exr(path: Path) -> NDArray[np.float32]:
    """(H, W, 3) float32 of an OpenEXR file of linear light.

    Raises:
        UserError: it is missing or damaged, holds something else, or the OpenEXR package is not installed.
    """
    from synthetless.scenes import render  # it imports all that a scene has, which few who read images need

    if not path.is_file():
        raise UserError(f"{path}: not found")
    try:
        linear = render.read_exr(path)
    except ModuleNotFoundError:
        raise MissingExtraError("OpenEXR") from None
    except (RuntimeError, KeyError, ValueError) as error:
        raise UserError(f"{path}: cannot be decoded ({' '.join(str(error).split())})") from None
    if linear.ndim != 3 or linear.shape[2] != 3 or not np.isfinite(linear).all():
        raise UserError(f"{path}: holds an image of shape {linear.shape}; three channels of finite light are needed")
    return linear
