"""The statistics themselves, as plain data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from synthetless.dataset.layout import DATASET_FILE, SYMMETRIES_FILE, find_split
from synthetless.dataset.reader import read_recipe
from synthetless.preview.statistics import sphere
from synthetless.preview.statistics.collect import Observations, collect
from synthetless.preview.statistics.distributions import Distribution, distributions, labelled_classes
from synthetless.symmetry import SymmetryTable
from synthetless.symmetry.atlas import SCHEMES, Scheme

NEAR_JUMP_DEG = 5.0
LUMINANCE_IMAGES = 500
_RANDOM_ROTATIONS = 8192
_RANDOM_SEED = 20190916
_IN_FRONT_MM = np.array([0.0, 0.0, 1000.0])


@dataclass(frozen=True)
class NearJump:
    """How many labels lie near a discontinuity, within NEAR_JUMP_DEG.

    Attributes:
        share: of the dataset's labels.
        random: of the labels that uniformly random rotations would have.
    """

    share: float
    random: float


@dataclass(frozen=True)
class ClassStatistics:
    """One object's labels.

    Attributes:
        obj_id: its id.
        group: its symmetries.
        instances: how many are labelled.
        mean_visib_fract: of them.
        regressors: how many labels each regressor has.
        regressors_random: how many it would have, were the rotations uniformly random.
        near_jump: by scheme.
        views, views_canonical: instances seen from each cell of the viewing sphere (``sphere.cell_counts``), by their
            true and by their canonical pose.
        coverage, coverage_canonical: share of the cells that are seen at all.
        coverage_uniform: the share that as many views, uniform on the sphere, are expected to see.
    """

    obj_id: int
    group: str
    instances: int
    mean_visib_fract: float
    regressors: tuple[int, ...]
    regressors_random: tuple[float, ...]
    near_jump: Mapping[Scheme, NearJump]
    views: tuple[tuple[int, ...], ...]
    views_canonical: tuple[tuple[int, ...], ...]
    coverage: float
    coverage_canonical: float
    coverage_uniform: float


@dataclass(frozen=True)
class Statistics:
    """What a dataset holds.

    Attributes:
        images, instances, drops: how many; drops are 0 where no scenes were recorded.
        scheme: of the dataset's labels.
        distributions: of everything that is drawn, and of what follows from it.
        classes: by object, ascending.
    """

    images: int
    instances: int
    drops: int
    scheme: str
    distributions: tuple[Distribution, ...]
    classes: tuple[ClassStatistics, ...]

    @property
    def biased(self) -> tuple[Distribution, ...]:
        """The distributions that differ from what the recipe asked for."""
        return tuple(each for each in self.distributions if each.verdict == "differs")

    def to_json(self) -> dict[str, Any]:
        """Plain dicts, lists and numbers."""
        content = asdict(self)
        for entry, each in zip(content["distributions"], self.distributions, strict=True):
            entry["verdict"] = each.verdict
        return content


def statistics(dataset: Path, split: str | None = None, luminance_images: int = LUMINANCE_IMAGES) -> Statistics:
    """Count what a dataset holds, beside what its recipe asked for.

    Args:
        dataset: folder of a dataset, or of a BOP dataset that was adopted: that one has no recipe to compare with.
        split: the folder of images; may be left out where there is only one.
        luminance_images: how many images to read for their luminance, evenly spread.

    Raises:
        UserError: there is no such dataset, or it is damaged.
    """
    split = split or find_split(dataset)
    recipe = read_recipe(dataset) if (dataset / DATASET_FILE).exists() else None
    table = SymmetryTable.read(dataset / SYMMETRIES_FILE)
    seen = collect(dataset, split, luminance_images)
    found = [int(obj_id) for obj_id in np.unique(seen.instances.obj_id)]
    offered = sorted(recipe.objects.ids or table.entries) if recipe is not None else found
    return Statistics(
        images=len(seen.objects_per_image),
        instances=len(seen.instances.obj_id),
        drops=len(seen.drops),
        scheme=table.scheme,
        distributions=(labelled_classes(seen, offered, recipe), *distributions(seen, recipe)),
        classes=tuple(_class(seen, obj_id, table) for obj_id in found),
    )


def _class(seen: Observations, obj_id: int, table: SymmetryTable) -> ClassStatistics:
    of = seen.instances
    rows = of.obj_id == obj_id
    R, t = of.R_m2c[rows], of.t_m2c[rows]
    n_regressors = table.canonical_map(obj_id).n_regressors
    views = sphere.cell_counts(sphere.viewing_directions(R, t))
    canonical = sphere.cell_counts(sphere.viewing_directions(of.R_canonical[rows], of.t_canonical[rows]))
    random = Rotation.random(_RANDOM_ROTATIONS, random_state=np.random.default_rng(_RANDOM_SEED)).as_matrix()
    ahead = np.broadcast_to(_IN_FRONT_MM, (len(random), 3))
    near, random_index = {}, np.empty(0, np.int64)
    for scheme in SCHEMES:
        labels = replace(table, scheme=scheme).canonical_map(obj_id)
        for_random = labels(random, ahead)
        near[scheme] = NearJump(
            _share_near(labels(R, t).discontinuity_margin_deg), _share_near(for_random.discontinuity_margin_deg)
        )
        if scheme == table.scheme:
            random_index = for_random.regressor_index
    expected = np.bincount(random_index, minlength=n_regressors) / len(random_index) * len(R)
    return ClassStatistics(
        obj_id=obj_id,
        group=table.entries[obj_id].group.name,
        instances=len(R),
        mean_visib_fract=float(of.visib_fract[rows].mean()),
        regressors=tuple(np.bincount(of.regressor_index[rows], minlength=n_regressors).tolist()),
        regressors_random=tuple(expected.tolist()),
        near_jump=near,
        views=_rows(views),
        views_canonical=_rows(canonical),
        coverage=sphere.coverage(views),
        coverage_canonical=sphere.coverage(canonical),
        coverage_uniform=sphere.uniform_coverage(len(R)),
    )


def _share_near(margin_deg: NDArray[np.float64]) -> float:
    return float((margin_deg < NEAR_JUMP_DEG).mean())


def _rows(counts: NDArray[np.int64]) -> tuple[tuple[int, ...], ...]:
    return tuple(tuple(row) for row in counts.tolist())
