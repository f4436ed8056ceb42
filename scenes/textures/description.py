"""What covers the table, as pure data: a few words in the scene's record from which the image comes back."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from synthetless.errors import UserError
from synthetless.scenes.textures.families import FAMILIES, paint


@dataclass(frozen=True)
class ProceduralTexture:
    """A built-in texture.

    Attributes:
        family: one of FAMILIES.
        seed: 0 <= seed < 2**63; colours and structure follow from it.
    """

    family: str
    seed: int

    def __post_init__(self) -> None:
        if self.family not in FAMILIES:
            near = difflib.get_close_matches(str(self.family), FAMILIES, n=1)
            hint = f"did you mean {near[0]}?" if near else f"known are {', '.join(FAMILIES)}"
            raise UserError(f"no texture family {self.family!r}: {hint}")
        if not isinstance(self.seed, int) or not 0 <= self.seed < 2**63:
            raise UserError(f"texture seed {self.seed!r}: must be an integer of 0 .. 2**63 - 1")

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


@dataclass(frozen=True)
class PhotoTexture:
    """A photograph; `file` is its path relative to the textures folder, with forward slashes."""

    file: str

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


Texture = ProceduralTexture | PhotoTexture


def texture_from_json(record: Mapping[str, Any]) -> Texture:
    """The texture that `to_json` recorded.

    Raises:
        UserError: other keys than {family, seed} or {file}, an unknown family, a seed out of range.
    """
    if set(record) == {"file"} and isinstance(record["file"], str):
        return PhotoTexture(record["file"])
    if set(record) == {"family", "seed"}:
        return ProceduralTexture(record["family"], record["seed"])
    raise UserError(f"not a texture: {dict(record)!r}; must be {{family, seed}} or {{file}}")


def sample_texture(rng: np.random.Generator, photos: Sequence[str] = (), families: Sequence[str] = FAMILIES) -> Texture:
    """A photograph where any are given, else a built-in texture; uniform over photos or over families.

    Raises:
        UserError: neither photos nor families given, or an unknown family.
    """
    if photos:
        return PhotoTexture(photos[int(rng.integers(len(photos)))])
    if not families:
        raise UserError("no texture to choose from: give at least one photograph or family")
    family = families[int(rng.integers(len(families)))]
    return ProceduralTexture(family, int(rng.integers(2**63)))


def procedural_image(texture: ProceduralTexture, size_px: int = 1024) -> NDArray[np.uint8]:
    """(size_px, size_px, 3) sRGB image, seamless in both directions, meant to cover 0.3 to 1 m.

    The same texture gives the same bytes, and at another size the same pattern.

    Raises:
        UserError: size_px is below 64.
    """
    if size_px < 64:
        raise UserError(f"texture size {size_px} px: must be at least 64")
    return paint(texture.family, texture.seed, size_px)
