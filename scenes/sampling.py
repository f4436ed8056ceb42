"""Draws scenes: settings, a seed and a drop number decide everything that is not left to physics.

Each purpose has a random stream of its own, so that a change of one setting leaves all else as it was, and a
second throw of the same drop changes only how the objects are let go.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from synthetless.scenes.rotations import random_rotation
from synthetless.scenes.settings import (
    CameraSettings,
    FloatRange,
    LightSettings,
    ObjectSettings,
    ReleaseSettings,
    RoomSettings,
    SceneSettings,
    SensorSettings,
    TableSettings,
)
from synthetless.scenes.spec import (
    AmbientLight,
    AreaLight,
    Material,
    ObjectSpec,
    PlaneSpec,
    PointLight,
    Pose,
    Role,
    RoomSpec,
    SceneSpec,
    SensorSpec,
    Vector,
    View,
)
from synthetless.scenes.srgb import linear_from_srgb
from synthetless.scenes.textures import sample_texture

_CANDLE = (1.0, 0.56, 0.17)
"""Linear RGB of a black body at about 2000 K, largest component 1: a lamp of warmth 1."""


class Stream(IntEnum):
    """One random stream per purpose; the numbers are part of every dataset's identity and never change."""

    OBJECTS = 0
    MATERIALS = 1
    RELEASE = 2
    PLANE = 3
    LIGHT = 4
    VIEWS = 5
    SENSOR = 6
    METALLIC = 7
    ROOM = 8


@dataclass(frozen=True)
class Catalogue:
    """What a scene can be made of.

    Attributes:
        models: diameter in metres of each labelled model, by object id.
        distractors: the same of the unlabelled ones.
        photos: names of the photographs for the table; empty means the built-in textures.
    """

    models: Mapping[int, float]
    distractors: Mapping[int, float]
    photos: Sequence[str] = ()


def sample_scene(settings: SceneSettings, catalogue: Catalogue, seed: int, drop: int, attempt: int = 0) -> SceneSpec:
    """Draw the scene of one drop.

    Args:
        settings: the ranges to draw from.
        catalogue: models, distractors and photographs to draw from.
        seed: of the dataset.
        drop: number of the drop within the dataset.
        attempt: number of the throw; only the release poses depend on it.

    Returns:
        The same scene for the same arguments, on every machine.
    """

    def stream(purpose: Stream, *further: int) -> np.random.Generator:
        return _stream(seed, drop, purpose, *further)

    chosen = _choose_objects(settings.objects, catalogue, stream(Stream.OBJECTS))
    materials, metallic = stream(Stream.MATERIALS), stream(Stream.METALLIC)
    diameters = [(catalogue.models if role == "model" else catalogue.distractors)[i] for role, i in chosen]
    releases = _release(settings.release, diameters, stream(Stream.RELEASE, attempt))
    objects = tuple(
        ObjectSpec(role, obj_id, _material(settings.objects, materials, metallic), pose)
        for (role, obj_id), pose in zip(chosen, releases, strict=True)
    )
    light, ambient = _lights(settings.light, stream(Stream.LIGHT))
    views = tuple(
        _view(settings.camera, stream(Stream.VIEWS, number)) for number in range(settings.camera.views_per_drop)
    )
    plane = _plane(settings.table, catalogue.photos, stream(Stream.PLANE))
    room = sample_room(settings.light.room, seed, drop)
    return SceneSpec(drop, attempt, objects, plane, light, ambient, views, room)


def sample_room(settings: RoomSettings | None, seed: int, drop: int) -> RoomSpec | None:
    """Draw the room of one drop; None without settings. Arguments as for ``sample_scene``."""
    if settings is None:
        return None
    rng = _stream(seed, drop, Stream.ROOM)
    side_m, height_m = _uniform(rng, settings.side_m), _uniform(rng, settings.height_m)
    level = _uniform(rng, settings.ceiling) / ceiling_share(side_m, height_m)
    ceiling = _tinted(level, settings.tint, rng)
    east, north, west, south, floor = (_tinted(_uniform(rng, settings.walls), settings.tint, rng) for _ in range(5))
    lamps = tuple(_area_light(settings, rng) for _ in range(rng.integers(*settings.lamps, endpoint=True)))
    return RoomSpec(side_m, height_m, ceiling, floor, (east, north, west, south), lamps)


def ceiling_share(side_m: float, height_m: float) -> float:
    """Share of a square ceiling in the light, equal from everywhere, that reaches the table's middle, facing up.

    Four times the view factor of a rectangle from a point below its corner (Howell, A catalog of radiation heat
    transfer configuration factors, B-4).
    """
    ratio = side_m / 2 / height_m
    slope = ratio / math.sqrt(1 + ratio * ratio)
    return 4 / math.pi * slope * math.atan(slope)


def sample_sensor(settings: SensorSettings, seed: int, drop: int, view: int) -> SensorSpec:
    """Draw the camera of one image; arguments as for ``sample_scene``, and the view of the drop."""
    return draw_sensor(settings, _stream(seed, drop, Stream.SENSOR, view, settings.variant))


def draw_sensor(settings: SensorSettings, rng: np.random.Generator) -> SensorSpec:
    """Draw a camera."""
    was_jpeg = float(rng.uniform()) < settings.jpeg_share
    quality = int(rng.integers(*settings.jpeg_quality, endpoint=True))
    return SensorSpec(
        blur_px=_uniform(rng, settings.blur_px),
        vignetting=_uniform(rng, settings.vignetting),
        exposure_ev=_uniform(rng, settings.exposure_ev),
        shoulder=_uniform(rng, settings.shoulder),
        photons=_log_uniform(rng, settings.photons),
        read_noise=_uniform(rng, settings.read_noise),
        red_gain=_log_uniform(rng, settings.red_gain),
        blue_gain=_log_uniform(rng, settings.blue_gain),
        chroma_px=_uniform(rng, settings.chroma_px),
        sharpen=_uniform(rng, settings.sharpen),
        sharpen_px=_uniform(rng, settings.sharpen_px),
        jpeg_quality=quality if was_jpeg else None,
        noise_seed=int(rng.integers(2**32)),
    )


def _stream(seed: int, drop: int, purpose: Stream, *further: int) -> np.random.Generator:
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(drop, purpose, *further)))


def _uniform(rng: np.random.Generator, bounds: FloatRange) -> float:
    return float(rng.uniform(*bounds))


def _log_uniform(rng: np.random.Generator, bounds: FloatRange) -> float:
    low, high = bounds
    return float(math.exp(rng.uniform(math.log(low), math.log(high))))


def _choose_objects(settings: ObjectSettings, catalogue: Catalogue, rng: np.random.Generator) -> list[tuple[Role, int]]:
    """Labelled objects and distractors in random order, since who is released last lies on top."""

    def draw(role: Role, ids: Mapping[int, float], count: tuple[int, int]) -> list[tuple[Role, int]]:
        number = int(rng.integers(count[0], count[1], endpoint=True))
        return [(role, int(i)) for i in rng.choice(sorted(ids), size=number)] if number else []

    chosen = draw("model", catalogue.models, settings.count)
    chosen += draw("distractor", catalogue.distractors, settings.distractors)
    return [chosen[i] for i in rng.permutation(len(chosen))]


def _material(settings: ObjectSettings, rng: np.random.Generator, metallic: np.random.Generator) -> Material:
    grey = _uniform(rng, settings.grey)
    deviations = rng.uniform(-settings.tint, settings.tint, size=3)
    channels = (min(max(grey + d, 0.0), 1.0) for d in deviations.tolist())
    red, green, blue = channels if settings.grey_scale == "linear" else map(linear_from_srgb, channels)
    roughness, specular = _uniform(rng, settings.roughness), _uniform(rng, settings.specular)
    return Material((red, green, blue), roughness, specular, _uniform(metallic, settings.metallic))


def _release(settings: ReleaseSettings, diameters_m: Sequence[float], rng: np.random.Generator) -> list[Pose]:
    """One above the other, bounding spheres apart, spread over a disc."""
    poses, floor = [], 0.0
    for diameter in diameters_m:
        rotation = random_rotation(rng)
        radius, angle = settings.spread_m * math.sqrt(rng.uniform()), rng.uniform(0, 2 * math.pi)
        height = floor + _uniform(rng, settings.clearance_m) + diameter / 2
        floor = height + diameter / 2
        poses.append(Pose(rotation, (radius * math.cos(angle), radius * math.sin(angle), height)))
    return poses


def _plane(settings: TableSettings, photos: Sequence[str], rng: np.random.Generator) -> PlaneSpec:
    return PlaneSpec(
        texture=sample_texture(rng, photos),
        tile_m=_log_uniform(rng, settings.tile_m),
        rotation_deg=float(rng.uniform(0, 360)),
        shift=(float(rng.uniform()), float(rng.uniform())),
        roughness=_uniform(rng, settings.roughness),
        specular=_uniform(rng, settings.specular),
    )


def lamp_warmth(light: PointLight) -> float:
    """The warmth that a lamp's colour was drawn with: 0 is white, 1 a candle."""
    return (1 - light.color[1]) / (1 - _CANDLE[1])


def _lights(settings: LightSettings, rng: np.random.Generator) -> tuple[PointLight, AmbientLight]:
    warmth = _uniform(rng, settings.warmth)
    light = PointLight(
        azimuth_deg=_uniform(rng, settings.azimuth_deg),
        elevation_deg=_uniform(rng, settings.elevation_deg),
        distance_m=_uniform(rng, settings.distance_m),
        strength=_uniform(rng, settings.strength),
        radius_m=_uniform(rng, settings.radius_m),
        color=_warm(warmth),
    )
    return light, AmbientLight(_uniform(rng, settings.ambient), (1.0, 1.0, 1.0))


def _area_light(settings: RoomSettings, rng: np.random.Generator) -> AreaLight:
    return AreaLight(
        azimuth_deg=_uniform(rng, settings.lamp_azimuth_deg),
        elevation_deg=_uniform(rng, settings.lamp_elevation_deg),
        distance_m=_uniform(rng, settings.lamp_distance_m),
        strength=_uniform(rng, settings.lamp_strength),
        radius_m=_uniform(rng, settings.lamp_radius_m),
        color=_warm(_uniform(rng, settings.lamp_warmth)),
    )


def _warm(warmth: float) -> Vector:
    return (1.0, 1 + warmth * (_CANDLE[1] - 1), 1 + warmth * (_CANDLE[2] - 1))


def _tinted(level: float, tint: float, rng: np.random.Generator) -> Vector:
    red, green, blue = (level * (1 + rng.uniform(-tint, tint, size=3))).tolist()
    return (red, green, blue)


def _view(settings: CameraSettings, rng: np.random.Generator) -> View:
    radius, angle = settings.aim_offset_m * math.sqrt(rng.uniform()), rng.uniform(0, 2 * math.pi)
    return View(
        distance_m=_uniform(rng, settings.distance_m),
        elevation_deg=_uniform(rng, settings.elevation_deg),
        azimuth_deg=_uniform(rng, settings.azimuth_deg),
        roll_deg=_uniform(rng, settings.roll_deg),
        aim_offset_m=(radius * math.cos(angle), radius * math.sin(angle), 0.0),
    )
