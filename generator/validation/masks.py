"""Masks of one image: against each other, against scene_gt_info.json and against what the poses allow."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from synthetless.annotation.instances import NO_BOX, Box, canvas_window, image_window
from synthetless.dataset.layout import ScenePaths
from synthetless.dataset.records import Entry
from synthetless.io.images import decode_mask
from synthetless.scenes.spec import Intrinsics
from synthetless.validation.geometry import Array, contains, silhouette_limits, window_box
from synthetless.validation.pictures import Pictures
from synthetless.validation.regions import Mask, Region
from synthetless.validation.report import Finding
from synthetless.validation.source import Source


@dataclass(frozen=True)
class Slack:
    """By how much counts, fractions and boxes may be off from the masks; by nothing, if ray casting made both.

    Attributes:
        share, px: a count may be off by this share of it, and so many pixels.
        box_px: each side of a box.
        fraction: a visible fraction.
    """

    share: float = 0.0
    px: int = 0
    box_px: int = 0
    fraction: float = 1e-9

    def allows(self, count: int, expected: int) -> bool:
        """Whether a count is close enough."""
        return abs(count - expected) <= self.px + self.share * expected

    def allows_box(self, box: Box, expected: Box) -> bool:
        """Whether all sides of a box are close enough."""
        return contains(_grown(expected, self.box_px), box) and contains(_grown(box, self.box_px), expected)


EXACT = Slack()
AS_RENDERED = Slack(share=0.01, px=2, box_px=1, fraction=1e-4)
"""bop_toolkit renders masks and counts apart, on canvases of two sizes, and they differ in a few pixels."""


@dataclass(frozen=True, eq=False)
class InstanceMasks:
    """The masks of one instance; None where a file is missing or unusable, or not asked for."""

    whole: Region | None = None
    visible: Region | None = None


def read_masks(scene: ScenePaths, im_id: int, n_instances: int, pictures: Pictures) -> list[InstanceMasks]:
    """The two mask files of every instance of an image."""
    masks = []
    for gt_id in range(n_instances):
        pixels: Mask | None = pictures.read(scene.mask(im_id, gt_id), decode_mask, gt_id)
        visible: Mask | None = pictures.read(scene.mask_visib(im_id, gt_id), decode_mask, gt_id)
        whole = None if pixels is None else Region.of(pixels)
        same = visible is pixels  # the same bytes are decoded once
        masks.append(InstanceMasks(whole, whole if same or visible is None else Region.of(visible)))
    return masks


def check_masks(
    scene: ScenePaths, im_id: int, masks: Sequence[InstanceMasks], shape: tuple[int, int], exact: bool
) -> Iterator[Finding]:
    """The visible part is part of the whole, and, if visibility is exact, no pixel shows two instances."""
    owner = np.full(shape, -1, dtype=np.int16)
    for gt_id, mask in enumerate(masks):
        if mask.visible is None or mask.visible.count == 0:
            continue
        path, crop, seen = scene.mask_visib(im_id, gt_id), mask.visible.crop, mask.visible.inside
        if mask.whole is not None and mask.whole is not mask.visible:
            outside = int(np.count_nonzero(seen & ~mask.whole.pixels[crop]))
            if outside:
                yield Finding("mask", path, f"{outside} pixels are not in the whole silhouette, mask/", im_id, gt_id)
        if exact:
            others = owner[crop][seen]
            if (others >= 0).any():
                shared, other = int(np.count_nonzero(others >= 0)), int(others.max())
                message = f"{shared} pixels are visible of instance {other}, too; a pixel shows one instance"
                yield Finding("mask", path, message, im_id, gt_id)
            owner[crop][seen] = gt_id


def check_info(
    camera: Intrinsics,
    limits: Box | None,
    scene: ScenePaths,
    im_id: int,
    gt_id: int,
    info: Entry,
    masks: InstanceMasks,
    depth: Array | None,
    slack: Slack = EXACT,
) -> Iterator[Finding]:
    """Counts, fraction and boxes of an instance: against each other, the pose and, as bop_toolkit counts, its masks.

    Args:
        camera: for the size of the image.
        limits: what the pose allows of the silhouette; None if that is not known.
        scene: the files of the scene folder.
        im_id, gt_id: the image and the instance.
        info: its entry in scene_gt_info.json.
        masks: its masks, as far as there are any.
        depth: (H, W) millimetres, 0 for none; or None.
        slack: what is allowed.
    """
    faults = [*_contradictions(info, slack), *_check_box(camera, info, limits)]
    if masks.visible is not None:
        faults += _recount_visible(info, masks.visible, slack)
    if masks.whole is not None:
        inside = limits is not None and contains(window_box(image_window(camera)), limits)
        faults += _recount_whole(info, masks.whole, depth, inside, slack)
    yield from (Finding("gt_info", scene.scene_gt_info, fault, im_id, gt_id) for fault in faults)


def silhouette_of(source: Source, pose: Entry) -> Box | None:
    """The pixels that can show an instance at all; None where its model cannot be read or is too near."""
    if pose["obj_id"] not in source.shapes:
        return None
    R = np.array(pose["cam_R_m2c"]).reshape(3, 3)
    return silhouette_limits(source.recipe.intrinsics, source.shapes[pose["obj_id"]], R, np.array(pose["cam_t_m2c"]))


def _contradictions(info: Entry, slack: Slack) -> Iterator[str]:
    visible, valid, whole = (info[f"px_count_{name}"] for name in ("visib", "valid", "all"))
    for name, count in (("visib", visible), ("valid", valid)):
        if count > whole:
            yield f"px_count_{name} {count} is more than px_count_all {whole}"
    fraction = visible / whole if whole else 0.0
    if abs(info["visib_fract"] - fraction) > slack.fraction:
        yield f"visib_fract is {info['visib_fract']}; {visible} of {whole} pixels are {fraction}"
    for name in ("bbox_obj", "bbox_visib"):
        if (_box(info[name]) == NO_BOX) != (visible == 0):
            yield f"{name} is {info[name]}; it is [-1, -1, -1, -1] where nothing is visible, and only there"


def _check_box(camera: Intrinsics, info: Entry, limits: Box | None) -> Iterator[str]:
    """The whole silhouette is on bop_toolkit's canvas, and where the pose can put it."""
    box = _box(info["bbox_obj"])
    if box == NO_BOX:
        return
    if not contains(window_box(canvas_window(camera)), box):
        yield f"bbox_obj is {list(box)}, beyond the canvas of three times the image"
    elif limits is not None and not contains(limits, box):
        yield f"bbox_obj is {list(box)}; the pose allows nothing outside {list(limits)}"


def _recount_visible(info: Entry, visible: Region, slack: Slack) -> Iterator[str]:
    if not slack.allows(info["px_count_visib"], visible.count):
        yield f"px_count_visib is {info['px_count_visib']}; mask_visib/ has {visible.count}"
    elif visible.count and info["px_count_visib"] and not slack.allows_box(_box(info["bbox_visib"]), visible.box):
        yield f"bbox_visib is {info['bbox_visib']}; mask_visib/ has {list(visible.box)}"


def _recount_whole(info: Entry, whole: Region, depth: Array | None, inside: bool, slack: Slack) -> Iterator[str]:
    """``inside`` says that the silhouette cannot leave the image, so that the mask has all of it."""
    valid = whole.count if depth is None else int(np.count_nonzero(whole.inside & (depth[whole.crop] > 0)))
    if not slack.allows(info["px_count_valid"], valid):
        yield f"px_count_valid is {info['px_count_valid']}; mask/ has {valid} where there is depth"
    if (inside or info["px_count_all"] < whole.count) and not slack.allows(info["px_count_all"], whole.count):
        yield f"px_count_all is {info['px_count_all']}; mask/ has {whole.count}"
    box = _box(info["bbox_obj"])
    same = slack.allows_box(box, whole.box) if inside else contains(_grown(box, slack.box_px), whole.box)
    if box != NO_BOX and whole.count and not same:
        yield f"bbox_obj is {info['bbox_obj']}; mask/ has {list(whole.box)}"


def _grown(box: Box, px: int) -> Box:
    return box[0] - px, box[1] - px, box[2] + 2 * px, box[3] + 2 * px


def _box(entry: Sequence[int]) -> Box:
    x, y, w, h = entry
    return x, y, w, h
