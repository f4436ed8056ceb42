"""docs/camera.md's pictures of light and materials: the same images of several datasets side by side, and a sheet.

The datasets are of one seed and differ in their light, their materials and their sensor (models and photographs:
docs/tless.md):

    synthetless generate configs/tless_camera.yaml --models T-LESS/models_cad --textures PHOTOGRAPHS --out out/camera \\
        --images 24 --set camera.views_per_drop=1
    ... --out out/material --set sensor=none
    ... --out out/room --set sensor=none --set 'objects.grey=[0.12, 0.92]' --set objects.grey_scale=displayed \\
        --set objects.tint=0 --set 'objects.roughness=[0.3, 0.9]' --set 'objects.specular=[0, 0.5]' \\
        --set 'objects.metallic=[0, 0]'
    ... --out out/lamp --set light.room=none --set 'light.strength=[0.3, 1.3]' and all that out/room sets
    python -m docs.figures.light out/lamp out/room out/material out/camera --images 5 6 7 11

The photographs are CC0 ones of ambientCG and Poly Haven; the models are those of T-LESS (Hodan et al., WACV 2017).
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from synthetless.dataset.reader import Dataset
from synthetless.io.files import atomic_write
from synthetless.io.images import encode_jpeg

IMAGES = Path(__file__).resolve().parents[1] / "images"
WIDTH_PX, COLUMNS, GAP_PX, QUALITY = 270, 4, 4, 85

Picture = NDArray[np.uint8]


def tiled(pictures: Sequence[Picture], columns: int) -> Picture:
    """Pictures of one shape in rows, reduced."""
    height = round(WIDTH_PX * pictures[0].shape[0] / pictures[0].shape[1])
    small = [cv2.resize(picture, (WIDTH_PX, height), interpolation=cv2.INTER_AREA) for picture in pictures]
    padded = [np.pad(picture, ((0, GAP_PX), (0, GAP_PX), (0, 0)), constant_values=255) for picture in small]
    rows = [np.hstack(padded[start : start + columns]) for start in range(0, len(padded), columns)]
    return np.vstack(rows)[:-GAP_PX, :-GAP_PX]


def main() -> None:
    """Write docs/images/camera_light.jpg and camera_sheet.jpg."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("datasets", type=Path, nargs="+", help="of the last, the sheet shows all images")
    parser.add_argument("--images", type=int, nargs="+", default=[0, 1, 2, 3], help="what is shown side by side")
    given = parser.parse_args()
    datasets = [Dataset.open(folder) for folder in given.datasets]
    beside = [dataset[number].rgb() for number in given.images for dataset in datasets]
    sheet = [image.rgb() for image in datasets[-1]]
    for name, shown in (("camera_light", tiled(beside, len(datasets))), ("camera_sheet", tiled(sheet, COLUMNS))):
        atomic_write(IMAGES / f"{name}.jpg", encode_jpeg(shown, QUALITY))


if __name__ == "__main__":
    main()
