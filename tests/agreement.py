"""What Cycles itself says about a scene, to hold the ray-cast annotation against."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from synthetless.scenes import camera
from synthetless.scenes.render import BlenderScene


@dataclass(frozen=True)
class CyclesGeometry:
    """Depth in millimetres and number of the object (from 1, 0 for none) at each pixel's centre, (H, W)."""

    depth_mm: NDArray[np.float64]
    numbers: NDArray[np.int64]


def cycles_geometry(scene: BlenderScene, view: int, folder: Path) -> CyclesGeometry:
    """Render one sample at the exact centre of each pixel, and read the depth and object-index passes."""
    import OpenEXR

    bpy_scene = scene.session.bpy.context.scene
    layer, cycles, render = bpy_scene.view_layers[0], bpy_scene.cycles, bpy_scene.render
    saved = (cycles.samples, cycles.use_denoising, cycles.pixel_filter_type, cycles.filter_width)
    file = folder / "passes.exr"
    try:
        layer.use_pass_z = layer.use_pass_object_index = True
        cycles.samples, cycles.use_denoising = 1, False
        cycles.pixel_filter_type, cycles.filter_width = "BOX", 0.01
        render.image_settings.file_format = "OPEN_EXR_MULTILAYER"
        render.filepath = str(file)
        camera.place(bpy_scene.camera, *scene.extrinsics(view))
        scene.session.bpy.ops.render.render(write_still=True)
    finally:
        layer.use_pass_z = layer.use_pass_object_index = False
        cycles.samples, cycles.use_denoising, cycles.pixel_filter_type, cycles.filter_width = saved
        render.image_settings.file_format = "OPEN_EXR"
        render.image_settings.color_mode = "RGB"
    with OpenEXR.File(str(file), separate_channels=True) as content:
        channels = content.channels()
        depth = next(c.pixels for name, c in channels.items() if name.endswith("Depth.Z"))
        index = next(c.pixels for name, c in channels.items() if name.endswith("IndexOB.X"))
        depth, index = np.array(depth, dtype=np.float64), np.array(index)
    return CyclesGeometry(np.where(depth < 1e6, depth * 1000, 0.0), np.rint(index).astype(np.int64))


def cycles_guides(scene: BlenderScene, view: int, folder: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Render as the session is set up, and read albedo and normals, OpenCV camera frame, (H, W, 3) each."""
    import OpenEXR

    bpy_scene = scene.session.bpy.context.scene
    layer, render, file = bpy_scene.view_layers[0], bpy_scene.render, folder / "guides.exr"
    try:
        layer.cycles.denoising_store_passes = True
        render.image_settings.file_format = "OPEN_EXR_MULTILAYER"
        render.filepath = str(file)
        camera.place(bpy_scene.camera, *scene.extrinsics(view))
        scene.session.bpy.ops.render.render(write_still=True)
    finally:
        layer.cycles.denoising_store_passes = False
        render.image_settings.file_format = "OPEN_EXR"
        render.image_settings.color_mode = "RGB"
    with OpenEXR.File(str(file), separate_channels=True) as content:
        pixels = {name: np.array(c.pixels, dtype=np.float64) for name, c in content.channels().items()}

    def read(name: str, axes: str) -> NDArray[np.float64]:
        return np.stack([next(p for n, p in pixels.items() if n.endswith(f"{name}.{axis}")) for axis in axes], axis=-1)

    return read("Denoising Albedo", "RGB"), read("Denoising Normal", "XYZ") * [1, -1, 1]  # Cycles' camera has y up
