"""The README's pictures of T-LESS: labels drawn into a rendered image, and a plot of the statistics.

They are made from two datasets, with the project's own commands (models and photographs: docs/tless.md):

    synthetless generate configs/tless_bop.yaml --models T-LESS/models_cad --textures PHOTOGRAPHS --out out/shown \
        --images 8 --set camera.views_per_drop=1
    synthetless generate configs/synthetless.yaml --models T-LESS/models_cad --textures PHOTOGRAPHS --out out/many \
        --images 1200 --set 'outputs=["masks"]'
    synthetless preview out/many
    python -m docs.figures.tless out/shown 4 out/many

The photographs are CC0 ones of ambientCG and Poly Haven; the models are those of T-LESS (Hodan et al., WACV 2017).
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from itertools import repeat
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from synthetless.dataset import records
from synthetless.dataset.labels import box_corners_mm
from synthetless.dataset.layout import ScenePaths, find_split
from synthetless.dataset.records import Entry
from synthetless.dataset.sheet import class_color
from synthetless.io import images
from synthetless.io.files import atomic_write, read_bytes
from synthetless.io.models import read_models_info
from synthetless.preview.image import Segment, axis_lines, box_lines

IMAGES = Path(__file__).resolve().parents[1] / "images"
PLOT = "near_jump"
SCALE = 2
FRACTION_BITS = 4
AXES_COLORS = ((255, 70, 60), (70, 230, 80), (90, 130, 255))

Picture = NDArray[np.uint8]
Color = tuple[int, int, int]


def overlay(dataset: Path, im_id: int) -> Picture:
    """The image cut to its objects, twice: left masks and true poses, right masks and canonical poses."""
    scene = ScenePaths.of(dataset, 1, find_split(dataset))
    path = next(path for path in (scene.rgb(im_id, "png"), scene.rgb(im_id, "jpg")) if path.exists())
    rgb = images.decode_rgb(read_bytes(path), path)
    truth = records.read_scene_json(scene.scene_gt)[im_id]
    canonical = records.read_scene_json(scene.scene_gt_canonical)[im_id]
    K = np.array(records.read_scene_json(scene.scene_camera)[im_id]["cam_K"]).reshape(3, 3)
    infos = read_models_info(dataset / "models")
    paths = [scene.mask_visib(im_id, gt_id) for gt_id in range(len(truth))]
    masks = [images.decode_mask(read_bytes(path), path) for path in paths]
    poses = (
        [(gt["obj_id"], gt["cam_R_m2c"], gt["cam_t_m2c"]) for gt in truth],
        [(entry["obj_id"], entry["cam_R_m2c_canonical"], entry["cam_t_m2c_canonical"]) for entry in canonical],
    )
    left, top, right, bottom = window(np.any(masks, axis=0))
    panels = [
        draw(rgb, masks, of, K, infos)[SCALE * top : SCALE * bottom, SCALE * left : SCALE * right] for of in poses
    ]
    gap = np.full((panels[0].shape[0], 8, 3), 255, dtype=np.uint8)
    return np.hstack([panels[0], gap, panels[1]])


def window(mask: NDArray[np.bool_], margin_px: int = 30) -> tuple[int, int, int, int]:
    """Left, top, right and bottom of what is set, with a margin."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    height, width = mask.shape
    return (
        max(0, int(columns[0]) - margin_px),
        max(0, int(rows[0]) - margin_px),
        min(width, int(columns[-1]) + margin_px),
        min(height, int(rows[-1]) + margin_px),
    )


def draw(
    rgb: Picture,
    masks: list[NDArray[np.bool_]],
    poses: list[tuple[int, list[float], list[float]]],
    K: NDArray[np.float64],
    infos: dict[int, Entry],
) -> Picture:
    """The image, enlarged, with tinted masks, boxes in the classes' colours, and axes x red, y green, z blue."""
    drawn = rgb.astype(np.float64)
    for mask, (obj_id, _, _) in zip(masks, poses, strict=True):
        drawn[mask] = 0.8 * drawn[mask] + 0.2 * np.array(class_color(obj_id))
    size = (SCALE * rgb.shape[1], SCALE * rgb.shape[0])
    picture = cv2.resize(drawn.astype(np.uint8), size, interpolation=cv2.INTER_CUBIC).astype(np.uint8)
    for obj_id, rotation, translation in poses:
        R, t = np.array(rotation).reshape(3, 3), np.array(translation)
        lines(picture, box_lines(K, R, t, box_corners_mm(infos[obj_id])), repeat(class_color(obj_id)), 1)
        lines(picture, axis_lines(K, R, t, 0.45 * float(infos[obj_id]["diameter"])), AXES_COLORS, 3)
    return picture


def lines(picture: Picture, segments: Sequence[Segment], colors: Iterable[Color], thickness: int) -> None:
    for segment, color in zip(segments, colors, strict=False):
        enlarged = SCALE * (np.array(segment) + 0.5) - 0.5  # pixel centres are whole numbers in both
        ends = np.rint(enlarged * 2**FRACTION_BITS).astype(int).reshape(2, 2).tolist()
        cv2.line(picture, ends[0], ends[1], color, thickness, cv2.LINE_AA, shift=FRACTION_BITS)


def main() -> None:
    """Write docs/images/tless_poses.jpg and tless_near_jump.svg."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("shown", type=Path, help="dataset with rendered images")
    parser.add_argument("image", type=int, help="which of them")
    parser.add_argument("many", type=Path, help="dataset with a preview")
    given = parser.parse_args()
    atomic_write(IMAGES / "tless_poses.jpg", images.encode_jpeg(overlay(given.shown, given.image), quality=88))
    atomic_write(IMAGES / f"tless_{PLOT}.svg", read_bytes(given.many / "preview" / "plots" / f"{PLOT}.svg"))


if __name__ == "__main__":
    main()
