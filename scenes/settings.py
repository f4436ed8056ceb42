"""What may vary in a scene: the recipe's settings that decide how scenes are sampled and rendered.

A range is written ``[low, high]``; values are drawn uniformly between the two unless the setting says otherwise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, GetCoreSchemaHandler, model_validator
from pydantic_core import CoreSchema, PydanticCustomError, core_schema

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


class Settings(BaseModel):
    """A frozen group of settings; unknown keys and infinite numbers are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, use_attribute_docstrings=True)


class ObjectSettings(Settings):
    """Which objects lie on the table, and what they are made of."""

    count: Annotated[IntRange, Bounds(1, 100, "objects")] = (1, 9)
    """Labelled objects per scene, drawn with replacement."""
    ids: tuple[int, ...] | None = None
    """Object ids to draw from; null takes every model of the folder."""
    grey: Annotated[FloatRange, Bounds(0, 1, "sRGB")] = (0.12, 0.92)
    """Grey of each object, as displayed: 0 black, 1 white."""
    tint: Annotated[float, Bounds(0, 1)] = 0.0
    """Largest deviation of a colour channel from the grey, as displayed; 0 keeps objects grey."""
    roughness: Annotated[FloatRange, Bounds(0, 1)] = (0.3, 0.9)
    """Surface roughness: 0 mirror-like, 1 matte."""
    specular: Annotated[FloatRange, Bounds(0, 1)] = (0.0, 0.5)
    """Specular level: 0 none, 0.5 ordinary plastic."""
    distractors: Annotated[IntRange, Bounds(0, 100, "objects")] = (0, 0)
    """Unlabelled objects per scene from the distractors folder; they are rendered and occlude."""


class ReleaseSettings(Settings):
    """How objects are let go above the table, and when they count as at rest."""

    spread_m: Annotated[float, Bounds(0, 1, "m")] = 0.06
    """Radius of the disc over which objects are released."""
    clearance_m: Annotated[FloatRange, Bounds(0, 1, "m")] = (0.005, 0.03)
    """Vertical gap between the bounding spheres of one object and the next."""
    max_throws: Annotated[int, Bounds(1, 1000, "throws")] = 20
    """A drop that does not come to rest is thrown again, at most this often altogether."""


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


class LightSettings(Settings):
    """One lamp and light from everywhere."""

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


class TableSettings(Settings):
    """The textured plane."""

    size_m: Annotated[float, Bounds(0.5, 1000, "m")] = 6.0
    """Side of the square table."""
    tile_m: Annotated[FloatRange, Bounds(0.01, 10, "m")] = (0.25, 1.0)
    """Side of one texture tile, drawn log-uniformly."""
    roughness: Annotated[FloatRange, Bounds(0, 1)] = (0.4, 1.0)
    """Surface roughness of the table."""
    specular: Annotated[FloatRange, Bounds(0, 1)] = (0.0, 0.0)
    """Specular level of the table; 0 renders it purely diffuse, which is faster."""


QUALITIES: dict[str, dict[str, Any]] = {
    "draft": {"samples": 4, "denoiser": "fast"},
    "standard": {"samples": 12, "denoiser": "fast"},
    "reference": {"samples": 256, "denoiser": "accurate"},
}
"""What the named qualities stand for; how near each comes to a converged render is in docs/scaling.md."""


class RenderSettings(Settings):
    """Cycles."""

    quality: Literal["draft", "standard", "reference"] = "standard"
    """Sets samples and denoiser: draft to try a recipe out, standard to train with, reference to compare with."""
    samples: Annotated[int, Bounds(1, 65536, "samples")] = QUALITIES["standard"]["samples"]
    """Light paths per pixel; if not given, those of the quality."""
    denoiser: Literal["none", "fast", "accurate"] = QUALITIES["standard"]["denoiser"]
    """Open Image Denoise with albedo and normal guides: none, fast (guides as they are), accurate (guides denoised
    first); if not given, the quality's."""
    bounces: Annotated[int, Bounds(0, 128, "bounces")] = 3
    """Reflections of light between surfaces."""
    exposure: Annotated[FloatRange, Bounds(0.01, 0.99)] = (0.15, 0.7)
    """Mean displayed luminance that an image is kept within, as a camera's automatic exposure would."""

    @model_validator(mode="before")
    @classmethod
    def _follow_quality(cls, given: Any) -> Any:
        """What is not given follows from the quality; written out, so that a stored recipe keeps its meaning."""
        if not isinstance(given, dict):
            return given
        quality = given.get("quality", "standard")
        return {**QUALITIES.get(quality, {}), **given} if isinstance(quality, str) else given


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
