"""What covers the table: built-in procedural textures, or photographs from a folder. Nothing here needs Blender."""

from synthetless.scenes.textures.description import (
    PhotoTexture,
    ProceduralTexture,
    Texture,
    procedural_image,
    sample_texture,
    texture_from_json,
)
from synthetless.scenes.textures.families import FAMILIES
from synthetless.scenes.textures.photos import list_photos, load_photo
from synthetless.scenes.textures.seamless import seamless

__all__ = [
    "FAMILIES",
    "PhotoTexture",
    "ProceduralTexture",
    "Texture",
    "list_photos",
    "load_photo",
    "procedural_image",
    "sample_texture",
    "seamless",
    "texture_from_json",
]
