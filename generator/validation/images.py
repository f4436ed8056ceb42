"""One image: all its files together with all its labels."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from synthetless.dataset.records import Entry
from synthetless.io.images import decode_depth, decode_normals, decode_object_coordinates
from synthetless.validation import coco, depth, masks, surfaces
from synthetless.validation.geometry import Array
from synthetless.validation.labels import SceneLabels
from synthetless.validation.masks import InstanceMasks
from synthetless.validation.pictures import Pictures, check_exr, check_rgb
from synthetless.validation.poses import Place
from synthetless.validation.regions import Region, union
from synthetless.validation.report import Finding
from synthetless.validation.source import Source


@dataclass(frozen=True, eq=False)
class ImageCheck:
    """Everything that can be said of an image without casting rays.

    Attributes:
        source: the dataset.
        labels: of the image's scene folder.
        im_id: the image.
        annotations: of scene_gt_coco.json, by gt_id.
        sound: the poses that are poses.
    """

    source: Source
    labels: SceneLabels
    im_id: int
    annotations: Mapping[int, Entry]
    sound: set[Place]

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of every picture."""
        return self.source.recipe.camera.height, self.source.recipe.camera.width

    def run(self) -> Iterator[Finding]:
        """Look at every file and every instance."""
        source, paths, im_id = self.source, self.labels.paths, self.im_id
        pictures = Pictures(im_id, self.shape)
        if source.has("rgb"):
            yield from check_rgb(paths.rgb(im_id, source.recipe.encoding.rgb_format), im_id, self.shape)
        if source.has("exr"):
            yield from check_exr(paths.exr(im_id), im_id, self.shape)
        depth_mm = self._read_depth(pictures)
        files = self._read_masks(pictures)
        exact = source.recipe.labels.visibility_delta_mm == 0
        yield from masks.check_masks(paths, im_id, files, self.shape, exact)
        yield from self._check_instances(files, depth_mm)
        visible = self._visible(files)
        if depth_mm is not None:
            yield from self._check_depth(visible, depth_mm)
        yield from self._check_surfaces(pictures, visible, depth_mm)
        yield from pictures.findings

    def _read_depth(self, pictures: Pictures) -> Array | None:
        if not self.source.has("depth"):
            return None
        scale: float = self.labels.camera[self.im_id]["depth_scale"]

        def decode(data: bytes, path: Path) -> Array:
            return decode_depth(data, scale, path)

        return pictures.read(self.labels.paths.depth(self.im_id), decode)

    def _read_masks(self, pictures: Pictures) -> list[InstanceMasks]:
        n_instances = len(self.labels.gt[self.im_id])
        if not self.source.has("masks"):
            return [InstanceMasks()] * n_instances
        return masks.read_masks(self.labels.paths, self.im_id, n_instances, pictures)

    def _check_instances(self, files: list[InstanceMasks], depth_mm: Array | None) -> Iterator[Finding]:
        source, labels, im_id = self.source, self.labels, self.im_id
        entries = zip(labels.gt[im_id], labels.gt_info[im_id], files, strict=True)
        for gt_id, (pose, info, masks_) in enumerate(entries):
            if (im_id, gt_id) in self.sound:
                limits = masks.silhouette_of(source, pose)
                camera = source.recipe.intrinsics
                yield from masks.check_info(camera, limits, labels.paths, im_id, gt_id, info, masks_, depth_mm)
            if gt_id in self.annotations:
                yield from coco.check_annotation(labels, im_id, gt_id, self.annotations[gt_id], masks_, self.shape)

    def _visible(self, files: list[InstanceMasks]) -> dict[int, Region]:
        """What is visible of each instance: by its mask, else by its annotation; left out if neither can be used."""
        visible: dict[int, Region] = {}
        for gt_id, (of_instance, info) in enumerate(zip(files, self.labels.gt_info[self.im_id], strict=True)):
            if of_instance.visible is not None:
                visible[gt_id] = of_instance.visible
            elif info["px_count_visib"] == 0:
                visible[gt_id] = Region.of(np.zeros(self.shape, dtype=bool))
            elif gt_id in self.annotations:
                mask = coco.decode(self.annotations[gt_id], self.shape)
                visible |= {} if mask is None else {gt_id: Region.of(mask)}
        return visible

    def _check_depth(self, visible: Mapping[int, Region], depth_mm: Array) -> Iterator[Finding]:
        source, labels, im_id = self.source, self.labels, self.im_id
        path = labels.paths.depth(im_id)
        for gt_id, region in visible.items():
            if (im_id, gt_id) in self.sound:
                pose = labels.gt[im_id][gt_id]
                yield from depth.check_instance_depth(source, path, im_id, gt_id, pose, region, depth_mm)
        if len(visible) == len(labels.gt[im_id]):
            seen = union(visible.values(), self.shape)
            camera = labels.camera[im_id]
            yield from depth.check_table_depth(source, path, im_id, camera, seen, self._distractors(), depth_mm)

    def _check_surfaces(
        self, pictures: Pictures, visible: Mapping[int, Region], depth_mm: Array | None
    ) -> Iterator[Finding]:
        source, paths, im_id = self.source, self.labels.paths, self.im_id
        if source.has("normals"):
            normals = pictures.read(paths.normals(im_id), decode_normals)
            if normals is not None:
                yield from surfaces.check_normals(paths.normals(im_id), im_id, normals, depth_mm)
        if source.has("object_coordinates"):
            path, gt = paths.object_coordinates(im_id), self.labels.gt[im_id]
            coordinates = pictures.read(path, _decode_coordinates)
            if coordinates is not None and source.recipe.labels.visibility_delta_mm == 0:
                yield from surfaces.check_coordinates(source, path, im_id, gt, visible, coordinates, depth_mm)

    def _distractors(self) -> bool:
        """Whether the image may show anything but models and the table."""
        if self.im_id not in self.labels.spec:
            return self.source.recipe.objects.distractors[1] > 0
        return any(item.role != "model" for item in self.labels.spec[self.im_id].scene.objects)


def _decode_coordinates(data: bytes, path: Path) -> Array:
    """(H, W, 4): x, y, z in millimetres, and 1 where there is a point."""
    points_mm, present = decode_object_coordinates(data, path)
    return np.dstack([points_mm, present])
