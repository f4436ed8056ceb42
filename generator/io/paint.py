"""The paint of a mesh's faces: the colours and pictures that materials of OBJ and GLB files name, in one texture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from synthetless.scenes.srgb import linear_of_levels, srgb_from_linear
from synthetless.scenes.textures import load_photo

Picture = NDArray[np.uint8]

_LARGEST_PX = 4096
_SWATCH_PX = 8
_BEYOND = 1e-3
"""Texture coordinates so little outside 0..1 are rounding."""


class PaintFault(Exception):
    """What is wrong with the paint of a file, in one line without its name."""


@dataclass(frozen=True, eq=False)
class Paint:
    """What a material looks like: a picture (H, W, 3), sRGB, or one colour."""

    rgb: tuple[int, int, int] = (255, 255, 255)
    picture: Picture | None = None


def read_picture(folder: Path, name: str) -> Picture:
    """The picture that a file in a folder names.

    Raises:
        PaintFault: it is not there.
        UserError: it cannot be decoded.
    """
    if not (folder / name).is_file():
        raise PaintFault(f"names the texture {name}, which is not there")
    return load_photo(folder, name, _LARGEST_PX)


def read_mtl(folder: Path, name: str) -> Mapping[str, Paint]:
    """The paint of each material of an MTL file: its map_Kd, else its Kd, taken as displayed.

    Raises:
        PaintFault: it cannot be read, a colour is not three numbers, or a texture is not there.
        UserError: a texture cannot be decoded.
    """
    try:
        lines = (folder / name).read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        raise PaintFault(f"names the materials {name}, which are not there") from None
    paints: dict[str, Paint] = {}
    material = ""
    for number, line in enumerate(lines, start=1):
        key, _, value = line.strip().partition(" ")
        words = value.split()
        if key == "newmtl":
            material = value.strip()
            paints[material] = Paint()
        elif key in {"Kd", "map_Kd"} and not paints:
            raise PaintFault(f"line {number} of {name}: {key} before any newmtl")
        elif key == "Kd" and paints[material].picture is None:
            try:
                red, green, blue = (round(255 * min(max(float(word), 0.0), 1.0)) for word in words)
            except ValueError:
                raise PaintFault(f"line {number} of {name}: Kd {value.strip()[:40]!r} is not three numbers") from None
            paints[material] = Paint((red, green, blue))
        elif key == "map_Kd" and words:
            options = words[0].startswith("-")  # such as -s 1 1 1; then the name, which has no spaces, comes last
            named = words[-1] if options else value.strip()
            paints[material] = Paint(picture=read_picture((folder / name).parent, named.replace("\\", "/")))
    return paints


def linear_factor(rgb: Sequence[float], picture: Picture | None) -> Paint:
    """The paint of a glTF material: a colour in linear light, which a picture is multiplied by."""
    factor = np.clip(np.asarray(rgb, dtype=np.float64)[:3], 0, 1)
    if picture is not None and (factor < 1).any():
        picture = np.rint(255 * srgb_from_linear(linear_of_levels()[picture] * factor)).astype(np.uint8)
    red, green, blue = np.rint(255 * srgb_from_linear(factor)).astype(int).tolist()
    return Paint((red, green, blue), picture)


def one_texture(
    paints: Sequence[Paint], paint_of: NDArray[np.int64], corner_uv: NDArray[np.float32]
) -> tuple[Picture, NDArray[np.float32]]:
    """One texture for all faces.

    Args:
        paints: that faces have.
        paint_of: (F,) number of each face's paint.
        corner_uv: (F, 3, 2) place in its own picture, NaN where there is none.

    Returns:
        The texture, and the places (F, 3, 2) in it. Several pictures are put one above the other.

    Raises:
        PaintFault: a face has a picture, but no place in it; or it repeats one of several pictures.
    """
    used = np.unique(paint_of)
    pictures = {k: picture for k in used.tolist() if (picture := paints[k].picture) is not None}
    has_picture = np.isin(paint_of, list(pictures))
    if not np.isfinite(corner_uv[has_picture]).all():
        raise PaintFault("has a texture, but faces without texture coordinates")
    if len(used) == len(pictures) == 1:
        return pictures[int(used[0])], corner_uv
    uv = np.where(has_picture[:, None, None], corner_uv, np.float32(0.5))
    uv -= np.floor(uv.min(axis=1, keepdims=True) + _BEYOND)
    if (uv > 1 + _BEYOND).any():
        raise PaintFault("repeats one of several textures within a face; bake them into one texture")
    parts = [pictures.get(k, np.full((_SWATCH_PX, _SWATCH_PX, 3), paints[k].rgb, np.uint8)) for k in used.tolist()]
    width = max(part.shape[1] for part in parts)
    padded = [np.pad(part, ((0, 0), (0, width - part.shape[1]), (0, 0)), mode="edge") for part in parts]
    sizes = np.array([part.shape[:2] for part in parts])
    above = np.cumsum(sizes[:, 0])  # rows down to the end of each
    place = np.searchsorted(used, paint_of)
    height, wide = sizes[place].T[..., None]
    rows = sizes[:, 0].sum()
    u = np.clip(uv[..., 0] * wide, 0.5, wide - 0.5) / width  # half a texel inside: neighbours must not shine through
    v = (np.clip(uv[..., 1] * height, 0.5, height - 0.5) + (rows - above[place])[:, None]) / rows
    return np.concatenate(padded), np.stack([u, v], axis=-1).astype(np.float32)
