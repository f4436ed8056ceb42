"""docs/camera.md's picture of lens distortion: one scene through a pinhole and two lenses, with labels drawn in.

It is made from three datasets of one image (models and photographs: docs/tless.md), with these values of DISTORTION:
``[0, 0, 0, 0, 0]``, ``[-0.6, 0.4, 0.002, -0.001, 0]`` and ``[0.6, 0.3, 0, 0, 0]``:

    synthetless generate configs/tless_bop.yaml --models T-LESS/models_cad --textures PHOTOGRAPHS --out out/lens_1 \
        --images 1 --seed 3 --set camera.views_per_drop=1 --set camera.width=400 --set camera.height=300 \
        --set camera.fx=420 --set camera.fy=420 --set camera.cx=199.5 --set camera.cy=149.5 \
        --set 'camera.distance_m=[0.36, 0.36]' --set 'camera.elevation_deg=[60, 60]' \
        --set 'camera.distortion=DISTORTION'
    python -m docs.figures.lens out/lens_1 out/lens_2 out/lens_3

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
from synthetless.io.models import BOX_EDGES

IMAGES = Path(__file__).resolve().parents[1] / "images"
SCALE = 2
OUTLINE, BOX = (255, 160, 30), (90, 255, 120)


def drawn(root: Path) -> NDArray[np.uint8]:
    """The first image of a dataset, enlarged, with the outlines of visible masks and the canonical boxes."""
    image = Dataset.open(root)[0]
    canvas = np.asarray(cv2.resize(image.rgb(), None, fx=SCALE, fy=SCALE, interpolation=cv2.INTER_CUBIC))
    for instance in image.instances:
        mask = np.kron(instance.mask_visib(), np.ones((SCALE, SCALE), np.uint8)).astype(np.uint8)
        contours, _ = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(canvas, contours, -1, OUTLINE, 1)
        if instance.label is not None:
            corners = np.rint((instance.label.corners_px + 0.5) * SCALE - 0.5).astype(int)
            for a, b in BOX_EDGES:
                cv2.line(canvas, corners[a].tolist(), corners[b].tolist(), BOX, 1, cv2.LINE_AA)
    return canvas.astype(np.uint8)


def main() -> None:
    """Write docs/images/camera_lens.jpg."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("datasets", type=Path, nargs=3, help="of a pinhole and two lenses")
    panels = [drawn(root) for root in parser.parse_args().datasets]
    gap = np.full((panels[0].shape[0], 8, 3), 255, dtype=np.uint8)
    shown = np.hstack([panels[0], gap, panels[1], gap, panels[2]])
    atomic_write(IMAGES / "camera_lens.jpg", encode_jpeg(shown, quality=80))


if __name__ == "__main__":
    main()
