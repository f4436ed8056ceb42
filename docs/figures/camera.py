"""docs/camera.md's pictures: the same light without a sensor, as the preset has it, and as ranges draw it.

They are made from a dataset with EXR files, of which two images are shown (models and photographs: docs/tless.md):

    synthetless generate configs/tless_bop.yaml --models T-LESS/models_cad --textures PHOTOGRAPHS --out out/camera \
        --images 4 --seed 3 --set camera.views_per_drop=1 --set 'camera.elevation_deg=[30, 70]' \
        --set 'outputs=[rgb, depth, masks, exr]'
    python -m docs.figures.camera out/camera 0 3

The photographs are CC0 ones of ambientCG and Poly Haven; the models are those of T-LESS (Hodan et al., WACV 2017).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from synthetless.dataset.reader import Dataset, Image, read_specs
from synthetless.io.color import picture
from synthetless.io.files import atomic_write
from synthetless.io.images import encode_jpeg
from synthetless.scenes.sampling import sample_sensor
from synthetless.scenes.settings import SensorSettings
from synthetless.scenes.spec import SensorSpec

IMAGES = Path(__file__).resolve().parents[1] / "images"
SIDE_PX, DETAIL_PX, ENLARGED = 288, 72, 4

Picture = NDArray[np.uint8]


def side_by_side(image: Image, sensors: list[SensorSpec | None]) -> Picture:
    """The image's largest object in its surroundings, and below each a detail, enlarged so that pixels are seen."""
    spec = read_specs(image.paths)[image.im_id]
    linear = image.linear()
    largest = max(image.instances, key=lambda instance: int(instance.mask_visib().sum()))
    rows, columns = np.nonzero(largest.mask_visib())
    height, width = linear.shape[:2]
    panels = []
    for sensor in sensors:
        rgb = picture(linear, spec.exposure_gain, sensor)
        around = _cut(rgb, int(np.median(rows)), int(np.median(columns)), SIDE_PX, height, width)
        detail = _cut(rgb, int(rows.min()) + DETAIL_PX // 3, int(np.median(columns)), DETAIL_PX, height, width)
        enlarged = cv2.resize(detail, (SIDE_PX, SIDE_PX), interpolation=cv2.INTER_NEAREST)
        panels.append(np.vstack([around, np.full((6, SIDE_PX, 3), 255, dtype=np.uint8), enlarged]))
    gap = np.full((panels[0].shape[0], 6, 3), 255, dtype=np.uint8)
    return np.hstack([part for panel in panels for part in (panel, gap)][:-1])


def _cut(rgb: Picture, row: int, column: int, side: int, height: int, width: int) -> Picture:
    top, left = (min(max(0, at - side // 2), size - side) for at, size in ((row, height), (column, width)))
    return rgb[top : top + side, left : left + side]


def main() -> None:
    """Write docs/images/camera_1.jpg and camera_2.jpg."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path, help="dataset with EXR files")
    parser.add_argument("images", type=int, nargs=2, help="two of its images")
    given = parser.parse_args()
    dataset = Dataset.open(given.dataset)
    primesense = sample_sensor(SensorSettings(preset="primesense"), 0, 0, 0)
    drawn = [sample_sensor(SensorSettings(), 0, 0, view) for view in range(2)]
    for number, im_id in enumerate(given.images, start=1):
        shown = side_by_side(dataset[im_id], [None, primesense, *drawn])
        atomic_write(IMAGES / f"camera_{number}.jpg", encode_jpeg(shown, quality=82))


if __name__ == "__main__":
    main()
