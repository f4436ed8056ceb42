"""BOP: a folder as registered loaders expect it, by names of datasets and splits that they know.

Format: https://github.com/thodan/bop_toolkit/blob/master/docs/bop_datasets_format.md, and what the loaders of
docs/formats.md read beside it. Scripts of others write masks, JSON files and models: those are never links to the
dataset, which nobody changes by way of an export.
"""

from __future__ import annotations

import io
import json
import pickle
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain, pairwise
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from synthetless.annotation.instances import PosedModel
from synthetless.annotation.raycast import RayCaster
from synthetless.annotation.scene import scene_caster
from synthetless.dataset.layout import (
    CAMERA_FILE,
    MODELS_FOLDER,
    SYMMETRIES_FILE,
    ScenePaths,
    find_models_folder,
    find_split,
    scene_ids,
)
from synthetless.dataset.records import MIN_VISIB_FRACT, read_scene_json
from synthetless.errors import UserError
from synthetless.exports.annotated import AnnotatedImage, annotated_images, names_of, read_scene_coco
from synthetless.exports.folder import Entry, FolderExport, Same, write_export
from synthetless.exports.keypoints import farthest_points
from synthetless.io.files import json_bytes, read_bytes, read_json
from synthetless.io.images import decode_rgb, encode_jpeg
from synthetless.io.models import INFO_FILE, ObjectModel, load_models, read_models_info
from synthetless.scenes.spec import Intrinsics

IMAGES_PER_SCENE = 1000
"""BOP's limit for a scene folder of rendered images."""
XYZ_FOLDER = "xyz_crop"
FPS_FILE = "fps_points.pkl"
_FPS_COUNTS = (4, 8, 12, 16, 20, 32, 64, 128, 256)
_OTHER_MODELS = ("models_cad", "models_eval")
_CAMERAS = {"tless": "camera_primesense.json", "hb": "camera_primesense.json", "ycbv": "camera_uw.json"}
"""Whose camera has another name, beside camera.json."""
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*")

Source = tuple[int, int]
"""An image of the dataset: scene folder and image id."""


DepthKind = Literal["exact", "sensed"]


@dataclass(frozen=True)
class BopExport(FolderExport):
    """A BOP dataset of another name.

    Attributes:
        name: of the dataset, as loaders know it.
        to_split: folder of scenes to write.
        jpg: quality of JPEG images; None: as they are.
        pixel_centre: where the centre of the first pixel is: 0 as in OpenCV, or 0.5.
        scenes: number of scene folders; None: as many as are needed.
        xyz_crops: also write each instance's object coordinates.
        fps: also write farthest points of the models.
        depth: "exact", or "sensed" as a depth camera measures it.
    """

    kind: ClassVar[str] = "bop"
    owned: ClassVar[tuple[str, ...]] = (
        *(f"*/[0-9]*/{folder}/*.*" for folder in ("rgb", "depth", "mask", "mask_visib")),
        f"*/{XYZ_FOLDER}/*/*.pkl",
    )

    name: str = "tless"
    to_split: str = "train_pbr"
    jpg: int | None = None
    pixel_centre: float = 0.0
    scenes: int | None = None
    xyz_crops: bool = False
    fps: bool = False
    depth: DepthKind = "exact"

    def __post_init__(self) -> None:
        for what, value in (("name", self.name), ("split", self.to_split)):
            if not _NAME.fullmatch(value):
                raise UserError(f"the {what} {value!r} is no plain name, such as tless or train_pbr")
        if self.jpg is not None and not 1 <= self.jpg <= 100:
            raise UserError(f"JPEG quality {self.jpg} is out of range; give 1..100")
        if self.pixel_centre not in (0.0, 0.5):
            raise UserError(f"pixel_centre is {self.pixel_centre:g}; it is 0, as in OpenCV, or 0.5")

    def parts(self) -> Sequence[int]:
        """The scene folders to write, from 0."""
        return range(len(self._sources))

    def entries(self, part: int) -> Iterator[Entry]:
        """A scene folder."""
        scene = f"{self.to_split}/{part:06d}"
        files: dict[str, dict[str, Any]] = {name: {} for name in ("camera", "gt", "gt_info", "gt_canonical")}
        images: list[dict[str, Any]] = []
        annotations: list[dict[str, Any]] = []
        categories: dict[int, dict[str, Any]] = {}
        for im_id, (paths, image, coco) in enumerate(self._read(self._sources[part])):
            labels = image.labels
            files["camera"][str(im_id)] = labels.camera | {"cam_K": self._shifted(labels.camera["cam_K"])}
            files["gt"][str(im_id)] = labels.gt
            files["gt_info"][str(im_id)] = labels.gt_info
            files["gt_canonical"][str(im_id)] = [self._moved(label) for label in labels.gt_canonical]
            source = paths.root / image.entry["file_name"]
            rgb = source.suffix if self.jpg is None else ".jpg"
            images.append({**image.entry, "id": im_id, "file_name": f"rgb/{im_id:06d}{rgb}"})
            if source.parent.is_dir():  # a recipe's outputs may lack what is not of interest
                yield f"{scene}/rgb/{im_id:06d}{rgb}", self._picture(source)
            yield from self._depth(paths, labels.im_id, f"{scene}/depth/{im_id:06d}.png")
            for folder, mask in (("mask", paths.mask), ("mask_visib", paths.mask_visib)):
                for gt_id in range(len(labels.gt) if (paths.root / folder).is_dir() else 0):
                    yield f"{scene}/{folder}/{im_id:06d}_{gt_id:06d}.png", read_bytes(mask(labels.im_id, gt_id))
            annotations += [{**annotation, "image_id": im_id} for _, annotation in image.visible]
            categories = {category["id"]: self._named(category) for category in coco["categories"]} | categories
            if self.xyz_crops:
                yield from self._crops(f"{self.to_split}/{XYZ_FOLDER}/{part:06d}/{im_id:06d}", image)
        for name, content_of in files.items():
            yield _json_file(f"{scene}/scene_{name}.json", content_of)
        coco = {
            "annotations": [{**annotation, "id": number} for number, annotation in enumerate(annotations, start=1)],
            "categories": [categories[obj_id] for obj_id in sorted(categories)],
            "images": images,
            "info": {"contributor": "", "description": self.name, "url": "", "version": "0.1.0"},
            "licenses": [],
        }
        yield _json_file(f"{scene}/scene_gt_coco.json", coco)

    def common(self) -> Iterator[Entry]:
        """Cameras, models, targets and symmetries."""
        camera = self._camera()
        for name in (CAMERA_FILE, *([_CAMERAS[self.name]] if self.name in _CAMERAS else [])):
            yield _json_file(name, camera)
        yield SYMMETRIES_FILE, read_bytes(self.dataset / SYMMETRIES_FILE)
        yield from self._model_files()
        poses, images = self._targets()
        yield "test_targets_bop19.json", _lines(poses)
        yield "test_targets_bop24.json", _lines(images)

    @cached_property
    def _sources(self) -> list[list[Source]]:
        """The images of each scene folder to write, in the dataset's order."""
        found = [
            (scene_id, im_id)
            for scene_id in scene_ids(self.dataset, self.split)
            for im_id in read_scene_json(self._paths(scene_id).scene_gt)
        ]
        if not found:
            raise UserError(f"{self.dataset}: holds no images to export")
        count = self.scenes or -(-len(found) // IMAGES_PER_SCENE)
        if not 1 <= count <= len(found) or len(found) > count * IMAGES_PER_SCENE:
            raise UserError(
                f"{self.dataset}: {len(found)} images do not fill {count} scene folders of 1 to {IMAGES_PER_SCENE}; "
                f"give {-(-len(found) // IMAGES_PER_SCENE)} to {len(found)}"
            )
        if self.scenes is None:
            return [found[first : first + IMAGES_PER_SCENE] for first in range(0, len(found), IMAGES_PER_SCENE)]
        bounds = [len(found) * number // count for number in range(count + 1)]
        return [found[first:last] for first, last in pairwise(bounds)]

    def _read(self, sources: Sequence[Source]) -> Iterator[tuple[ScenePaths, AnnotatedImage, dict[str, Any]]]:
        """The images, each with its scene folder's paths and scene_gt_coco.json; in their order."""
        for scene_id in dict.fromkeys(scene_id for scene_id, _ in sources):
            paths, wanted = self._paths(scene_id), {im_id for scene, im_id in sources if scene == scene_id}
            coco = read_scene_coco(paths)
            for image in annotated_images(paths, coco):
                if image.labels.im_id in wanted:
                    if "cam_K" not in image.labels.camera:
                        raise UserError(
                            f"{paths.scene_camera}: image {image.labels.im_id} was taken through a lens (cam_model); "
                            "the loaders that this folder is for read cam_K"
                        )
                    yield paths, image, coco

    def _depth(self, paths: ScenePaths, im_id: int, to: str) -> Iterator[Entry]:
        path = paths.depth(im_id) if self.depth == "exact" else paths.depth_sensed(im_id)
        if path.exists():
            yield to, path
        elif self.depth == "sensed":
            raise UserError(f"{path}: not there; generate the dataset with depth_sensed among its outputs")

    def _paths(self, scene_id: int) -> ScenePaths:
        return ScenePaths.of(self.dataset, scene_id, self.split)

    def _shifted(self, K: Sequence[float]) -> list[float]:
        """A camera matrix for pixels whose centres are elsewhere."""
        shifted = list(K)
        shifted[2], shifted[5] = shifted[2] + self.pixel_centre, shifted[5] + self.pixel_centre
        return shifted

    def _named(self, category: Mapping[str, Any]) -> dict[str, Any]:
        names = self._names
        return {**category, **({"name": names[category["id"]]} if category["id"] in names else {})}

    @cached_property
    def _names(self) -> dict[int, str]:
        return names_of(self.dataset)

    def _moved(self, label: Mapping[str, Any]) -> dict[str, Any]:
        corners = [[u + self.pixel_centre, v + self.pixel_centre] for u, v in label["bbox3d_corners_2d"]]
        return {**label, "bbox3d_corners_2d": corners}

    def _picture(self, path: Path) -> bytes | Path:
        """The file of a colour image: as it is, or a PNG as JPEG."""
        if self.jpg is None or path.suffix == ".jpg":
            return path
        return encode_jpeg(decode_rgb(read_bytes(path), path), self.jpg)

    def _camera(self) -> dict[str, Any]:
        """Content of camera.json: the dataset's, or else its first image's camera."""
        path = self.dataset / CAMERA_FILE
        if path.exists():
            camera = read_json(path)
        else:
            _, image, _ = next(self._read(self._sources[0][:1]))
            K, entry = image.labels.camera["cam_K"], image.entry
            camera = {"fx": K[0], "fy": K[4], "cx": K[2], "cy": K[5]}
            camera |= {"width": entry["width"], "height": entry["height"]}
            camera["depth_scale"] = image.labels.camera.get("depth_scale", 1.0)
        return camera | {key: camera[key] + self.pixel_centre for key in ("cx", "cy")}

    def _model_files(self) -> Iterator[Entry]:
        folder = find_models_folder(self.dataset)
        infos = {str(obj_id): info for obj_id, info in read_models_info(folder).items()}
        yield _json_file(f"{MODELS_FOLDER}/{INFO_FILE}", infos)
        meshes = (path for pattern in ("obj_*.ply", "obj_*.png") for path in folder.glob(pattern))  # and textures
        names = [INFO_FILE, *sorted(path.name for path in meshes)]
        for name in names[1:]:
            yield f"{MODELS_FOLDER}/{name}", read_bytes(folder / name)
        if self.fps:
            names.append(FPS_FILE)
            yield f"{MODELS_FOLDER}/{FPS_FILE}", _pickled({str(i): _fps(model) for i, model in self._models.items()})
        for other in _OTHER_MODELS:
            for name in names:
                yield f"{other}/{name}", Same(f"{MODELS_FOLDER}/{name}")

    def _targets(self) -> tuple[list[dict[str, int]], list[dict[str, int]]]:
        """BOP's targets of 2019: how often each object is at least 10 % visible; and of 2024: the images with any."""
        poses: list[dict[str, int]] = []
        images: list[dict[str, int]] = []
        places = [
            {"im_id": im_id, "scene_id": scene_id}
            for scene_id, sources in enumerate(self._sources)
            for im_id in range(len(sources))
        ]
        for place, (_, image, _) in zip(places, self._read(list(chain(*self._sources))), strict=True):
            counts: dict[int, int] = {}
            for gt, info in zip(image.labels.gt, image.labels.gt_info, strict=True):
                if info["visib_fract"] >= MIN_VISIB_FRACT:
                    counts[gt["obj_id"]] = counts.get(gt["obj_id"], 0) + 1
            poses += [place | {"obj_id": obj_id, "inst_count": counts[obj_id]} for obj_id in sorted(counts)]
            images += [place] if counts else []
        return poses, images

    @cached_property
    def _models(self) -> dict[int, ObjectModel]:
        return load_models(find_models_folder(self.dataset))

    @cached_property
    def _caster(self) -> RayCaster:
        return scene_caster({"model": self._models})

    def _crops(self, place: str, image: AnnotatedImage) -> Iterator[Entry]:
        """GDR-Net's files: the model coordinates of an instance's whole silhouette, metres."""
        K, entry = image.labels.camera["cam_K"], image.entry
        camera = Intrinsics(entry["width"], entry["height"], K[0], K[4], K[2], K[5])
        for gt_id, gt in enumerate(image.labels.gt):
            posed = PosedModel(gt["obj_id"], np.reshape(gt["cam_R_m2c"], (3, 3)), np.array(gt["cam_t_m2c"]))
            window, met, coordinates_mm = self._caster.whole_coordinates_mm(camera, posed)
            box, crop = [0, 0, 0, 0], np.zeros((1, 1, 3))
            if met.any():
                rows, columns = np.flatnonzero(met.any(axis=1)), np.flatnonzero(met.any(axis=0))
                top, bottom, left, right = (int(i) for i in (rows[0], rows[-1], columns[0], columns[-1]))
                box = [window.left + left, window.top + top, window.left + right, window.top + bottom]
                crop = coordinates_mm[top : bottom + 1, left : right + 1] / 1000
            yield f"{place}_{gt_id:06d}-xyz.pkl", _pickled({"xyz_crop": crop.astype(np.float16), "xyxy": box})


def export_bop(
    dataset: Path,
    to: Path,
    name: str = "tless",
    to_split: str = "train_pbr",
    split: str | None = None,
    jpg: int | None = None,
    pixel_centre: float = 0.0,
    scenes: int | None = None,
    xyz_crops: bool = False,
    fps: bool = False,
    depth: DepthKind = "exact",
    copy: bool = False,
    workers: int | None = None,
) -> Path:
    """Write a split as a BOP dataset of a name that loaders know: TO/NAME/SPLIT/000000, ...

    Args:
        dataset: a BOP dataset folder with scene_gt_canonical.json and scene_gt_coco.json in its scenes.
        to: where BOP datasets are; ``name`` in it must be new or empty, and appears when everything is written.
        name: of the dataset, "tless".
        to_split: folder of scenes to write.
        split: the dataset's own; the only one if None.
        jpg: write PNG images as JPEG of this quality; None: leave them as they are.
        pixel_centre: 0.5 for loaders that have the centre of pixel (i, j) at (i + 0.5, j + 0.5): added to cx and cy.
        scenes: spread the images evenly over so many scene folders; None: 1000 in each.
        xyz_crops: write xyz_crop/SCENE/IMAGE_INSTANCE-xyz.pkl, for trainers like GDR-Net.
        fps: write models/fps_points.pkl, for the same.
        depth: which depth images become those in depth/: "exact", or "sensed", as a depth camera measures it.
        copy: copy colour and depth images, for a folder that is to be sent; else link them.
        workers: processes; one per available core if None.

    Returns:
        The folder.

    Raises:
        UserError: the dataset is incomplete, an argument is out of range, or the folder belongs to the dataset, holds
            something, or cannot be written.
    """
    own = split or find_split(dataset)
    export = BopExport(dataset, own, copy, name, to_split, jpg, pixel_centre, scenes, xyz_crops, fps, depth)
    write_export(export, to / name, workers)
    return to / name


def _fps(model: ObjectModel) -> dict[str, NDArray[np.float32]]:
    """As GDR-Net's fps_points.pkl: farthest points, then the vertices' mean, metres."""
    points = farthest_points(model.vertices_mm, model.faces, max(_FPS_COUNTS))
    mean = model.vertices_mm.mean(axis=0, keepdims=True)
    return {
        f"fps{count}_and_center": (np.concatenate([points[:count], mean]) / 1000).astype(np.float32)
        for count in _FPS_COUNTS
    }


class _Pickler(pickle.Pickler):
    """Writes arrays as shape, type and bytes: the same file whatever NumPy writes it, and any NumPy reads it."""

    def reducer_override(self, obj: Any) -> Any:
        if isinstance(obj, np.ndarray):
            return np.ndarray, (obj.shape, obj.dtype.str, bytearray(obj.tobytes()))
        return NotImplemented


def _pickled(content: Mapping[str, Any]) -> bytes:
    file = io.BytesIO()
    _Pickler(file, protocol=4).dump(content)
    return file.getvalue()


def _json_file(name: str, content: Mapping[str, Any]) -> Entry:
    return name, json_bytes(Path(name), content)


def _lines(items: Sequence[Mapping[str, int]]) -> bytes:
    """A JSON list, an item a line."""
    return ("[\n" + ",\n".join(f"  {json.dumps(item, sort_keys=True)}" for item in items) + "\n]\n").encode()
