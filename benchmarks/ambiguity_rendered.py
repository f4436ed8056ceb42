"""Hold A(P) against Blender: ``python -m benchmarks.ambiguity_rendered [--instances N]``.

Parts with a detail that spoils their symmetry are rendered at a pose P and at the poses P S, S in H, under the same
camera and light, which is to say that both are turned along with S. The poses that look alike by ray casting have to be
those whose pictures differ by no more than noise. Rendering P twice tells the noise of so many paths of light.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchmarks import keep
from synthetless.annotation.instances import PosedModel
from synthetless.annotation.raycast import RayCaster
from synthetless.config import load_recipe
from synthetless.scenes.render import BlenderScene, BlenderSession
from synthetless.scenes.sampling import Catalogue, sample_scene
from synthetless.scenes.settings import RenderSettings, TableSettings
from synthetless.scenes.spec import AmbientLight, Intrinsics, Material, Mesh, ObjectSpec, Pose, SceneSpec, View
from synthetless.symmetry import CanonicalMap, SymmetryGroup
from synthetless.symmetry.ambiguity import MIN_PIXELS, Cosets, Resolution, see

Floats = NDArray[np.float64]

CAMERA = Intrinsics(72, 72, 320.0, 320.0, 35.5, 35.5)
DISTANCE_M, HEIGHT_M = 0.4, 0.5
SAMPLES = 64
COVER = 3
"""Object id of the plate that hides a part of every third instance."""


@dataclass(frozen=True)
class Part:
    """A prism about z whose cross-section has a flat, and the group that it has but for this."""

    radii_mm: tuple[float, ...]
    half_height_mm: float
    quasi: SymmetryGroup

    def mesh(self) -> tuple[Floats, NDArray[np.int64]]:
        """Vertices (V, 3) in mm, and faces (F, 3)."""
        radii, n = np.array(self.radii_mm), len(self.radii_mm)
        angles = 2 * np.pi * np.arange(n) / n
        ring = radii[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        z = np.repeat([-self.half_height_mm, self.half_height_mm], n)
        ends = [[0, 0, -self.half_height_mm], [0, 0, self.half_height_mm]]
        i = np.arange(n)
        j, bottom, top = np.roll(i, -1), np.full(n, 2 * n), np.full(n, 2 * n + 1)
        faces = [(i, j, j + n), (i, j + n, i + n), (j, i, bottom), (i + n, j + n, top)]
        vertices = np.concatenate([np.column_stack([np.tile(ring, (2, 1)), z]), ends])
        return vertices, np.concatenate([np.stack(face, axis=1) for face in faces])


def shaft() -> Part:
    """A cylinder with a flat along its side."""
    angles = np.arange(-180, 180, 3)
    radii = np.full(len(angles), 26.0)
    flat = np.abs(angles) < 40
    radii[flat] *= np.cos(np.radians(40)) / np.cos(np.radians(angles[flat]))
    return Part(tuple(np.roll(radii, len(radii) // 2).tolist()), 26.0, SymmetryGroup("C8"))


def block() -> Part:
    """A square block without one of its edges."""
    angles = np.arange(-180, 180, 3)
    square = 20 / np.cos(np.radians((angles + 45) % 90 - 45))
    cut = 22 / np.cos(np.radians(angles - 45))
    radii = np.where(np.abs(angles - 45) < 45, np.minimum(square, cut), square)
    return Part(tuple(np.roll(radii, len(radii) // 2).tolist()), 24.0, SymmetryGroup("D4"))


@dataclass(frozen=True, eq=False)
class Compared:
    """An instance.

    Attributes:
        apart: (k,) at how many pixels ray casting tells each coset from the true pose.
        rendered_apart: (k,) the same by the rendered pictures.
        noise: of a picture, linear: twice the largest difference of two pictures of the true pose.
    """

    apart: NDArray[np.int64]
    rendered_apart: NDArray[np.int64]
    noise: float

    @property
    def contradictions(self) -> int:
        """Cosets that one of the two tells from the true pose, and the other does not.

        Of those that few pixels tell from it, less than MIN_PIXELS, a picture may show the difference; and a single
        pixel of a picture may be noise.
        """
        by_rays = self.apart >= MIN_PIXELS
        return int(np.count_nonzero((by_rays != (self.rendered_apart > 1)) & (by_rays | (self.apart == 0))))


def compare(instances: int, log: Path = Path(os.devnull)) -> Iterator[Compared]:
    """Judge and render some instances, of the two parts in turn, every third one behind a plate."""
    parts = {1: shaft(), 2: block()}
    plate = np.array([[x, y, z] for x in (-40.0, 40) for y in (-40.0, 40) for z in (-1.0, 1)])
    faces = np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
                      [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]])  # fmt: skip
    meshes = {obj_id: part.mesh() for obj_id, part in parts.items()} | {COVER: (plate, faces)}
    caster = RayCaster({("model", obj_id): mesh for obj_id, mesh in meshes.items()})
    session = BlenderSession(
        {("model", obj_id): Mesh(vertices / 1000, triangles) for obj_id, (vertices, triangles) in meshes.items()},
        CAMERA,
        RenderSettings(samples=SAMPLES, denoiser="none", bounces=0),
        TableSettings(size_m=0.5),
        log=log,
    )
    rng = np.random.default_rng(4)
    for number in range(instances):
        obj_id = 1 + number % 2
        shown = [obj_id, COVER] if number % 3 == 2 else [obj_id]
        spec, poses = _scene(shown, rng)
        with session.scene(spec, poses) as scene:
            yield _compare(scene, caster, parts[obj_id].quasi)


def _scene(obj_ids: list[int], rng: np.random.Generator) -> tuple[SceneSpec, list[Pose]]:
    """Matte objects in mid-air, the first one turned at random, and a lamp that stands beside the camera."""
    spec = sample_scene(load_recipe(None, ["objects.count=[1, 1]"]), Catalogue({1: 0.05}, {}), seed=1, drop=0)
    elevation_deg, azimuth_deg = float(rng.uniform(20, 70)), float(rng.uniform(0, 360))
    view = View(DISTANCE_M, elevation_deg, azimuth_deg, 0.0, (0.0, 0.0, 0.0))
    x, y, z, w = Rotation.random(random_state=rng).as_quat().tolist()
    turns = [(w, x, y, z), (1.0, 0.0, 0.0, 0.0)]
    spec = dataclasses.replace(
        spec,
        objects=tuple(
            ObjectSpec("model", obj_id, Material((0.6, 0.6, 0.6), 1.0, 0.0), spec.objects[0].release)
            for obj_id in obj_ids
        ),
        light=dataclasses.replace(
            spec.light, azimuth_deg=azimuth_deg + 20, elevation_deg=elevation_deg + 15, strength=0.8, radius_m=0.05
        ),
        ambient=AmbientLight(0.2, (1.0, 1.0, 1.0)),
        views=(view, view),  # two views have noise of their own
    )
    return spec, [Pose(turn, (0.0, 0.0, HEIGHT_M)) for turn in turns[: len(obj_ids)]]


def _compare(scene: BlenderScene, caster: RayCaster, quasi: SymmetryGroup) -> Compared:
    R_w2c, t_w2c_m = scene.extrinsics(0)
    centre_m = np.array([0.0, 0.0, HEIGHT_M])
    t_mm = 1000 * (R_w2c @ centre_m + t_w2c_m)
    true = scene.session.bpy.data.objects["object 0"].matrix_world
    posed = PosedModel(scene.spec.objects[0].obj_id, R_w2c @ np.array(true.to_3x3()), t_mm)
    others = []
    if len(scene.spec.objects) > 1:  # in front of one half of it
        others = [PosedModel(COVER, np.eye(3), t_mm + np.array([40.0, 0.0, -80.0]))]
        _move(scene, 1, R_w2c.T, R_w2c.T @ (others[0].t_m2c / 1000 - t_w2c_m))
    cosets = Cosets.of(quasi, SymmetryGroup.trivial())
    R_canonical = CanonicalMap(quasi)(posed.R_m2c[None], posed.t_m2c[None]).R_m2c[0]
    seen = see(caster, CAMERA, posed, R_canonical, cosets, others, resolution=Resolution("normals"))
    again = scene.render(1)
    pictures = []
    for R in seen.R_m2c:
        _move(scene, 0, R_w2c.T @ R, centre_m)
        pictures.append(scene.render(0))
    noise = 2 * float(np.abs(again - pictures[seen.coset_true]).max())
    counts = [_pixels_apart(again, picture, noise) for picture in pictures]
    return Compared(seen.pixels_apart, np.array(counts), noise)


def _move(scene: BlenderScene, number: int, R_m2w: Floats, position_m: Floats) -> None:
    """Put an object of a built scene elsewhere."""
    from mathutils import Matrix

    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = R_m2w, position_m
    scene.session.bpy.data.objects[f"object {number}"].matrix_world = Matrix(transform.tolist())


def _pixels_apart(picture: NDArray[np.float32], other: NDArray[np.float32], noise: float) -> int:
    """At how many pixels one of two pictures shows what the other shows neither there nor at a neighbour."""
    return int(np.count_nonzero(_unexplained(picture, other, noise) | _unexplained(other, picture, noise)))


def _unexplained(picture: NDArray[np.float32], by: NDArray[np.float32], noise: float) -> NDArray[np.bool_]:
    around = np.ones((3, 3), np.uint8)
    low, high = cv2.erode(by, around), cv2.dilate(by, around)
    apart: NDArray[np.bool_] = ((picture < low - noise) | (picture > high + noise)).any(axis=2)
    return apart


def main() -> None:
    """Render, compare, print a line an instance, write benchmarks/results/ambiguity_rendered.json."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--instances", type=int, default=20)
    arguments = parser.parse_args()
    found = list(compare(arguments.instances))
    for number, each in enumerate(found):
        print(f"{number:2}  pixels apart {each.apart.tolist()}, rendered {each.rendered_apart.tolist()}")
    pairs, wrong = sum(len(each.apart) for each in found), sum(each.contradictions for each in found)
    few = sum(int(np.count_nonzero((each.apart > 0) & (each.apart < MIN_PIXELS))) for each in found)
    print(f"{pairs} pairs of poses, {wrong} contradictions; {few} pairs differ at fewer than {MIN_PIXELS} pixels")
    rows = [{"pixels_apart": each.apart.tolist(), "rendered_apart": each.rendered_apart.tolist()} for each in found]
    keep("ambiguity_rendered", {"pairs": pairs, "contradictions": wrong, "instances": rows})


if __name__ == "__main__":
    main()
