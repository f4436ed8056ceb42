"""One image for the pages: its small pictures, and everything that can be drawn into them or told beside them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from synthetless.dataset.labels import box_corners_mm
from synthetless.dataset.layout import ScenePaths
from synthetless.dataset.reader import ImageEntries
from synthetless.dataset.records import Entry, GtInfoEntry, ImageSpec
from synthetless.io.files import atomic_write
from synthetless.preview import overlays, parameters, pictures

_GREY = np.uint8(128)


@dataclass(frozen=True)
class ImageTask:
    """An image on its way to a worker process.

    Attributes:
        scene: the files of its scene folder.
        labels: what the scene's JSON files say of it.
        recorded: how it was made, if that was recorded.
        infos: models_info.json.
        size_px: width and height.
        to: the folder of the pages.
    """

    scene: ScenePaths
    labels: ImageEntries
    recorded: ImageSpec | None
    infos: Mapping[int, Entry]
    size_px: tuple[int, int]
    to: Path

    @property
    def key(self) -> str:
        """What the image is called: SCENE/IMAGE."""
        return f"{self.scene.root.name}/{self.labels.im_id:06d}"


def write_image(task: ImageTask) -> str:
    """Write the files of an image into the folder of the pages, and return its key.

    Raises:
        UserError: a file of the dataset is damaged, or one of the pages cannot be written.
    """
    views, depth_mm = _views(task)
    shown = {name: f"images/{task.key}-{name}.jpg" for name in views}
    for name, pixels in views.items():
        atomic_write(task.to / shown[name], pictures.encode(pixels))
    thumbnail = next(iter(views.values()), np.full((*task.size_px[::-1], 3), _GREY))
    atomic_write(task.to / f"thumbnails/{task.key}.jpg", pictures.encode(thumbnail, pictures.THUMBNAIL_PX))
    content = json.dumps(detail(task) | {"views": shown, "depth_mm": depth_mm}, allow_nan=False)
    atomic_write(task.to / f"data/{task.key}.js", f"synthetless.arrived({json.dumps(task.key)}, {content});\n".encode())
    return task.key


def detail(task: ImageTask) -> dict[str, Any]:
    """What the page of one image draws and tells; strings in it are data, never markup."""
    gts = range(len(task.labels.gt))
    return {
        "size": list(task.size_px),
        "sections": parameters.sections(task.labels.camera, task.recorded),
        "instances": [_instance(task, gt_id) for gt_id in gts],
    }


def _views(task: ImageTask) -> tuple[dict[str, NDArray[np.uint8]], list[float]]:
    """The pictures that there are of an image, the best one first, and the range that the depth picture shows."""
    im_id = task.labels.im_id
    depth, range_mm = pictures.depth(task.scene, im_id, float(task.labels.camera.get("depth_scale", 1.0)))
    views = {"rgb": pictures.rgb(task.scene, im_id), "depth": depth, "normals": pictures.normals(task.scene, im_id)}
    return {name: pixels for name, pixels in views.items() if pixels is not None}, range_mm


def _instance(task: ImageTask, gt_id: int) -> dict[str, Any]:
    labels, im_id = task.labels, task.labels.im_id
    gt, info, canonical = labels.gt[gt_id], labels.gt_info[gt_id], labels.gt_canonical[gt_id]
    model = task.infos[gt["obj_id"]]
    K = np.array(labels.camera["cam_K"], dtype=np.float64).reshape(3, 3)
    masks = {"visible": task.scene.mask_visib(im_id, gt_id), "amodal": task.scene.mask(im_id, gt_id)}
    outlines = {name: pictures.mask(path) for name, path in masks.items()}
    return {
        "gt": gt_id,
        "obj": gt["obj_id"],
        "visib": round(info["visib_fract"], 4),
        "regressor": canonical["regressor_index"],
        "regressors": canonical["n_regressors"],
        "margin": round(canonical["discontinuity_margin_deg"], 2),
        "distance": round(float(np.linalg.norm(gt["cam_t_m2c"])), 1),
        "place": _place(info),
        "material": parameters.material(task.recorded, gt_id),
        "outlines": {name: overlays.outline(mask) for name, mask in outlines.items() if mask is not None},
        "true": _pose(K, gt["cam_R_m2c"], gt["cam_t_m2c"], model),
        "canonical": _pose(K, canonical["cam_R_m2c_canonical"], canonical["cam_t_m2c_canonical"], model),
    }


def _pose(K: NDArray[np.float64], rotation: list[float], translation: list[float], model: Entry) -> dict[str, Any]:
    R, t = np.array(rotation, dtype=np.float64).reshape(3, 3), np.array(translation, dtype=np.float64)
    return {
        "box": overlays.box_lines(K, R, t, box_corners_mm(model)),
        "axes": overlays.axis_lines(K, R, t, 0.5 * float(model["diameter"])),
    }


def _place(info: GtInfoEntry) -> list[float]:
    """Where an instance's words are written: the middle of its visible box; nowhere if it is hidden."""
    x, y, w, h = info["bbox_visib"]
    return [] if w < 0 else [x + w / 2, y + h / 2]
