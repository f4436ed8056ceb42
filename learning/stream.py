"""An endless stream of ray-cast crops: what a virtual camera that looks straight at a part sees, some 600 a second.

No renderer is needed: the first surface behind each pixel, a Lambert term and a highlight, a texture behind it. Crop
number i follows from the seed and i alone, whoever makes it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from embreex.rtcore import EmbreeDevice
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from typing_extensions import Self

from synthetless.annotation.instances import Window
from synthetless.annotation.raycast import MISS, PosedSurface, Rays, Surface
from synthetless.errors import UserError
from synthetless.io.models import ObjectModel
from synthetless.learning.targets import rolled
from synthetless.scenes.spec import Intrinsics
from synthetless.scenes.textures import ProceduralTexture, procedural_image, sample_texture

Floats = NDArray[np.float64]
Poses = Literal["upright", "any"]

_TEXTURES, _TEXTURE_PX = 24, 160
_DISTANCE_MM = (450.0, 900.0)


@dataclass(frozen=True)
class CropSettings:
    """How crops are drawn.

    Attributes:
        size_px: side of a crop.
        poses: ``upright``: the model's z axis points up, seen from an elevation; ``any``: every rotation is as likely.
        elevation_deg: range of the camera's elevation above the table, for upright parts.
        roll_deg: the camera rolls by up to so much either way.
        zoom: range of the crop's side over the longer side of the silhouette's box.
        shift: the part's box is off the crop's centre by up to this share of its side.
    """

    size_px: int = 48
    poses: Poses = "upright"
    elevation_deg: tuple[float, float] = (10.0, 89.0)
    roll_deg: float = 15.0
    zoom: tuple[float, float] = (1.1, 1.35)
    shift: float = 0.05


@dataclass(frozen=True, eq=False)
class Crops:
    """N crops and the true poses in the frames of their cameras.

    Attributes:
        pixels: (N, S, S, 3) uint8.
        obj_ids: (N,).
        R_m2c, t_m2c: (N, 3, 3), (N, 3) mm.
        K: (N, 3, 3) camera matrices; the principal point is the crop's centre, ((S - 1) / 2, (S - 1) / 2).
        elevation_deg: (N,) of the camera above the model's x-y plane.
    """

    pixels: NDArray[np.uint8]
    obj_ids: NDArray[np.int64]
    R_m2c: Floats
    t_m2c: Floats
    K: Floats
    elevation_deg: Floats

    def __len__(self) -> int:
        return len(self.pixels)

    def take(self, rows: NDArray[np.int64]) -> Self:
        """Some of the crops."""
        return type(self)(
            self.pixels[rows],
            self.obj_ids[rows],
            self.R_m2c[rows],
            self.t_m2c[rows],
            self.K[rows],
            self.elevation_deg[rows],
        )

    @classmethod
    def concatenate(cls, parts: Sequence[Self]) -> Self:
        """All crops of several."""
        names = ("pixels", "obj_ids", "R_m2c", "t_m2c", "K", "elevation_deg")
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


class CropStream:
    """Makes crops of some models; each process needs its own (as a ray caster does)."""

    def __init__(self, models: Mapping[int, ObjectModel], settings: CropSettings, seed: int) -> None:
        """Prepare the models and the textures.

        Raises:
            UserError: there are no models, or a mesh is unusable.
        """
        if not models:
            raise UserError("no models to make crops of")
        device = EmbreeDevice()
        self._surfaces = {i: Surface(device, model.vertices_mm, model.faces) for i, model in models.items()}
        self._ids = sorted(models)
        self._settings, self._seed = settings, seed
        rng = np.random.default_rng([seed, 0])
        self._textures = [procedural_image(_texture(rng), _TEXTURE_PX) for _ in range(_TEXTURES)]

    def __iter__(self) -> Iterator[Crops]:
        number = 0
        while True:
            yield self.crops(number, 1)
            number += 1

    def crops(self, first: int, count: int, step: int = 1) -> Crops:
        """``count`` crops from number ``first`` on, every ``step``-th."""
        made = [self._crop(first + step * i) for i in range(count)]
        columns = list(zip(*made, strict=True))
        return Crops(*(np.stack(column) for column in columns))

    def _crop(self, number: int) -> tuple[NDArray[np.uint8], int, Floats, Floats, Floats, float]:
        rng = np.random.default_rng([self._seed, 1, number])
        obj_id = self._ids[number % len(self._ids)]
        R = self._rotation(rng)
        posed, K = self._framed(rng, self._surfaces[obj_id], R)
        elevation = float(np.degrees(np.arcsin(np.clip(-R[2, 2], -1, 1))))
        t = posed.t_center - R @ posed.surface.center_mm
        return self._picture(rng, posed, K), obj_id, R, t, K, elevation

    def _rotation(self, rng: np.random.Generator) -> Floats:
        if self._settings.poses == "any":
            return np.asarray(Rotation.random(random_state=rng).as_matrix())
        return upright(
            float(np.radians(rng.uniform(*self._settings.elevation_deg))),
            float(rng.uniform(0, 2 * np.pi)),
            float(np.radians(rng.uniform(-self._settings.roll_deg, self._settings.roll_deg))),
        )

    def _framed(self, rng: np.random.Generator, surface: Surface, R: Floats) -> tuple[PosedSurface, Floats]:
        """The surface before a camera whose picture its silhouette fills, but for the margin."""
        size, distance = self._settings.size_px, rng.uniform(*_DISTANCE_MM)
        points = surface.hull_mm @ R.T
        for _ in range(2):  # the perspective of the centred part differs a little
            z = points[:, 2] + distance
            seen = points[:, :2] / z[:, None]
            low, high = seen.min(axis=0), seen.max(axis=0)
            points[:, :2] -= (low + high) / 2 * distance
        side = float((high - low).max() * rng.uniform(*self._settings.zoom))
        shift = rng.uniform(-self._settings.shift, self._settings.shift, 2) * side * distance
        centre = points[0] - surface.hull_mm[0] @ R.T + np.array([*shift, distance])
        middle = (size - 1) / 2
        return PosedSurface(surface, R, centre), np.array(
            [[size / side, 0, middle], [0, size / side, middle], [0, 0, 1.0]]
        )

    def _picture(self, rng: np.random.Generator, posed: PosedSurface, K: Floats) -> NDArray[np.uint8]:
        size = self._settings.size_px
        camera = Intrinsics(size, size, K[0, 0], K[1, 1], K[0, 2], K[1, 2])
        rays = Rays.through(camera, Window(0, 0, size, size))
        faces = posed.first_faces(rays)
        hit = faces != MISS
        texture = self._textures[int(rng.integers(len(self._textures)))]
        top, left = rng.integers(0, _TEXTURE_PX - size, 2) if size < _TEXTURE_PX else (0, 0)
        picture = texture[top : top + size, left : left + size].astype(np.float64) * rng.uniform(0.5, 1.1)
        normals = posed.normals(faces[hit])
        towards = np.stack(np.broadcast_arrays(rays.x, rays.y, 1.0), axis=-1)[hit]
        towards = -towards / np.linalg.norm(towards, axis=1, keepdims=True)
        normals *= np.sign(np.einsum("ij,ij->i", normals, towards))[:, None]
        picture[hit] = _shade(rng, normals, towards)
        return np.clip(picture, 0, 255).astype(np.uint8)


def _texture(rng: np.random.Generator) -> ProceduralTexture:
    texture = sample_texture(rng)
    assert isinstance(texture, ProceduralTexture)  # no photographs were given
    return texture


def upright(elevation_rad: float, azimuth_rad: float, roll_rad: float) -> Floats:
    """R_m2c (3, 3) of a part whose z axis points up, seen from an elevation above its x-y plane."""
    c, s = np.cos(elevation_rad), np.sin(elevation_rad)
    R_w2c = np.array([[0.0, 1, 0], [s, 0, -c], [-c, 0, -s]])  # right, down, forward
    return np.asarray(rolled(roll_rad) @ R_w2c @ rolled(azimuth_rad))


def _shade(rng: np.random.Generator, normals: Floats, towards: Floats) -> Floats:
    """(N, 3) sRGB of grey plastic under one lamp, 0 to 255."""
    lamp = np.array([rng.uniform(-1, 1), rng.uniform(-1.4, 0.4), rng.uniform(-1.2, -0.3)])
    lamp /= np.linalg.norm(lamp)
    diffuse = np.maximum(normals @ lamp, 0)
    half = towards + lamp
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    highlight = np.maximum(np.einsum("ij,ij->i", normals, half), 0) ** rng.uniform(10, 60)
    ambient, albedo = rng.uniform(0.15, 0.5), rng.uniform(0.25, 0.9) * rng.uniform(0.92, 1.0, 3)
    light = albedo * (ambient + (1 - ambient) * diffuse[:, None]) + rng.uniform(0, 0.3) * highlight[:, None]
    return np.asarray(255 * np.clip(light, 0, 1) ** (1 / 2.2))
