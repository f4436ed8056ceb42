"""Prediction: detections, the regressor that the classifier chooses, corners to pose by PnP, a BOP result file."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from synthetless.dataset.reader import Dataset, Image, Instance
from synthetless.errors import UserError
from synthetless.extras import cv2
from synthetless.io.files import atomic_write, read_bytes, read_json
from synthetless.io.images import decode_rgb, encode_png
from synthetless.io.models import BOX_EDGES
from synthetless.learning.data import picture, sample_of
from synthetless.learning.detector import Detections, Detector
from synthetless.learning.fit import CHECKPOINT_FILE, load, load_weights
from synthetless.learning.operators import iou
from synthetless.learning.results import Estimate, write_results
from synthetless.learning.solve import solve_pose
from synthetless.learning.train import Parts, choose_device, read_run
from synthetless.scenes.lens import project
from synthetless.scenes.spec import NO_DISTORTION

Floats = NDArray[np.float64]

_TRUE, _PREDICTED = (60, 200, 60), (230, 60, 40)
_SHOWN = 0.5


@dataclass(frozen=True, eq=False)
class Picture:
    """A picture to predict from, and the true poses, if they are known.

    Attributes:
        scene_id, im_id, key: which it is.
        K: (3, 3) camera matrix.
        distortion: (5,) of the lens; zeros of a pinhole.
        read: its pixels (H, W, 3).
        image: of the dataset, if it is of one.
    """

    scene_id: int
    im_id: int
    key: str
    K: Floats
    distortion: Floats
    read: Callable[[], NDArray[np.uint8]]
    image: Image | None = None

    @classmethod
    def of(cls, image: Image) -> Picture:
        """An image of a dataset."""
        return cls(image.scene_id, image.im_id, image.key, image.K, image.distortion, image.rgb, image)

    @property
    def instances(self) -> Sequence[Instance]:
        """What is in it, as far as it is known."""
        return () if self.image is None else self.image.instances

    @property
    def has_boxes(self) -> bool:
        """Whether the boxes of all that is in it are known."""
        return self.image is not None and all(n.visibility is not None for n in self.instances)


def pictures_of(source: Path, split: str | None = None, camera: Path | None = None) -> list[Picture]:
    """The images of a BOP dataset, or of a folder of pictures, which are scene 0 and numbered by their names' order.

    Args:
        source: the folder.
        split: of the dataset.
        camera: BOP's camera.json (fx, fy, cx, cy, and of a lens also distortion), for a folder of pictures.

    Raises:
        UserError: it is neither; or a camera is missing or damaged.
    """
    if camera is None:
        return [Picture.of(image) for image in Dataset.open(source, split)]
    intrinsics = read_json(camera)
    try:
        fx, fy, cx, cy = (float(intrinsics[name]) for name in ("fx", "fy", "cx", "cy"))
        distortion = np.array(intrinsics.get("distortion", NO_DISTORTION), dtype=np.float64).reshape(5)
    except (KeyError, TypeError, ValueError):
        raise UserError(
            f"{camera}: must have the numbers fx, fy, cx and cy, as BOP's camera.json; distortion, if any, has five"
        ) from None
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    paths = sorted(path for path in source.glob("*") if path.suffix.lower() in (".png", ".jpg", ".jpeg"))
    if not paths:
        raise UserError(f"{source}: holds no pictures (*.png, *.jpg)")
    return [
        Picture(0, number, path.stem, K, distortion, partial(_read_picture, path)) for number, path in enumerate(paths)
    ]


def _read_picture(path: Path) -> NDArray[np.uint8]:
    return decode_rgb(read_bytes(path), path)


class Predictor:
    """A trained detector, ready for pictures."""

    def __init__(self, run: Path, device: str = "auto") -> None:
        """Load a run.

        Raises:
            UserError: it is no run, has no checkpoint yet, or is damaged.
        """
        self._training, self.parts = read_run(run)
        # The run's own weights follow; those that the backbone began with need not be there any more.
        network = self._training.network.model_copy(update={"weights": "none"})
        detector = self.parts.detector(self._training.model_copy(update={"network": network}))
        path = run / CHECKPOINT_FILE
        load_weights(detector, load(path).get("model", {}), path)
        self._device = choose_device(device)
        self._detector: Detector = detector.to(self._device).eval()

    def detect(self, pixels: NDArray[np.uint8]) -> Detections:
        """What is in a picture (H, W, 3)."""
        found = self._detector.detect(picture(pixels, None, 0, 0)[None].to(self._device))[0]
        parts = (found.boxes, found.classes, found.scores, found.corners_px, found.index)
        return Detections(*(part.cpu() for part in parts))

    def estimates(self, image: Picture, found: Detections, seconds: float) -> list[Estimate]:
        """Poses of the detections of an image; corners that have none are left out."""
        estimates = []
        for number in range(len(found.scores)):
            obj_id = self.parts.ids[int(found.classes[number]) - 1]
            corners = found.corners_px[number].numpy().astype(np.float64)
            pose = solve_pose(corners, self.parts.boxes_mm[obj_id], image.K, image.distortion)
            if pose is not None:
                score = float(found.scores[number])
                estimates.append(Estimate(image.scene_id, image.im_id, obj_id, score, pose.R_m2c, pose.t_m2c, seconds))
        return estimates


@dataclass(frozen=True)
class Predicted:
    """What came of a prediction.

    Attributes:
        poses: how many were found.
        box_map: mAP of the boxes at an overlap of 0.5, over the images whose boxes are known; None without any.
    """

    poses: int
    box_map: float | None


def predict(
    run: Path,
    source: Path,
    to: Path,
    overlays: Path | None = None,
    split: str | None = None,
    device: str = "auto",
    camera: Path | None = None,
) -> Predicted:
    """Predict the poses in all images of a dataset or folder.

    Args:
        run: folder of a training.
        source: BOP dataset folder, of one's own, adopted or any other, of which only pictures and cameras are used;
            with ``camera`` a folder of pictures.
        to: result file to write.
        overlays: folder for a picture of each image with true (green) and predicted (red) boxes.
        split: of the dataset.
        device: as for training.
        camera: see ``pictures_of``.
    """
    predictor = Predictor(run, device)
    estimates: list[Estimate] = []
    detected: list[tuple[Image, Detections]] = []
    for image in pictures_of(source, split, camera):
        pixels, started = image.read(), time.perf_counter()
        found = predictor.detect(pixels)
        own = predictor.estimates(image, found, 0.0)
        seconds = time.perf_counter() - started
        own = [Estimate(e.scene_id, e.im_id, e.obj_id, e.score, e.R_m2c, e.t_m2c, seconds) for e in own]
        estimates += own
        if image.image is not None and image.has_boxes:
            detected.append((image.image, found))
        if overlays is not None:
            atomic_write(overlays / f"{image.key}.png", encode_png(draw(pixels, image, own, predictor.parts)))
    write_results(to, estimates)
    known = any(image.instances for image, _ in detected)
    return Predicted(len(estimates), mean_average_precision(predictor.parts.ids, detected) if known else None)


def draw(pixels: NDArray[np.uint8], image: Picture, estimates: Sequence[Estimate], parts: Parts) -> NDArray[np.uint8]:
    """The picture with the boxes of true poses (green) and of the surer estimates (red), as the paper's figures."""
    canvas = pixels.copy()
    for instance in image.instances:
        if instance.obj_id in parts.boxes_mm:
            _draw_box(canvas, parts.boxes_mm[instance.obj_id], instance.R_m2c, instance.t_m2c, image, _TRUE)
    for estimate in estimates:
        if estimate.score >= _SHOWN:
            _draw_box(canvas, parts.boxes_mm[estimate.obj_id], estimate.R_m2c, estimate.t_m2c, image, _PREDICTED)
    return canvas


def _draw_box(
    canvas: NDArray[np.uint8], box_mm: Floats, R: Floats, t: Floats, image: Picture, color: tuple[int, int, int]
) -> None:
    seen = box_mm @ R.T + t
    if (seen[:, 2] <= 0).any():
        return
    at = np.clip(project(seen, image.K, image.distortion), -1e4, 1e4).round().astype(int)
    for a, b in BOX_EDGES:
        cv2.line(canvas, at[a].tolist(), at[b].tolist(), color, 1, cv2.LINE_AA)


def mean_average_precision(
    ids: Sequence[int], detected: Iterable[tuple[Image, Detections]], iou_threshold: float = 0.5
) -> float:
    """mAP of the boxes at one overlap, over the objects; instances less than a tenth visible do not count.

    Args:
        ids: the objects, in the order of the classes.
        detected: images whose true boxes are known, and what is found in each.
        iou_threshold: the overlap.
    """
    scored: dict[int, list[tuple[float, bool]]] = {obj_id: [] for obj_id in ids}
    asked = dict.fromkeys(ids, 0)
    for image, found in detected:
        sample = sample_of(image)
        for number, obj_id in enumerate(ids, start=1):
            mine = sample.obj_ids == obj_id
            boxes, counted = sample.boxes[mine], sample.visib_fract[mine] >= 0.1
            asked[obj_id] += int(counted.sum())
            taken = np.zeros(len(boxes), dtype=bool)
            rows = torch.nonzero(found.classes == number)[:, 0]
            overlaps = iou(found.boxes[rows], torch.from_numpy(boxes).float()).numpy()
            for row, overlap in zip(rows, overlaps, strict=True):
                free = np.where(taken, 0, overlap)
                best = int(free.argmax()) if len(free) else -1
                hit = best >= 0 and free[best] >= iou_threshold
                if hit:
                    taken[best] = True
                if not hit or counted[best]:
                    scored[obj_id].append((float(found.scores[row]), bool(hit)))
    return float(np.mean([_average_precision(scored[i], asked[i]) for i in ids if asked[i]] or [0.0]))


def _average_precision(scored: Sequence[tuple[float, bool]], asked: int) -> float:
    """Area below the precision-recall curve, precision made monotonous, at every recall that occurs."""
    if not scored:
        return 0.0
    hits = np.array([hit for _, hit in sorted(scored, key=lambda pair: -pair[0])])
    recall = np.cumsum(hits) / asked
    precision = np.cumsum(hits) / np.arange(1, len(hits) + 1)
    best = np.maximum.accumulate(precision[::-1])[::-1]
    return float(np.sum(np.diff(recall, prepend=0.0) * best))
