"""Draws scenes: settings, a seed and a drop number decide everything that is not left to physics.

Each purpose has a random stream of its own, so that a change of one setting leaves all else as it was, and a
second throw of the same drop changes only how the objects are let go.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum

import numpy as np

from synthetless.scenes.container import turn
from synthetless.scenes.rotations import random_rotation
from synthetless.scenes.settings import (
    BoxSettings,
    CameraSettings,
    ContainerSettings,
    DepthSensorSettings,
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
    ContainerKind,
    ContainerSpec,
    DepthSensorSpec,
    EnvironmentSpec,
    Material,
    ObjectSpec,
    PlaneSpec,
    PointLight,
    Pose,
    Quaternion,
    Role,
    RoomSpec,
    SceneSpec,
    SensorSpec,
    Standing,
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
    CONTAINER = 9
    UPRIGHT = 10
    ENVIRONMENT = 11
    COLOUR = 12
    DEPTH_SENSOR = 13


@dataclass(frozen=True)
class Catalogue:
    """What a scene can be made of.

    Attributes:
        models: diameter in metres of each labelled model, by object id.
        distractors: the same of the unlabelled ones.
        photos: names of the photographs for the table; empty means the built-in textures.
        standing: how each labelled model stands, where objects are to be set down upright.
        panoramas: names of the panoramas that may light a scene.
        coloured: role and id of the objects whose files have colours.
    """

    models: Mapping[int, float]
    distractors: Mapping[int, float]
    photos: Sequence[str] = ()
    standing: Mapping[int, Standing] = field(default_factory=dict)
    panoramas: Sequence[str] = ()
    coloured: Collection[tuple[Role, int]] = ()


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
    materials, metallic, colour = (stream(of) for of in (Stream.MATERIALS, Stream.METALLIC, Stream.COLOUR))
    diameters = [(catalogue.models if role == "model" else catalogue.distractors)[i] for role, i in chosen]
    container = sample_container(settings.release.container, seed, drop)
    upright = _set_down(settings.release, catalogue, chosen, container, stream(Stream.UPRIGHT, attempt))
    releases = _release(settings.release, diameters, upright, container, stream(Stream.RELEASE, attempt))
    objects = tuple(
        ObjectSpec(role, obj_id, _material(settings.objects, materials, metallic), pose)
        for (role, obj_id), pose in zip(chosen, releases, strict=True)
    )
    objects = tuple(_coloured(item, settings.objects, catalogue, colour) for item in objects)
    light, ambient = _lights(settings.light, stream(Stream.LIGHT))
    views = tuple(
        _view(settings.camera, stream(Stream.VIEWS, number)) for number in range(settings.camera.views_per_drop)
    )
    plane = _plane(settings.table, catalogue.photos, stream(Stream.PLANE))
    room, environment = sample_surroundings(settings.light, catalogue.panoramas, seed, drop)
    return SceneSpec(drop, attempt, objects, plane, light, ambient, views, room, container, environment)


def sample_surroundings(
    settings: LightSettings, panoramas: Sequence[str], seed: int, drop: int
) -> tuple[RoomSpec | None, EnvironmentSpec | None]:
    """Draw what stands around the table of one drop: a room, a panorama, or nothing.

    Args:
        settings: the ranges to draw from.
        panoramas: names of those to draw from. Only the name that is drawn depends on them.
        seed, drop: as for ``sample_scene``.
    """
    rng = _stream(seed, drop, Stream.ENVIRONMENT)
    if panoramas and float(rng.uniform()) < settings.environment_share:
        turn_deg, strength = float(rng.uniform(0, 360)), _uniform(rng, settings.environment_strength)
        return None, EnvironmentSpec(panoramas[int(rng.integers(len(panoramas)))], turn_deg, strength)
    return None if settings.room is None else _room(settings.room, _stream(seed, drop, Stream.ROOM)), None


def _room(settings: RoomSettings, rng: np.random.Generator) -> RoomSpec:
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


def sample_container(settings: ContainerSettings, seed: int, drop: int) -> ContainerSpec | None:
    """Draw what the objects of a drop are poured into, if anything; arguments as for ``sample_scene``."""
    rng = _stream(seed, drop, Stream.CONTAINER)
    of_kind: tuple[tuple[ContainerKind, BoxSettings], ...] = (("box", settings.box), ("tray", settings.tray))
    drawn, reached = float(rng.uniform()), 0.0
    for kind, asked in of_kind:
        reached += asked.share
        if drawn < reached:
            return _container(kind, asked, rng)
    return None


def _container(kind: ContainerKind, settings: BoxSettings, rng: np.random.Generator) -> ContainerSpec:
    return ContainerSpec(
        kind=kind,
        floor_m=(_uniform(rng, settings.sides_m), _uniform(rng, settings.sides_m)),
        height_m=_uniform(rng, settings.height_m),
        wall_m=_uniform(rng, settings.wall_m),
        slope_deg=_uniform(rng, settings.slope_deg),
        rotation_deg=float(rng.uniform(0, 360)),
        material=Material(_colour(settings.grey, settings.tint, "displayed", rng), float(rng.uniform(0.4, 0.9)), 0.3),
    )


def sample_sensor(settings: SensorSettings, seed: int, drop: int, view: int) -> SensorSpec:
    """Draw the camera of one image; arguments as for ``sample_scene``, and the view of the drop."""
    return draw_sensor(settings, _stream(seed, drop, Stream.SENSOR, view, settings.variant))


def sample_depth_sensor(settings: DepthSensorSettings, seed: int, drop: int, view: int) -> DepthSensorSpec:
    """Draw the depth camera of one image; arguments as for ``sample_sensor``."""
    rng = _stream(seed, drop, Stream.DEPTH_SENSOR, view, settings.variant)
    return DepthSensorSpec(
        baseline_m=_uniform(rng, settings.baseline_m),
        noise_mm=_uniform(rng, settings.noise_mm),
        noise_growth_mm=_uniform(rng, settings.noise_growth_mm),
        noise_from_m=settings.noise_from_m,
        noise_order=settings.noise_order,
        noise_tilt_mm=_uniform(rng, settings.noise_tilt_mm),
        lateral_px=_uniform(rng, settings.lateral_px),
        edges=settings.edges,
        disparity_step_px=_uniform(rng, settings.disparity_step_px),
        step_mm=_uniform(rng, settings.step_mm),
        grazing_deg=_uniform(rng, settings.grazing_deg),
        dark=_uniform(rng, settings.dark),
        speckle=_uniform(rng, settings.speckle),
        range_m=settings.range_m,
        noise_seed=int(rng.integers(2**32)),
    )


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
    albedo = _colour(settings.grey, settings.tint, settings.grey_scale, rng)
    roughness, specular = _uniform(rng, settings.roughness), _uniform(rng, settings.specular)
    return Material(albedo, roughness, specular, _uniform(metallic, settings.metallic))


def _colour(grey: FloatRange, tint: float, scale: str, rng: np.random.Generator) -> Vector:
    """Linear colour of a grey whose channels deviate; both on a linear scale, or as displayed."""
    drawn = _uniform(rng, grey)
    deviations = rng.uniform(-tint, tint, size=3)
    channels = (min(max(drawn + d, 0.0), 1.0) for d in deviations.tolist())
    red, green, blue = channels if scale == "linear" else map(linear_from_srgb, channels)
    return (red, green, blue)


def _coloured(item: ObjectSpec, settings: ObjectSettings, catalogue: Catalogue, rng: np.random.Generator) -> ObjectSpec:
    """The object in the colours of its file, if they are drawn and it has any."""
    share = {"grey": 0.0, "mixed": 0.5, "model": 1.0}[settings.colour]
    if float(rng.uniform()) >= share or (item.role, item.obj_id) not in catalogue.coloured:
        return item
    return replace(item, material=replace(item.material, colour="model"))


def _release(
    settings: ReleaseSettings,
    diameters_m: Sequence[float],
    upright: Mapping[int, tuple[Pose, float]],
    container: ContainerSpec | None,
    rng: np.random.Generator,
) -> list[Pose]:
    """One above the other, bounding spheres apart, spread over a disc or a container's floor.

    Those that are set down, by number, are given with their height; the others are poured over them.
    """
    poses = []
    floor = max((top for _, top in upright.values()), default=0.0 if container is None else container.wall_m)
    for number, diameter in enumerate(diameters_m):
        rotation = random_rotation(rng)
        share, turned = float(rng.uniform()), float(rng.uniform())
        clearance = _uniform(rng, settings.clearance_m)
        if number in upright:
            poses.append(upright[number][0])
            continue
        if container is None:
            radius, angle = settings.spread_m * math.sqrt(share), turned * 2 * math.pi
            x, y = radius * math.cos(angle), radius * math.sin(angle)
        else:
            x, y = _on_floor(container, diameter / 2, (share, turned))
        height = floor + clearance + diameter / 2
        floor = height + diameter / 2
        poses.append(Pose(rotation, (x, y, height)))
    return poses


def _on_floor(container: ContainerSpec, radius_m: float, shares: tuple[float, float]) -> tuple[float, float]:
    """The point at some share of each of the floor's sides, where a circle of some radius stays on the floor."""
    along = [
        (share - 0.5) * max(side - 2 * radius_m, 0.0) for share, side in zip(shares, container.floor_m, strict=True)
    ]
    x, y = (turn(container)[:2, :2] @ along).tolist()
    return x, y


_SET_DOWN_M, _APART_M = 0.001, 0.005
"""From how high objects are set down, and how far from each other at least."""
_PLACES = 100
"""So many places are tried for an object that is set down."""


def _set_down(
    settings: ReleaseSettings,
    catalogue: Catalogue,
    chosen: Sequence[tuple[Role, int]],
    container: ContainerSpec | None,
    rng: np.random.Generator,
) -> dict[int, tuple[Pose, float]]:
    """Poses of the objects that are set down upright, by number, and the height that each reaches.

    They are apart from each other; those that find no room on a container's floor are left out.
    """
    placed: dict[int, tuple[Pose, float]] = {}
    circles: list[tuple[float, float, float]] = []
    ground = 0.0 if container is None else container.wall_m
    for number, (role, obj_id) in enumerate(chosen):
        if role != "model" or float(rng.uniform()) >= settings.upright:
            continue
        stands = catalogue.standing[obj_id]
        half_turn = float(rng.uniform(0, math.pi))
        circle = _free_place(stands.radius_m, circles, settings.spread_m, container, rng)
        if circle is None:
            continue
        circles.append(circle)
        cos, sin = math.cos(half_turn), math.sin(half_turn)
        rotation: Quaternion = (0.0, cos, sin, 0.0) if stands.upside_down else (cos, 0.0, 0.0, sin)
        foot = ground + _SET_DOWN_M
        placed[number] = Pose(rotation, (*circle[:2], foot + stands.origin_m)), foot + stands.height_m
    return placed


def _free_place(
    radius_m: float,
    taken: Sequence[tuple[float, float, float]],
    spread_m: float,
    container: ContainerSpec | None,
    rng: np.random.Generator,
) -> tuple[float, float, float] | None:
    """A circle (x, y, radius) apart from the taken ones: on a disc that grows until there is room, or on the floor."""
    for attempt in range(_PLACES):
        shares = float(rng.uniform()), float(rng.uniform())
        if container is None:
            reach = spread_m * math.sqrt(shares[0]) * 1.1**attempt
            x, y = reach * math.cos(2 * math.pi * shares[1]), reach * math.sin(2 * math.pi * shares[1])
        else:
            x, y = _on_floor(container, radius_m, shares)
        if all(math.hypot(x - u, y - v) >= radius_m + other + _APART_M for u, v, other in taken):
            return x, y, radius_m
    return None


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
