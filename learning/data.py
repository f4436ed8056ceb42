"""Images, instances and crops of datasets, for torch: by number from folders, or as a stream from webdataset shards.

Both are safe with worker processes: a dataset is pickled as its paths, a stream shares its shards among the workers.
Labels are computed from true poses and the symmetry table, not read: any label set, whatever the folder holds.
"""

from __future__ import annotations

import json
import tarfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import Dataset as TorchDataset
from torch.utils.data import IterableDataset, get_worker_info

from synthetless.annotation.instances import NO_BOX
from synthetless.dataset.reader import Dataset, Image, read_specs
from synthetless.dataset.records import projection_of
from synthetless.errors import UserError
from synthetless.extras import cv2
from synthetless.io.images import decode_rgb
from synthetless.learning.detector import Instances
from synthetless.learning.stream import Crops
from synthetless.learning.targets import LabelMaker, looking_at, turned, turning_homography
from synthetless.scenes.sensor import capture
from synthetless.scenes.settings import SensorSettings

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Sample:
    """An image and its N instances.

    Attributes:
        key: "000001_000042", scene and image.
        pixels: (H, W, 3) uint8 sRGB.
        K: (3, 3) camera matrix.
        distortion: (5,) of the lens; zeros of a pinhole.
        obj_ids: (N,).
        R_m2c, t_m2c: (N, 3, 3), (N, 3) mm, true poses.
        boxes: (N, 4) float, x1, y1, x2, y2 of the visible part.
        visib_fract: (N,); instances that cannot be seen at all are left out.
    """

    key: str
    pixels: NDArray[np.uint8]
    K: Floats
    distortion: Floats
    obj_ids: NDArray[np.int64]
    R_m2c: Floats
    t_m2c: Floats
    boxes: Floats
    visib_fract: Floats


def sample_of(image: Image) -> Sample:
    """An image of a dataset folder, with its pixels.

    Raises:
        UserError: it has no scene_gt_info.json, or its picture cannot be read.
    """
    infos = [(n, n.visibility) for n in image.instances]
    if any(visibility is None for _, visibility in infos):
        raise UserError(f"{image.paths.scene_gt_info}: not found; boxes are needed to learn from")
    seen = [(n, visibility) for n, visibility in infos if visibility and visibility.bbox_visib != NO_BOX]
    return Sample(
        image.key,
        image.rgb(),
        image.K,
        image.distortion,
        np.array([n.obj_id for n, _ in seen], dtype=np.int64),
        np.array([n.R_m2c for n, _ in seen]).reshape(-1, 3, 3),
        np.array([n.t_m2c for n, _ in seen]).reshape(-1, 3),
        _corners([v.bbox_visib for _, v in seen]),
        np.array([v.visib_fract for _, v in seen]),
    )


def _corners(boxes: Sequence[Sequence[float]]) -> Floats:
    """BOP's [x, y, w, h] with w = xmax - xmin as (N, 4) x1, y1, x2, y2."""
    xywh = np.array(boxes, dtype=np.float64).reshape(-1, 4)
    return np.concatenate([xywh[:, :2], xywh[:, :2] + xywh[:, 2:]], axis=1)


class FolderImages(TorchDataset[Sample]):
    """The images of one or more dataset folders, by number."""

    def __init__(self, roots: Sequence[Path], split: str | None = None) -> None:
        """Open them; errors as in ``Dataset.open``."""
        self.datasets = [Dataset.open(root, split) for root in roots]
        self._ends = np.cumsum([0, *(len(dataset) for dataset in self.datasets)])

    def __len__(self) -> int:
        return int(self._ends[-1])

    def __getitem__(self, number: int) -> Sample:
        return sample_of(self.image(number))

    def image(self, number: int) -> Image:
        """The image with a number, counted through all datasets."""
        if not 0 <= number < len(self):
            raise IndexError(f"image {number} of {len(self)}")
        of = int(np.searchsorted(self._ends, number, side="right")) - 1
        return self.datasets[of][number - int(self._ends[of])]


class Photographs:
    """Takes the images of folders anew, each time with another camera, from their linear light (outputs: exr)."""

    def __init__(self, images: FolderImages, sensor: SensorSettings) -> None:
        """Take those images with cameras drawn from the ranges of ``sensor``."""
        self._images, self._sensor = images, sensor
        self._gains: dict[Path, dict[int, float]] = {}

    def sample(self, number: int, rng: np.random.Generator) -> Sample:
        """The image with a number, with other pixels.

        Raises:
            UserError: its linear light is not there.
        """
        image = self._images.image(number)
        if not image.paths.exr(image.im_id).exists():
            raise UserError(f"{image.paths.root}: has no linear light to take anew (output exr); set data.sensor=none")
        pixels = capture(image.linear(), self._sensor, rng, self._gain(image))
        return replace(sample_of(image), pixels=pixels)

    def _gain(self, image: Image) -> float:
        root = image.paths.root
        if root not in self._gains:
            self._gains[root] = {im_id: spec.exposure_gain for im_id, spec in read_specs(image.paths).items()}
        if image.im_id not in self._gains[root]:
            raise UserError(f"{root}: scene_spec.jsonl does not say how image {image.im_id} was exposed")
        return self._gains[root][image.im_id]


class ShardImages(IterableDataset[Sample]):
    """The images of webdataset shards, endlessly, in an order that follows from the seed and the worker's number."""

    def __init__(self, folder: Path, seed: int, buffer: int = 64, once: bool = False) -> None:
        """Find the shards.

        Args:
            folder: as ``export webdataset`` writes it.
            seed: of the order of the shards, and of the images within a buffer.
            buffer: so many images are held back and drawn from.
            once: end after every image came once, instead of never.

        Raises:
            UserError: there are no shards.
        """
        self._shards = sorted(folder.glob("shard-*.tar"))
        if not self._shards:
            raise UserError(f"{folder}: holds no shards (shard-000000.tar, ...)")
        self._seed, self._buffer, self._once = seed, buffer, once

    def __iter__(self) -> Iterator[Sample]:
        worker = get_worker_info()
        number, count = (0, 1) if worker is None else (worker.id, worker.num_workers)
        if number >= len(self._shards):
            return  # fewer shards than workers
        epoch = 0
        while True:
            rng = np.random.default_rng([self._seed, epoch, number])
            order = np.random.default_rng([self._seed, epoch]).permutation(len(self._shards))
            yield from self._shuffled((self._shards[i] for i in order[number::count]), rng)
            epoch += 1
            if self._once:
                return

    def _shuffled(self, shards: Iterator[Path], rng: np.random.Generator) -> Iterator[Sample]:
        held: list[tuple[str, Mapping[str, bytes], Path]] = []
        for shard in shards:
            for key, members in _members(shard):
                held.append((key, members, shard))
                if len(held) > self._buffer:
                    yield _sample(*held.pop(int(rng.integers(len(held)))))
        while held:
            yield _sample(*held.pop(int(rng.integers(len(held)))))


def _members(shard: Path) -> Iterator[tuple[str, dict[str, bytes]]]:
    """Key and members of every image of a shard.

    Raises:
        UserError: the shard cannot be read.
    """
    try:
        with tarfile.open(shard, "r:") as tar:
            for key, group in groupby(tar, key=lambda member: member.name.partition(".")[0]):
                files = {member.name.partition(".")[2]: tar.extractfile(member) for member in group}
                yield key, {name: file.read() for name, file in files.items() if file is not None}
    except (tarfile.TarError, OSError) as error:
        raise UserError(f"{shard}: not a readable shard ({error})") from None


def _sample(key: str, members: Mapping[str, bytes], shard: Path) -> Sample:
    try:
        name = next(name for name in ("rgb.png", "rgb.jpg") if name in members)
        camera, gt, info = (json.loads(members[f"{part}.json"]) for part in ("camera", "gt", "gt_info"))
        K, distortion = projection_of(camera)
        seen = [(g, i) for g, i in zip(gt, info, strict=True) if tuple(i["bbox_visib"]) != NO_BOX]
        return Sample(
            key,
            decode_rgb(members[name], shard / f"{key}.{name}"),
            np.array(K, dtype=np.float64).reshape(3, 3),
            np.array(distortion),
            np.array([g["obj_id"] for g, _ in seen], dtype=np.int64),
            np.array([g["cam_R_m2c"] for g, _ in seen], dtype=np.float64).reshape(-1, 3, 3),
            np.array([g["cam_t_m2c"] for g, _ in seen], dtype=np.float64).reshape(-1, 3),
            _corners([i["bbox_visib"] for _, i in seen]),
            np.array([i["visib_fract"] for _, i in seen], dtype=np.float64),
        )
    except UserError as error:
        raise UserError(f"{shard}: image {key}: {error}") from None
    except (KeyError, StopIteration, TypeError, json.JSONDecodeError) as error:
        raise UserError(f"{shard}: image {key} lacks what is learned from ({error!r})") from None


class SampleBatcher:
    """Samples to pictures and targets, under one label set; allocentric, since boxes are cut out where they are."""

    def __init__(
        self,
        maker: LabelMaker,
        boxes_mm: Mapping[int, Floats],
        ids: Sequence[int],
        min_visib_fract: float,
    ) -> None:
        """Prepare.

        Args:
            maker: labels the poses.
            boxes_mm: (8, 3) box corners by object id.
            ids: the objects, sorted; the first is class 1.
            min_visib_fract: of less is not learned.
        """
        self._maker, self._ids, self._least = maker, np.array(ids, dtype=np.int64), min_visib_fract
        self._boxes = np.stack([boxes_mm[obj_id] for obj_id in ids])
        self.regressors = [maker.n_regressors(obj_id) for obj_id in ids]

    def instances(self, sample: Sample) -> Instances:
        """The targets of an image."""
        wanted = np.isin(sample.obj_ids, self._ids) & (sample.visib_fract >= self._least)
        classes = np.searchsorted(self._ids, sample.obj_ids[wanted])
        targets = self._maker(sample.obj_ids[wanted], sample.R_m2c[wanted], sample.t_m2c[wanted])
        corners = targets.corners_px(self._boxes[classes], sample.K, sample.distortion)
        return Instances(
            torch.from_numpy(sample.boxes[wanted]).float(),
            torch.from_numpy(classes + 1),
            torch.from_numpy(sample.boxes[~wanted]).float(),
            torch.from_numpy(corners).float(),
            torch.from_numpy(targets.regressor_index),
            torch.from_numpy(targets.n_regressors),
        )


def picture(pixels: NDArray[np.uint8], rng: np.random.Generator | None, brightness: float, noise: float) -> Any:
    """(3, H, W) float tensor of 0 to 255; with a generator lighter or darker, and noisy."""
    values = pixels.astype(np.float32)
    if rng is not None:
        values *= np.float32(rng.uniform(1 - brightness, 1 + brightness))
        values += rng.standard_normal(values.shape, dtype=np.float32) * np.float32(rng.uniform(0, noise))
        values = np.clip(values, 0, 255)
    return torch.from_numpy(values).permute(2, 0, 1).contiguous()


def crops_of(
    sample: Sample,
    size_px: int,
    zoom: float = 1.2,
    min_visib_fract: float = 0.6,
    elevation: Floats | None = None,
    wanted: NDArray[np.bool_] | None = None,
) -> Crops:
    """What virtual cameras that look straight at the instances' boxes see, with the poses turned along: exact.

    Args:
        sample: an image.
        size_px: side of the crops.
        zoom: side of a crop over the longer side of its box.
        min_visib_fract: instances of which less is visible are left out.
        elevation: (N,) degrees, if known.
        wanted: (N,) which instances; all if None.

    Raises:
        UserError: the image was taken through a lens, which no virtual camera's homography takes out.
    """
    if sample.distortion.any():
        raise UserError(
            f"image {sample.key} has lens distortion; crops are cut from pinhole images, undistort it first"
        )
    visible = sample.visib_fract >= min_visib_fract
    rows = np.flatnonzero(visible if wanted is None else visible & wanted)
    boxes = sample.boxes[rows]
    centres = (boxes[:, :2] + boxes[:, 2:]) / 2
    Q = looking_at(centres, sample.K)
    R, t = turned(Q, sample.R_m2c[rows], sample.t_m2c[rows])
    middle = (size_px - 1) / 2
    pixels = np.zeros((len(rows), size_px, size_px, 3), dtype=np.uint8)
    cameras = np.zeros((len(rows), 3, 3))
    for i, box in enumerate(boxes):
        side = float(np.max(box[2:] - box[:2]) + 1) * zoom
        K_new = np.array([[0, 0, middle], [0, 0, middle], [0, 0, 1.0]])
        K_new[0, 0], K_new[1, 1] = (size_px / side) * sample.K[0, 0], (size_px / side) * sample.K[1, 1]
        H = turning_homography(Q[i], sample.K, K_new)
        pixels[i] = _warped(sample.pixels, H, size_px, side / size_px)
        cameras[i] = K_new
    known = np.full(len(rows), np.nan) if elevation is None else elevation[rows]
    return Crops(pixels, sample.obj_ids[rows], R, t, cameras, known)


def _warped(pixels: NDArray[np.uint8], H: Floats, size_px: int, shrinking: float) -> NDArray[np.uint8]:
    """The picture under a homography; blurred first where it shrinks, so that nothing is skipped."""
    if shrinking > 1:
        pixels = np.asarray(cv2.GaussianBlur(pixels, (0, 0), 0.4 * shrinking), dtype=np.uint8)
    warped = cv2.warpPerspective(pixels, H, (size_px, size_px), borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(warped, dtype=np.uint8)
