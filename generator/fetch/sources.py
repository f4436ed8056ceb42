"""What can be fetched: where it is published, what is taken of it, how it is recognised, and under which licence."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from synthetless.errors import UserError
from synthetless.fetch.archive import Limits
from synthetless.io.meshes import diameter
from synthetless.io.models import load_models

TLESS_DIAMETERS_MM = (
    *(63.515, 66.151, 65.349, 80.726, 108.690, 108.265, 178.615, 217.156, 144.546, 90.211),
    *(76.598, 86.011, 58.126, 71.947, 68.569, 69.188, 112.839, 110.982, 89.069, 98.889),
    *(92.253, 92.253, 142.587, 84.736, 108.801, 108.801, 152.495, 124.778, 134.227, 88.754),
)
"""Diameters of the 30 CAD models as BOP's models_cad/models_info.json gives them, in the order of their ids."""
DIAMETER_TOLERANCE_MM = 0.01
DTD_CATEGORIES, DTD_IMAGES_PER_CATEGORY = 47, 120


@dataclass(frozen=True)
class DataSource:
    """A published archive of which some files are wanted.

    Attributes:
        name: by which it is asked for.
        title: what it is, for messages.
        address: where the archive is published.
        archive: its file name.
        sha256: of the archive as published.
        archive_bytes: a larger download is refused; many times what is published.
        unpacked_bytes: disk that the wanted files take, roughly.
        limits: what any archive of it may hold altogether.
        wanted: matches the names of the wanted members; the first group is the path inside ``folder``.
        folder: what holds the wanted files in the end.
        check: raises ValueError unless a folder holds what is expected.
        licence: terms and attribution.
    """

    name: str
    title: str
    address: str
    archive: str
    sha256: str
    archive_bytes: int
    unpacked_bytes: int
    limits: Limits
    wanted: re.Pattern[str]
    folder: str
    check: Callable[[Path], None]
    licence: str


def check_tless(folder: Path) -> None:
    """The 30 T-LESS CAD models, recognised by their diameters.

    Raises:
        UserError: one is missing, unreadable, of another size than models_info.json says, or another object.
    """
    models = load_models(folder)
    if sorted(models) != list(range(1, len(TLESS_DIAMETERS_MM) + 1)):
        raise UserError(f"holds {len(models)} models with ids {min(models)} to {max(models)}; T-LESS has 1 to 30")
    for obj_id, expected_mm in enumerate(TLESS_DIAMETERS_MM, start=1):
        model = models[obj_id]
        measured_mm = diameter(model.vertices_mm)
        for what, value_mm in ("the mesh", measured_mm), ("models_info.json", model.diameter_mm):
            if abs(value_mm - expected_mm) > DIAMETER_TOLERANCE_MM:
                raise UserError(
                    f"object {obj_id}: diameter {value_mm:.3f} mm by {what}; {expected_mm:.3f} mm is that of T-LESS"
                )


def check_dtd(folder: Path) -> None:
    """The 47 categories of 120 textures each.

    Raises:
        UserError: a category or an image is missing, or an image is empty.
    """
    images = [path for path in folder.glob("*/*") if path.is_file() and not path.name.startswith(".")]
    counts = Counter(path.parent.name for path in images)
    if len(counts) != DTD_CATEGORIES:
        raise UserError(f"holds {len(counts)} categories of textures; DTD has {DTD_CATEGORIES}")
    for category, count in sorted(counts.items()):
        if count != DTD_IMAGES_PER_CATEGORY:
            raise UserError(f"category {category} has {count} images; in DTD each has {DTD_IMAGES_PER_CATEGORY}")
    if empty := [path for path in images if path.stat().st_size == 0]:
        raise UserError(f"{len(empty)} images are empty, {empty[0].parent.name}/{empty[0].name} for one")


TLESS = DataSource(
    name="tless",
    title="T-LESS CAD models",
    address="https://huggingface.co/datasets/bop-benchmark/tless/resolve/main/tless_models.zip",
    archive="tless_models.zip",
    sha256="6a29c59766b8d2af05e62e71739f0ca7243ad81bc3c7f9a24925504a8cb37928",  # 33,468,762 bytes
    archive_bytes=500_000_000,
    unpacked_bytes=50_000_000,
    limits=Limits(files=5_000, size_bytes=2_000_000_000),
    wanted=re.compile(r"(?:.*/)?models_cad/(obj_\d{6}\.ply|models_info\.json)"),
    folder="models_cad",
    check=check_tless,
    licence="""\
T-LESS: An RGB-D Dataset for 6D Pose Estimation of Texture-less Objects
T. Hodan, P. Haluza, S. Obdrzalek, J. Matas, M. Lourakis, X. Zabulis, WACV 2017
https://cmp.felk.cvut.cz/t-less, in the format of BOP: https://bop.felk.cvut.cz

Licence: BOP publishes it on Hugging Face under Creative Commons Attribution 4.0
(CC BY 4.0, https://creativecommons.org/licenses/by/4.0/). The authors' T-LESS
toolkit names Attribution-ShareAlike 4.0 for it instead (CC BY-SA 4.0,
https://creativecommons.org/licenses/by-sa/4.0/). Whoever passes on the models,
or images of them, respects both by keeping to the latter.
""",
)

DTD = DataSource(
    name="dtd",
    title="Describable Textures Dataset",
    address="https://www.robots.ox.ac.uk/~vgg/data/dtd/download/dtd-r1.0.1.tar.gz",
    archive="dtd-r1.0.1.tar.gz",
    sha256="e42855a52a4950a3b59612834602aa253914755c95b0cff9ead6d07395f8e205",  # 625,239,812 bytes
    archive_bytes=2_000_000_000,
    unpacked_bytes=700_000_000,
    limits=Limits(files=20_000, size_bytes=3_000_000_000),
    wanted=re.compile(r"(?:.*/)?images/([^/]+/[^/.][^/]*\.jpe?g)", re.IGNORECASE),
    folder="images",
    check=check_dtd,
    licence="""\
Describable Textures Dataset (DTD), release 1.0.1
M. Cimpoi, S. Maji, I. Kokkinos, S. Mohamed, A. Vedaldi:
Describing Textures in the Wild, CVPR 2014
https://www.robots.ox.ac.uk/~vgg/data/dtd/

Licence: made available to the computer vision community for research purposes.
The images were collected from the web and belong to their photographers; for
other purposes take textures whose licence allows it, such as CC0 ones.
""",
)

SOURCES = {source.name: source for source in (TLESS, DTD)}
