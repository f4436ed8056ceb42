"""What may vary in a scene: the recipe's settings that decide how scenes are sampled and rendered.

A range is written ``[low, high]``; values are drawn uniformly between the two unless the setting says otherwise.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    ValidationInfo,
    field_validator,
    model_validator,
)
from pydantic_core import CoreSchema, PydanticCustomError, core_schema
from typing_extensions import Self

from synthetless.scenes.lens import fault
from synthetless.scenes.spec import NO_DISTORTION, Coefficients, Intrinsics

FloatRange = tuple[float, float]
IntRange = tuple[int, int]


@dataclass(frozen=True)
class Bounds:
    """The smallest and largest permitted value of a number, or of both ends of a range, and its unit."""

    low: float
    high: float
    unit: str = ""

    def check(self, value: Any) -> Any:
        ends = value if isinstance(value, Sequence) else (value,)
        if len(ends) == 2 and ends[0] > ends[1]:
            raise PydanticCustomError(
                "range", "min {low} is greater than max {high}; write [min, max]", {"low": ends[0], "high": ends[1]}
            )
        for end in ends:
            if not self.low <= end <= self.high:
                raise PydanticCustomError("bounds", "{end} is outside {text}", {"end": end, "text": str(self)})
        return value

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_after_validator_function(self.check, handler(source))

    def __str__(self) -> str:
        return f"{_plain(self.low)}..{_plain(self.high)}" + (f" {self.unit}" if self.unit else "")


def _plain(number: float) -> str:
    return str(int(number)) if number == int(number) else f"{number:g}"


def _is_name(given: Any, kind: str, names: Collection[str], also: str = "") -> bool:
    """Whether a group of settings is given by name; yes and no, which YAML makes true and false, are no names.

    Raises:
        PydanticCustomError: it is none of these names.
    """
    if not isinstance(given, str | bool):
        return False
    if given not in names:
        text = "unknown {kind}; give {names}{also}"
        raise PydanticCustomError("name", text, {"kind": kind, "names": ", ".join(names), "also": also})
    return True


class Settings(BaseModel):
    """A frozen group of settings; unknown keys and infinite numbers are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, use_attribute_docstrings=True)


class ObjectSettings(Settings):
    """Which objects lie on the table, and what they are made of."""

    count: Annotated[IntRange, Bounds(1, 100, "objects")] = (1, 9)
    """Labelled objects per scene, drawn with replacement."""
    ids: tuple[int, ...] | None = None
    """Object ids to draw from; null takes every model of the folder."""
    grey: Annotated[FloatRange, Bounds(0, 1)] = (0.12, 0.92)
    """Grey of each object: 0 black, 1 white."""
    grey_scale: Literal["displayed", "linear"] = "displayed"
    """What grey and tint are measured in: values as displayed, or linear light, which gives lighter objects."""
    tint: Annotated[float, Bounds(0, 1)] = 0.0
    """Largest deviation of a colour channel from the grey; 0 keeps objects grey."""
    colour: Literal["grey", "model", "mixed"] = "grey"
    """Colours of the objects: the grey above; those of the model's file, of its vertices or its texture; or mixed,
    either for each object. Distractors whose file has none are grey."""
    roughness: Annotated[FloatRange, Bounds(0, 1)] = (0.3, 0.9)
    """Surface roughness: 0 mirror-like, 1 matte."""
    specular: Annotated[FloatRange, Bounds(0, 1)] = (0.0, 0.5)
    """Specular level: 0 none, 0.5 ordinary plastic."""
    metallic: Annotated[FloatRange, Bounds(0, 1)] = (0.0, 0.0)
    """How much of a metal the surface is, which reflects in its own colour: 0 plastic, 1 metal."""
    distractors: Annotated[IntRange, Bounds(0, 100, "objects")] = (0, 0)
    """Unlabelled objects per scene from the distractors folder; they are rendered and occlude."""


class BoxSettings(Settings):
    """An open box that objects are poured into."""

    share: Annotated[float, Bounds(0, 1)] = 0.0
    """Share of the drops that have one; `release.container: box` is short for 1."""
    sides_m: Annotated[FloatRange, Bounds(0.02, 5, "m")] = (0.22, 0.32)
    """Length and width of its floor, inside, each drawn; no smaller than the largest object's diameter."""
    height_m: Annotated[FloatRange, Bounds(0.01, 2, "m")] = (0.05, 0.12)
    """Height of its rim above the table."""
    wall_m: Annotated[FloatRange, Bounds(0.001, 0.1, "m")] = (0.006, 0.01)
    """Thickness of its sides and floor."""
    slope_deg: Annotated[FloatRange, Bounds(0, 60, "deg")] = (0.0, 5.0)
    """How far its sides lean outwards."""
    grey: Annotated[FloatRange, Bounds(0, 1, "sRGB")] = (0.15, 0.85)
    """Its grey, as displayed."""
    tint: Annotated[float, Bounds(0, 1)] = 0.15
    """Largest deviation of a colour channel from the grey, as displayed."""

    @model_validator(mode="after")
    def _has_room(self) -> Self:
        if self.wall_m[1] >= self.height_m[0]:
            raise PydanticCustomError(
                "walls",
                "a floor of up to {wall} m (wall_m) fills a container that is {height} m high (height_m)",
                {"wall": self.wall_m[1], "height": self.height_m[0]},
            )
        return self


class TraySettings(BoxSettings):
    """A wide and low one with leaning sides."""

    share: Annotated[float, Bounds(0, 1)] = 0.0
    """Share of the drops that have one; `release.container: tray` is short for 1."""
    sides_m: Annotated[FloatRange, Bounds(0.02, 5, "m")] = (0.28, 0.42)
    """Length and width of its floor, inside, each drawn; no smaller than the largest object's diameter."""
    height_m: Annotated[FloatRange, Bounds(0.01, 2, "m")] = (0.025, 0.05)
    """Height of its rim above the table."""
    slope_deg: Annotated[FloatRange, Bounds(0, 60, "deg")] = (10.0, 35.0)
    """How far its sides lean outwards."""


CONTAINERS: dict[str, dict[str, Any]] = {"none": {}, "box": {"box": {"share": 1.0}}, "tray": {"tray": {"share": 1.0}}}
"""What the names of containers stand for."""


class ContainerSettings(Settings):
    """What objects are poured into: nothing, or what the shares say."""

    box: BoxSettings = Field(default_factory=BoxSettings)
    """With high sides."""
    tray: TraySettings = Field(default_factory=TraySettings)
    """With low ones."""

    @model_validator(mode="before")
    @classmethod
    def _by_name(cls, given: Any) -> Any:
        return CONTAINERS[given] if _is_name(given, "container", CONTAINERS) else given

    @model_validator(mode="after")
    def _are_shares(self) -> Self:
        if self.box.share + self.tray.share > 1:
            raise PydanticCustomError(
                "shares",
                "the shares of box and tray add up to {total}; at most 1",
                {"total": f"{self.box.share + self.tray.share:g}"},
            )
        return self


class ReleaseSettings(Settings):
    """How objects are let go above the table, and when they count as at rest."""

    spread_m: Annotated[float, Bounds(0, 1, "m")] = 0.06
    """Radius of the disc over which objects are released."""
    clearance_m: Annotated[FloatRange, Bounds(0, 1, "m")] = (0.005, 0.03)
    """Vertical gap between the bounding spheres of one object and the next."""
    max_throws: Annotated[int, Bounds(1, 1000, "throws")] = 20
    """A drop that does not come to rest is thrown again, at most this often altogether."""
    crowding: Annotated[float, Bounds(0.1, 10)] = 0.7
    """Radius of the invisible tube in which objects fall, in units of the root of their summed squared radii; it is
    never narrower than the objects need that are released over spread_m."""
    upright: Annotated[float, Bounds(0, 1)] = 0.0
    """Share of the labelled objects that are set down, apart from each other, on the face across their z axis: z up,
    or down if they would not stand that way up. The others are poured over them."""
    container: ContainerSettings = Field(default_factory=ContainerSettings)
    """What the others are poured into."""


class CameraSettings(Settings):
    """The camera's intrinsics and where it stands. The centre of pixel (i, j) is at (u, v) = (i, j)."""

    width: Annotated[int, Bounds(16, 8192, "px")] = 400
    """Image width."""
    height: Annotated[int, Bounds(16, 8192, "px")] = 400
    """Image height."""
    fx: Annotated[float, Bounds(1, 100000, "px")] = 1075.0
    """Horizontal focal length."""
    fy: Annotated[float, Bounds(1, 100000, "px")] = 1075.0
    """Vertical focal length."""
    cx: Annotated[float, Bounds(-100000, 100000, "px")] = 199.5
    """Horizontal principal point."""
    cy: Annotated[float, Bounds(-100000, 100000, "px")] = 199.5
    """Vertical principal point."""
    distortion: Annotated[Coefficients, Bounds(-100, 100)] = NO_DISTORTION
    """Of the lens: k1, k2, p1, p2, k3, Brown-Conrady in OpenCV's order; zeros are a pinhole."""
    distance_m: Annotated[FloatRange, Bounds(0.05, 20, "m")] = (0.6, 1.4)
    """Distance from the point aimed at."""
    elevation_deg: Annotated[FloatRange, Bounds(1, 90, "deg")] = (10.0, 89.0)
    """Angle between the viewing ray and the table; the table's tilt to the view is 90 minus this."""
    azimuth_deg: Annotated[FloatRange, Bounds(-360, 360, "deg")] = (0.0, 360.0)
    """Direction of the camera around the table."""
    roll_deg: Annotated[FloatRange, Bounds(-360, 360, "deg")] = (-15.0, 15.0)
    """Turn about the optical axis."""
    aim_offset_m: Annotated[float, Bounds(0, 1, "m")] = 0.03
    """The camera aims at the centre of the settled objects, off by up to this along the table."""
    views_per_drop: Annotated[int, Bounds(1, 1000, "views")] = 1
    """Images taken of one drop from different viewpoints."""

    @field_validator("distortion")
    @classmethod
    def _refuse_folds(cls, given: Coefficients, others: ValidationInfo) -> Coefficients:
        pinhole: dict[str, Any] = {name: others.data.get(name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
        if None not in pinhole.values() and (found := fault(Intrinsics(**pinhole, distortion=given))):
            raise PydanticCustomError("distortion", "{fault}", {"fault": found})
        return given

    @property
    def intrinsics(self) -> Intrinsics:
        """The camera's model."""
        return Intrinsics(self.width, self.height, self.fx, self.fy, self.cx, self.cy, self.distortion)


class RoomSettings(Settings):
    """A room around the table: a glowing ceiling, coloured walls, and soft lamps."""

    side_m: Annotated[FloatRange, Bounds(0.5, 1000, "m")] = (6.0, 10.0)
    """Side of its square floor plan; at least that of the table."""
    height_m: Annotated[FloatRange, Bounds(0.2, 1000, "m")] = (2.6, 4.0)
    """Height of the ceiling above the table; lamps and cameras must fit below it."""
    ceiling: Annotated[FloatRange, Bounds(0, 100)] = (0.1, 0.5)
    """Linear brightness of a white matte surface on the table under the ceiling alone."""
    walls: Annotated[FloatRange, Bounds(0, 100)] = (0.05, 0.4)
    """Linear brightness of each wall as it is seen, and of the floor below the table."""
    tint: Annotated[float, Bounds(0, 1)] = 0.3
    """Largest relative deviation of a colour channel of ceiling, walls and floor."""
    lamps: Annotated[IntRange, Bounds(0, 20, "lamps")] = (1, 3)
    """Soft lamps, discs that face the point aimed at, beside the one above."""
    lamp_azimuth_deg: Annotated[FloatRange, Bounds(-360, 360, "deg")] = (0.0, 360.0)
    """Direction of each of them around the table."""
    lamp_elevation_deg: Annotated[FloatRange, Bounds(1, 90, "deg")] = (30.0, 85.0)
    """Height of each of them above the table."""
    lamp_distance_m: Annotated[FloatRange, Bounds(0.1, 100, "m")] = (1.0, 2.2)
    """Distance of each of them from the point aimed at."""
    lamp_radius_m: Annotated[FloatRange, Bounds(0.001, 10, "m")] = (0.1, 0.4)
    """Radius of each disc."""
    lamp_strength: Annotated[FloatRange, Bounds(0, 100)] = (0.1, 0.5)
    """Linear brightness of a white matte surface that faces one of them."""
    lamp_warmth: Annotated[FloatRange, Bounds(0, 1)] = (0.0, 0.3)
    """Colour of each of them: 0 white, 1 candle-light."""


def _room_by_name(given: Any) -> Any:
    if not _is_name(given, "room", ("none", "ranges"), ", or a mapping of its settings"):
        return given
    return None if given == "none" else {}


class LightSettings(Settings):
    """One lamp and light from everywhere, and what stands around the table."""

    azimuth_deg: Annotated[FloatRange, Bounds(-360, 360, "deg")] = (0.0, 360.0)
    """Direction of the lamp around the table."""
    elevation_deg: Annotated[FloatRange, Bounds(1, 90, "deg")] = (30.0, 80.0)
    """Height of the lamp above the table."""
    distance_m: Annotated[FloatRange, Bounds(0.1, 100, "m")] = (1.0, 2.5)
    """Distance of the lamp from the point aimed at."""
    strength: Annotated[FloatRange, Bounds(0, 100)] = (0.3, 1.3)
    """Linear brightness of a white matte surface that faces the lamp."""
    radius_m: Annotated[FloatRange, Bounds(0.001, 1, "m")] = (0.01, 0.06)
    """Radius of the lamp; larger is softer shadows."""
    warmth: Annotated[FloatRange, Bounds(0, 1)] = (0.0, 0.5)
    """Colour of the lamp: 0 white, 1 candle-light."""
    ambient: Annotated[FloatRange, Bounds(0, 100)] = (0.08, 0.5)
    """Linear brightness of a white matte surface under the ambient light alone."""
    room: Annotated[RoomSettings | None, BeforeValidator(_room_by_name)] = None
    """A room around the table, whose ceiling, walls and lamps give more light and are mirrored by what shines: none,
    ranges as below, or its settings."""
    environments: str | None = None
    """Folder of panoramas, linear light in .hdr or .exr files twice as wide as high, that light the scene and are
    mirrored by what shines."""
    environment_strength: Annotated[FloatRange, Bounds(0, 100)] = (0.3, 0.8)
    """Linear brightness of a white matte surface that faces the zenith, under the panorama alone."""
    environment_share: Annotated[float, Bounds(0, 1)] = 1.0
    """Share of the drops that have a panorama, each of the folder equally often, turned at random; the others have the
    room, if there is one."""


class TableSettings(Settings):
    """The textured plane."""

    size_m: Annotated[float, Bounds(0.5, 1000, "m")] = 6.0
    """Side of the square table."""
    tile_m: Annotated[FloatRange, Bounds(0.01, 10, "m")] = (0.25, 1.0)
    """Side of one texture tile, drawn log-uniformly."""
    photos: Literal["mirrored", "seamless"] = "mirrored"
    """How photographs are repeated: mirrored at their borders; or seamless, opposite borders joined along the path on
    which they differ least, in tiles so small, down to the least of tile_m, that a texel is not larger than a pixel."""
    roughness: Annotated[FloatRange, Bounds(0, 1)] = (0.4, 1.0)
    """Surface roughness of the table."""
    specular: Annotated[FloatRange, Bounds(0, 1)] = (0.0, 0.0)
    """Specular level of the table; 0 renders it purely diffuse, which is faster."""


QUALITIES: dict[str, dict[str, Any]] = {
    "draft": {"samples": 1, "detail_samples": 4, "denoiser": "guided"},
    "standard": {"samples": 2, "detail_samples": 8, "denoiser": "guided"},
    "reference": {"samples": 256, "detail_samples": 0, "denoiser": "accurate"},
}
"""What the named qualities stand for; how near each comes to a converged render is in docs/scaling.md."""
_UNGUIDED_SAMPLES = {"draft": 4, "standard": 12}
"""What they take with Blender's own denoiser, or none."""


class RenderSettings(Settings):
    """Cycles."""

    quality: Literal["draft", "standard", "reference"] = "standard"
    """Sets samples and denoiser: draft to try a recipe out, standard to train with, reference to compare with."""
    samples: Annotated[int, Bounds(1, 65536, "samples")] = QUALITIES["standard"]["samples"]
    """Light paths per pixel; if not given, those of the quality."""
    detail_samples: Annotated[int, Bounds(0, 65536, "samples")] = QUALITIES["standard"]["detail_samples"]
    """Light paths per pixel where an image is noisiest, with the guided denoiser; 0 for no more than elsewhere; if not
    given, those of the quality, where they are more than samples."""
    detail_share: Annotated[float, Bounds(0.01, 1)] = 0.2
    """Share of the image that gets as many."""
    denoiser: Literal["none", "guided", "fast", "accurate"] = QUALITIES["standard"]["denoiser"]
    """Open Image Denoise with albedo and normal guides: none; guided, by guides without noise, from the geometry; or as
    Blender calls it, fast (guides as sampled) or accurate (guides denoised first); if not given, the quality's."""
    bounces: Annotated[int, Bounds(0, 128, "bounces")] = 3
    """Reflections of light between surfaces."""
    exposure: Annotated[FloatRange, Bounds(0.01, 0.99)] = (0.15, 0.7)
    """Mean displayed luminance that an image is kept within, as a camera's automatic exposure would."""
    shoulder: Annotated[float, Bounds(0, 0.9)] = 0.0
    """Upper part of the linear range over which highlights roll off in images without a sensor, which has its own; 0
    cuts them off at full scale."""

    @model_validator(mode="before")
    @classmethod
    def _follow_quality(cls, given: Any) -> Any:
        """What is not given follows from the quality; written out, so that a stored recipe keeps its meaning."""
        if not isinstance(given, dict):
            return given
        quality = given.get("quality", "standard")
        if not isinstance(quality, str) or quality not in QUALITIES:
            return given
        follows = dict(QUALITIES[quality])
        if given.get("denoiser", follows["denoiser"]) != "guided":
            follows["samples"], follows["detail_samples"] = _UNGUIDED_SAMPLES.get(quality, follows["samples"]), 0
        samples = given.get("samples", 0)
        if isinstance(samples, int) and samples >= follows["detail_samples"]:
            follows["detail_samples"] = 0
        return {**follows, **given}

    @model_validator(mode="after")
    def _refine_what_can_be(self) -> Self:
        if self.detail_samples and self.denoiser != "guided":
            text = "detail_samples = {many} needs the guided denoiser, not {denoiser}; give 0"
            raise PydanticCustomError("detail", text, {"many": self.detail_samples, "denoiser": self.denoiser})
        if 0 < self.detail_samples <= self.samples:
            text = "detail_samples = {many} must be more than samples = {few}, or 0"
            raise PydanticCustomError("detail", text, {"many": self.detail_samples, "few": self.samples})
        return self


SENSORS: dict[str, dict[str, Any]] = {
    "ranges": {},
    "primesense": {
        "blur_px": (0.4, 0.4),
        "vignetting": (0.1, 0.1),
        "exposure_ev": (0.0, 0.0),
        "shoulder": (0.3, 0.3),
        "photons": (3000.0, 3000.0),
        "read_noise": (0.003, 0.003),
        "red_gain": (0.97, 0.97),
        "blue_gain": (1.12, 1.12),
        "chroma_px": (1.75, 1.75),
        "sharpen": (0.6, 0.6),
        "sharpen_px": (2.0, 2.0),
        "jpeg_share": 0.0,
    },
}
"""What the named sensors stand for.

Those of primesense were set on crops of real T-LESS images, enlarged twice. There, the grain of flat parts is 2.55 in
luminance and 0.77 in red minus green (2.6 and 0.77 with these values), halos are 0.16 of an edge's height (0.16), and
edges as wide as rendered ones (0.9 times that).
"""


class SensorSettings(Settings):
    """A colour camera: optics, noise, and what it does to its images."""

    preset: Literal["ranges", "primesense"] = "ranges"
    """Sets all that is not given: ranges as below, or one camera, the PrimeSense of T-LESS."""
    variant: Annotated[int, Bounds(0, 1_000_000)] = 0
    """Another number draws other values and other noise for the same scenes."""
    blur_px: Annotated[FloatRange, Bounds(0, 10, "px")] = (0.0, 0.7)
    """Standard deviation of the point spread."""
    vignetting: Annotated[FloatRange, Bounds(0, 1)] = (0.0, 0.3)
    """Share of the light that the corners of the image lose."""
    exposure_ev: Annotated[FloatRange, Bounds(-5, 5, "stops")] = (-0.5, 0.5)
    """Over-exposure, beyond what render.exposure asks for."""
    shoulder: Annotated[FloatRange, Bounds(0, 0.9)] = (0.3, 0.3)
    """Upper part of the linear range over which highlights roll off; 0 cuts them off at full scale."""
    photons: Annotated[FloatRange, Bounds(10, 1e9, "photons")] = (400.0, 10000.0)
    """Photons that a pixel counts at full scale, drawn log-uniformly; fewer are more noise."""
    read_noise: Annotated[FloatRange, Bounds(0, 0.5)] = (0.001, 0.01)
    """Standard deviation of the noise in the dark, of full scale."""
    red_gain: Annotated[FloatRange, Bounds(0.1, 10)] = (0.84, 1.19)
    """White balance: gain of red relative to green, drawn log-uniformly."""
    blue_gain: Annotated[FloatRange, Bounds(0.1, 10)] = (0.84, 1.19)
    """White balance: gain of blue relative to green, drawn log-uniformly."""
    chroma_px: Annotated[FloatRange, Bounds(0, 10, "px")] = (0.0, 2.5)
    """Standard deviation of the blur by which a camera removes coloured noise."""
    sharpen: Annotated[FloatRange, Bounds(0, 10)] = (0.0, 1.0)
    """Amount of the unsharp masking, which gives edges their halos."""
    sharpen_px: Annotated[FloatRange, Bounds(0.1, 10, "px")] = (1.0, 2.0)
    """Standard deviation of the blur that is masked with; half the width of the halos."""
    jpeg_share: Annotated[float, Bounds(0, 1)] = 0.5
    """Share of the images that were compressed as JPEG inside the camera."""
    jpeg_quality: Annotated[IntRange, Bounds(1, 100)] = (70, 98)
    """Quality of that compression."""

    @model_validator(mode="before")
    @classmethod
    def _follow_preset(cls, given: Any) -> Any:
        """What is not given follows from the preset; written out, so that a stored recipe keeps its meaning."""
        if not isinstance(given, dict):
            return given
        preset = given.get("preset", "ranges")
        return {**SENSORS.get(preset, {}), **given} if isinstance(preset, str) else given


def _sensor_by_name(given: Any) -> Any:
    if not _is_name(given, "sensor", ("none", *SENSORS)):
        return given
    return None if given == "none" else {"preset": given}


DEPTH_SENSORS: dict[str, dict[str, Any]] = {
    "structured_light": {},
    "time_of_flight": {
        "baseline_m": (0.0, 0.0),
        "noise_mm": (0.5, 0.5),
        "noise_growth_mm": (1.0, 1.0),
        "noise_from_m": 0.5,
        "noise_order": 1,
        "noise_tilt_mm": (0.0, 0.0),
        "lateral_px": (0.25, 0.25),
        "edges": "mixed",
        "disparity_step_px": (0.0, 0.0),
        "step_mm": (1.0, 1.0),
        "grazing_deg": (78.0, 86.0),
        "dark": (0.005, 0.02),
    },
}
"""What the named depth cameras stand for."""


class DepthSensorSettings(Settings):
    """A depth camera, for the output depth_sensed: what its projector reaches, its noise, its steps."""

    preset: Literal["structured_light", "time_of_flight"] = "structured_light"
    """Sets all that is not given: as below, or a camera that times its light."""
    variant: Annotated[int, Bounds(0, 1_000_000)] = 0
    """Another number draws other values and other noise for the same scenes."""
    baseline_m: Annotated[FloatRange, Bounds(-1, 1, "m")] = (0.075, 0.075)
    """How far to the right of the camera the projector is; its shadows lie to the left of objects. 0 has none."""
    noise_mm: Annotated[FloatRange, Bounds(0, 100, "mm")] = (1.2, 1.2)
    """Standard deviation of the axial noise at noise_from_m and nearer, seen straight on."""
    noise_growth_mm: Annotated[FloatRange, Bounds(0, 1000, "mm")] = (1.9, 1.9)
    """What is added to it for each metre beyond, or each square metre; see noise_order."""
    noise_from_m: Annotated[float, Bounds(0, 100, "m")] = 0.4
    """Depth from which on it grows."""
    noise_order: Annotated[int, Bounds(1, 2)] = 2
    """Whether it grows linearly or with the square of the depth."""
    noise_tilt_mm: Annotated[FloatRange, Bounds(0, 100, "mm")] = (0.1, 0.1)
    """What tilted surfaces add, in 1 m and at 45 degrees."""
    lateral_px: Annotated[FloatRange, Bounds(0, 10, "px")] = (0.8, 0.8)
    """Standard deviation of the lateral noise."""
    edges: Literal["sharp", "mixed"] = "sharp"
    """Whether a pixel has the depth of one surface, or, at edges, one between two surfaces."""
    disparity_step_px: Annotated[FloatRange, Bounds(0, 10, "px")] = (0.125, 0.125)
    """Steps in which the disparity is measured; 0 for none."""
    step_mm: Annotated[FloatRange, Bounds(0, 100, "mm")] = (0.0, 0.0)
    """Steps in which depth is measured, where it is not by disparity; 0 for none."""
    grazing_deg: Annotated[FloatRange, Bounds(1, 90, "deg")] = (75.0, 85.0)
    """Angle between ray and normal from which on nothing returns."""
    dark: Annotated[FloatRange, Bounds(0, 1)] = (0.01, 0.03)
    """Linear albedo, seen straight on, below which nothing returns; of metal, only what is not metallic counts."""
    speckle: Annotated[FloatRange, Bounds(0, 1)] = (0.25, 0.25)
    """Relative standard deviation of the returned light, which makes the edges of dark regions ragged."""
    range_m: Annotated[FloatRange, Bounds(0, 100, "m")] = (0.3, 5.0)
    """Nearest and farthest depth that is measured; nothing is drawn."""

    @model_validator(mode="before")
    @classmethod
    def _follow_preset(cls, given: Any) -> Any:
        """What is not given follows from the preset; written out, so that a stored recipe keeps its meaning."""
        if not isinstance(given, dict):
            return given
        preset = given.get("preset", "structured_light")
        return {**DEPTH_SENSORS.get(preset, {}), **given} if isinstance(preset, str) else given


def _depth_sensor_by_name(given: Any) -> Any:
    if not _is_name(given, "depth sensor", ("none", *DEPTH_SENSORS)):
        return given
    return None if given == "none" else {"preset": given}


class SceneSettings(Settings):
    """All that decides what a scene looks like."""

    objects: ObjectSettings = Field(default_factory=ObjectSettings)
    """Which objects lie on the table."""
    release: ReleaseSettings = Field(default_factory=ReleaseSettings)
    """How they are dropped."""
    camera: CameraSettings = Field(default_factory=CameraSettings)
    """Where the camera stands."""
    light: LightSettings = Field(default_factory=LightSettings)
    """The lamp and the ambient light."""
    table: TableSettings = Field(default_factory=TableSettings)
    """The textured plane."""
    render: RenderSettings = Field(default_factory=RenderSettings)
    """How the image is computed."""
    sensor: Annotated[SensorSettings | None, BeforeValidator(_sensor_by_name)] = None
    """The camera that takes the picture: none for what the renderer gives, primesense, or ranges; or its settings."""
    depth_sensor: Annotated[DepthSensorSettings | None, BeforeValidator(_depth_sensor_by_name)] = None
    """The depth camera of the output depth_sensed: none, structured_light, or time_of_flight; or its settings."""
