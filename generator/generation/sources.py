"""What a dataset is made from: models, distractors and photographs, found and checked before anything is written."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from synthetless.config import BUILTIN, Recipe, RecipeError, models_folder
from synthetless.errors import UserError
from synthetless.generation.progress import Tracker
from synthetless.io.models import ObjectModel, load_models
from synthetless.scenes.sampling import Catalogue
from synthetless.scenes.textures import list_photos, load_photo
from synthetless.symmetry import SymmetryGroup

_BESIDE_CENTRE_M = 0.1
"""The objects' centre, which lamps and cameras are measured from, is about this far from the middle of the table."""


@dataclass(frozen=True)
class Sources:
    """What a dataset is made from, as found on disk.

    Attributes:
        models: labelled models by object id.
        distractors: unlabelled ones.
        photos: names of the photographs for the table, relative to ``photos_folder``; empty for built-in textures.
        photos_folder: where they are.
    """

    models: Mapping[int, ObjectModel]
    distractors: Mapping[int, ObjectModel]
    photos: tuple[str, ...]
    photos_folder: Path | None

    @property
    def catalogue(self) -> Catalogue:
        """What a scene can be drawn from, metres."""

        def diameters(models: Mapping[int, ObjectModel]) -> dict[int, float]:
            return {obj_id: model.diameter_mm / 1000 for obj_id, model in models.items()}

        return Catalogue(diameters(self.models), diameters(self.distractors), self.photos)

    @property
    def scenery_digest(self) -> str:
        """SHA-256 of what surrounds the models: names and sizes of the photographs, meshes of the distractors."""
        listing = [f"distractor {obj_id} {model.digest}" for obj_id, model in self.distractors.items()]
        if self.photos_folder is not None:
            listing += [f"photo {name} {(self.photos_folder / name).stat().st_size}" for name in self.photos]
        return hashlib.sha256("\n".join(listing).encode()).hexdigest()


def load_sources(recipe: Recipe) -> Sources:
    """Find and check the recipe's models, distractors and photographs.

    Raises:
        UserError: one of them is missing or cannot be used.
    """
    _check_room(recipe)
    models = load_models(models_folder(recipe.source.models), recipe.objects.ids)
    for obj_id, model in models.items():
        _check_symmetries(obj_id, model)
    distractors: Mapping[int, ObjectModel] = {}
    if recipe.objects.distractors[1] > 0:
        if recipe.source.distractors is None:
            raise RecipeError(
                f"objects.distractors = {list(recipe.objects.distractors)} needs source.distractors, a models folder"
            )
        distractors = load_models(models_folder(recipe.source.distractors))
    if recipe.source.textures == BUILTIN:
        return Sources(models, distractors, (), None)
    folder = Path(recipe.source.textures)
    return Sources(models, distractors, list_photos(folder), folder)


def _check_room(recipe: Recipe) -> None:
    """What is outside the room would be hidden by its walls."""
    room = recipe.light.room
    if room is None:
        return
    if room.side_m[0] < recipe.table.size_m:
        raise RecipeError(
            f"light.room.side_m = {list(room.side_m)}: the table, {recipe.table.size_m:g} m wide, must fit in the room"
        )
    inside_m = min(room.height_m[0], room.side_m[0] / 2) - _BESIDE_CENTRE_M
    for key, farthest_m in (
        ("camera.distance_m", recipe.camera.distance_m[1]),
        ("light.distance_m", recipe.light.distance_m[1] if recipe.light.strength[1] > 0 else 0.0),
        ("light.room.lamp_distance_m", room.lamp_distance_m[1] if room.lamps[1] > 0 else 0.0),
    ):
        if farthest_m > inside_m:
            raise RecipeError(
                f"{key} reaches {farthest_m:g} m; with light.room.height_m = {list(room.height_m)} and side_m = "
                f"{list(room.side_m)}, what is farther than {inside_m:g} m may be outside the room"
            )


def check_photos(sources: Sources, tracker: Tracker) -> None:
    """Decode every photograph once, so that a damaged one is found before the run and not in the middle of it.

    Raises:
        UserError: one cannot be decoded.
    """
    if sources.photos_folder is not None:
        for number, name in enumerate(sources.photos, start=1):
            tracker.phase("checking textures", f"{number} of {len(sources.photos)}")
            load_photo(sources.photos_folder, name)


def _check_symmetries(obj_id: int, model: ObjectModel) -> None:
    try:
        SymmetryGroup.from_bop(model.info)
    except ValueError as error:
        raise UserError(f"{model.path.parent / 'models_info.json'}: object {obj_id}: {error}") from None
