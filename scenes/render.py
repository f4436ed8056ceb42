"""Cycles: from a settled scene to a linear image."""

from __future__ import annotations

import contextlib
import functools
import math
import os
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from synthetless.errors import UserError
from synthetless.scenes import blender, camera, lights, materials
from synthetless.scenes.blender import RenderDevice
from synthetless.scenes.container import container_mesh
from synthetless.scenes.denoise import Denoiser, Guides
from synthetless.scenes.environments import load_panorama
from synthetless.scenes.lens import pinhole_around
from synthetless.scenes.materials import TableTexture
from synthetless.scenes.refine import noisy_cells, pixels_of, stencil
from synthetless.scenes.rotations import matrix
from synthetless.scenes.settings import RenderSettings, TableSettings
from synthetless.scenes.spec import AmbientLight, EnvironmentSpec, Intrinsics, Mesh, Pose, Role, SceneSpec
from synthetless.scenes.textures import PhotoTexture, load_photo, procedural_image, seamless
from synthetless.scenes.warp import warped

_CREASE_DEG = 30.0
"""Edges sharper than this are shaded as edges."""


@dataclass(eq=False)
class BlenderSession:
    """A Blender session that scenes are built on; meshes are loaded once and kept. At most one per process is in use.

    Attributes:
        meshes: every model that may appear, by role and object id.
        intrinsics: of the camera, with its lens.
        settings: of the renderer.
        table: its size, and how photographs are repeated on it.
        photos: folder of the photographs, None if only built-in textures are used.
        threads: of the renderer; 0 uses every core.
        device: what to render on.
        log: file that takes Blender's console output.
        panoramas: folder of the panoramas, None if none are used.
    """

    meshes: Mapping[tuple[Role, int], Mesh]
    intrinsics: Intrinsics
    settings: RenderSettings
    table: TableSettings
    photos: Path | None = None
    threads: int = 0
    device: RenderDevice = blender.CPU
    log: Path = Path(os.devnull)
    panoramas: Path | None = None
    _loaded: dict[tuple[Role, int], Any] = field(default_factory=dict, init=False)
    _textures: dict[tuple[Role, int], Any] = field(default_factory=dict, init=False)

    def __post_init__(self) -> None:
        self.pinhole = pinhole_around(self.intrinsics)
        self.bpy = blender.start(self.threads, self.device)
        self.configure(self.settings)

    def configure(self, settings: RenderSettings) -> None:
        """Render in this way from now on."""
        self.settings = settings
        _configure(self.bpy.context.scene, settings)

    @functools.cached_property
    def denoiser(self) -> Denoiser:
        """The guided one; started when it is first used."""
        return Denoiser(self.threads)

    @contextlib.contextmanager
    def scene(self, spec: SceneSpec, settled: Sequence[Pose]) -> Iterator[BlenderScene]:
        """Build a scene, and take it apart again at the end.

        Args:
            spec: what to build.
            settled: pose of each object of ``spec`` at rest.

        Raises:
            UserError: the photograph of the table, or the panorama, cannot be read.
        """
        bpy_scene = self.bpy.context.scene
        collection = bpy_scene.collection
        centre_m = camera.settled_centre(settled)
        try:
            lights.add_ambient(self.bpy, bpy_scene, spec.ambient)
            lights.add_lamp(self.bpy, collection, spec.light, centre_m)
            if spec.room is not None:
                lights.add_room(self.bpy, collection, spec.room, spec.ambient, centre_m, self.settings.bounces)
            if spec.environment is not None:
                self._add_panorama(bpy_scene.world, spec.environment, spec.ambient)
            cover = self._table_texture(spec, centre_m)
            materials.add_table(self.bpy, collection, cover, self.table.size_m)
            if spec.container is not None:
                container = self.bpy.data.objects.new("container", _load_mesh(self.bpy, container_mesh(spec.container)))
                container.data.materials[0] = materials.plastic(self.bpy, spec.container.material)
                collection.objects.link(container)
            for number, (item, pose) in enumerate(zip(spec.objects, settled, strict=True)):
                placed = self.bpy.data.objects.new(f"object {number}", self._mesh(item.role, item.obj_id))
                placed.matrix_world = _transform(pose)
                placed.pass_index = number + 1
                collection.objects.link(placed)
                placed.material_slots[0].link = "OBJECT"  # the mesh is shared, the grey is not
                texture = self._textures.get((item.role, item.obj_id))
                placed.material_slots[0].material = materials.plastic(self.bpy, item.material, texture)
            data = self.bpy.data.cameras.new("camera")
            bpy_scene.camera = self.bpy.data.objects.new("camera", data)
            collection.objects.link(bpy_scene.camera)
            camera.set_intrinsics(bpy_scene, bpy_scene.camera, self.pinhole)
            yield BlenderScene(self, spec, centre_m, cover)
        finally:
            blender.clear(self.bpy, keep={*self._loaded.values(), *self._textures.values()})

    def _table_texture(self, spec: SceneSpec, centre_m: NDArray[np.float64]) -> TableTexture:
        plane, texture = spec.plane, spec.plane.texture
        is_seamless = True
        if isinstance(texture, PhotoTexture):
            if self.photos is None:
                raise UserError(f"the scene needs the photograph {texture.file}, but no textures folder is given")
            pixels = load_photo(self.photos, texture.file)
            is_seamless = self.table.photos == "seamless"
            if is_seamless:
                texel_m = self._texel_m(spec, centre_m, len(pixels))
                pixels = seamless(pixels)
                plane = replace(plane, tile_m=texel_m * len(pixels))
        else:
            pixels = procedural_image(texture)
        return TableTexture(plane, pixels, is_seamless)

    def _add_panorama(self, world: Any, environment: EnvironmentSpec, ambient: AmbientLight) -> None:
        if self.panoramas is None:
            raise UserError(f"the scene needs the panorama {environment.file}, but no folder of them is given")
        light = load_panorama(self.panoramas, environment.file) * np.float32(environment.strength)
        light += ambient.level * np.array(ambient.color, dtype=np.float32)
        lights.add_panorama(self.bpy, world, light, environment.turn_deg)

    def _texel_m(self, spec: SceneSpec, centre_m: NDArray[np.float64], rows: int) -> float:
        """Side of a texel of a photograph: as the tile was drawn, or no larger than a pixel where the recipe allows."""
        poses = (camera.extrinsics(view, centre_m) for view in spec.views)
        pixel_m = min(camera.finest_pixel_m(*pose, self.pinhole) for pose in poses)
        return max(self.table.tile_m[0] / rows, min(spec.plane.tile_m / rows, pixel_m))

    def _mesh(self, role: Role, obj_id: int) -> Any:
        key = (role, obj_id)
        if key not in self._loaded:
            self._loaded[key] = _load_mesh(self.bpy, self.meshes[key])
            colours = self.meshes[key].colours
            if colours is not None and colours.texture is not None:
                self._textures[key] = materials.new_image(self.bpy, colours.texture)
        return self._loaded[key]


@dataclass(frozen=True, eq=False)
class BlenderScene:
    """A scene that is built in a session.

    Attributes:
        session: where it is built.
        spec: what it was built from.
        centre_m: (3,) centre of its objects, world frame.
        texture: of the table.
    """

    session: BlenderSession
    spec: SceneSpec
    centre_m: NDArray[np.float64]
    texture: TableTexture

    def extrinsics(self, view: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """R_w2c (3, 3) and t_w2c (3,) in metres of the given view."""
        return camera.extrinsics(self.spec.views[view], self.centre_m)

    def render(self, view: int, guides: Callable[[], Guides] | None = None) -> NDArray[np.float32]:
        """Linear image (H, W, 3), Rec. 709 primaries, of the given view.

        Args:
            view: its number.
            guides: gives those of the denoiser, for the session's pinhole, where the settings ask for the guided one.

        Raises:
            ValueError: they are asked for, but not given.
            BlenderError: the denoiser cannot be used.
        """
        light = self._denoised(view, guides) if self.session.settings.denoiser == "guided" else self._rendered(view)
        if self.session.pinhole is self.session.intrinsics:
            return light
        return warped(light, self.session.intrinsics)

    def _denoised(self, view: int, guides: Callable[[], Guides] | None) -> NDArray[np.float32]:
        """The image of the session's pinhole, guided."""
        if guides is None:
            raise ValueError("the guided denoiser needs guides")
        known = guides()
        if self.session.settings.detail_samples:
            sampled = self._refined(view, known)
        else:
            sampled = self._rendered(view, with_albedo=True)
        return self.session.denoiser.denoise(sampled[..., :3], sampled[..., 3:], known)

    def _refined(self, view: int, guides: Guides) -> NDArray[np.float32]:
        """The image and the albedo that was sampled, where it is noisiest by all of the settings' samples."""
        bpy, cycles, settings = self.session.bpy, self.session.bpy.context.scene.cycles, self.session.settings
        few, many = settings.samples, settings.detail_samples
        cycles.samples, cycles.use_sample_subset = many, True
        cycles.sample_offset, cycles.sample_subset_length = 0, few
        image = self._rendered(view, with_albedo=True)
        light, albedo = image[..., :3], image[..., 3:]
        # What paths brought from a texture goes with the albedo that they met, not with the pixel's.
        met = replace(guides, known=guides.known & ~guides.textured).completed(albedo).albedo
        cells = noisy_cells(light, met, guides.textured, settings.detail_share)
        cycles.sample_offset, cycles.sample_subset_length = few, many - few
        with stencil(bpy, bpy.context.scene.camera, self.session.pinhole, cells) as window:
            more = self._rendered(view, with_albedo=True)
        _configure(bpy.context.scene, settings)
        noisy = pixels_of(cells, *image.shape[:2])[window]
        refined = image[window]
        refined[noisy] = (few * refined[noisy] + (many - few) * more[noisy]) / np.float32(many)
        return image

    def _rendered(self, view: int, with_albedo: bool = False) -> NDArray[np.float32]:
        """The image as Cycles gives it; if wanted, the albedo that it sampled as three more channels."""
        scene = self.session.bpy.context.scene
        # With one lamp there is nothing to choose. What was made with Blender's own denoiser was made with the tree.
        chooses = self.session.settings.denoiser != "guided" or self.spec.room is not None
        scene.cycles.use_light_tree = lights.uses_tree(self.spec) and chooses
        scene.view_layers[0].cycles.denoising_store_passes = with_albedo
        scene.render.image_settings.file_format = "OPEN_EXR_MULTILAYER" if with_albedo else "OPEN_EXR"
        scene.render.image_settings.color_mode = "RGB"
        camera.place(scene.camera, *self.extrinsics(view))
        scene.cycles.seed = (self.spec.drop * len(self.spec.views) + view) % 2**31
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "image.exr"
            scene.render.filepath = str(file)
            with blender.console_to(self.session.log):
                self.session.bpy.ops.render.render(write_still=True)
            return _read_passes(file, "Combined", "Denoising Albedo") if with_albedo else read_exr(file)


def _read_passes(file: Path, *passes: str) -> NDArray[np.float32]:
    """(H, W, 3 n) float32 colours of n passes of an OpenEXR file of many layers."""
    import OpenEXR

    with OpenEXR.File(str(file), separate_channels=True) as content:
        channels = {name.partition(".")[2]: channel.pixels for name, channel in content.channels().items()}
        return np.stack([channels[f"{name}.{colour}"] for name in passes for colour in "RGB"], axis=-1)


def read_exr(file: Path) -> NDArray[np.float32]:
    """(H, W, 3) float32 colour channels of an OpenEXR file."""
    import OpenEXR

    with OpenEXR.File(str(file)) as content:
        pixels: NDArray[np.float32] = content.channels()["RGB"].pixels
    return pixels.astype(np.float32)


def _configure(scene: Any, settings: RenderSettings) -> None:
    scene.render.engine = "CYCLES"
    cycles = scene.cycles
    cycles.samples, cycles.use_sample_subset = settings.samples, False
    cycles.use_adaptive_sampling = False  # gains nothing at these sample counts
    cycles.max_bounces = settings.bounces
    cycles.diffuse_bounces = cycles.glossy_bounces = settings.bounces
    cycles.transmission_bounces = cycles.volume_bounces = cycles.transparent_max_bounces = 0
    cycles.caustics_reflective = cycles.caustics_refractive = False  # they are what fireflies are made of
    cycles.use_denoising = settings.denoiser in ("fast", "accurate")
    cycles.denoiser = "OPENIMAGEDENOISE"
    cycles.denoising_input_passes = "RGB_ALBEDO_NORMAL"
    cycles.denoising_use_gpu = cycles.device == "GPU"
    cycles.denoising_quality = "HIGH"
    cycles.denoising_prefilter = "NONE" if settings.denoiser == "fast" else "ACCURATE"
    scene.render.use_persistent_data = False  # it would show the previous scene's texture again
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.render.image_settings.color_mode = "RGB"
    scene.render.image_settings.color_depth = "32"
    scene.render.image_settings.exr_codec = "NONE"
    scene.render.use_compositing = scene.render.use_sequencer = False
    scene.view_settings.view_transform = "Standard"


def _load_mesh(bpy: Any, mesh: Mesh) -> Any:
    """A bpy mesh with one material slot, smooth but for its creases."""
    made = bpy.data.meshes.new("model")
    count = len(mesh.faces)
    made.vertices.add(len(mesh.vertices_m))
    made.vertices.foreach_set("co", mesh.vertices_m.astype(np.float32).ravel())
    made.loops.add(3 * count)
    made.loops.foreach_set("vertex_index", mesh.faces.astype(np.int32).ravel())
    made.polygons.add(count)
    made.polygons.foreach_set("loop_start", np.arange(0, 3 * count, 3, dtype=np.int32))
    made.polygons.foreach_set("use_smooth", np.ones(count, dtype=bool))
    made.update(calc_edges=True)
    made.set_sharp_from_angle(angle=math.radians(_CREASE_DEG))
    if mesh.colours is not None:
        materials.add_colours(made, mesh.colours)
    made.materials.append(None)
    return made


def _transform(pose: Pose) -> Any:
    from mathutils import Matrix

    transform = np.eye(4)
    transform[:3, :3] = matrix(pose.rotation_wxyz)
    transform[:3, 3] = pose.position_m
    return Matrix(transform.tolist())
