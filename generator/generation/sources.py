"""What a dataset is made from: models, distractors and pictures, found and checked before anything is written."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from synthetless.config import BUILTIN, Recipe, RecipeError, models_folder
from synthetless.errors import UserError
from synthetless.generation.progress import Tracker
from synthetless.io.cache import Cache, digest
from synthetless.io.models import ObjectModel, load_models
from synthetless.scenes.collider import VERSION, Collider, collider, standing
from synthetless.scenes.environments import list_panoramas, load_panorama
from synthetless.scenes.sampling import Catalogue
from synthetless.scenes.settings import BoxSettings
from synthetless.scenes.spec import Mesh, Role, Standing
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
        standing: how each labelled model stands, if the recipe sets objects down.
        panoramas: names of the panoramas that light scenes, relative to ``panoramas_folder``.
        panoramas_folder: where they are; None if none are asked for.
    """

    models: Mapping[int, ObjectModel]
    distractors: Mapping[int, ObjectModel]
    photos: tuple[str, ...]
    photos_folder: Path | None
    standing: Mapping[int, Standing] = field(default_factory=dict)
    panoramas: tuple[str, ...] = ()
    panoramas_folder: Path | None = None

    @property
    def by_role(self) -> dict[Role, Mapping[int, ObjectModel]]:
        """All models, by role and object id."""
        return {"model": self.models, "distractor": self.distractors}

    @property
    def catalogue(self) -> Catalogue:
        """What a scene can be drawn from, metres."""

        def diameters(models: Mapping[int, ObjectModel]) -> dict[int, float]:
            return {obj_id: model.diameter_mm / 1000 for obj_id, model in models.items()}

        models = ((role, i, model) for role, of in self.by_role.items() for i, model in of.items())
        coloured = frozenset((role, i) for role, i, model in models if model.colours is not None)
        return Catalogue(
            diameters(self.models), diameters(self.distractors), self.photos, self.standing, self.panoramas, coloured
        )

    @property
    def scenery_digest(self) -> str:
        """SHA-256 of what surrounds the models: names and sizes of the pictures, meshes of the distractors."""
        listing = [f"distractor {obj_id} {model.digest}" for obj_id, model in self.distractors.items()]
        textures = ((obj_id, model.to_png()) for obj_id, model in self.distractors.items())
        listing += [f"texture {obj_id} {hashlib.sha256(png).hexdigest()}" for obj_id, png in textures if png]
        if self.photos_folder is not None:
            listing += [f"photo {name} {(self.photos_folder / name).stat().st_size}" for name in self.photos]
        if self.panoramas_folder is not None:
            listing += [f"panorama {name} {(self.panoramas_folder / name).stat().st_size}" for name in self.panoramas]
        return hashlib.sha256("\n".join(listing).encode()).hexdigest()


def load_sources(recipe: Recipe, tracker: Tracker | None = None) -> Sources:
    """Find and check the recipe's models and distractors, and find its pictures; the tracker is told what takes long.

    Raises:
        UserError: one of them is missing or cannot be used.
    """
    _check_room(recipe)
    colours = recipe.objects.colour != "grey"
    models = load_models(models_folder(recipe.source.models), recipe.objects.ids, colours)
    for obj_id, model in models.items():
        _check_symmetries(obj_id, model)
        if recipe.objects.colour == "model" and model.colours is None:
            raise RecipeError(
                f"objects.colour = model: {model.path} has neither vertex colours nor a texture; give one that has, "
                "leave it out with objects.ids, or set objects.colour to mixed"
            )
    distractors: Mapping[int, ObjectModel] = {}
    if recipe.objects.distractors[1] > 0:
        if recipe.source.distractors is None:
            raise RecipeError(
                f"objects.distractors = {list(recipe.objects.distractors)} needs source.distractors, a models folder"
            )
        distractors = load_models(models_folder(recipe.source.distractors), None, colours)
    _check_containers(recipe, models, distractors)
    photos_folder = None if recipe.source.textures == BUILTIN else Path(recipe.source.textures)
    panoramas_folder = None if recipe.light.environments is None else Path(recipe.light.environments)
    return Sources(
        models,
        distractors,
        () if photos_folder is None else list_photos(photos_folder),
        photos_folder,
        _standing(models, tracker) if recipe.release.upright > 0 else {},
        () if panoramas_folder is None else list_panoramas(panoramas_folder),
        panoramas_folder,
    )


def cached_collider(mesh: Mesh, cache: Cache) -> Collider:
    """A mesh as physics sees it, from the cache if it was made before.

    Raises:
        UserError: the mesh is flat.
    """
    return collider(mesh, partial(cache.arrays, "collider", digest(mesh.vertices_m, mesh.faces), VERSION))


def _standing(models: Mapping[int, ObjectModel], tracker: Tracker | None) -> dict[int, Standing]:
    cache, stands = Cache.default(), {}
    for number, (obj_id, model) in enumerate(models.items(), start=1):
        if tracker is not None:
            tracker.phase("standing models up", f"{number} of {len(models)}")
        found = standing(cached_collider(Mesh(model.vertices_mm / 1000, model.faces), cache))
        if found is None:
            raise RecipeError(
                f"release.upright: {model.path.name} has no stable face across its z axis to be set down on; "
                "choose others with objects.ids, or turn its model"
            )
        stands[obj_id] = found
    return stands


def _containers(recipe: Recipe) -> Iterator[tuple[str, BoxSettings]]:
    """The containers that the recipe asks for, with the names of their settings."""
    containers = recipe.release.container
    for kind, asked in (("box", containers.box), ("tray", containers.tray)):
        if asked.share > 0:
            yield f"release.container.{kind}", asked


def _check_containers(recipe: Recipe, *offered: Mapping[int, ObjectModel]) -> None:
    """Every object must fit between the sides, and sides must hide what lies against them."""
    largest = max((model for models in offered for model in models.values()), key=lambda model: model.diameter_mm)
    delta_mm = recipe.labels.visibility_delta_mm
    for name, asked in _containers(recipe):
        if 1000 * asked.sides_m[0] < largest.diameter_mm:
            raise RecipeError(
                f"{name}.sides_m = {list(asked.sides_m)}: {largest.path.name} has a diameter of "
                f"{largest.diameter_mm:.0f} mm and would not fit; give at least {largest.diameter_mm / 1000 + 5e-4:.3f}"
            )
        wall_mm = 1000 * asked.wall_m[0] * math.cos(math.radians(asked.slope_deg[1]))
        if wall_mm <= delta_mm:
            raise RecipeError(
                f"{name}.wall_m = {list(asked.wall_m)}: labels.visibility_delta_mm = {delta_mm:g} counts as visible "
                f"what is behind sides as thin as {wall_mm:.1f} mm; give thicker ones, or a smaller delta"
            )


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


def check_pictures(sources: Sources, tracker: Tracker) -> None:
    """Decode every photograph and panorama once, so that a damaged one is found before the run, not in its middle.

    Raises:
        UserError: one cannot be decoded.
    """
    if sources.photos_folder is not None:
        for number, name in enumerate(sources.photos, start=1):
            tracker.phase("checking textures", f"{number} of {len(sources.photos)}")
            load_photo(sources.photos_folder, name)
    if sources.panoramas_folder is not None:
        for number, name in enumerate(sources.panoramas, start=1):
            tracker.phase("checking panoramas", f"{number} of {len(sources.panoramas)}")
            load_panorama(sources.panoramas_folder, name)


def _check_symmetries(obj_id: int, model: ObjectModel) -> None:
    try:
        SymmetryGroup.from_bop(model.info)
    except ValueError as error:
        raise UserError(f"{model.path.parent / 'models_info.json'}: object {obj_id}: {error}") from None
