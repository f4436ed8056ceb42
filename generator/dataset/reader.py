"""Reads a dataset: poses, labels and pictures of every image as arrays.

``Dataset`` opens a folder that ``generate`` made, one that ``adopt`` labelled, or any other BOP dataset, and gives its
scenes, images and instances. Nothing is written, no file is kept open; Blender and torch are not needed. One object may
be shared by threads, and is pickled as its path: a process that gets it reads for itself.

Below it are the two forms in which the rest of the package reads a scene folder: its JSON records (``read_entries``)
and its poses (``ScenePoses``).
"""

from __future__ import annotations

import reprlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any, TypeVar, overload

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError

from synthetless.annotation.instances import Box
from synthetless.config import Recipe
from synthetless.dataset.layout import (
    DATASET_FILE,
    SYMMETRIES_FILE,
    ScenePaths,
    find_models_folder,
    find_split,
    scene_ids,
)
from synthetless.dataset.records import (
    CameraEntry,
    CanonicalEntry,
    GtEntry,
    GtInfoEntry,
    ImageSpec,
    read_scene_json,
)
from synthetless.errors import UserError
from synthetless.io import images
from synthetless.io.files import read_bytes, read_json, read_json_lines
from synthetless.io.models import read_models_info
from synthetless.symmetry import SymmetryTable

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Place = TypeVar("Place")


@dataclass(frozen=True, eq=False)
class Label:
    """What a network learns of an instance.

    Attributes:
        R_m2c: (3, 3) canonical rotation, model to camera.
        t_m2c: (3,) canonical translation, millimetres.
        regressor_index: which of the object's regressors is responsible, from 0.
        n_regressors: how many the object has.
        discontinuity_margin_deg: how far the pose may turn before the label jumps.
        corners_px: (8, 2) corners (u, v) of the model's box under the canonical pose; x varies slowest, z fastest.
    """

    R_m2c: Floats
    t_m2c: Floats
    regressor_index: int
    n_regressors: int
    discontinuity_margin_deg: float
    corners_px: Floats


@dataclass(frozen=True, eq=False)
class Visibility:
    """What of an instance is in the image, counted as bop_toolkit counts.

    Attributes:
        visib_fract: visible pixels / pixels of the whole silhouette.
        px_count_all, px_count_valid, px_count_visib: pixels of the whole silhouette, of its part in the image where
            there is depth, and of the visible part.
        bbox_obj, bbox_visib: [x, y, w, h] with w = xmax - xmin of the whole silhouette and of the visible part;
            (-1, -1, -1, -1) where nothing is visible.
    """

    visib_fract: float
    px_count_all: int
    px_count_valid: int
    px_count_visib: int
    bbox_obj: Box
    bbox_visib: Box


@dataclass(frozen=True, eq=False)
class Instance:
    """An object in an image.

    Attributes:
        paths, im_id, gt_id: scene folder, image id, and number in the image, from 0.
        obj_id: BOP object id.
        R_m2c: (3, 3) true rotation, model to camera (OpenCV: x right, y down, z forward).
        t_m2c: (3,) true translation, millimetres.
        label: canonical pose and regressor; None if the dataset is not labelled.
        visibility: None if the scene folder has no scene_gt_info.json.
    """

    paths: ScenePaths
    im_id: int
    gt_id: int
    obj_id: int
    R_m2c: Floats
    t_m2c: Floats
    label: Label | None
    visibility: Visibility | None

    def mask(self) -> NDArray[np.bool_]:
        """(H, W) whole silhouette inside the image, hidden parts included; a UserError without a readable file."""
        path = self.paths.mask(self.im_id, self.gt_id)
        return images.decode_mask(read_bytes(path), path)

    def mask_visib(self) -> NDArray[np.bool_]:
        """(H, W) visible part; a UserError without a readable file."""
        path = self.paths.mask_visib(self.im_id, self.gt_id)
        return images.decode_mask(read_bytes(path), path)


@dataclass(frozen=True, eq=False)
class Image:
    """An image of a dataset. Pictures are decoded when asked for; a UserError names a file that cannot be read.

    Attributes:
        paths: the scene folder's files.
        im_id: BOP image id in it.
        K: (3, 3) camera matrix, pixels; the centre of pixel (column i, row j) is (u, v) = (i, j).
        depth_scale: millimetres per unit of the depth image.
        R_w2c, t_w2c: (3, 3) and (3,) mm, world to camera; None if the dataset does not say.
        instances: in scene_gt's order.
    """

    paths: ScenePaths
    im_id: int
    K: Floats
    depth_scale: float
    R_w2c: Floats | None
    t_w2c: Floats | None
    instances: tuple[Instance, ...]

    @property
    def scene_id(self) -> int:
        """Number of the scene folder."""
        return int(self.paths.root.name)

    @property
    def key(self) -> str:
        """Name of the image in the whole split, as BOP's webdataset has it: "000001_000042"."""
        return f"{self.scene_id:06d}_{self.im_id:06d}"

    def rgb(self) -> NDArray[np.uint8]:
        """(H, W, 3) sRGB."""
        path = self.paths.find_rgb(self.im_id) or self.paths.rgb(self.im_id)
        return images.decode_rgb(read_bytes(path), path)

    def linear(self) -> NDArray[np.float32]:
        """(H, W, 3) linear light before exposure, Rec. 709 primaries, if ``outputs`` has exr."""
        return images.read_exr(self.paths.exr(self.im_id))

    def depth_mm(self) -> Floats:
        """(H, W) z in millimetres, 0 where there is no depth."""
        path = self.paths.depth(self.im_id)
        return images.decode_depth(read_bytes(path), self.depth_scale, path)

    def normals(self) -> Floats:
        """(H, W, 3) unit normals, camera frame, 0 where there is no surface."""
        path = self.paths.normals(self.im_id)
        return images.decode_normals(read_bytes(path), path)

    def object_coordinates_mm(self) -> tuple[Floats, NDArray[np.bool_]]:
        """(H, W, 3) model coordinates in millimetres, and (H, W) where there are any."""
        path = self.paths.object_coordinates(self.im_id)
        return images.decode_object_coordinates(read_bytes(path), path)


@dataclass(frozen=True, eq=False)
class Labels:
    """Columns of ``Label``, one row for each of N instances."""

    R_m2c: Floats
    t_m2c: Floats
    regressor_index: Integers
    n_regressors: Integers
    discontinuity_margin_deg: Floats
    corners_px: Floats

    @classmethod
    def of(cls, entries: Sequence[CanonicalEntry]) -> Labels:
        """The columns of entries of scene_gt_canonical.json."""
        return cls(
            _column(entries, "cam_R_m2c_canonical", 3, 3),
            _column(entries, "cam_t_m2c_canonical", 3),
            _column(entries, "regressor_index").astype(np.int64),
            _column(entries, "n_regressors").astype(np.int64),
            _column(entries, "discontinuity_margin_deg"),
            _column(entries, "bbox3d_corners_2d", 8, 2),
        )

    def row(self, number: int) -> Label:
        """The label of one instance."""
        return Label(
            self.R_m2c[number],
            self.t_m2c[number],
            int(self.regressor_index[number]),
            int(self.n_regressors[number]),
            float(self.discontinuity_margin_deg[number]),
            self.corners_px[number],
        )


@dataclass(frozen=True, eq=False)
class Visibilities:
    """Columns of ``Visibility``, one row for each of N instances; ``px_counts`` (N, 3) are all, valid, visib."""

    visib_fract: Floats
    px_counts: Integers
    bbox_obj: Integers
    bbox_visib: Integers

    @classmethod
    def of(cls, entries: Sequence[GtInfoEntry]) -> Visibilities:
        """The columns of entries of scene_gt_info.json."""
        counts = [_column(entries, f"px_count_{what}") for what in ("all", "valid", "visib")]
        return cls(
            _column(entries, "visib_fract"),
            np.stack(counts, axis=1).astype(np.int64),
            _column(entries, "bbox_obj", 4).astype(np.int64),
            _column(entries, "bbox_visib", 4).astype(np.int64),
        )

    def row(self, number: int) -> Visibility:
        """The visibility of one instance."""
        boxes = [tuple(int(side) for side in box[number]) for box in (self.bbox_obj, self.bbox_visib)]
        return Visibility(float(self.visib_fract[number]), *map(int, self.px_counts[number]), *boxes)  # type: ignore[arg-type]


@dataclass(frozen=True, eq=False)
class ScenePoses:
    """Cameras and poses of a scene folder, M images and N instances in scene_gt's order.

    Attributes:
        image_ids: (M,).
        first: (M + 1,) number of each image's first instance, and N.
        cameras: (M, 3, 3) camera matrix of each image, pixels.
        obj_ids: (N,).
        R_m2c, t_m2c: (N, 3, 3), (N, 3) mm.
    """

    image_ids: Integers
    first: Integers
    cameras: Floats
    obj_ids: Integers
    R_m2c: Floats
    t_m2c: Floats

    @classmethod
    def of(cls, scene_gt: Mapping[int, Sequence[GtEntry]], scene_camera: Mapping[int, CameraEntry]) -> ScenePoses:
        """The arrays of the entries of scene_gt.json and scene_camera.json.

        Raises:
            UserError: an image has no camera, or an entry is damaged; with the file, the image and the instance.
        """
        for im_id, entries in scene_gt.items():
            if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
                raise UserError(f"scene_gt.json: image {im_id} has no list of instances")
            if not isinstance(scene_camera.get(im_id), dict):
                raise UserError(f"scene_camera.json: image {im_id} of scene_gt.json has no entry")
        places = [(im_id, gt_id) for im_id, entries in scene_gt.items() for gt_id in range(len(entries))]
        every = [entry for entries in scene_gt.values() for entry in entries]
        for place, entry in zip(places, every, strict=True):
            if not isinstance(entry.get("obj_id"), int):
                raise UserError(f"{_instance(place)}: obj_id is {entry.get('obj_id')!r}, not a whole number")
        counts = [len(entries) for entries in scene_gt.values()]
        K = _rows([scene_camera[im_id].get("cam_K") for im_id in scene_gt], 9, "cam_K", list(scene_gt), _image)
        return cls(
            np.array(list(scene_gt), dtype=np.int64),
            np.cumsum([0, *counts]),
            K.reshape(-1, 3, 3),
            np.array([entry["obj_id"] for entry in every], dtype=np.int64),
            _rows([entry.get("cam_R_m2c") for entry in every], 9, "cam_R_m2c", places, _instance).reshape(-1, 3, 3),
            _rows([entry.get("cam_t_m2c") for entry in every], 3, "cam_t_m2c", places, _instance),
        )

    @property
    def K(self) -> Floats:
        """(N, 3, 3) camera matrix of each instance's image."""
        return np.repeat(self.cameras, np.diff(self.first), axis=0)

    def place(self, row: int) -> str:
        """File, image and instance of a row, for messages."""
        image = int(np.searchsorted(self.first, row, side="right")) - 1
        return _instance((int(self.image_ids[image]), row - int(self.first[image])))


@dataclass(frozen=True, eq=False)
class Scene:
    """A scene folder in columns: M images, N instances.

    Attributes:
        paths: its files.
        poses: image ids, camera matrices, object ids and true poses.
        depth_scale: (M,) millimetres per unit of the depth images.
        R_w2c, t_w2c: (M, 3, 3), (M, 3) mm, world to camera; None if the dataset does not say.
        labels: of the N instances; None without scene_gt_canonical.json.
        visibility: of the N instances; None without scene_gt_info.json.
    """

    paths: ScenePaths
    poses: ScenePoses
    depth_scale: Floats
    R_w2c: Floats | None
    t_w2c: Floats | None
    labels: Labels | None
    visibility: Visibilities | None

    @classmethod
    def read(cls, paths: ScenePaths) -> Scene:
        """Read the JSON files of a scene folder.

        Raises:
            UserError: one is damaged, or they disagree about the images or their instances.
        """
        entries = read_entries(paths, partly=True)
        gt = {image.im_id: image.gt for image in entries}
        camera = {image.im_id: image.camera for image in entries}
        poses = ScenePoses.of(gt, camera)
        try:
            canonical = [label for image in entries for label in image.gt_canonical]
            info = [entry for image in entries for entry in image.gt_info]
            placed = all("cam_R_w2c" in entry and "cam_t_w2c" in entry for entry in camera.values())
            return cls(
                paths,
                poses,
                np.array([entry.get("depth_scale", 1.0) for entry in camera.values()], dtype=np.float64),
                _column(list(camera.values()), "cam_R_w2c", 3, 3) if placed else None,
                _column(list(camera.values()), "cam_t_w2c", 3) if placed else None,
                Labels.of(canonical) if paths.scene_gt_canonical.exists() else None,
                Visibilities.of(info) if paths.scene_gt_info.exists() else None,
            )
        except (KeyError, TypeError, ValueError) as error:
            raise UserError(f"{paths.root}: an entry of its JSON files is damaged ({error}); see validate") from error

    def __len__(self) -> int:
        """Number of images."""
        return len(self.poses.image_ids)

    def image(self, number: int) -> Image:
        """The image with a number in this folder, counted from 0."""
        rows = range(int(self.poses.first[number]), int(self.poses.first[number + 1]))
        return Image(
            self.paths,
            int(self.poses.image_ids[number]),
            self.poses.cameras[number],
            float(self.depth_scale[number]),
            None if self.R_w2c is None else self.R_w2c[number],
            None if self.t_w2c is None else self.t_w2c[number],
            tuple(self._instance(int(self.poses.image_ids[number]), gt_id, row) for gt_id, row in enumerate(rows)),
        )

    def _instance(self, im_id: int, gt_id: int, row: int) -> Instance:
        return Instance(
            self.paths,
            im_id,
            gt_id,
            int(self.poses.obj_ids[row]),
            self.poses.R_m2c[row],
            self.poses.t_m2c[row],
            None if self.labels is None else self.labels.row(row),
            None if self.visibility is None else self.visibility.row(row),
        )


class Dataset(Sequence[Image]):
    """A split of a BOP dataset: a sequence of images, in the order of scene folders and image ids.

    The JSON files of a scene folder are read when its first image is asked for, and kept as arrays (about 0.5 kB an
    instance). ``len`` and access by number read those of all folders.

    >>> dataset = Dataset.open("out/demo")  # doctest: +SKIP
    >>> for image in dataset:  # doctest: +SKIP
    ...     for instance in image.instances:
    ...         crop, pose = image.rgb(), instance.label.R_m2c

    Attributes:
        root: the dataset's folder.
        split: name of the folder of scenes.
        scene_ids: numbers of the scene folders, ascending.
    """

    def __init__(self, root: Path, split: str, ids: Sequence[int]) -> None:
        """Use ``open``."""
        self.root, self.split, self.scene_ids = root, split, tuple(ids)
        self._scenes: dict[int, Scene] = {}

    @classmethod
    def open(cls, root: str | Path, split: str | None = None) -> Dataset:
        """Open a dataset's folder.

        Args:
            root: holds SPLIT/%06d/scene_gt.json.
            split: may be left out where there is only one.

        Raises:
            UserError: this is no BOP dataset, or the split is not in it.
        """
        root = Path(root)
        split = split or find_split(root)
        return cls(root, split, scene_ids(root, split))

    def __reduce__(self) -> tuple[Callable[..., Dataset], tuple[Path, str, tuple[int, ...]]]:
        return Dataset, (self.root, self.split, self.scene_ids)

    def scene(self, scene_id: int) -> Scene:
        """A scene folder in columns; errors as in ``Scene.read``."""
        if scene_id not in self._scenes:  # two threads may both read it; the results are equal
            self._scenes[scene_id] = Scene.read(self.paths(scene_id))
        return self._scenes[scene_id]

    def scenes(self) -> Iterator[Scene]:
        """All scene folders."""
        return (self.scene(scene_id) for scene_id in self.scene_ids)

    def paths(self, scene_id: int) -> ScenePaths:
        """The files of a scene folder."""
        return ScenePaths.of(self.root, scene_id, self.split)

    def __len__(self) -> int:
        return int(self._ends[-1])

    def __iter__(self) -> Iterator[Image]:
        return (scene.image(number) for scene in self.scenes() for number in range(len(scene)))

    @overload
    def __getitem__(self, number: int) -> Image: ...
    @overload
    def __getitem__(self, number: slice) -> list[Image]: ...
    def __getitem__(self, number: int | slice) -> Image | list[Image]:
        if isinstance(number, slice):
            return [self[i] for i in range(*number.indices(len(self)))]
        index = number + len(self) if number < 0 else number
        if not 0 <= index < len(self):
            raise IndexError(f"image {number} of {len(self)}")
        scene = int(np.searchsorted(self._ends, index, side="right")) - 1
        return self.scene(self.scene_ids[scene]).image(index - int(self._ends[scene]))

    @cached_property
    def _ends(self) -> Integers:
        """Number of images before each scene folder, and of all."""
        return np.cumsum([0, *(len(scene) for scene in self.scenes())])

    @cached_property
    def header(self) -> Mapping[str, Any] | None:
        """Content of dataset.json; None where ``generate`` did not make the dataset."""
        path = self.root / DATASET_FILE
        return read_json(path) if path.exists() else None

    @cached_property
    def symmetries(self) -> SymmetryTable:
        """The table that the labels were made with; a UserError if there is none."""
        return SymmetryTable.read(self.root / SYMMETRIES_FILE)

    @cached_property
    def models_info(self) -> Mapping[int, Mapping[str, Any]]:
        """models_info.json by object id: diameter, box and symmetries, mm; a UserError if there is none."""
        return read_models_info(find_models_folder(self.root))


@dataclass(frozen=True)
class ImageEntries:
    """One image's records in a scene folder's JSON files, as they stand there; the lists are in scene_gt's order.

    Attributes:
        im_id: the image.
        camera: its entry in scene_camera.json.
        gt, gt_info, gt_canonical: its entries in scene_gt.json, scene_gt_info.json and scene_gt_canonical.json.
    """

    im_id: int
    camera: CameraEntry
    gt: list[GtEntry]
    gt_info: list[GtInfoEntry]
    gt_canonical: list[CanonicalEntry]


def read_entries(paths: ScenePaths, partly: bool = False) -> list[ImageEntries]:
    """The records of a scene folder's images, in ascending order.

    Args:
        paths: the scene folder.
        partly: also where scene_gt_info.json or scene_gt_canonical.json is missing; its lists are empty then.

    Raises:
        UserError: a file is missing or damaged, or the files disagree about the images or their instances.
    """
    cameras = read_scene_json(paths.scene_camera)
    gts = read_scene_json(paths.scene_gt)
    info, canonical = (
        {} if partly and not path.exists() else _matching(path, paths.scene_gt, gts)
        for path in (paths.scene_gt_info, paths.scene_gt_canonical)
    )
    if cameras.keys() != gts.keys():
        image = min(cameras.keys() ^ gts.keys())
        raise UserError(f"{paths.root}: image {image} is in only one of scene_camera.json and scene_gt.json")
    return [
        ImageEntries(im_id, cameras[im_id], gt, info.get(im_id, []), canonical.get(im_id, []))
        for im_id, gt in gts.items()
    ]


def read_specs(paths: ScenePaths) -> dict[int, ImageSpec]:
    """The recorded images of a scene folder, by image id; empty without scene_spec.jsonl.

    Raises:
        UserError: scene_spec.jsonl is damaged.
    """
    if not paths.scene_spec.exists():
        return {}
    adapter = spec_schema()
    try:
        specs = [adapter.validate_python(line) for line in read_json_lines(paths.scene_spec)]
    except ValidationError as error:
        fault = error.errors()[0]
        place = ".".join(str(part) for part in fault["loc"])
        raise UserError(f"{paths.scene_spec}: {place}: {fault['msg']}") from None
    return {spec.image_id: spec for spec in specs}


@cache
def spec_schema() -> TypeAdapter[ImageSpec]:
    """The schema of a line of scene_spec.jsonl; made once, since that takes long."""
    return TypeAdapter(ImageSpec)


def read_recipe(root: Path) -> Recipe:
    """The recipe that a dataset was made from.

    Raises:
        UserError: dataset.json is missing or damaged.
    """
    path = root / DATASET_FILE
    try:
        return Recipe.model_validate(read_json(path).get("recipe"))
    except ValidationError as error:
        raise UserError(f"{path}: its recipe is damaged ({error.errors()[0]['msg']})") from None


def _matching(path: Path, gt_path: Path, gts: Mapping[int, Any]) -> dict[int, Any]:
    content = read_scene_json(path)
    for im_id in sorted(content.keys() | gts.keys()):
        expected, found = _length(gts.get(im_id)), _length(content.get(im_id))
        if im_id not in content or expected != found:
            raise UserError(f"{path}: image {im_id} has {found} entries, but {expected} in {gt_path.name}")
    return content


def _length(entries: Any) -> int:
    return len(entries) if isinstance(entries, list) else 0


def _column(entries: Sequence[Mapping[str, Any]], key: str, *shape: int) -> Floats:
    """(N, *shape) a key's numbers in every entry."""
    return np.array([entry[key] for entry in entries], dtype=np.float64).reshape(len(entries), *shape)


def _rows(values: list[Any], count: int, name: str, places: list[Place], where: Callable[[Place], str]) -> Floats:
    """Lists of numbers as an array (N, count); a list of another form is named by its place."""
    if (array := as_floats(values)).shape == (len(values), count) and np.isfinite(array).all():
        return array
    for place, value in zip(places, values, strict=True):
        if (row := as_floats(value)).shape != (count,) or not np.isfinite(row).all():
            raise UserError(f"{where(place)}: {name} is {reprlib.repr(value)}, not {count} finite numbers")
    return np.empty((0, count))


def as_floats(values: Any) -> Floats:
    """Nested lists of numbers as an array; one of shape () if they are something else."""
    try:
        return np.array(values, dtype=np.float64)
    except (TypeError, ValueError):
        return np.empty(())


def _image(im_id: int) -> str:
    return f"scene_camera.json: image {im_id}"


def _instance(place: tuple[int, int]) -> str:
    return f"scene_gt.json: image {place[0]}, instance {place[1]}"
