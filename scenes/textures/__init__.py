"""What covers the table: built-in procedural textures, or photographs from a folder. Nothing here needs Blender."""

from scenes.textures.description import (
    PhotoTexture,
    ProceduralTexture,
    Texture,
    procedural_image,
    sample_texture,
    texture_from_json,
)
from scenes.textures.families import FAMILIES
from scenes.textures.photos import list_photos, load_photo

__all__ = [
    "FAMILIES",
    "PhotoTexture",
    "ProceduralTexture",
    "Texture",
    "list_photos",
    "load_photo",
    "procedural_image",
    "sample_texture",
    "texture_from_json",
]
