"""Makes the images of a drop: draw it, let it fall, render it, measure it, encode it.

One DropRenderer per process: it holds the Blender session, the meshes and their ray-casting trees, all loaded once.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from synthetless.annotation.scene import annotate_scene, scene_caster, scene_guides
from synthetless.config import Recipe
from synthetless.dataset.layout import ImagePlan
from synthetless.dataset.store import FinishedImage, planned_depth_sensor
from synthetless.generation.progress import COLLIDERS, DROPPING, RENDERING, Report, Stage, unreported
from synthetless.generation.sources import Sources, cached_collider
from synthetless.io.cache import Cache
from synthetless.scenes.blender import CPU, RenderDevice
from synthetless.scenes.collider import Collider
from synthetless.scenes.physics import NotSettled, PhysicsSettings, settle
from synthetless.scenes.render import BlenderScene, BlenderSession
from synthetless.scenes.sampling import sample_scene
from synthetless.scenes.spec import Mesh, Pose, Role, SceneSpec

_MM = 1000.0
ModelKey = tuple[Role, int]


class DropFailed(Exception):
    """A drop did not come to rest however often it was thrown; the message says why the last throw did not."""


class DropRenderer:
    """Turns drops into images.

    Attributes:
        session: the Blender session.
    """

    def __init__(
        self,
        recipe: Recipe,
        sources: Sources,
        threads: int = 0,
        device: RenderDevice = CPU,
        log: Path = Path(os.devnull),
    ) -> None:
        """Load everything that drops share.

        Args:
            recipe: what to make.
            sources: from what.
            threads: of the renderer; 0 uses every core.
            device: what to render on.
            log: file that takes Blender's console output.
        """
        models = {(role, obj_id): model for role, of in sources.by_role.items() for obj_id, model in of.items()}
        self._recipe = recipe
        self._catalogue = sources.catalogue
        self._meshes = {
            key: Mesh(model.vertices_mm / _MM, model.faces, colours=model.colours) for key, model in models.items()
        }
        self._colliders: dict[ModelKey, Collider] = {}
        self._cache = Cache.default()
        self._caster = scene_caster(sources.by_role)
        self.session = BlenderSession(
            self._meshes,
            recipe.intrinsics,
            recipe.render,
            recipe.table,
            sources.photos_folder,
            threads,
            device,
            log,
            sources.panoramas_folder,
        )

    def make(self, drop: int, plans: Sequence[ImagePlan], report: Report = unreported) -> Iterator[FinishedImage]:
        """Make images of one drop, one after the other.

        Args:
            drop: its number.
            plans: the images wanted of it.
            report: is told what is done, as it begins.

        Raises:
            DropFailed: it never came to rest.
            UserError: an input file became unreadable.
        """
        spec, settled = self.drop(drop, report)
        with self.session.scene(spec, settled) as scene:
            for number, plan in enumerate(plans):
                detail = f"{number + 1} of {len(plans)}" if len(plans) > 1 else ""
                report(Stage(RENDERING, detail, (1 + number) / (1 + len(plans))))  # the drop counts as an image
                yield self._image(plan, scene, settled)

    def drop(self, drop: int, report: Report = unreported) -> tuple[SceneSpec, tuple[Pose, ...]]:
        """Throw the objects until they come to rest.

        Returns:
            The scene and each object's pose at rest.

        Raises:
            DropFailed: not within the recipe's number of throws.
        """
        throws = self._recipe.release.max_throws
        physics = PhysicsSettings(crowding=self._recipe.release.crowding)
        reason = ""
        for attempt in range(throws):
            spec = sample_scene(self._recipe, self._catalogue, self._recipe.seed, drop, attempt)
            try:
                colliders = self._colliders_of(spec, report)
                report(Stage(DROPPING, f"again, throw {attempt + 1}" if attempt else ""))
                releases = [item.release for item in spec.objects]
                return spec, settle(colliders, releases, physics, spec.container).poses
            except NotSettled as failure:
                reason = str(failure)
        raise DropFailed(f"did not come to rest in {throws} throws; the last time, {reason}")

    def render(self, scene: BlenderScene, settled: Sequence[Pose], view: int) -> NDArray[np.float32]:
        """Linear image (H, W, 3) of one view of a scene, objects at rest; errors as in ``BlenderScene.render``."""
        guides = partial(scene_guides, self._caster, self._recipe, scene.spec, settled, view, scene.texture)
        return scene.render(view, guides)

    def _colliders_of(self, spec: SceneSpec, report: Report) -> list[Collider]:
        keys: list[ModelKey] = [(item.role, item.obj_id) for item in spec.objects]
        new = list(dict.fromkeys(key for key in keys if key not in self._colliders))
        for number, key in enumerate(new, start=1):
            report(Stage(COLLIDERS, f"{number} of {len(new)}"))
            self._collider(key)
        return [self._collider(key) for key in keys]

    def _collider(self, key: ModelKey) -> Collider:
        if key not in self._colliders:
            self._colliders[key] = cached_collider(self._meshes[key], self._cache)
        return self._colliders[key]

    def _image(self, plan: ImagePlan, scene: BlenderScene, settled: Sequence[Pose]) -> FinishedImage:
        depth_sensor = planned_depth_sensor(self._recipe, plan)
        annotated = annotate_scene(self._caster, self._recipe, scene.spec, settled, plan.view, depth_sensor)
        linear = self.render(scene, settled, plan.view) if {"rgb", "exr"} & set(self._recipe.outputs) else None
        return FinishedImage.of(self._recipe, plan, scene.spec, settled, annotated, linear)
