"""Reads a dataset into columns: one row per instance, per image and per drop."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from synthetless.dataset.layout import ScenePaths, scene_ids
from synthetless.dataset.reader import ImageEntries, read_entries, read_specs
from synthetless.dataset.records import ImageSpec
from synthetless.io import images
from synthetless.io.files import read_bytes
from synthetless.scenes.color import srgb
from synthetless.scenes.spec import SceneSpec, View

Floats = NDArray[np.float64]
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722], dtype=np.float32)  # Rec. 709


@dataclass(frozen=True, eq=False)
class Instances:
    """All labelled instances, N of them.

    Attributes:
        obj_id: (N,).
        visib_fract: (N,).
        regressor_index: (N,).
        R_m2c, t_m2c: true poses (N, 3, 3), (N, 3) mm.
        R_canonical, t_canonical: canonical ones.
    """

    obj_id: NDArray[np.int64]
    visib_fract: Floats
    regressor_index: NDArray[np.int64]
    R_m2c: Floats
    t_m2c: Floats
    R_canonical: Floats
    t_canonical: Floats


@dataclass(frozen=True, eq=False)
class Observations:
    """What a dataset says of itself.

    Attributes:
        instances: the labels.
        objects_per_image: labelled instances of each image.
        views: the camera of each image that was recorded.
        exposure_gains: of the same images.
        drops: the scenes that those images show, each once.
        luminance: mean displayed luminance, 0..1, of some images, evenly spread.
    """

    instances: Instances
    objects_per_image: NDArray[np.int64]
    views: Sequence[View]
    exposure_gains: Floats
    drops: Sequence[SceneSpec]
    luminance: Floats


def collect(dataset: Path, split: str, luminance_images: int) -> Observations:
    """Read the labels and records of a split, and at most ``luminance_images`` of its images.

    Raises:
        UserError: a file is missing or damaged.
    """
    gathered = _Gathered()
    scenes = [ScenePaths.of(dataset, scene_id, split) for scene_id in scene_ids(dataset, split)]
    for scene in tqdm(scenes, desc="statistics", unit="scene", disable=None, leave=False):
        recorded = read_specs(scene) if scene.scene_spec.exists() else {}
        for labels in read_entries(scene):
            gathered.add(scene, labels, recorded.get(labels.im_id))
    return gathered.observations(luminance_images)


@dataclass
class _Gathered:
    """Columns that are still growing."""

    rows: list[tuple[Any, ...]] = field(default_factory=list)
    objects: list[int] = field(default_factory=list)
    views: list[View] = field(default_factory=list)
    gains: list[float] = field(default_factory=list)
    drops: dict[int, SceneSpec] = field(default_factory=dict)
    pictures: list[Path] = field(default_factory=list)

    def add(self, scene: ScenePaths, labels: ImageEntries, recorded: ImageSpec | None) -> None:
        self.objects.append(len(labels.gt))
        for gt, info, canonical in zip(labels.gt, labels.gt_info, labels.gt_canonical, strict=True):
            poses = gt["cam_R_m2c"], gt["cam_t_m2c"]
            folded = canonical["cam_R_m2c_canonical"], canonical["cam_t_m2c_canonical"]
            self.rows.append((gt["obj_id"], info["visib_fract"], canonical["regressor_index"], *poses, *folded))
        if recorded is not None:
            self.views.append(recorded.scene.views[recorded.view])
            self.gains.append(recorded.exposure_gain)
            self.drops.setdefault(recorded.scene.drop, recorded.scene)
        self.pictures += [p for p in (scene.rgb(labels.im_id, "png"), scene.rgb(labels.im_id, "jpg")) if p.exists()][:1]

    def observations(self, luminance_images: int) -> Observations:
        columns = list(zip(*self.rows, strict=True)) or [()] * 7
        obj_id, visib, index, R, t, R_canonical, t_canonical = columns
        instances = Instances(
            np.array(obj_id, dtype=np.int64),
            np.array(visib, dtype=np.float64),
            np.array(index, dtype=np.int64),
            np.array(R, dtype=np.float64).reshape(-1, 3, 3),
            np.array(t, dtype=np.float64).reshape(-1, 3),
            np.array(R_canonical, dtype=np.float64).reshape(-1, 3, 3),
            np.array(t_canonical, dtype=np.float64).reshape(-1, 3),
        )
        chosen = _spread(self.pictures, luminance_images)
        luminance = np.array([mean_luminance(images.decode_rgb(read_bytes(p), p)) for p in chosen], dtype=np.float64)
        counts = np.array(self.objects, dtype=np.int64)
        return Observations(instances, counts, self.views, np.array(self.gains), list(self.drops.values()), luminance)


def mean_luminance(rgb: NDArray[np.uint8]) -> float:
    """Mean displayed luminance, 0..1, of an (H, W, 3) sRGB image: what a recipe's render.exposure bounds."""
    levels = np.arange(256, dtype=np.float64) / 255
    linear = np.where(levels <= 0.04045, levels / 12.92, ((levels + 0.055) / 1.055) ** 2.4).astype(np.float32)
    return float(srgb(linear[rgb] @ _LUMINANCE).mean())


def _spread(paths: Sequence[Path], limit: int) -> Iterator[Path]:
    count = min(limit, len(paths))
    return (paths[number * len(paths) // count] for number in range(count))
