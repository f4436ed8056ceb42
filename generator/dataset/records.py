"""The records of an image: what each JSON file of a scene folder says of it, declared once.

A record is plain JSON data. Its type is the schema that readers and the validator hold it against, and the function
beside it makes one of what was measured. BOP's format:
https://github.com/thodan/bop_toolkit/blob/master/docs/bop_datasets_format.md
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, ConfigDict, Field, TypeAdapter, ValidationError, with_config
from pydantic_core import ErrorDetails, PydanticCustomError
from typing_extensions import NotRequired, TypedDict

from synthetless.annotation.instances import InstanceAnnotation
from synthetless.errors import UserError
from synthetless.io.documents import shown
from synthetless.io.files import read_json, write_json
from synthetless.scenes.spec import (
    NO_DISTORTION,
    Coefficients,
    DepthSensorSpec,
    Intrinsics,
    Pose,
    SceneSpec,
    SensorSpec,
    plain,
)

MIN_VISIB_FRACT = 0.1
"""Instances with a smaller visible fraction are marked ``ignore`` in scene_gt_coco.json, as bop_toolkit does."""

_EXACT = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)
_OPEN = ConfigDict(extra="ignore", strict=True, allow_inf_nan=False)

Number = Annotated[float, Field(ge=-1e12, le=1e12)]
NotNegative = Annotated[float, Field(ge=0, le=1e12)]
Positive = Annotated[float, Field(gt=0, le=1e12)]
Count = Annotated[int, Field(ge=0)]
Vector = Annotated[list[Number], Field(min_length=3, max_length=3)]
Matrix = Annotated[list[Number], Field(min_length=9, max_length=9)]
Entry = dict[str, Any]
ModelInfo = Mapping[str, Any]
"""An object's entry in models_info.json."""
BoxList = Annotated[list[int], Field(min_length=4, max_length=4)]
PoseList = Annotated[list[Number], Field(min_length=12, max_length=12)]
"""R_m2c row by row, and t_m2c."""
Point = Annotated[list[float], Field(min_length=2, max_length=2)]


ModelType = Literal["PinholePlane", "OpenCV"]


_N_PARAMETERS: Mapping[str, int] = {"PinholePlane": 4, "OpenCV": 9}


def _with_all_parameters(model: Any) -> Any:
    kind, found = model["projection_model_type"], len(model["projection_params"])
    if found != _N_PARAMETERS[kind]:
        text = "cam_model has {found} projection_params; {kind} has {number}"
        raise PydanticCustomError("camera", text, {"found": found, "kind": kind, "number": _N_PARAMETERS[kind]})
    return model


@with_config(_OPEN)
class _CameraModelEntry(TypedDict):
    image_width: Count
    image_height: Count
    projection_model_type: Literal["PinholePlane", "OpenCV"]
    projection_params: list[Number]


CameraModelEntry = Annotated[_CameraModelEntry, AfterValidator(_with_all_parameters)]
"""An image's cam_model, which BOP has since 2024 in the place of cam_K, of one of the two models that are supported.

``projection_params`` are fx, fy, cx, cy, and of OpenCV's model also k1, k2, k3, p1, p2, in this order, which is not
OpenCV's: https://github.com/facebookresearch/hand_tracking_toolkit, which bop_toolkit projects with.
"""


def _with_a_projection(entry: Any) -> Any:
    if "cam_K" not in entry and "cam_model" not in entry:
        raise PydanticCustomError("camera", "cam_K is missing")
    return entry


@with_config(_EXACT)
class _CameraEntry(TypedDict):
    cam_K: NotRequired[Matrix]
    cam_model: NotRequired[CameraModelEntry]
    cam_R_w2c: Matrix
    cam_t_w2c: Vector
    depth_scale: Positive


CameraEntry = Annotated[_CameraEntry, AfterValidator(_with_a_projection)]
"""An image in scene_camera.json: camera matrix (row-wise, pixels) or, of a camera with a lens, its model; world to
camera (mm); mm per unit of depth."""


@with_config(_EXACT)
class GtEntry(TypedDict):
    """An instance in scene_gt.json: its pose, model to camera (row-wise; mm)."""

    cam_R_m2c: Matrix
    cam_t_m2c: Vector
    obj_id: Count


@with_config(_EXACT)
class GtInfoEntry(TypedDict):
    """An instance in scene_gt_info.json, counted as ``annotation.instances.InstanceAnnotation`` says."""

    bbox_obj: BoxList
    bbox_visib: BoxList
    px_count_all: Count
    px_count_valid: Count
    px_count_visib: Count
    visib_fract: NotNegative


@with_config(_EXACT)
class CanonicalEntry(TypedDict):
    """An instance in scene_gt_canonical.json: what a network learns of it."""

    obj_id: Count
    cam_R_m2c_canonical: Matrix
    cam_t_m2c_canonical: Vector
    regressor_index: Count
    n_regressors: Annotated[int, Field(ge=1)]
    discontinuity_margin_deg: NotNegative
    bbox3d_corners_2d: Annotated[list[Point], Field(min_length=8, max_length=8)]


@with_config(_EXACT)
class AmbiguityEntry(TypedDict):
    """An instance in scene_gt_ambiguity.json: which cosets of its quasi-symmetry group the image cannot tell apart.

    ``symmetry.ambiguity`` says what the numbers mean. Instances without such a group have null in their place.
    """

    obj_id: Count
    cam_R_m2c_quasi: Matrix
    cam_t_m2c_quasi: Vector
    quasi_index: Count
    n_quasi_indices: Annotated[int, Field(ge=1)]
    n_cosets: Annotated[int, Field(ge=2)]
    coset_true: Count
    cosets_alike: Annotated[list[Count], Field(min_length=1)]
    pixels_apart: list[Count]
    view_ambiguity: Annotated[float, Field(gt=0, le=1)]
    eps_mm: Positive
    poses_alike: NotRequired[list[PoseList]]


@with_config(_OPEN)
class _ForeignCameraEntry(TypedDict):
    cam_K: NotRequired[Matrix]
    cam_model: NotRequired[CameraModelEntry]
    depth_scale: NotRequired[Positive]


ForeignCameraEntry = Annotated[_ForeignCameraEntry, AfterValidator(_with_a_projection)]
"""An image in somebody else's scene_camera.json, which may say more, or not where the camera stands."""


@with_config(_OPEN)
class ForeignGtEntry(GtEntry):
    """An instance in somebody else's scene_gt.json, which may say more."""


@with_config(_OPEN)
class ForeignGtInfoEntry(GtInfoEntry):
    """An instance in somebody else's scene_gt_info.json, which may say more."""


@with_config(_OPEN)
class ModelEntry(TypedDict):
    """An object in models_info.json, millimetres; ``SymmetryGroup.from_bop`` reads its symmetries."""

    diameter: Positive
    min_x: Number
    min_y: Number
    min_z: Number
    size_x: NotNegative
    size_y: NotNegative
    size_z: NotNegative


@with_config(_EXACT)
class RunLengths(TypedDict):
    """COCO's uncompressed run lengths, column by column, the first outside the mask; ``size`` is [rows, columns]."""

    counts: list[Count]
    size: Annotated[list[Count], Field(min_length=2, max_length=2)]


@with_config(_EXACT)
class CocoAnnotation(TypedDict):
    """An instance in scene_gt_coco.json, without its id."""

    image_id: Count
    category_id: Count
    iscrowd: int
    area: Count
    bbox: BoxList
    segmentation: RunLengths
    ignore: bool
    width: Count
    height: Count


@with_config(_EXACT)
class NumberedAnnotation(CocoAnnotation):
    """An instance in scene_gt_coco.json; ``id`` is counted when a scene folder's images are put together."""

    id: Count


@with_config(_EXACT)
class CocoImage(TypedDict):
    """An image in scene_gt_coco.json."""

    id: Count
    file_name: str
    width: Count
    height: Count
    license: int
    coco_url: str
    flickr_url: str
    date_captured: str


@with_config(_EXACT)
class CocoCategory(TypedDict):
    """An object in scene_gt_coco.json."""

    id: Count
    name: str
    supercategory: str


@with_config(_EXACT)
class CocoFile(TypedDict):
    """scene_gt_coco.json."""

    annotations: list[NumberedAnnotation]
    categories: list[CocoCategory]
    images: list[CocoImage]
    info: dict[str, str]
    licenses: list[Any]


@with_config(_EXACT)
class CameraFile(TypedDict):
    """camera.json: the size and intrinsics of all images, pixels, and mm per unit of depth.

    ``distortion``, which BOP does not have, is k1, k2, p1, p2, k3 of a camera with a lens.
    """

    width: Count
    height: Count
    fx: Positive
    fy: Positive
    cx: Number
    cy: Number
    depth_scale: Positive
    distortion: NotRequired[Annotated[list[Number], Field(min_length=5, max_length=5)]]


@dataclass(frozen=True)
class ImageSpec:
    """A line of scene_spec.jsonl: everything needed to make the image again.

    Attributes:
        image_id: BOP image id within its scene folder.
        view: which of the scene's views it shows.
        exposure_gain: what the linear image was multiplied by.
        instances: number in ``scene.objects`` of each labelled instance, in scene_gt's order.
        scene: what was built.
        settled: pose of each object at rest.
        sensor: the camera that took the picture; without one, the record leaves it out.
        depth_sensor: the depth camera of the output depth_sensed; likewise.
    """

    image_id: int
    view: int
    exposure_gain: float
    instances: tuple[int, ...]
    scene: SceneSpec
    settled: tuple[Pose, ...]
    sensor: SensorSpec | None = None
    depth_sensor: DepthSensorSpec | None = None


class ImageRecord(TypedDict):
    """An image's record, .records/SCENE/IMAGE.json, from which its entries in the scene folder's files are assembled.

    ``spec`` is an ``ImageSpec`` as JSON data.
    """

    camera: CameraEntry
    gt: list[GtEntry]
    gt_info: list[GtInfoEntry]
    coco: list[CocoAnnotation]
    spec: dict[str, Any]


@dataclass(frozen=True)
class SchemaFault:
    """Where in a JSON value it departs from its schema, and how."""

    place: tuple[int | str, ...]
    message: str

    @property
    def instance(self) -> int | None:
        """The list index that the place begins with, if it does."""
        return self.place[0] if self.place and isinstance(self.place[0], int) else None


@cache
def schema(form: Any) -> TypeAdapter[Any]:
    """The schema of a type of this module; made once, since that takes long."""
    return TypeAdapter(form)


def schema_faults(form: Any, value: Any) -> list[SchemaFault]:
    """Every departure of a parsed JSON value from the schema of a type of this module, ``list[GtEntry]`` say."""
    try:
        schema(form).validate_python(value)
    except ValidationError as error:
        return [_schema_fault(fault) for fault in error.errors(include_url=False)]
    return []


def validated(form: Any, value: Any, path: Path) -> Any:
    """A parsed JSON value as a type of this module.

    Raises:
        UserError: it departs from the schema; with the file, the first place in it, and what was expected.
    """
    try:
        return schema(form).validate_python(value)
    except ValidationError as error:
        raise UserError(f"{path}: {_schema_fault(error.errors(include_url=False)[0]).message}") from None


def _schema_fault(fault: ErrorDetails) -> SchemaFault:
    name = ".".join(str(part) for part in fault["loc"]) or "it"
    if fault["type"] == "camera":
        return SchemaFault(fault["loc"], fault["msg"])
    if fault["type"] == "missing":
        return SchemaFault(fault["loc"], f"{name} is missing")
    return SchemaFault(fault["loc"], f"{name} is {shown(fault['input'])}: {fault['msg'][0].lower()}{fault['msg'][1:]}")


def spec_entry(spec: ImageSpec) -> dict[str, Any]:
    """An image's line in scene_spec.jsonl."""
    entry: dict[str, Any] = plain(spec)
    return entry


def ambiguity_fault(entry: AmbiguityEntry) -> str | None:
    """Why an entry of scene_gt_ambiguity.json contradicts itself, if it does."""
    n, true, alike, apart = entry["n_cosets"], entry["coset_true"], entry["cosets_alike"], entry["pixels_apart"]
    if len(apart) != n:
        return f"pixels_apart has {len(apart)} numbers; there are {n} cosets"
    if not 0 <= true < n or apart[true] != 0:
        return f"coset_true is {true}, which is not one of the {n} cosets with 0 pixels apart"
    most = max((apart[number] for number in alike if number < n), default=0)
    if alike != [number for number, count in enumerate(apart) if count <= most]:
        return f"cosets_alike is {alike}, not the cosets of the fewest pixels apart, ascending"
    if abs(entry["view_ambiguity"] - len(alike) / n) > 1e-9:
        return f"view_ambiguity is {entry['view_ambiguity']}; {len(alike)} of {n} cosets are alike"
    return None


def write_scene_json(path: Path, entries: Mapping[int, Any]) -> None:
    """Write a scene's JSON file: one image per line, in ascending order of the image ids.

    Floats keep every bit of their float64.

    Raises:
        UserError: a number is not finite, or the file cannot be written.
    """
    write_json(path, {str(im_id): entries[im_id] for im_id in sorted(entries)})


def read_scene_json(path: Path) -> dict[int, Any]:
    """Read a scene's JSON file, by image id in ascending order.

    Raises:
        UserError: the file is missing, cut off or damaged, or has a key that is no image id.
    """
    content = read_json(path)
    for key in content:
        if not key.isdecimal():
            raise UserError(f'{path}: has the key "{key}"; image ids are needed')
    return dict(sorted(((int(key), value) for key, value in content.items()), key=lambda entry: entry[0]))


def camera_matrix(intrinsics: Intrinsics) -> NDArray[np.float64]:
    """(3, 3) K of a pinhole camera without skew, pixels."""
    return np.array(
        [[intrinsics.fx, 0.0, intrinsics.cx], [0.0, intrinsics.fy, intrinsics.cy], [0.0, 0.0, 1.0]], dtype=np.float64
    )


def camera_json(intrinsics: Intrinsics, depth_scale: float) -> CameraFile:
    """The content of a dataset's camera.json; ``depth_scale`` is mm per unit of a depth image."""
    lens: dict[str, Any] = {}
    if intrinsics.distortion != NO_DISTORTION:
        lens["distortion"] = list(intrinsics.distortion)
    return {
        "cx": intrinsics.cx,
        "cy": intrinsics.cy,
        "depth_scale": depth_scale,
        "fx": intrinsics.fx,
        "fy": intrinsics.fy,
        "height": intrinsics.height,
        "width": intrinsics.width,
        **lens,  # type: ignore[typeddict-item]
    }


def camera_model(camera: Intrinsics) -> CameraModelEntry | None:
    """The ``cam_model`` of a camera with a lens; None of a pinhole, which has ``cam_K``."""
    if camera.distortion == NO_DISTORTION:
        return None
    k1, k2, p1, p2, k3 = camera.distortion
    parameters = (camera.fx, camera.fy, camera.cx, camera.cy, k1, k2, k3, p1, p2)
    return {
        "image_height": camera.height,
        "image_width": camera.width,
        "projection_model_type": "OpenCV",
        "projection_params": [float(value) for value in parameters],
    }


def projection_of(entry: CameraEntry) -> tuple[list[float], Coefficients]:
    """The camera matrix, 9 numbers row-wise, and the distortion that an image's entry in scene_camera.json has.

    Raises:
        UserError: it has neither a camera matrix nor a model that is known.
    """
    if "cam_K" in entry or "cam_model" not in entry:
        return entry.get("cam_K"), NO_DISTORTION  # type: ignore[return-value]
    model: Any = entry["cam_model"]
    kind = model.get("projection_model_type") if isinstance(model, dict) else None
    if kind not in _N_PARAMETERS:
        raise UserError(f"cam_model is {kind or shown(model)}; PinholePlane and OpenCV are supported")
    if faults := schema_faults(CameraModelEntry, model):
        raise UserError(f"cam_model: {faults[0].message}")
    fx, fy, cx, cy, *lens = model["projection_params"]
    k1, k2, k3, p1, p2 = lens or NO_DISTORTION
    return [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0], (k1, k2, p1, p2, k3)


def camera_entry(
    K: NDArray[np.float64],
    R_w2c: NDArray[np.float64],
    t_w2c: NDArray[np.float64],
    depth_scale: float,
    model: CameraModelEntry | None = None,
) -> CameraEntry:
    """An image's entry in scene_camera.json.

    Args:
        K: (3, 3) camera matrix, pixels.
        R_w2c: (3, 3) rotation, world to camera (OpenCV).
        t_w2c: (3,) translation, world to camera, millimetres.
        depth_scale: millimetres per unit of the depth image.
        model: of a camera with a lens, as ``camera_model`` gives it: it takes the place of K.
    """
    pose: _CameraEntry = {
        "cam_R_w2c": _floats(R_w2c, 9),
        "cam_t_w2c": _floats(t_w2c, 3),
        "depth_scale": float(depth_scale),
    }
    return {"cam_K": _floats(K, 9), **pose} if model is None else {"cam_model": model, **pose}


def gt_entry(obj_id: int, R_m2c: NDArray[np.float64], t_m2c: NDArray[np.float64]) -> GtEntry:
    """An instance's entry in scene_gt.json: (3, 3) rotation and (3,) translation in mm, model to camera."""
    return {"cam_R_m2c": _floats(R_m2c, 9), "cam_t_m2c": _floats(t_m2c, 3), "obj_id": int(obj_id)}


def gt_info_entry(instance: InstanceAnnotation) -> GtInfoEntry:
    """An instance's entry in scene_gt_info.json."""
    return {
        "bbox_obj": [int(value) for value in instance.bbox_obj],
        "bbox_visib": [int(value) for value in instance.bbox_visib],
        "px_count_all": int(instance.px_count_all),
        "px_count_valid": int(instance.px_count_valid),
        "px_count_visib": int(instance.px_count_visib),
        "visib_fract": float(instance.visib_fract),
    }


def uncompressed_rle(mask: NDArray[np.bool_]) -> RunLengths:
    """COCO's uncompressed run lengths, which BOP's files use: column by column, first run outside the mask.

    pycocotools writes compressed runs only, which BOP's own readers of mask.json do not all take.
    """
    edges = np.zeros(0, dtype=np.intp)
    columns = np.flatnonzero(mask.any(axis=0))
    if columns.size:  # all runs end in these columns, but for the last
        left, right = int(columns[0]), int(columns[-1]) + 1
        pixels = np.ascontiguousarray(mask[:, left:right].T).ravel()
        edges = np.flatnonzero(np.diff(pixels, prepend=False, append=False)) + left * mask.shape[0]
    if edges.size == 0 or edges[-1] != mask.size:
        edges = np.append(edges, mask.size)
    return {"counts": np.diff(edges, prepend=0).tolist(), "size": [int(side) for side in mask.shape]}


def amodal_box(mask: NDArray[np.bool_]) -> list[int]:
    """COCO's [x, y, w, h] of a mask that is not empty, with w = xmax - xmin + 1."""
    columns, rows = np.flatnonzero(mask.any(axis=0)), np.flatnonzero(mask.any(axis=1))
    x, y = int(columns[0]), int(rows[0])
    return [x, y, int(columns[-1]) - x + 1, int(rows[-1]) - y + 1]


def coco_annotations(
    im_id: int, obj_ids: Sequence[int], instances: Sequence[InstanceAnnotation]
) -> list[CocoAnnotation]:
    """An image's annotations for scene_gt_coco.json, without their ids, which ``scene_gt_coco`` counts.

    The box is amodal, inside the image. Instances of which nothing is visible are left out.

    Args:
        im_id: the image.
        obj_ids: BOP object ids, in the order of ``instances``.
        instances: what is measured of the image.
    """
    return [
        {
            "area": int(instance.px_count_visib),
            "bbox": amodal_box(instance.mask),
            "category_id": int(obj_id),
            "height": int(instance.mask.shape[0]),
            "ignore": bool(instance.visib_fract < MIN_VISIB_FRACT),
            "image_id": int(im_id),
            "iscrowd": 0,
            "segmentation": uncompressed_rle(instance.mask_visib),
            "width": int(instance.mask.shape[1]),
        }
        for obj_id, instance in zip(obj_ids, instances, strict=True)
        if instance.mask_visib.any()
    ]


def coco_image(im_id: int, rgb: Path, width: int, height: int) -> CocoImage:
    """An image's entry in scene_gt_coco.json; ``rgb`` is its file, SCENE/rgb/NAME."""
    return {
        "coco_url": "",
        "date_captured": "",
        "file_name": f"{rgb.parent.name}/{rgb.name}",
        "flickr_url": "",
        "height": height,
        "id": im_id,
        "license": 1,
        "width": width,
    }


def scene_gt_coco(
    dataset_name: str,
    obj_ids: Iterable[int],
    images: Iterable[CocoImage],
    annotations: Iterable[CocoAnnotation],
    names: Mapping[int, str] | None = None,
) -> CocoFile:
    """The content of scene_gt_coco.json, for ``synthetless.io.files.write_json``.

    Args:
        dataset_name: as BOP calls it, "tless"; the supercategory of all objects.
        obj_ids: every object of the dataset, whether it occurs or not.
        images: ``coco_image`` of every image.
        annotations: ``coco_annotations`` of the images, one after the other; they are numbered from 1.
        names: of objects; one that has none is called by its id.
    """
    return {
        "annotations": [{**annotation, "id": number} for number, annotation in enumerate(annotations, start=1)],
        "categories": [
            {"id": obj_id, "name": (names or {}).get(obj_id, str(obj_id)), "supercategory": dataset_name}
            for obj_id in sorted(set(obj_ids))
        ],
        "images": list(images),
        "info": {"contributor": "", "description": dataset_name, "url": "", "version": "0.1.0"},
        "licenses": [],
    }


def _floats(array: NDArray[np.float64], count: int) -> list[float]:
    values: list[float] = np.asarray(array, dtype=np.float64).reshape(count).tolist()
    return values
