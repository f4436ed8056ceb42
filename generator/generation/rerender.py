"""Renders a recorded image again, from its record alone."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from synthetless.annotation.scene import MM_PER_M, scene_caster, scene_guides
from synthetless.config import BUILTIN, Recipe, models_folder
from synthetless.dataset.layout import DATASET_FILE, MODELS_FOLDER, ScenePaths
from synthetless.dataset.reader import read_recipe, read_specs
from synthetless.dataset.store import refuse_former_denoiser
from synthetless.errors import UserError
from synthetless.io.color import picture
from synthetless.io.files import read_json
from synthetless.io.models import ObjectModel, load_models
from synthetless.scenes.render import BlenderSession
from synthetless.scenes.spec import Mesh, Role, SceneSpec


def render_again(dataset: Path, scene_id: int, im_id: int, textures: Path | None = None) -> NDArray[np.uint8]:
    """Render one recorded image.

    Args:
        dataset: the dataset's folder.
        scene_id: its scene folder's number.
        im_id: the image's id in it.
        textures: folder of the photographs, if it has moved since.

    Returns:
        (H, W, 3) sRGB, equal to the stored PNG pixel by pixel.

    Raises:
        UserError: there is no such image, a file that it needs is missing, or it was made with a denoiser that is gone.
    """
    recipe = read_recipe(dataset)
    refuse_former_denoiser(dataset / DATASET_FILE, read_json(dataset / DATASET_FILE))
    paths = ScenePaths.of(dataset, scene_id, recipe.split)
    recorded = read_specs(paths)
    if im_id not in recorded:
        known = f"{min(recorded)}..{max(recorded)}" if recorded else "none"
        raise UserError(f"{paths.scene_spec}: no image {im_id}; it records images {known}")
    image = recorded[im_id]
    if textures is None and recipe.source.textures != BUILTIN:
        textures = Path(recipe.source.textures)
    panoramas = None if recipe.light.environments is None else Path(recipe.light.environments)
    models = _models(dataset, recipe, image.scene)
    meshes = {
        (role, i): Mesh(model.vertices_mm / MM_PER_M, model.faces, colours=model.colours)
        for role, of in models.items()
        for i, model in of.items()
    }
    session = BlenderSession(meshes, recipe.intrinsics, recipe.render, recipe.table, textures, panoramas=panoramas)
    with session.scene(image.scene, image.settled) as scene:
        guides = partial(
            scene_guides, scene_caster(models), recipe, image.scene, image.settled, image.view, scene.texture
        )
        linear = scene.render(image.view, guides)
        return picture(linear, image.exposure_gain, image.sensor, recipe.render.shoulder)


def _models(dataset: Path, recipe: Recipe, scene: SceneSpec) -> Mapping[Role, Mapping[int, ObjectModel]]:
    """Those that the scene shows, by role and object id."""
    folders: dict[Role, Path] = {"model": dataset / MODELS_FOLDER}
    if recipe.source.distractors is not None:
        folders["distractor"] = models_folder(recipe.source.distractors)
    models: dict[Role, Mapping[int, ObjectModel]] = {}
    for role, folder in folders.items():
        ids = tuple({item.obj_id for item in scene.objects if item.role == role})
        colours = any(item.role == role and item.material.colour == "model" for item in scene.objects)
        models[role] = load_models(folder, ids, colours) if ids else {}
    return models
