"""Which cells of an image are refined, and what covers the others."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from synthetless.scenes import blender, camera, lights
from synthetless.scenes.refine import CELL_PX, _sheet, noisy_cells, pixels_of, stencil
from synthetless.scenes.render import read_exr
from synthetless.scenes.spec import AmbientLight, Intrinsics


def test_noise_is_found_in_the_light_and_not_in_the_texture() -> None:
    rng = np.random.default_rng(0)
    albedo = rng.uniform(0.2, 0.8, (80, 80, 1)).astype(np.float32).repeat(3, axis=2)
    light = np.ones((80, 80, 1), dtype=np.float32)
    light[20:50, 30:60] = rng.uniform(0.5, 1.5, (30, 30, 1))
    cells = noisy_cells(albedo * light, albedo, np.zeros((80, 80), dtype=bool), 0.15)
    assert cells.sum() == round(0.15 * cells.size)
    noisy = np.zeros((80, 80), dtype=bool)
    noisy[20:50, 30:60] = True
    assert (pixels_of(cells, 80, 80) | ~noisy).mean() > 0.98


def test_noise_counts_for_less_where_it_is_removed_best() -> None:
    light = np.random.default_rng(1).uniform(0.5, 1.5, (80, 80, 1)).astype(np.float32).repeat(3, axis=2)
    smooth = np.zeros((80, 80), dtype=bool)
    smooth[:, :40] = True
    cells = noisy_cells(light, np.ones_like(light), smooth, 0.5)
    assert pixels_of(cells, 80, 80)[~smooth].mean() > 0.98


@pytest.mark.parametrize("shape", [(1, 1), (3, 5), (9, 300), (65, 66)])
def test_images_of_any_size_have_cells(shape: tuple[int, int]) -> None:
    black = np.zeros((*shape, 3), dtype=np.float32)
    cells = noisy_cells(black, black, black[..., 0] > 0, 0.15)
    assert cells.any()
    assert pixels_of(cells, *shape).shape == shape


@settings(deadline=None, max_examples=40)
@given(rows=st.integers(1, 80), columns=st.integers(1, 80), share=st.floats(0.01, 0.9), seed=st.integers(0, 99))
def test_the_sheet_covers_what_is_not_open(rows: int, columns: int, share: float, seed: int) -> None:
    """All but a pixel around the opened cells, and nothing of those or of that pixel."""
    opened = np.random.default_rng(seed).random((rows, columns)) < share
    height, width = CELL_PX * rows, CELL_PX * columns
    camera = Intrinsics(width, height, 100.0, 90.0, 3.0, 5.0)
    x, y, z = _sheet(opened, camera).transpose(2, 0, 1)
    u, v = (np.round(at, 6) for at in (-100 * x / z + 3.0 + 0.5, 90 * y / z + 5.0 + 0.5))
    covered = np.zeros((height, width), dtype=int)
    for left, right, top, bottom in zip(u.min(1), u.max(1), v.min(1), v.max(1), strict=True):
        rows_of, columns_of = slice(max(int(top), 0), max(int(bottom), 0)), slice(max(int(left), 0), max(int(right), 0))
        covered[rows_of, columns_of] += 1
    open_px = pixels_of(opened, height, width)
    near = np.pad(open_px, 1)
    near = np.any([near[i : i + height, j : j + width] for i in range(3) for j in range(3)], axis=0)
    assert not covered[near].any()
    assert covered.max() <= 1
    if not opened.any():
        assert (covered == 1).all()


@pytest.mark.parametrize(("width", "height"), [(720, 540), (97, 61), (1280, 960), (301, 811)])
def test_the_window_is_what_blender_renders(width: int, height: int, tmp_path: Path) -> None:
    """White where cells are open, whatever the numbers of pixels come to in single precision."""
    bpy = blender.start(0, blender.CPU)
    scene = bpy.context.scene
    pinhole = Intrinsics(width, height, 800.0, 800.0, width / 2, height / 2)
    camera_object = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.camera = camera_object
    scene.collection.objects.link(camera_object)
    camera.set_intrinsics(scene, camera_object, pinhole)
    scene.render.engine, scene.cycles.samples, scene.cycles.use_sample_subset = "CYCLES", 1, False
    scene.render.image_settings.file_format, scene.render.filepath = "OPEN_EXR", str(tmp_path / "image.exr")
    scene.render.image_settings.color_mode = "RGB"
    scene.cycles.use_denoising = False
    lights.add_ambient(bpy, scene, AmbientLight(1.0, (1.0, 1.0, 1.0)))
    rng = np.random.default_rng(width)
    for _ in range(12):
        shape = (-(-height // CELL_PX), -(-width // CELL_PX))
        (top, bottom), (left, right) = (np.sort(rng.integers(0, side, 2)) for side in shape)
        opened = np.zeros(shape, dtype=bool)
        opened[top : bottom + 1, left : right + 1] = rng.random((bottom + 1 - top, right + 1 - left)) < 0.5
        opened[[top, bottom], [left, right]] = True
        with stencil(bpy, camera_object, pinhole, opened) as window, blender.console_to(tmp_path / "log"):
            bpy.ops.render.render(write_still=True)
        seen = read_exr(tmp_path / "image.exr")[..., 0]
        expected = pixels_of(opened, height, width)[window]
        assert seen.shape == expected.shape
        assert seen[expected].min() > 0.99
