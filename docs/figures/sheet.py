"""A contact sheet of a recipe's first images, for docs/: what it makes, at a glance.

    synthetless generate tless_bin --models T-LESS/models_cad --textures PHOTOGRAPHS --out out/tless_bin \
        --images 24 --set camera.views_per_drop=1 --set render.quality=draft --set 'outputs=[rgb]'
    python -m docs.figures.sheet out/tless_bin docs/images/tless_bin.jpg

That of tless_camera was made with ``--seed 5``, those of recipes without shoulder and seamless photographs with
``--set render.shoulder=0.4 --set table.photos=seamless``.
The photographs are CC0 ones of ambientCG and Poly Haven; the models are those of T-LESS (Hodan et al., WACV 2017).
"""

from __future__ import annotations

import argparse
from pathlib import Path

from docs.figures.light import tiled
from synthetless.dataset.reader import Dataset
from synthetless.io.files import atomic_write
from synthetless.io.images import encode_jpeg

COLUMNS, QUALITY = 6, 75


def main() -> None:
    """Write the sheet."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("to", type=Path, help="JPEG file")
    parser.add_argument("--images", type=int, default=24)
    given = parser.parse_args()
    dataset = Dataset.open(given.dataset)
    pictures = [dataset[number].rgb() for number in range(min(given.images, len(dataset)))]
    atomic_write(given.to, encode_jpeg(tiled(pictures, COLUMNS), QUALITY))


if __name__ == "__main__":
    main()
