"""The guided denoiser, in the library that comes with Blender; and its guides against what Cycles samples."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from synthetless.annotation.raycast import RayCaster
from synthetless.annotation.scene import scene_caster, scene_guides
from synthetless.config import BUILTIN_MODELS, Recipe, load_recipe
from synthetless.io.models import ObjectModel, load_models
from synthetless.scenes import denoise
from synthetless.scenes.blender import BlenderError
from synthetless.scenes.denoise import Denoiser, Guides
from synthetless.scenes.refine import noisy_cells, pixels_of, stencil
from synthetless.scenes.render import BlenderScene, BlenderSession
from synthetless.scenes.sampling import Catalogue, sample_scene
from synthetless.scenes.settings import RenderSettings
from synthetless.scenes.spec import Mesh, Pose, SceneSpec
from tests.agreement import cycles_guides

pytestmark = pytest.mark.blender

CONVERGED = RenderSettings(samples=64, denoiser="none")


def _recipe() -> Recipe:
    camera = "camera={width: 96, height: 72, fx: 160, fy: 150, cx: 50, cy: 33}"
    return load_recipe(
        None, [camera, "objects={count: [4, 4], specular: [0, 0]}", "table.tile_m=[0.2, 0.2]", "render.samples=4"]
    )


@pytest.fixture(scope="module")
def models() -> dict[int, ObjectModel]:
    return load_models(BUILTIN_MODELS)


@pytest.fixture(scope="module")
def caster(models: dict[int, ObjectModel]) -> RayCaster:
    return scene_caster({"model": models})


@pytest.fixture(scope="module")
def session(models: dict[int, ObjectModel], tmp_path_factory: pytest.TempPathFactory) -> BlenderSession:
    recipe = _recipe()
    return BlenderSession(
        {("model", key): Mesh(model.vertices_mm / 1000, model.faces) for key, model in models.items()},
        recipe.intrinsics,
        recipe.render,
        recipe.table,
        threads=1,
        log=tmp_path_factory.mktemp("session") / "log",
    )


@pytest.fixture(scope="module")
def spec(models: dict[int, ObjectModel]) -> SceneSpec:
    """Built-in parts that hover over the table."""
    sizes = {key: model.diameter_mm / 1000 for key, model in models.items()}
    return sample_scene(_recipe(), Catalogue(sizes, {}, ()), seed=4, drop=0)


@pytest.fixture
def built(
    session: BlenderSession, caster: RayCaster, spec: SceneSpec
) -> Iterator[tuple[BlenderScene, partial[Guides]]]:
    """A scene, and what gives its guides."""
    with _built(session, caster, spec) as found:
        yield found


@contextmanager
def _built(
    session: BlenderSession, caster: RayCaster, spec: SceneSpec
) -> Iterator[tuple[BlenderScene, partial[Guides]]]:
    settled = [Pose(item.release.rotation_wxyz, (0.05 * k - 0.07, 0.0, 0.04)) for k, item in enumerate(spec.objects)]
    with session.scene(spec, settled) as scene:
        yield scene, partial(scene_guides, caster, _recipe(), spec, settled, 0, scene.texture)


def test_guides_are_what_cycles_samples(built: tuple[BlenderScene, partial[Guides]], tmp_path: Path) -> None:
    """A flip, a shift or a wrong mirroring of the texture would show, as would a body that is not where it is."""
    scene, guides = built
    scene.session.configure(CONVERGED)
    albedo, normals = cycles_guides(scene, 0, tmp_path)
    found = guides()
    assert np.abs(found.albedo - albedo).mean() < 0.01
    assert np.corrcoef(found.albedo.ravel(), albedo.ravel())[0, 1] > 0.99
    assert (np.einsum("ijk,ijk->ij", found.normals, normals) > 0.8).mean() > 0.95


def test_it_takes_the_noise_and_leaves_the_edges(built: tuple[BlenderScene, partial[Guides]]) -> None:
    scene, guides = built
    scene.session.configure(CONVERGED)
    exact = scene.render(0)
    scene.session.configure(RenderSettings(samples=4, denoiser="none"))
    noisy = scene.render(0)
    scene.session.configure(RenderSettings(samples=4, denoiser="guided"))
    clean = scene.render(0, guides)
    assert _error(clean, exact) < 0.5 * _error(noisy, exact)
    nothing_known = replace(guides(), known=np.zeros(clean.shape[:2], dtype=bool))
    assert _error(clean, exact) < _error(scene.render(0, lambda: nothing_known), exact) < _error(noisy, exact)
    np.testing.assert_array_equal(scene.render(0, guides), clean)  # the other way to read the image left no trace
    assert _error(clean, exact) < 0.8 * _error(_with_blenders_own(scene), exact)
    scene.session.configure(RenderSettings(samples=4, denoiser="guided"))
    with pytest.raises(ValueError, match="needs guides"):
        scene.render(0)


def test_the_same_bytes_with_any_threads_and_after_another_image(built: tuple[BlenderScene, partial[Guides]]) -> None:
    scene, guides = built
    scene.session.configure(RenderSettings(samples=2, denoiser="guided"))
    first, known = scene.render(0, guides), guides()
    white = np.ones((40, 30, 3), dtype=np.float32)
    scene.session.denoiser.denoise(white, white, _blank((40, 30, 3)))
    np.testing.assert_array_equal(scene.render(0, guides), first)
    np.testing.assert_array_equal(guides().albedo, known.albedo)
    for threads in (1, 2):
        np.testing.assert_array_equal(
            Denoiser(threads).denoise(half := first * 0.5, half, known), Denoiser(1).denoise(half, half, known)
        )


def test_the_noisiest_cells_are_rendered_as_they_are_without_the_sheet(
    built: tuple[BlenderScene, partial[Guides]],
) -> None:
    """To the bit: a hole that were a pixel too narrow, or off by one, would show."""
    scene, _ = built
    scene.session.configure(RenderSettings(samples=2, denoiser="guided"))
    bpy, pinhole = scene.session.bpy, scene.session.pinhole
    whole = scene._rendered(0, with_albedo=True)
    nowhere = np.zeros(whole.shape[:2], dtype=bool)
    noisy = noisy_cells(whole[..., :3], whole[..., 3:], nowhere, 0.15)
    for cells in (noisy, np.eye(18, 24, dtype=bool), np.ones((18, 24), dtype=bool)):
        with stencil(bpy, bpy.context.scene.camera, pinhole, cells) as window:
            seen = scene._rendered(0, with_albedo=True)
        opened = pixels_of(cells, *whole.shape[:2])[window]
        assert opened.sum() == 16 * cells.sum(), "every cell is in the window"
        np.testing.assert_array_equal(seen[opened], whole[window][opened])
        closed = ndimage.distance_transform_edt(~opened) > 3
        assert seen[closed].any(axis=-1).sum() <= 0.3 * closed.sum(), "sides that are drawn back let a little through"
    np.testing.assert_array_equal(scene._rendered(0, with_albedo=True), whole)


def test_more_paths_where_it_is_noisy_are_nearly_as_good_as_everywhere(
    built: tuple[BlenderScene, partial[Guides]],
) -> None:
    scene, guides = built
    scene.session.configure(RenderSettings(samples=128, denoiser="none"))
    exact = scene.render(0)
    few, refined, many = (
        _rendered_with(scene, guides, samples, detail) for samples, detail in ((2, 0), (2, 16), (16, 0))
    )
    assert _error(refined, exact) < 0.85 * _error(few, exact)
    assert _error(refined, exact) < 1.5 * _error(many, exact)
    np.testing.assert_array_equal(_rendered_with(scene, guides, 2, 16), refined)


def test_a_texture_that_is_taken_away_comes_back_as_it_is() -> None:
    """However the few paths met it; its colours may be black in one channel or in all."""
    rng = np.random.default_rng(3)
    albedo, sampled = (rng.uniform(0.0, 0.9, (40, 50, 3)).astype(np.float32) for _ in range(2))
    albedo[10:12], sampled[11:13], sampled[20:30, :, 2] = 0, 0, 0
    textured = rng.random((40, 50)) < 0.5
    guides = Guides(albedo, albedo, np.ones((40, 50), dtype=bool), textured)
    light = np.array([2.0, 1.5, 1.0], dtype=np.float32)
    image, plain, texture = guides.without_texture(light * sampled, sampled)
    even = np.broadcast_to(image[textured][0], image[textured].shape)
    np.testing.assert_allclose(image[textured], even, rtol=2e-3)
    np.testing.assert_allclose((image * texture)[textured], light * albedo[textured], rtol=2e-3, atol=1e-6)
    np.testing.assert_array_equal(plain[textured], np.broadcast_to(plain[textured][0], plain[textured].shape))
    np.testing.assert_array_equal(image[~textured], light * sampled[~textured])
    np.testing.assert_array_equal(plain[~textured], albedo[~textured])
    np.testing.assert_array_equal(texture[~textured], 1)


def test_a_black_texture_and_none_are_no_trouble() -> None:
    black, white = np.zeros((5, 6, 3), dtype=np.float32), np.ones((5, 6, 3), dtype=np.float32)
    everywhere = np.ones((5, 6), dtype=bool)
    image, _, texture = Guides(black, white, everywhere, everywhere).without_texture(black, black)
    assert not (image * texture).any()
    image, albedo, texture = Guides(white, white, everywhere, ~everywhere).without_texture(white, black)
    np.testing.assert_array_equal([image, albedo, texture], np.ones((3, 5, 6, 3)))


def test_a_table_that_shines_is_as_bright_as_it_is(session: BlenderSession, caster: RayCaster, spec: SceneSpec) -> None:
    """What it reflects is no part of its texture; it was taken for one, and the table came out darker."""
    shining = replace(spec, plane=replace(spec.plane, specular=1.0, roughness=0.6))
    with _built(session, caster, shining) as (scene, guides):
        session.configure(RenderSettings(samples=32, denoiser="none"))
        exact = scene.render(0)
        session.configure(RenderSettings(samples=4, denoiser="guided"))
        found = scene.render(0, guides)
    assert exact.mean() > 0.1
    assert found.mean() == pytest.approx(exact.mean(), rel=0.01)
    assert _error(found, exact) < 0.1 * exact.mean()


def _rendered_with(
    scene: BlenderScene, guides: partial[Guides], samples: int, detail_samples: int
) -> NDArray[np.float32]:
    scene.session.configure(RenderSettings(samples=samples, detail_samples=detail_samples, denoiser="guided"))
    return scene.render(0, guides)


def test_images_that_do_not_fit_are_refused() -> None:
    image = np.ones((8, 9, 3), dtype=np.float32)
    for guides in (_blank((9, 8, 3)), Guides(image.astype(np.float64), image, image[..., 0] > 0, image[..., 0] < 0)):  # type: ignore[arg-type]
        with pytest.raises(ValueError, match="float32 like the image is needed"):
            Denoiser().denoise(image, image, guides)


def test_a_blender_without_the_library_is_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(denoise, "_LIBRARIES", ("nothing*",))
    with pytest.raises(BlenderError, match=r"no Open Image Denoise; .*--set render\.denoiser=fast"):
        Denoiser()
    damaged = tmp_path / "libOpenImageDenoise.so.2"
    damaged.write_bytes(b"damaged")
    monkeypatch.setattr(denoise, "_LIBRARIES", (damaged.name,))
    utils = SimpleNamespace(resource_path=lambda kind: str(tmp_path / "4.5"))
    monkeypatch.setattr(denoise.blender, "module", lambda: SimpleNamespace(utils=utils))
    with pytest.raises(BlenderError, match=r"cannot be loaded .*render\.denoiser=fast"):
        Denoiser()


def _blank(shape: tuple[int, int, int]) -> Guides:
    known = np.ones(shape[:2], dtype=bool)
    return Guides(*(np.zeros(shape, dtype=np.float32) for _ in range(2)), known, ~known)


def _with_blenders_own(scene: BlenderScene) -> NDArray[np.float32]:
    scene.session.configure(RenderSettings(samples=4, denoiser="fast"))
    return scene.render(0)


def _error(image: NDArray[np.float32], exact: NDArray[np.float32]) -> float:
    return float(np.sqrt(np.mean((image - exact) ** 2)))
