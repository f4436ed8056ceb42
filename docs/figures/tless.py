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
from collections.abc import Iterable, Mapping, Sequence
from itertools import repeat
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from synthetless.dataset import Dataset
from synthetless.dataset.labels import box_corners_mm
from synthetless.dataset.palette import class_color
from synthetless.dataset.records import ModelInfo
from synthetless.io import images
from synthetless.io.files import atomic_write, read_bytes
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
    source = Dataset.open(dataset)
    image = source.image(1, im_id)
    rgb, infos = image.rgb(), source.models_info
    masks = [instance.mask_visib() for instance in image.instances]
    poses = (
        [(instance.obj_id, instance.R_m2c, instance.t_m2c) for instance in image.instances],
        [(each.obj_id, each.label.R_m2c, each.label.t_m2c) for each in image.instances if each.label is not None],
    )
    left, top, right, bottom = window(np.any(masks, axis=0))
    panels = [
        draw(rgb, masks, of, image.K, infos)[SCALE * top : SCALE * bottom, SCALE * left : SCALE * right] for of in poses
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
    poses: list[tuple[int, NDArray[np.float64], NDArray[np.float64]]],
    K: NDArray[np.float64],
    infos: Mapping[int, ModelInfo],
) -> Picture:
    """The image, enlarged, with tinted masks, boxes in the classes' colours, and axes x red, y green, z blue."""
    drawn = rgb.astype(np.float64)
    for mask, (obj_id, _, _) in zip(masks, poses, strict=True):
        drawn[mask] = 0.8 * drawn[mask] + 0.2 * np.array(class_color(obj_id))
    size = (SCALE * rgb.shape[1], SCALE * rgb.shape[0])
    picture = cv2.resize(drawn.astype(np.uint8), size, interpolation=cv2.INTER_CUBIC).astype(np.uint8)
    for obj_id, R, t in poses:
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
