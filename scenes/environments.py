"""A folder of panoramas: light from all around, as a mirror ball or a panoramic camera took it.

A panorama is a picture in equirectangular projection, twice as wide as high, of linear light: its columns are azimuths,
its rows elevations from the zenith down. Needs NumPy and OpenCV, for OpenEXR files also OpenEXR.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from synthetless.errors import UserError
from synthetless.extras import cv2
from synthetless.scenes.srgb import LUMINANCE_WEIGHTS
from synthetless.scenes.textures.photos import files_below

SUFFIXES = (".hdr", ".exr")
_WIDEST_PX = 2048
"""A panorama is reduced to this width: mirrors and the horizon show it at about the resolution of an image."""

Light = NDArray[np.float32]


def list_panoramas(folder: Path) -> tuple[str, ...]:
    """All HDR and EXR files below a folder, as sorted relative paths with forward slashes; hidden files are left out.

    Raises:
        UserError: the folder is missing or holds none.
    """
    if not folder.is_dir():
        raise UserError(f"light.environments {folder}: not a folder; give one with .hdr or .exr panoramas")
    names = files_below(folder, SUFFIXES)
    if not names:
        raise UserError(f"light.environments {folder}: no {' or '.join(SUFFIXES)} file in it or below")
    return names


def load_panorama(folder: Path, file: str) -> Light:
    """(H, 2 H, 3) linear light, Rec. 709 primaries, zenith on top, at most 2048 pixels wide.

    It is scaled so that a white matte surface that faces the zenith has the luminance 1 under it.

    Raises:
        UserError: the file cannot be read, is no picture of linear light, not twice as wide as high, or holds numbers
            that are no light.
    """
    path = folder / file
    if not path.is_file():
        raise UserError(f"panorama {path}: not found")
    light = _read_exr(path) if path.suffix.lower() == ".exr" else _read_hdr(path)
    height, width = light.shape[:2]
    if width != 2 * height:
        raise UserError(f"panorama {path}: has {width} x {height} pixels; one that is twice as wide as high is needed")
    if not (np.isfinite(light).all() and (light >= 0).all()):
        raise UserError(f"panorama {path}: holds pixels that are negative or no finite numbers; linear light is needed")
    if width > _WIDEST_PX:
        light = np.asarray(cv2.resize(light, (_WIDEST_PX, _WIDEST_PX // 2), interpolation=cv2.INTER_AREA), np.float32)
    brightness = sky_brightness(light)
    if not brightness > 0:
        raise UserError(f"panorama {path}: is black above the horizon; it gives no light")
    return light / np.float32(brightness)


def sky_brightness(panorama: Light) -> float:
    """Luminance of a white matte surface that faces the zenith: 1 / pi of its irradiance.

    A row at elevation e stands for the solid angle 2 pi cos(e) de, and reaches the surface at sin(e).
    """
    rows = len(panorama)
    edges = np.clip(np.pi / 2 - np.pi * np.arange(rows + 1) / rows, 0, None)  # what is below the horizon adds nothing
    weights = np.sin(edges[:-1]) ** 2 - np.sin(edges[1:]) ** 2
    luminance = panorama.mean(axis=1, dtype=np.float64) @ LUMINANCE_WEIGHTS.astype(np.float64)
    return float(weights @ luminance)


def _read_hdr(path: Path) -> Light:
    """A Radiance file. OpenCV tells by the content what a file is, and decodes a misnamed PNG as such."""
    talkative = cv2.setLogLevel(0)  # of a damaged file it would print lines of its own
    try:
        content = np.frombuffer(path.read_bytes(), np.uint8)
        image = cv2.imdecode(content, cv2.IMREAD_UNCHANGED) if len(content) else None
    except OSError as error:
        raise UserError(f"panorama {path}: cannot be read ({error.strerror})") from None
    except cv2.error:
        image = None
    finally:
        cv2.setLogLevel(talkative)
    if image is None:
        raise UserError(f"panorama {path}: cannot be decoded as a Radiance file (.hdr); replace or remove it")
    if image.dtype != np.float32 or image.ndim != 3:
        raise UserError(
            f"panorama {path}: holds an ordinary picture of {8 * image.dtype.itemsize} bits, not a Radiance file of "
            "linear light, whatever its name says"
        )
    return np.ascontiguousarray(image[..., ::-1])


def _read_exr(path: Path) -> Light:
    try:
        import OpenEXR
    except ModuleNotFoundError:
        raise UserError(f"panorama {path}: reading it needs OpenEXR; install synthetless[blender]") from None
    try:
        with OpenEXR.File(str(path)) as content:
            channels = content.channels()
            found = next((channels[name].pixels for name in ("RGB", "RGBA") if name in channels), None)
            names = ", ".join(channels)
    except (RuntimeError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise UserError(f"panorama {path}: cannot be decoded as an OpenEXR file ({reason})") from None
    if found is None:
        raise UserError(f"panorama {path}: has the channels {names}; R, G and B are needed")
    return np.ascontiguousarray(found[..., :3], dtype=np.float32)
