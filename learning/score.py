"""The score of a result file: BOP's recalls, and the paper's own rule.

Localization as in the BOP challenge: an image asks for the instances of which at least a tenth is visible. Of an
object's poses in an image as many count as there are such instances, those of the highest score; each takes, the
highest first, the best instance that is left, if its error is below the threshold. The recall is averaged over the
thresholds (and over VSD's tolerances).

The paper (Pitteri et al., 3DV 2019) calls a pose right if its VSD with a tolerance of 20 mm is below 0.3, and averages
the recalls of the objects.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from embreex.rtcore import EmbreeDevice
from numpy.typing import NDArray

from synthetless.annotation.instances import PosedModel
from synthetless.annotation.raycast import RayCaster, Surface
from synthetless.dataset.layout import CAMERA_FILE, SYMMETRIES_FILE, find_models_folder
from synthetless.dataset.reader import Dataset, Image, Instance
from synthetless.errors import UserError
from synthetless.io.files import read_json
from synthetless.io.models import ObjectModel, load_models, read_models_info
from synthetless.io.parallel import each
from synthetless.learning.pose_error import (
    CONTINUOUS_STEPS,
    ModelPoints,
    ObjectDepth,
    RigidPose,
    bop_motions,
    silhouettes_may_overlap,
    vsd,
)
from synthetless.learning.results import Estimate, read_results
from synthetless.scenes.spec import Intrinsics
from synthetless.symmetry import SymmetryTable

Floats = NDArray[np.float64]
ErrorName = Literal["vsd", "mssd", "mspd"]
SymmetrySource = Literal["models_info", "table"]
DepthSource = Literal["image", "models"]

ERRORS: tuple[ErrorName, ...] = get_args(ErrorName)
MIN_VISIB_FRACT = 0.1
"""BOP asks for no instance of which less is visible."""
SHARES = np.arange(0.05, 0.51, 0.05)
"""Of the diameter: VSD's tolerances, and the thresholds of MSSD; of 1: the thresholds of VSD."""
PIXELS = np.arange(5, 51, 5).astype(np.float64)
"""Thresholds of MSPD, for an image 640 pixels wide."""
PAPER_TAU_MM, PAPER_THRESHOLD = 20.0, 0.3

_IMAGES_PER_TASK = 20
_MARGINS_DEG = (0, 2, 5, 10, 20, 180.001)
_ELEVATIONS_DEG = (-90, 10, 30, 50, 70, 90.001)
_VISIBLE = (MIN_VISIB_FRACT, 0.3, 0.6, 0.9, 1.001)


@dataclass(frozen=True)
class Judge:
    """What is judged, and how.

    Attributes:
        dataset: folder of a BOP dataset.
        split: its folder of scenes; None where there is only one.
        models: folder of the models; None for the dataset's own.
        errors: which are measured.
        true_z: whether estimates are first moved along the ray to their origin until it has the true z.
        symmetries: those of models_info.json, as bop_toolkit has them, or those of the dataset's table.
        depth: VSD's scene: the depth image, or the true poses' models without a table.
    """

    dataset: Path
    split: str | None = None
    models: Path | None = None
    errors: tuple[ErrorName, ...] = ERRORS
    true_z: bool = False
    symmetries: SymmetrySource = "models_info"
    depth: DepthSource = "image"

    def __post_init__(self) -> None:
        for error in self.errors:
            if error not in ERRORS:
                raise UserError(f"unknown error {error!r}: use {', '.join(ERRORS)}")
        if not self.errors:
            raise UserError(f"no errors to measure: give some of {', '.join(ERRORS)}")


class Target(NamedTuple):
    """An instance that an image asks for, and what of it was found.

    Attributes:
        scene_id, im_id, gt_id, obj_id: the instance.
        margin_deg: discontinuity margin of its label; NaN without labels.
        elevation_deg: of the camera above the table, seen from the object; NaN where the dataset does not say.
        visib_fract: visible share; NaN without scene_gt_info.json.
        found: by error, whether an estimate was below each threshold; VSD (10 tolerances, 10 thresholds), MSSD and
            MSPD (10,), "paper" ().
    """

    scene_id: int
    im_id: int
    gt_id: int
    obj_id: int
    margin_deg: float
    elevation_deg: float
    visib_fract: float
    found: Mapping[str, NDArray[np.bool_]]


@dataclass(frozen=True)
class Row:
    """Average recalls over some of the targets.

    Attributes:
        group, name: what the targets have in common: ("object", "27"), ("margin", "2 to 5 degrees"), ...
        targets: how many there are.
        recalls: by error, and "paper" with VSD.
    """

    group: str
    name: str
    targets: int
    recalls: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class Score:
    """How good a result file is.

    Attributes:
        judge: what was judged, and how.
        targets: all instances that were asked for.
        estimates: how many poses the file has.
    """

    judge: Judge
    targets: Sequence[Target]
    estimates: int

    @property
    def measured(self) -> tuple[str, ...]:
        """The errors, and "paper" with VSD."""
        return (*self.judge.errors, *(["paper"] if "vsd" in self.judge.errors else []))

    def recalls(self, targets: Iterable[Target]) -> dict[str, float]:
        """Average recall by error over some targets; 0 if there are none."""
        chosen = list(targets)
        return {
            name: float(np.mean([target.found[name].mean() for target in chosen])) if chosen else 0.0
            for name in self.measured
        }

    @cached_property
    def average_recalls(self) -> dict[str, float]:
        """Over all targets, by error; "paper" is the mean of the objects' recalls."""
        recalls = self.recalls(self.targets)
        if "paper" in recalls:
            recalls["paper"] = float(np.mean([row.recalls["paper"] for row in self.by_object()] or [0.0]))
        return recalls

    @property
    def average_recall(self) -> float:
        """BOP's AR: the mean over the errors."""
        return float(np.mean([self.average_recalls[error] for error in self.judge.errors]))

    def recall_curve(self, error: ErrorName) -> tuple[Floats, Floats]:
        """Thresholds (10,) and the recall (10,) below each; of VSD averaged over the tolerances."""
        found = np.array([target.found[error] for target in self.targets]).reshape(len(self.targets), -1, 10)
        recall = found.mean(axis=(0, 1)) if len(self.targets) else np.zeros(10)
        return PIXELS if error == "mspd" else SHARES, recall

    def by_object(self) -> list[Row]:
        """A row for each object that was asked for."""
        of: dict[int, list[Target]] = defaultdict(list)
        for target in self.targets:
            of[target.obj_id].append(target)
        return [Row("object", str(obj_id), len(of[obj_id]), self.recalls(of[obj_id])) for obj_id in sorted(of)]

    def rows(self) -> list[Row]:
        """By object, by margin, by elevation and by visible fraction; what the dataset does not say is left out."""
        return [
            *self.by_object(),
            *self._binned("margin", "degrees", _MARGINS_DEG, [target.margin_deg for target in self.targets]),
            *self._binned("elevation", "degrees", _ELEVATIONS_DEG, [target.elevation_deg for target in self.targets]),
            *self._binned("visible", "of it", _VISIBLE, [target.visib_fract for target in self.targets]),
        ]

    def _binned(self, group: str, unit: str, edges: Sequence[float], values: Sequence[float]) -> Iterator[Row]:
        for low, high in pairwise(edges):
            inside = [t for t, value in zip(self.targets, values, strict=True) if low <= value < high]
            if inside:
                yield Row(group, f"{low:g} to {high:.4g} {unit}", len(inside), self.recalls(inside))

    def to_json(self) -> dict[str, Any]:
        """Everything but the single targets, as plain values."""
        return {
            "average_recall": self.average_recall,
            "average_recalls": self.average_recalls,
            "targets": len(self.targets),
            "estimates": self.estimates,
            "true_z": self.judge.true_z,
            "symmetries": self.judge.symmetries,
            "depth": self.judge.depth,
            "rows": [
                {"group": row.group, "name": row.name, "targets": row.targets, "recalls": dict(row.recalls)}
                for row in self.rows()
            ],
        }


def score(judge: Judge, results: Path, workers: int | None = None) -> Score:
    """Judge a result file.

    Raises:
        UserError: the file is damaged or names an image or object that the dataset does not have (with the row), the
            dataset cannot be read, or it lacks what an error needs.
    """
    estimates = read_results(results)
    dataset = Dataset.open(judge.dataset, judge.split)
    of_image = _by_image(results, estimates, dataset, _models_folder(judge))
    images = list(of_image)
    shares = [images[i : i + _IMAGES_PER_TASK] for i in range(0, len(images), _IMAGES_PER_TASK)]
    tasks = [_Task(judge, tuple((place, tuple(of_image[place])) for place in share)) for share in shares]
    judged = each(_judge_task, tasks, workers, "images", "parts")
    return Score(judge, [target for targets in judged for target in targets], len(estimates))


def _by_image(
    results: Path, estimates: Iterable[Estimate], dataset: Dataset, models: Path
) -> dict[tuple[int, int], list[Estimate]]:
    """The estimates of every image of the dataset, by scene and number in it.

    Raises:
        UserError: an estimate is of an image or object that does not exist.
    """
    numbers = {
        (scene_id, int(im_id)): (scene_id, number)
        for scene_id in dataset.scene_ids
        for number, im_id in enumerate(dataset.scene(scene_id).poses.image_ids)
    }
    known = {int(obj_id) for scene in dataset.scenes() for obj_id in scene.poses.obj_ids} | set(
        read_models_info(models)
    )
    of_image: dict[tuple[int, int], list[Estimate]] = {place: [] for place in numbers.values()}
    for estimate in estimates:
        place = numbers.get((estimate.scene_id, estimate.im_id))
        row = f"{results}, row {estimate.row}"
        if place is None:
            raise UserError(
                f"{row}: image {estimate.im_id} of scene {estimate.scene_id} is not in {dataset.root / dataset.split}"
            )
        if estimate.obj_id not in known:
            raise UserError(f"{row}: object {estimate.obj_id} is not among the models of {models}")
        of_image[place].append(estimate)
    return of_image


class _Task(NamedTuple):
    """Some images, by scene and number in it, with their estimates."""

    judge: Judge
    images: tuple[tuple[tuple[int, int], tuple[Estimate, ...]], ...]


def _judge_task(task: _Task) -> list[Target]:
    jury = _jury(task.judge)
    return [
        target
        for (scene_id, number), estimates in task.images
        for target in jury.judge_image(jury.dataset.scene(scene_id).image(number), estimates)
    ]


@lru_cache(maxsize=1)
def _jury(judge: Judge) -> _Jury:
    """Models, trees and symmetries are made once in a process."""
    return _Jury(judge)


def _models_folder(judge: Judge) -> Path:
    return judge.models or find_models_folder(judge.dataset)


class _Jury:
    """Judges images; keeps what it needs of each object."""

    def __init__(self, judge: Judge) -> None:
        self.judge, self.dataset = judge, Dataset.open(judge.dataset, judge.split)
        self._models: dict[int, ObjectModel] = {}
        self._points: dict[int, ModelPoints] = {}
        self._surfaces: dict[int, Surface] = {}
        self._device = EmbreeDevice()

    def judge_image(self, image: Image, estimates: Sequence[Estimate]) -> list[Target]:
        """The targets of an image."""
        asked = [n for n in image.instances if n.visibility is None or n.visibility.visib_fract >= MIN_VISIB_FRACT]
        if not asked:
            return []
        camera = self._camera(image)
        found: dict[int, dict[str, NDArray[np.bool_]]] = {}
        scene_depth_mm = self._scene_depth(image, camera) if "vsd" in self.judge.errors and estimates else None
        for obj_id in sorted({instance.obj_id for instance in asked}):
            truths = [instance for instance in asked if instance.obj_id == obj_id]
            best = sorted((e for e in estimates if e.obj_id == obj_id), key=lambda e: -e.score)[: len(truths)]
            matched = self._match(image, camera, scene_depth_mm, best, truths)
            for i, truth in enumerate(truths):
                found[truth.gt_id] = {error: hits[i] for error, hits in matched.items()}
        return [
            Target(
                image.scene_id,
                image.im_id,
                instance.gt_id,
                instance.obj_id,
                np.nan if instance.label is None else instance.label.discontinuity_margin_deg,
                elevation_deg(image, instance),
                np.nan if instance.visibility is None else instance.visibility.visib_fract,
                found[instance.gt_id],
            )
            for instance in asked
        ]

    def _match(
        self,
        image: Image,
        camera: Intrinsics,
        scene_depth_mm: Floats | None,
        estimates: Sequence[Estimate],
        truths: Sequence[Instance],
    ) -> dict[str, NDArray[np.bool_]]:
        """By error, which of N true poses of one object were found, (N, ...) as in ``Target``."""
        pairs = [[self._poses(estimate, truth) for truth in truths] for estimate in estimates]
        obj_id, shape = truths[0].obj_id, (len(estimates), len(truths))
        matched: dict[str, NDArray[np.bool_]] = {}
        if "vsd" in self.judge.errors:
            errors = self._vsd(pairs, truths, camera, scene_depth_mm).reshape(*shape, len(SHARES) + 1)
            by_tau = [match(errors[..., tau], SHARES) for tau in range(len(SHARES))]
            matched["vsd"] = np.stack(by_tau, axis=1)
            matched["paper"] = match(errors[..., -1], np.array([PAPER_THRESHOLD]))[:, 0]
        if "mssd" in self.judge.errors:
            diameter = self._model(obj_id).diameter_mm
            mssd = [self._mssd(obj_id, *pair) / diameter for row in pairs for pair in row]
            matched["mssd"] = match(np.reshape(mssd, shape), SHARES)
        if "mspd" in self.judge.errors:
            scale = 640.0 / camera.width
            lens = (image.K, image.distortion)
            mspd = [scale * self._points_of(obj_id).mspd(*pair, *lens) for row in pairs for pair in row]
            matched["mspd"] = match(np.reshape(mspd, shape), PIXELS)
        return matched

    def _poses(self, estimate: Estimate, truth: Instance) -> tuple[RigidPose, RigidPose]:
        t = estimate.t_m2c
        if self.judge.true_z and t[2] > 0:
            t = t * (truth.t_m2c[2] / t[2])
        return RigidPose(estimate.R_m2c, t), RigidPose(truth.R_m2c, truth.t_m2c)

    def _mssd(self, obj_id: int, estimate: RigidPose, truth: RigidPose) -> float:
        if np.linalg.norm(estimate.t_m2c - truth.t_m2c) >= self._model(obj_id).diameter_mm:
            return float(np.inf)  # bop_toolkit's short cut
        return self._points_of(obj_id).mssd(estimate, truth)

    def _vsd(
        self,
        pairs: Sequence[Sequence[tuple[RigidPose, RigidPose]]],
        truths: Sequence[Instance],
        camera: Intrinsics,
        scene_depth_mm: Floats | None,
    ) -> Floats:
        """(E, N, 11): for BOP's tolerances, and for the paper's."""
        if not pairs or scene_depth_mm is None:
            return np.empty((0, len(truths), len(SHARES) + 1))
        model = self._model(truths[0].obj_id)
        surface = self._surface(model.obj_id)
        taus_mm = np.append(SHARES * model.diameter_mm, PAPER_TAU_MM)
        true_depth = [ObjectDepth.cast(surface, pairs[0][i][1], camera) for i in range(len(truths))]
        errors = np.ones((len(pairs), len(truths), len(taus_mm)))
        for e, row in enumerate(pairs):
            depth = None if self.judge.true_z else ObjectDepth.cast(surface, row[0][0], camera)
            for i, (estimate, truth) in enumerate(row):
                if silhouettes_may_overlap(model.diameter_mm / 2, estimate.t_m2c, truth.t_m2c):
                    seen = depth or ObjectDepth.cast(surface, estimate, camera)
                    errors[e, i] = vsd(seen, true_depth[i], scene_depth_mm, camera, taus_mm)
        return errors

    def _scene_depth(self, image: Image, camera: Intrinsics) -> Floats:
        if self.judge.depth == "image":
            return image.depth_mm()
        meshes = {("model", n.obj_id): self._model(n.obj_id) for n in image.instances}
        caster = RayCaster({key: (model.vertices_mm, model.faces) for key, model in meshes.items()})  # type: ignore[misc]
        posed = [PosedModel(n.obj_id, n.R_m2c, n.t_m2c) for n in image.instances]
        return caster.annotate(camera, None, posed).depth_mm

    def _camera(self, image: Image) -> Intrinsics:
        height, width = self._image_size(image)
        return image.camera(width, height)

    def _image_size(self, image: Image) -> tuple[int, int]:
        """Rows and columns: of the depth image, else of the colour image, else what camera.json says."""
        if image.paths.depth(image.im_id).exists():
            rows, columns = image.depth_mm().shape
            return rows, columns
        if image.paths.find_rgb(image.im_id) is not None:
            rows, columns, _ = image.rgb().shape
            return rows, columns
        path = self.dataset.root / CAMERA_FILE
        size = read_json(path)
        try:
            return int(size["height"]), int(size["width"])
        except (KeyError, TypeError, ValueError):
            raise UserError(f"{path}: says no width and height, and image {image.key} has no picture") from None

    def _model(self, obj_id: int) -> ObjectModel:
        if obj_id not in self._models:
            self._models |= load_models(_models_folder(self.judge), (obj_id,))
        return self._models[obj_id]

    def _points_of(self, obj_id: int) -> ModelPoints:
        if obj_id not in self._points:
            model = self._model(obj_id)
            motions = bop_motions(model.info)
            if self.judge.symmetries == "table":
                motions = self._table.canonical_map(obj_id).group.motions(CONTINUOUS_STEPS)
            self._points[obj_id] = ModelPoints(model.vertices_mm, motions)
        return self._points[obj_id]

    @cached_property
    def _table(self) -> SymmetryTable:
        return SymmetryTable.read(self.judge.dataset / SYMMETRIES_FILE)

    def _surface(self, obj_id: int) -> Surface:
        if obj_id not in self._surfaces:
            model = self._model(obj_id)
            self._surfaces[obj_id] = Surface(self._device, model.vertices_mm, model.faces)
        return self._surfaces[obj_id]


def match(errors: Floats, thresholds: Floats) -> NDArray[np.bool_]:
    """Which true poses are found, for each threshold: (N, T).

    Args:
        errors: (E, N) of E estimates, the surest first, against N true poses. Each estimate takes the true pose with
            the smallest error that is left, if that is below the threshold.
        thresholds: (T,).
    """
    found = np.zeros((errors.shape[1], len(thresholds)), dtype=bool)
    for number, threshold in enumerate(thresholds):
        for of_estimate in errors:
            left = np.where(found[:, number], np.inf, of_estimate)
            best = int(np.argmin(left))
            found[best, number] |= bool(left[best] < threshold)
    return found


def elevation_deg(image: Image, instance: Instance) -> float:
    """How high above the table's plane the camera is, seen from the object's origin; NaN without cam_R_w2c."""
    if image.R_w2c is None:
        return float(np.nan)
    to_camera = -instance.t_m2c / np.linalg.norm(instance.t_m2c)
    return float(np.degrees(np.arcsin(np.clip(to_camera @ image.R_w2c[:, 2], -1, 1))))
