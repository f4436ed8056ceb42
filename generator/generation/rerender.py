"""Renders a recorded image again, from nothing but what the dataset says of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError

from synthetless.config import BUILTIN, Recipe
from synthetless.dataset.layout import DATASET_FILE, MODELS_FOLDER, ScenePaths
from synthetless.errors import UserError
from synthetless.generation.sources import models_folder
from synthetless.io.color import develop
from synthetless.io.files import read_json, read_json_lines
from synthetless.io.models import ObjectModel, load_models
from synthetless.scenes.render import BlenderSession
from synthetless.scenes.spec import Mesh, Pose, Role, SceneSpec


@dataclass(frozen=True)
class RecordedImage:
    """One line of scene_spec.jsonl.

    Attributes:
        image_id: BOP image id within its scene folder.
        view: which of the scene's views it shows.
        exposure_gain: what the linear image was multiplied by.
        instances: number in ``scene.objects`` of each labelled instance, in scene_gt's order.
        scene: what was built.
        settled: pose of each object at rest.
    """

    image_id: int
    view: int
    exposure_gain: float
    instances: tuple[int, ...]
    scene: SceneSpec
    settled: tuple[Pose, ...]


def read_recipe(dataset: Path) -> Recipe:
    """The recipe that a dataset was made from.

    Raises:
        UserError: dataset.json is missing or damaged.
    """
    path = dataset / DATASET_FILE
    try:
        return Recipe.model_validate(read_json(path).get("recipe"))
    except ValidationError as error:
        raise UserError(f"{path}: its recipe is damaged ({error.errors()[0]['msg']})") from None


def read_recorded(scene: ScenePaths) -> dict[int, RecordedImage]:
    """The recorded images of a scene folder, by image id.

    Raises:
        UserError: scene_spec.jsonl is missing or damaged.
    """
    adapter = TypeAdapter(RecordedImage)
    try:
        images = [adapter.validate_python(line) for line in read_json_lines(scene.scene_spec)]
    except ValidationError as error:
        fault = error.errors()[0]
        place = ".".join(str(part) for part in fault["loc"])
        raise UserError(f"{scene.scene_spec}: {place}: {fault['msg']}") from None
    return {image.image_id: image for image in images}


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
        UserError: there is no such image, or a file that it needs is missing.
    """
    recipe = read_recipe(dataset)
    paths = ScenePaths.of(dataset, scene_id, recipe.split)
    recorded = read_recorded(paths)
    if im_id not in recorded:
        known = f"{min(recorded)}..{max(recorded)}" if recorded else "none"
        raise UserError(f"{paths.scene_spec}: no image {im_id}; it records images {known}")
    image = recorded[im_id]
    if textures is None and recipe.source.textures != BUILTIN:
        textures = Path(recipe.source.textures)
    session = BlenderSession(
        _meshes(dataset, recipe, image.scene), recipe.intrinsics, recipe.render, recipe.table.size_m, textures
    )
    with session.scene(image.scene, image.settled) as scene:
        return develop(scene.render(image.view), image.exposure_gain)


def _meshes(dataset: Path, recipe: Recipe, scene: SceneSpec) -> Mapping[tuple[Role, int], Mesh]:
    folders: dict[Role, Path] = {"model": dataset / MODELS_FOLDER}
    if recipe.source.distractors is not None:
        folders["distractor"] = models_folder(recipe.source.distractors)
    meshes: dict[tuple[Role, int], Mesh] = {}
    for role, folder in folders.items():
        ids = tuple({item.obj_id for item in scene.objects if item.role == role})
        models: Mapping[int, ObjectModel] = load_models(folder, ids) if ids else {}
        meshes |= {(role, obj_id): Mesh(model.vertices_mm / 1000, model.faces) for obj_id, model in models.items()}
    return meshes
