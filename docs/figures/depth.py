"""docs/camera.md's picture of depth as cameras measure it: exact, structured light, time of flight, and what is off.

It is made from two datasets of one image, one of them with ``depth_sensor=time_of_flight`` (models and photographs:
docs/tless.md):

    synthetless generate configs/tless_bop.yaml --models T-LESS/models_cad --textures PHOTOGRAPHS --out out/depth_1 \
        --images 1 --seed 3 --set camera.views_per_drop=1 --set 'camera.elevation_deg=[45, 45]' \
        --set 'outputs=[rgb, depth, masks, depth_sensed]' --set depth_sensor=structured_light
    python -m docs.figures.depth out/depth_1 out/depth_2

The photographs are CC0 ones of ambientCG and Poly Haven; the models are those of T-LESS (Hodan et al., WACV 2017).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from synthetless.dataset import Dataset
from synthetless.io.files import atomic_write
from synthetless.io.images import encode_jpeg

IMAGES = Path(__file__).resolve().parents[1] / "images"
SIDE_PX, OFF_MM = 400, 6.0

Floats = NDArray[np.float64]
Picture = NDArray[np.uint8]


def coloured(values: Floats, low: float, high: float, present: NDArray[np.bool_], colours: int) -> Picture:
    """Values between two bounds as colours, black where there are none."""
    levels = np.rint(255 * np.clip((values - low) / (high - low), 0, 1)).astype(np.uint8)
    rgb = cv2.applyColorMap(levels, colours)[..., ::-1]
    return np.where(present[..., None], rgb, 0).astype(np.uint8)


def main() -> None:
    """Write docs/images/camera_depth.jpg."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("datasets", type=Path, nargs=2, help="of structured light and of time of flight")
    images = [Dataset.open(root)[0] for root in parser.parse_args().datasets]
    exact, sensed = images[0].depth_mm(), [image.depth_sensed_mm() for image in images]
    rows, columns = np.nonzero(np.any([instance.mask_visib() for instance in images[0].instances], axis=0))
    top, left = int(rows.mean()) - SIDE_PX // 2, int(columns.mean()) - SIDE_PX // 2
    top, left = (min(max(0, at), size - SIDE_PX) for at, size in zip((top, left), exact.shape, strict=True))
    cut = np.s_[top : top + SIDE_PX, left : left + SIDE_PX]
    near, far = np.percentile(exact[cut], [0, 100])
    above = [coloured(far - z[cut], 0, far - near, z[cut] > 0, cv2.COLORMAP_VIRIDIS) for z in (exact, *sensed)]
    below = [images[0].rgb()[cut]]
    below += [
        coloured((z - exact)[cut], -OFF_MM, OFF_MM, (z > 0)[cut] & (exact > 0)[cut], cv2.COLORMAP_JET) for z in sensed
    ]
    gap = np.full((SIDE_PX, 8, 3), 255, dtype=np.uint8)
    lines = [np.hstack([line[0], gap, line[1], gap, line[2]]) for line in (above, below)]
    shown = np.vstack([lines[0], np.full((8, lines[0].shape[1], 3), 255, dtype=np.uint8), lines[1]])
    atomic_write(IMAGES / "camera_depth.jpg", encode_jpeg(shown, quality=80))


if __name__ == "__main__":
    main()
