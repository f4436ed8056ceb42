"""The form of every JSON file of a dataset: BOP's, and those that it adds."""

# ruff: noqa: N815  (the fields are the files' own keys)
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from synthetless.config import Recipe

_EXACT = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False, frozen=True)
_OPEN = ConfigDict(extra="ignore", strict=True, allow_inf_nan=False, frozen=True)

Number = Annotated[float, Field(ge=-1e12, le=1e12)]
Vector = Annotated[list[Number], Field(min_length=3, max_length=3)]
Matrix = Annotated[list[Number], Field(min_length=9, max_length=9)]
Box = Annotated[list[int], Field(min_length=4, max_length=4)]
Count = Annotated[int, Field(ge=0)]
NotNegative = Annotated[float, Field(ge=0, le=1e12)]
Positive = Annotated[float, Field(gt=0, le=1e12)]
Id = Annotated[int, Field(ge=0)]


class CameraEntry(BaseModel):
    """An image in scene_camera.json."""

    model_config = _EXACT
    cam_K: Matrix
    cam_R_w2c: Matrix
    cam_t_w2c: Vector
    depth_scale: Positive


class GtEntry(BaseModel):
    """An instance in scene_gt.json."""

    model_config = _EXACT
    cam_R_m2c: Matrix
    cam_t_m2c: Vector
    obj_id: Id


class GtInfoEntry(BaseModel):
    """An instance in scene_gt_info.json."""

    model_config = _EXACT
    bbox_obj: Box
    bbox_visib: Box
    px_count_all: Count
    px_count_valid: Count
    px_count_visib: Count
    visib_fract: NotNegative


class ForeignCameraEntry(BaseModel):
    """An image in somebody else's scene_camera.json, which may say more, or not where the camera stands."""

    model_config = _OPEN
    cam_K: Matrix
    depth_scale: Positive = 1.0


class ForeignGtEntry(GtEntry):
    """An instance in somebody else's scene_gt.json, which may say more."""

    model_config = _OPEN


class ForeignGtInfoEntry(GtInfoEntry):
    """An instance in somebody else's scene_gt_info.json, which may say more."""

    model_config = _OPEN


class CanonicalEntry(BaseModel):
    """An instance in scene_gt_canonical.json."""

    model_config = _EXACT
    obj_id: Id
    cam_R_m2c_canonical: Matrix
    cam_t_m2c_canonical: Vector
    regressor_index: Id
    n_regressors: Annotated[int, Field(ge=1)]
    discontinuity_margin_deg: NotNegative
    bbox3d_corners_2d: Annotated[
        list[Annotated[list[float], Field(min_length=2, max_length=2)]], Field(min_length=8, max_length=8)
    ]


class RunLengths(BaseModel):
    """COCO's uncompressed run lengths."""

    model_config = _EXACT
    counts: list[Count]
    size: Annotated[list[Count], Field(min_length=2, max_length=2)]


class CocoAnnotation(BaseModel):
    """An instance in scene_gt_coco.json."""

    model_config = _EXACT
    id: Id
    image_id: Id
    category_id: Id
    iscrowd: int
    area: Count
    bbox: Box
    segmentation: RunLengths
    ignore: bool
    width: Count
    height: Count


class CocoImage(BaseModel):
    """An image in scene_gt_coco.json."""

    model_config = _EXACT
    id: Id
    file_name: str
    width: Count
    height: Count
    license: int
    coco_url: str
    flickr_url: str
    date_captured: str


class CocoCategory(BaseModel):
    """An object in scene_gt_coco.json."""

    model_config = _EXACT
    id: Id
    name: str
    supercategory: str


class CocoFile(BaseModel):
    """scene_gt_coco.json; its long lists are looked at item by item."""

    model_config = _EXACT
    annotations: list[Any]
    categories: list[CocoCategory]
    images: list[Any]
    info: dict[str, str]
    licenses: list[Any]


class CameraFile(BaseModel):
    """camera.json."""

    model_config = _EXACT
    width: Count
    height: Count
    fx: Positive
    fy: Positive
    cx: Number
    cy: Number
    depth_scale: Positive


class ModelInfo(BaseModel):
    """An object in models_info.json; its symmetries are read elsewhere."""

    model_config = _OPEN
    diameter: Positive
    min_x: Number
    min_y: Number
    min_z: Number
    size_x: NotNegative
    size_y: NotNegative
    size_z: NotNegative


class Counts(BaseModel):
    """Totals in dataset.json."""

    model_config = _EXACT
    images: Count
    instances: Count


class SymmetriesDigest(BaseModel):
    """Which symmetries the labels are of, in dataset.json."""

    model_config = _EXACT
    scheme: str
    sha256: Annotated[str, Field(min_length=64, max_length=64)]


class Header(BaseModel):
    """dataset.json; other keys than these are nobody's business."""

    model_config = ConfigDict(extra="ignore", frozen=True)
    name: str
    recipe: Recipe
    versions: dict[str, str]
    models_sha256: dict[int, str]
    scenery_digest: str
    licence: str
    counts: Counts
    symmetries: SymmetriesDigest


@dataclass(frozen=True)
class SchemaFault:
    """Where in a JSON value it departs from its form, and how."""

    place: tuple[int | str, ...]
    message: str

    @property
    def instance(self) -> int | None:
        """The list index the place begins with, if it does."""
        return self.place[0] if self.place and isinstance(self.place[0], int) else None


def faults(adapter: TypeAdapter[Any], value: Any) -> Iterator[SchemaFault]:
    """Every departure of a parsed JSON value from its form."""
    try:
        adapter.validate_python(value)
    except ValidationError as error:
        for fault in error.errors(include_url=False):
            place = tuple(fault["loc"])
            name = ".".join(str(part) for part in place) or "it"
            shown = repr(fault["input"])
            shown = shown if len(shown) <= 60 else f"{shown[:57]}..."
            yield SchemaFault(place, f"{name} is {shown}: {fault['msg'][0].lower()}{fault['msg'][1:]}")
