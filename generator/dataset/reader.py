"""Reads a dataset: poses, labels and pictures of every image as arrays.

``Dataset`` opens a folder that ``generate`` made, one that ``adopt`` labelled, or any other BOP dataset, and gives its
scenes, images and instances. Nothing is written, no file is kept open; Blender and torch are not needed. One object may
be shared by threads, and is pickled as its path: a process that gets it reads for itself.

Below it are the two forms in which the rest of the package reads a scene folder: in columns (``Scene``), and as the
JSON records that stand there (``read_entries``).
"""

from __future__ import annotations

import hashlib
import operator
import reprlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, SupportsIndex, overload

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from synthetless.annotation.instances import Box
from synthetless.config import Recipe
from synthetless.dataset.layout import (
    AMBIGUITY_FILE,
    DATASET_FILE,
    SYMMETRIES_FILE,
    ScenePaths,
    find_models_folder,
    find_split,
    scene_ids,
)
from synthetless.dataset.records import (
    AmbiguityEntry,
    CameraEntry,
    CanonicalEntry,
    ForeignCameraEntry,
    ForeignGtEntry,
    ForeignGtInfoEntry,
    GtEntry,
    GtInfoEntry,
    ImageSpec,
    ambiguity_fault,
    projection_of,
    read_scene_json,
    validated,
)
from synthetless.errors import UserError
from synthetless.io import images
from synthetless.io.files import read_bytes, read_json, read_json_lines
from synthetless.io.models import read_models_info
from synthetless.scenes.spec import Intrinsics
from synthetless.symmetry import SymmetryTable

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Where = Callable[[int], str]
"""Names a row's place for a message: file, image and instance."""


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
class QuasiLabel:
    """Which nearly symmetrical poses the image cannot tell apart; see ``symmetry.ambiguity``.

    Attributes:
        R_m2c, t_m2c: (3, 3) and (3,) mm, canonical pose under the quasi-symmetry group: what is learned coarsely.
        index, n_indices: the regressor that is responsible for it, and how many there are.
        coset_true: the coset h G of the true pose among those of the exact group: it looks like R_m2c h.
        alike: (k,) whether the image cannot tell each coset from the true one; the true one is among them.
        pixels_apart: (k,) at how many pixels it can be told from it.
        view_ambiguity: share of ``alike``.
        eps_mm: depths that differ by more were told apart.
        R_alike, t_alike: (M, 3, 3) and (M, 3) mm, all poses that look alike; None unless they were asked for.
    """

    R_m2c: Floats
    t_m2c: Floats
    index: int
    n_indices: int
    coset_true: int
    alike: NDArray[np.bool_]
    pixels_apart: Integers
    view_ambiguity: float
    eps_mm: float
    R_alike: Floats | None = None
    t_alike: Floats | None = None

    @classmethod
    def of(cls, entry: AmbiguityEntry) -> QuasiLabel:
        """The label of an entry of scene_gt_ambiguity.json."""
        alike = np.zeros(entry["n_cosets"], dtype=bool)
        alike[entry["cosets_alike"]] = True
        poses = np.array(entry["poses_alike"], dtype=np.float64).reshape(-1, 12) if "poses_alike" in entry else None
        return cls(
            np.array(entry["cam_R_m2c_quasi"], dtype=np.float64).reshape(3, 3),
            np.array(entry["cam_t_m2c_quasi"], dtype=np.float64),
            entry["quasi_index"],
            entry["n_quasi_indices"],
            entry["coset_true"],
            alike,
            np.array(entry["pixels_apart"], dtype=np.int64),
            entry["view_ambiguity"],
            entry["eps_mm"],
            None if poses is None else poses[:, :9].reshape(-1, 3, 3),
            None if poses is None else poses[:, 9:],
        )


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
        quasi: None if the object has no quasi-symmetry group, or ``synthetless ambiguity`` has not judged the dataset
            as it is now.
    """

    paths: ScenePaths
    im_id: int
    gt_id: int
    obj_id: int
    R_m2c: Floats
    t_m2c: Floats
    label: Label | None
    visibility: Visibility | None
    quasi: QuasiLabel | None = None

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
        distortion: (5,) of the lens, k1, k2, p1, p2, k3 as in OpenCV, zeros of a pinhole; for ``project`` and
            ``undistorted_pixels`` of ``synthetless.scenes.lens``.
        depth_scale: millimetres per unit of the depth image.
        R_w2c, t_w2c: (3, 3) and (3,) mm, world to camera; None if the dataset does not say.
        instances: in scene_gt's order.
    """

    paths: ScenePaths
    im_id: int
    K: Floats
    distortion: Floats
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

    def camera(self, width: int, height: int) -> Intrinsics:
        """Its pinhole and lens, for an image of this size."""
        return intrinsics_of(self.K, self.distortion, width, height)

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

    def depth_sensed_mm(self) -> Floats:
        """(H, W) z in millimetres as a depth camera measures it, 0 where it has none; if it is among the outputs."""
        path = self.paths.depth_sensed(self.im_id)
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
    """Columns of ``Label``, one row for each of N instances; ``corners_px`` is (N, 8, 2)."""

    R_m2c: Floats
    t_m2c: Floats
    regressor_index: Integers
    n_regressors: Integers
    discontinuity_margin_deg: Floats
    corners_px: Floats

    @classmethod
    def of(cls, entries: Sequence[CanonicalEntry], where: Where) -> Labels:
        """The columns of entries of scene_gt_canonical.json; a UserError names a damaged one."""
        return cls(
            _column(entries, "cam_R_m2c_canonical", where, 9).reshape(-1, 3, 3),
            _column(entries, "cam_t_m2c_canonical", where, 3),
            _whole_column(entries, "regressor_index", where),
            _whole_column(entries, "n_regressors", where),
            _column(entries, "discontinuity_margin_deg", where),
            _column(entries, "bbox3d_corners_2d", where, 8, 2),
        )

    def row(self, number: int) -> Label:
        """The label of one instance."""
        return Label(
            self.R_m2c[number].copy(),
            self.t_m2c[number].copy(),
            int(self.regressor_index[number]),
            int(self.n_regressors[number]),
            float(self.discontinuity_margin_deg[number]),
            self.corners_px[number].copy(),
        )


@dataclass(frozen=True, eq=False)
class Visibilities:
    """Columns of ``Visibility``, one row for each of N instances; ``px_counts`` (N, 3) are all, valid, visib."""

    visib_fract: Floats
    px_counts: Integers
    bbox_obj: Integers
    bbox_visib: Integers

    @classmethod
    def of(cls, entries: Sequence[GtInfoEntry], where: Where) -> Visibilities:
        """The columns of entries of scene_gt_info.json; a UserError names a damaged one."""
        counts = [_whole_column(entries, f"px_count_{what}", where) for what in ("all", "valid", "visib")]
        return cls(
            _column(entries, "visib_fract", where),
            np.stack(counts, axis=1),
            _whole_column(entries, "bbox_obj", where, 4),
            _whole_column(entries, "bbox_visib", where, 4),
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
        lenses: (M, 5) distortion of each image, as ``Image.distortion``.
        obj_ids: (N,).
        R_m2c, t_m2c: (N, 3, 3), (N, 3) mm.
    """

    image_ids: Integers
    first: Integers
    cameras: Floats
    lenses: Floats
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
        image_ids = np.array(list(scene_gt), dtype=np.int64)
        first = np.cumsum([0, *(len(entries) for entries in scene_gt.values())])
        every = [entry for entries in scene_gt.values() for entry in entries]
        cameras, lenses = _projections(scene_gt, scene_camera)
        in_gt = _in_file("scene_gt.json", image_ids, first)
        return cls(
            image_ids,
            first,
            _column(cameras, "cam_K", _in_file("scene_camera.json", image_ids), 9).reshape(-1, 3, 3),
            lenses,
            _whole_column(every, "obj_id", in_gt),
            _column(every, "cam_R_m2c", in_gt, 9).reshape(-1, 3, 3),
            _column(every, "cam_t_m2c", in_gt, 3),
        )

    @property
    def K(self) -> Floats:
        """(N, 3, 3) camera matrix of each instance's image."""
        return np.repeat(self.cameras, np.diff(self.first), axis=0)

    @property
    def distortion(self) -> Floats:
        """(N, 5) distortion of each instance's image."""
        return np.repeat(self.lenses, np.diff(self.first), axis=0)

    def place(self, row: int) -> str:
        """File, image and instance of a row, for messages."""
        return _in_file("scene_gt.json", self.image_ids, self.first)(row)


@dataclass(frozen=True, eq=False)
class Scene:
    """A scene folder in columns: M images, N instances. The arrays are shared and cannot be written to.

    Attributes:
        paths: its files.
        poses: image ids, camera matrices, object ids and true poses.
        depth_scale: (M,) millimetres per unit of the depth images.
        R_w2c, t_w2c: (M, 3, 3), (M, 3) mm, world to camera; None if the dataset does not say.
        labels: of the N instances; None without scene_gt_canonical.json.
        visibility: of the N instances; None without scene_gt_info.json.
        ambiguity: records of the N instances, as ``Instance.quasi`` has them.
    """

    paths: ScenePaths
    poses: ScenePoses
    depth_scale: Floats
    R_w2c: Floats | None
    t_w2c: Floats | None
    labels: Labels | None
    visibility: Visibilities | None
    ambiguity: tuple[AmbiguityEntry | None, ...]

    @classmethod
    def read(cls, paths: ScenePaths) -> Scene:
        """Read the JSON files of a scene folder.

        Raises:
            UserError: one is damaged, or they disagree about the images or their instances.
        """
        entries = _read_entries(paths, partly=True)
        try:
            return cls._of(paths, entries)
        except UserError as error:
            raise UserError(f"{paths.root}: {error}") from None

    @classmethod
    def _of(cls, paths: ScenePaths, entries: Sequence[ImageEntries]) -> Scene:
        poses = ScenePoses.of(
            {image.im_id: image.gt for image in entries}, {image.im_id: image.camera for image in entries}
        )
        cameras = [{"depth_scale": 1.0, **image.camera} for image in entries]
        canonical = [label for image in entries for label in image.gt_canonical]
        info = [entry for image in entries for entry in image.gt_info]
        in_camera, in_canonical, in_info = (
            _in_file(path.name, poses.image_ids, first)
            for path, first in (
                (paths.scene_camera, None),
                (paths.scene_gt_canonical, poses.first),
                (paths.scene_gt_info, poses.first),
            )
        )
        placed = all("cam_R_w2c" in camera and "cam_t_w2c" in camera for camera in cameras)
        return cls(
            paths,
            poses,
            _column(cameras, "depth_scale", in_camera),
            _column(cameras, "cam_R_w2c", in_camera, 9).reshape(-1, 3, 3) if placed else None,
            _column(cameras, "cam_t_w2c", in_camera, 3) if placed else None,
            Labels.of(canonical, in_canonical) if paths.scene_gt_canonical.exists() else None,
            Visibilities.of(info, in_info) if paths.scene_gt_info.exists() else None,
            tuple(entry for image in entries for entry in image.gt_ambiguity or [None] * len(image.gt)),
        )

    def __post_init__(self) -> None:
        for columns in (self, self.poses, self.labels, self.visibility):
            for column in () if columns is None else vars(columns).values():
                if isinstance(column, np.ndarray):
                    column.flags.writeable = False

    def labelled(self) -> tuple[ScenePoses, Labels, Visibilities]:
        """Poses, labels and visibility, for those who need all of them.

        Raises:
            UserError: scene_gt_canonical.json or scene_gt_info.json is missing.
        """
        if self.labels is None:
            raise UserError(f"{self.paths.scene_gt_canonical}: not found; adopt writes the labels of a BOP dataset")
        if self.visibility is None:
            raise UserError(f"{self.paths.scene_gt_info}: not found; bop_toolkit's calc_gt_info.py writes it")
        return self.poses, self.labels, self.visibility

    def __len__(self) -> int:
        """Number of images."""
        return len(self.poses.image_ids)

    def image(self, number: int) -> Image:
        """The image with a number in this folder, counted from 0."""
        rows = range(int(self.poses.first[number]), int(self.poses.first[number + 1]))
        return Image(
            self.paths,
            int(self.poses.image_ids[number]),
            self.poses.cameras[number].copy(),
            self.poses.lenses[number].copy(),
            float(self.depth_scale[number]),
            None if self.R_w2c is None else self.R_w2c[number].copy(),
            None if self.t_w2c is None else self.t_w2c[number].copy(),
            tuple(self._instance(int(self.poses.image_ids[number]), gt_id, row) for gt_id, row in enumerate(rows)),
        )

    def _instance(self, im_id: int, gt_id: int, row: int) -> Instance:
        ambiguity = self.ambiguity[row]
        return Instance(
            self.paths,
            im_id,
            gt_id,
            int(self.poses.obj_ids[row]),
            self.poses.R_m2c[row].copy(),
            self.poses.t_m2c[row].copy(),
            None if self.labels is None else self.labels.row(row),
            None if self.visibility is None else self.visibility.row(row),
            None if ambiguity is None else QuasiLabel.of(ambiguity),
        )


class Dataset(Sequence[Image]):
    """A split of a BOP dataset: a sequence of images, in the order of scene folders and image ids.

    The JSON files of a scene folder are read when its first image is asked for, and kept as arrays (about 0.5 kB an
    instance). ``len`` and access by number read those of all folders. The arrays of an image and of its instances are
    copies, which may be changed.

    >>> dataset = Dataset.open("out/demo")  # doctest: +SKIP
    >>> image = dataset[0]  # doctest: +SKIP
    >>> image.key, image.rgb().shape, len(image.instances)  # doctest: +SKIP
    ('000001_000000', (300, 400, 3), 5)
    >>> instance = image.instances[0]  # doctest: +SKIP
    >>> instance.obj_id, instance.R_m2c.shape, instance.label.regressor_index  # doctest: +SKIP
    (3, (3, 3), 0)

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
            UserError: this is not a BOP dataset, the split is not in it, or there are several and none is named.
        """
        root = Path(root)
        split = split or find_split(root)
        return cls(root, split, scene_ids(root, split))

    def __repr__(self) -> str:
        return f"Dataset({str(self.root)!r}, split {self.split!r}, {len(self.scene_ids)} scene folders)"

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

    def image(self, scene_id: int, im_id: int) -> Image:
        """The image with these BOP ids; a UserError if there is none."""
        if scene_id in self.scene_ids:
            scene = self.scene(scene_id)
            if (numbers := np.flatnonzero(scene.poses.image_ids == im_id)).size:
                return scene.image(int(numbers[0]))
        raise UserError(f"{self.paths(scene_id).root}: no image {im_id}")

    def paths(self, scene_id: int) -> ScenePaths:
        """The files of a scene folder."""
        return ScenePaths.of(self.root, scene_id, self.split)

    def __len__(self) -> int:
        return int(self._ends[-1])

    def __iter__(self) -> Iterator[Image]:
        return (scene.image(number) for scene in self.scenes() for number in range(len(scene)))

    @overload
    def __getitem__(self, number: SupportsIndex) -> Image: ...
    @overload
    def __getitem__(self, number: slice) -> list[Image]: ...
    def __getitem__(self, number: SupportsIndex | slice) -> Image | list[Image]:
        if isinstance(number, slice):
            return [self[i] for i in range(*number.indices(len(self)))]
        index = operator.index(number)  # a whole number of any type, numpy's included
        index += len(self) if index < 0 else 0
        if not 0 <= index < len(self):
            raise IndexError(f"{self.root}: image {number} of {len(self)}; 0 to {len(self) - 1} are possible")
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
        gt_ambiguity: those in scene_gt_ambiguity.json; none unless the file is of the dataset as it is now.
    """

    im_id: int
    camera: CameraEntry
    gt: list[GtEntry]
    gt_info: list[GtInfoEntry]
    gt_canonical: list[CanonicalEntry]
    gt_ambiguity: list[AmbiguityEntry | None]


def read_entries(paths: ScenePaths) -> list[ImageEntries]:
    """The records of a scene folder's images, in ascending order, unchanged: with what others wrote beside.

    Raises:
        UserError: a file is missing or damaged, or the files disagree about the images or their instances.
    """
    entries = _read_entries(paths)
    for path, form, content in (
        (paths.scene_camera, ForeignCameraEntry, {image.im_id: image.camera for image in entries}),
        (paths.scene_gt, list[ForeignGtEntry], {image.im_id: image.gt for image in entries}),
        (paths.scene_gt_info, list[ForeignGtInfoEntry], {image.im_id: image.gt_info for image in entries}),
        (paths.scene_gt_canonical, list[CanonicalEntry], {image.im_id: image.gt_canonical for image in entries}),
    ):
        validated(dict[int, form], content, path)  # type: ignore[valid-type]
    return entries


def _read_entries(paths: ScenePaths, partly: bool = False) -> list[ImageEntries]:
    """The records as they stand there; ``partly`` also where those of visibility or labels are missing."""
    cameras = read_scene_json(paths.scene_camera)
    gts = read_scene_json(paths.scene_gt)
    info, canonical = (
        {} if partly and not path.exists() else _matching(path, paths.scene_gt, gts)
        for path in (paths.scene_gt_info, paths.scene_gt_canonical)
    )
    ambiguity = read_ambiguity(paths, gts)
    if cameras.keys() != gts.keys():
        image = min(cameras.keys() ^ gts.keys())
        raise UserError(f"{paths.root}: image {image} is in only one of scene_camera.json and scene_gt.json")
    return [
        ImageEntries(im_id, cameras[im_id], gt, info.get(im_id, []), canonical.get(im_id, []), ambiguity.get(im_id, []))
        for im_id, gt in gts.items()
    ]


def read_ambiguity(paths: ScenePaths, gts: Mapping[int, Sequence[Any]]) -> dict[int, list[AmbiguityEntry | None]]:
    """Entries of scene_gt_ambiguity.json by image id; none unless the file is of the dataset as it is now.

    Args:
        paths: a scene folder.
        gts: content of its scene_gt.json.

    Raises:
        UserError: the file, or one that says what it is of, is damaged.
    """
    path = paths.scene_gt_ambiguity
    if not path.exists() or not is_ambiguity_current(paths):
        return {}
    content = _matching(path, paths.scene_gt, gts)
    validated(dict[int, list[AmbiguityEntry | None]], content, path)
    for im_id, entries in content.items():
        for gt_id, entry in enumerate(entries):
            if entry is not None and (fault := ambiguity_fault(entry)):
                raise UserError(f"{path}: image {im_id}, instance {gt_id}: {fault}")
    return content


def is_ambiguity_current(paths: ScenePaths) -> bool:
    """Whether a scene folder's scene_gt_ambiguity.json is of the symmetries and poses that there are now."""
    root = paths.root.parents[1]
    if not (root / AMBIGUITY_FILE).exists() or not (root / SYMMETRIES_FILE).exists():
        return False
    stamp = read_json(root / AMBIGUITY_FILE)
    scenes = stamp.get("scenes")
    stated = scenes.get(paths.name) if isinstance(scenes, dict) else None
    return stamp.get("symmetries") == SymmetryTable.read(root / SYMMETRIES_FILE).digest() and stated == digest(paths)


def digest(paths: ScenePaths) -> str:
    """SHA-256 of what a scene folder records of its bodies and cameras."""
    files = [path for path in (paths.scene_gt, paths.scene_camera, paths.scene_spec) if path.exists()]
    return hashlib.sha256(b"\0".join(read_bytes(path) for path in files)).hexdigest()


def read_specs(paths: ScenePaths) -> dict[int, ImageSpec]:
    """The recorded images of a scene folder, by image id; empty without scene_spec.jsonl.

    Raises:
        UserError: scene_spec.jsonl is damaged.
    """
    if not paths.scene_spec.exists():
        return {}
    lines = read_json_lines(paths.scene_spec)
    specs: list[ImageSpec] = [validated(ImageSpec, line, paths.scene_spec) for line in lines]
    return {spec.image_id: spec for spec in specs}


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


def intrinsics_of(K: Floats, distortion: Floats, width: int, height: int) -> Intrinsics:
    """A camera of the matrix K (3, 3) without skew, and a lens (5,)."""
    k1, k2, p1, p2, k3 = distortion.tolist()
    return Intrinsics(width, height, K[0, 0], K[1, 1], K[0, 2], K[1, 2], (k1, k2, p1, p2, k3))


def _projections(
    scene_gt: Mapping[int, Any], scene_camera: Mapping[int, CameraEntry]
) -> tuple[list[dict[str, list[float]]], Floats]:
    """``cam_K`` of each image, whichever way its camera is described, and (M, 5) its distortion."""
    matrices, lenses = [], []
    for im_id in scene_gt:
        try:
            K, distortion = projection_of(scene_camera[im_id])
        except UserError as error:
            raise UserError(f"scene_camera.json: image {im_id}: {error}") from None
        matrices.append({"cam_K": K})
        lenses.append(distortion)
    return matrices, np.array(lenses, dtype=np.float64).reshape(-1, 5)


def _matching(path: Path, gt_path: Path, gts: Mapping[int, Any]) -> dict[int, Any]:
    content = read_scene_json(path)
    for im_id in sorted(content.keys() | gts.keys()):
        expected, found = _length(gts.get(im_id)), _length(content.get(im_id))
        if im_id not in content or expected != found:
            raise UserError(f"{path}: image {im_id} has {found} entries, but {expected} in {gt_path.name}")
    return content


def _length(entries: Any) -> int:
    return len(entries) if isinstance(entries, list) else 0


def _column(entries: Sequence[Any], key: str, where: Where, *shape: int) -> Floats:
    """(N, *shape) a key's numbers in every entry; an entry without them is named by its place."""
    values = [entry.get(key) if isinstance(entry, dict) else None for entry in entries]
    if (column := as_floats(values)).shape == (len(values), *shape) and np.isfinite(column).all():
        return column
    for row, value in enumerate(values):
        if (numbers := as_floats(value)).shape != shape or not np.isfinite(numbers).all():
            wanted = " x ".join(map(str, shape)) + " finite numbers" if shape else "a finite number"
            raise UserError(f"{where(row)}: {key} is {reprlib.repr(value)}, not {wanted}")
    return np.empty((0, *shape))


def _whole_column(entries: Sequence[Any], key: str, where: Where, *shape: int) -> Integers:
    """The same of whole numbers."""
    column = _column(entries, key, where, *shape)
    if (odd := np.argwhere(column != np.floor(column))).size:
        row = int(odd[0, 0])
        raise UserError(f"{where(row)}: {key} is {entries[row][key]!r}; whole numbers are needed")
    return column.astype(np.int64)


def as_floats(values: Any) -> Floats:
    """Nested lists of numbers as an array; one of shape () if they are something else, text or null included."""
    try:
        array = np.array(values)
    except ValueError:  # lists of different lengths
        return np.full((), np.nan)
    return array.astype(np.float64) if array.dtype.kind in "iuf" else np.full((), np.nan)


def _in_file(name: str, image_ids: Integers, first: Integers | None = None) -> Where:
    """Names rows of a file: images, or instances if ``first`` says with which row each image begins."""

    def place(row: int) -> str:
        if first is None:
            return f"{name}: image {image_ids[row]}"
        image = int(np.searchsorted(first, row, side="right")) - 1
        return f"{name}: image {image_ids[image]}, instance {row - int(first[image])}"

    return place
