"""What a dataset holds, beside what its recipe asked for: a bias shows before a network learns it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from synthetless.dataset.reader import Dataset, Scene, read_recipe, read_specs
from synthetless.dataset.records import ImageSpec
from synthetless.io import images
from synthetless.io.color import mean_luminance
from synthetless.io.files import read_bytes
from synthetless.preview.distributions import Distribution, Observations, distributions, labelled_classes
from synthetless.scenes.spec import SceneSpec
from synthetless.symmetry import SymmetryEntry, SymmetryTable
from synthetless.symmetry.atlas import SCHEMES, Scheme

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

NEAR_JUMP_DEG = 5.0
LUMINANCE_IMAGES = 500
_RANDOM_ROTATIONS = 8192
_RANDOM_SEED = 20190916
BANDS, SECTORS = 8, 16
CELLS = BANDS * SECTORS
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
class DetailStatistics:
    """How often the images show that an object is not as symmetrical as its quasi-symmetry group.

    Attributes:
        quasi: name of that group.
        visible: share of the instances whose image leaves no coset open but the true one.
        mean_view_ambiguity: mean share of the cosets that are left open.
        views_visible: the former instances by cell of the viewing sphere, as ``ClassStatistics.views`` has all.
    """

    quasi: str
    visible: float
    mean_view_ambiguity: float
    views_visible: tuple[tuple[int, ...], ...]


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
        views, views_canonical: instances seen from each cell of the viewing sphere (``cell_counts``), by their
            true and by their canonical pose.
        coverage, coverage_canonical: share of the cells that are seen at all.
        coverage_uniform: the share that as many views, uniform on the sphere, are expected to see.
        detail: what ``synthetless ambiguity`` found; None without a quasi-symmetry group, or where it was not called.
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
    detail: DetailStatistics | None


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
    source = Dataset.open(dataset, split)
    recipe = None if source.header is None else read_recipe(dataset)
    table = source.symmetries
    instances, seen = _collect(source, luminance_images)
    found = [int(obj_id) for obj_id in np.unique(seen.obj_id)]
    offered = sorted(recipe.objects.ids or table.entries) if recipe is not None else found
    return Statistics(
        images=len(seen.objects_per_image),
        instances=len(seen.obj_id),
        drops=len(seen.drops),
        scheme=table.scheme,
        distributions=(labelled_classes(seen, offered, recipe), *distributions(seen, recipe)),
        classes=tuple(_class(obj_id, instances.of(obj_id), table) for obj_id in found),
    )


@dataclass(frozen=True, eq=False)
class _Instances:
    """Columns of N labelled instances: true and canonical poses, visible fraction, regressor, ambiguity.

    ``view_ambiguity`` is nan and ``is_certain`` false where the ambiguity of an instance is not known.
    """

    obj_id: Integers
    visib_fract: Floats
    regressor_index: Integers
    R_m2c: Floats
    t_m2c: Floats
    R_canonical: Floats
    t_canonical: Floats
    view_ambiguity: Floats
    is_certain: NDArray[np.bool_]

    @classmethod
    def in_scene(cls, scene: Scene) -> _Instances:
        poses, labels, seen = scene.labelled()
        return cls(
            poses.obj_ids,
            seen.visib_fract,
            labels.regressor_index,
            poses.R_m2c,
            poses.t_m2c,
            labels.R_m2c,
            labels.t_m2c,
            np.array([np.nan if entry is None else entry["view_ambiguity"] for entry in scene.ambiguity]),
            np.array([entry is not None and len(entry["cosets_alike"]) == 1 for entry in scene.ambiguity], dtype=bool),
        )

    @classmethod
    def together(cls, parts: Sequence[_Instances]) -> _Instances:
        return cls(*(np.concatenate([getattr(part, each.name) for part in parts]) for each in fields(cls)))

    def of(self, obj_id: int) -> _Instances:
        rows = self.obj_id == obj_id
        return _Instances(*(getattr(self, each.name)[rows] for each in fields(self)))


def _collect(source: Dataset, luminance_images: int) -> tuple[_Instances, Observations]:
    """Read the labels and records of a split, and at most ``luminance_images`` of its images."""
    parts: list[_Instances] = []
    counts: list[Integers] = []
    recorded: list[ImageSpec] = []
    pictures: list[Path] = []
    for scene_id in tqdm(source.scene_ids, desc="statistics", unit="scene", disable=None, leave=False):
        scene = Scene.read(source.paths(scene_id))
        parts.append(_Instances.in_scene(scene))
        counts.append(np.diff(scene.poses.first))
        specs, im_ids = read_specs(scene.paths), scene.poses.image_ids.tolist()
        recorded += [specs[im_id] for im_id in im_ids if im_id in specs]
        pictures += [path for path in map(scene.paths.find_rgb, im_ids) if path is not None]
    instances = _Instances.together(parts)
    drops: dict[int, SceneSpec] = {}
    for spec in recorded:
        drops.setdefault(spec.scene.drop, spec.scene)
    few = min(luminance_images, len(pictures))
    chosen = [pictures[number * len(pictures) // few] for number in range(few)]
    return instances, Observations(
        obj_id=instances.obj_id,
        visib_fract=instances.visib_fract,
        distance_mm=np.linalg.norm(instances.t_m2c, axis=1),
        objects_per_image=np.concatenate(counts),
        views=[spec.scene.views[spec.view] for spec in recorded],
        exposure_gains=np.array([spec.exposure_gain for spec in recorded]),
        drops=list(drops.values()),
        luminance=np.array([mean_luminance(images.decode_rgb(read_bytes(path), path)) for path in chosen]),
    )


def _class(obj_id: int, of: _Instances, table: SymmetryTable) -> ClassStatistics:
    n_regressors = table.canonical_map(obj_id).n_regressors
    views = cell_counts(viewing_directions(of.R_m2c, of.t_m2c))
    canonical = cell_counts(viewing_directions(of.R_canonical, of.t_canonical))
    random = Rotation.random(_RANDOM_ROTATIONS, random_state=np.random.default_rng(_RANDOM_SEED)).as_matrix()
    ahead = np.broadcast_to(_IN_FRONT_MM, (len(random), 3))
    near, random_index = {}, np.empty(0, np.int64)
    for scheme in SCHEMES:
        labels = replace(table, scheme=scheme).canonical_map(obj_id)
        for_random = labels(random, ahead)
        near[scheme] = NearJump(
            _share_near(labels(of.R_m2c, of.t_m2c).discontinuity_margin_deg),
            _share_near(for_random.discontinuity_margin_deg),
        )
        if scheme == table.scheme:
            random_index = for_random.regressor_index
    expected = np.bincount(random_index, minlength=n_regressors) / len(random_index) * len(of.obj_id)
    return ClassStatistics(
        obj_id=obj_id,
        group=table.entries[obj_id].group.name,
        instances=len(of.obj_id),
        mean_visib_fract=float(of.visib_fract.mean()),
        regressors=tuple(np.bincount(of.regressor_index, minlength=n_regressors).tolist()),
        regressors_random=tuple(expected.tolist()),
        near_jump=near,
        views=_rows(views),
        views_canonical=_rows(canonical),
        coverage=coverage(views),
        coverage_canonical=coverage(canonical),
        coverage_uniform=uniform_coverage(len(of.obj_id)),
        detail=_detail(of, table.entries[obj_id]),
    )


def _detail(of: _Instances, entry: SymmetryEntry) -> DetailStatistics | None:
    if entry.quasi is None or np.isnan(of.view_ambiguity).any():
        return None
    certain = of.is_certain
    seen_from = viewing_directions(of.R_m2c[certain], of.t_m2c[certain])
    return DetailStatistics(
        quasi=entry.quasi.group.name,
        visible=float(certain.mean()),
        mean_view_ambiguity=float(of.view_ambiguity.mean()),
        views_visible=_rows(cell_counts(seen_from)),
    )


def _share_near(margin_deg: NDArray[np.float64]) -> float:
    return float((margin_deg < NEAR_JUMP_DEG).mean())


def _rows(counts: NDArray[np.int64]) -> tuple[tuple[int, ...], ...]:
    return tuple(tuple(row) for row in counts.tolist())


# From where an object is seen: the viewing sphere of a model in cells of equal area.


def viewing_directions(R_m2c: Floats, t_m2c: Floats) -> Floats:
    """(N, 3) unit vectors from the model's origin to the camera, model frame, of poses (N, 3, 3), (N, 3)."""
    towards = -np.einsum("nji,nj->ni", R_m2c, t_m2c)
    directions: Floats = towards / np.linalg.norm(towards, axis=1, keepdims=True)
    return directions


def cell_counts(directions: Floats) -> NDArray[np.int64]:
    """(BANDS, SECTORS) directions in each cell: bands of equal height along z, which have equal area (Archimedes),
    from -z to z, cut into sectors of longitude from -180 degrees on."""
    band = np.clip(((directions[:, 2] + 1) / 2 * BANDS).astype(np.int64), 0, BANDS - 1)
    longitude = np.arctan2(directions[:, 1], directions[:, 0])
    sector = np.clip(((longitude + np.pi) / (2 * np.pi) * SECTORS).astype(np.int64), 0, SECTORS - 1)
    return np.bincount(band * SECTORS + sector, minlength=CELLS).reshape(BANDS, SECTORS)


def coverage(counts: NDArray[np.int64]) -> float:
    """Share of the cells from which the object is seen at least once."""
    return float((counts > 0).mean())


def uniform_coverage(views: int) -> float:
    """The coverage that as many views, uniform on the sphere, are expected to have."""
    return float(1 - (1 - 1 / CELLS) ** views)


def cell_centres() -> Floats:
    """(BANDS, SECTORS, 3) a unit vector in the middle of each cell."""
    z = ((np.arange(BANDS) + 0.5) / BANDS * 2 - 1)[:, None]
    longitude = (np.arange(SECTORS) + 0.5) / SECTORS * 2 * np.pi - np.pi
    x, y = (np.sqrt(1 - z**2) * component for component in (np.cos(longitude), np.sin(longitude)))
    return np.stack([x, y, np.broadcast_to(z, x.shape)], axis=-1)


def cell_outlines(points: int = 6) -> Floats:
    """(BANDS, SECTORS, 4 * points, 2) outlines of the cells in Hammer's equal-area projection, within an ellipse of
    half axes 2 sqrt(2) and sqrt(2)."""
    steps = np.linspace(0, 1, points, endpoint=False)
    right = np.concatenate([steps, np.ones(points), 1 - steps, np.zeros(points)])
    up = np.concatenate([np.zeros(points), steps, np.ones(points), 1 - steps])
    longitude = (np.arange(SECTORS)[None, :, None] + right) / SECTORS * 2 * np.pi - np.pi
    height = (np.arange(BANDS)[:, None, None] + up) / BANDS * 2 - 1
    longitude, height = np.broadcast_arrays(longitude, height)
    cosine = np.sqrt(np.clip(1 - height**2, 0, None))
    scale = np.sqrt(1 + cosine * np.cos(longitude / 2))
    x, y = 2 * np.sqrt(2) * cosine * np.sin(longitude / 2) / scale, np.sqrt(2) * height / scale
    return np.stack([x, y], axis=-1)
