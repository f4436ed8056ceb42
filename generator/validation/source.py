"""What the whole dataset rests on: dataset.json, camera.json, the models and the symmetries."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from synthetless.config import Recipe
from synthetless.dataset import records
from synthetless.dataset.labels import is_half_labelled
from synthetless.dataset.layout import (
    CAMERA_FILE,
    DATASET_FILE,
    MODELS_FOLDER,
    SYMMETRIES_FILE,
    ImagePlan,
    ScenePaths,
    plan_image,
)
from synthetless.dataset.records import Entry
from synthetless.io.files import read_json
from synthetless.symmetry import SymmetryTable
from synthetless.validation.geometry import Shape
from synthetless.validation.models import read_models
from synthetless.validation.report import Finding, bare
from synthetless.validation.schemas import CameraFile, Header, faults


@dataclass(frozen=True, eq=False)
class Source:
    """What every scene is held against; travels to the worker processes.

    Attributes:
        root: the dataset's folder.
        recipe: what was made.
        infos: models_info.json by object id.
        shapes: of the models that can be read.
        labelled: whether symmetries.json can be read and covers every model.
    """

    root: Path
    recipe: Recipe
    infos: Mapping[int, Entry]
    shapes: Mapping[int, Shape]
    labelled: bool

    @property
    def symmetries(self) -> Path | None:
        """The table that labels can be recomputed from, if they can."""
        return self.root / SYMMETRIES_FILE if self.labelled else None

    def scene(self, scene_id: int) -> ScenePaths:
        """The files of a scene folder."""
        return ScenePaths.of(self.root, scene_id, self.recipe.split)

    def has(self, output: str) -> bool:
        """Whether the recipe asks for files of this kind."""
        return output in self.recipe.outputs


def read_header(root: Path) -> tuple[Header | None, list[Finding]]:
    """dataset.json, without which nothing else can be judged."""
    path = root / DATASET_FILE
    if not path.exists():
        return None, [Finding("missing", path, "not there; generate writes it, and nothing can be judged without it")]
    try:
        return Header.model_validate(read_json(path)), []
    except ValidationError as error:
        faults_ = [
            f"{'.'.join(map(str, fault['loc']))}: {fault['msg'][0].lower()}{fault['msg'][1:]}"
            for fault in error.errors(include_url=False)
        ]
        return None, [Finding("schema", path, fault) for fault in faults_]
    except ValueError as error:
        return None, [Finding("unreadable", path, bare(error, path))]


def read_source(root: Path, header: Header) -> tuple[Source, list[Finding]]:
    """Read and check everything outside the scene folders."""
    findings: list[Finding] = []
    models = read_models(root / MODELS_FOLDER, header.models_sha256)
    findings += models.findings
    findings += _check_camera_file(root / CAMERA_FILE, header.recipe)
    labelled = _check_symmetries(root, header, sorted(models.infos), findings)
    return Source(root, header.recipe, models.infos, models.shapes, labelled), findings


def plans_by_scene(recipe: Recipe) -> dict[int, list[ImagePlan]]:
    """Every image that the recipe asks for, by scene folder."""
    plans: dict[int, list[ImagePlan]] = {}
    for number in range(recipe.images):
        plan = plan_image(number, recipe.camera.views_per_drop)
        plans.setdefault(plan.scene_id, []).append(plan)
    return plans


def check_folders(root: Path, recipe: Recipe, scenes: Sequence[int]) -> Iterator[Finding]:
    """Scene folders that are missing or foreign, leftovers of interrupted writing, and the marker of a relabelling."""
    if is_half_labelled(root):
        message = "the dataset is half relabelled: relabel was killed while the files took their places; run it again"
        yield Finding("stale", root / SYMMETRIES_FILE, message)
    for path in sorted(root.glob(".*.part")):
        yield Finding("stray", path, "left over from an interrupted write; it can be deleted")
    split = root / recipe.split
    expected = {f"{scene_id:06d}" for scene_id in scenes}
    found = {path.name for path in split.iterdir()} if split.is_dir() else set()
    for name in sorted(expected - found):
        yield Finding("missing", split / name, f"no such scene folder; the recipe's {recipe.images} images need it")
    for name in sorted(found - expected):
        yield Finding("stray", split / name, f"belongs to none of the recipe's {recipe.images} images")


def check_counts(root: Path, header: Header, images: int, instances: int) -> Iterator[Finding]:
    """dataset.json's totals against what the scene folders hold."""
    for name, stated, found in (
        ("images", header.counts.images, images),
        ("instances", header.counts.instances, instances),
    ):
        if stated != found:
            yield Finding("counts", root / DATASET_FILE, f"counts {stated} {name}; the scene folders hold {found}")


def _check_camera_file(path: Path, recipe: Recipe) -> Iterator[Finding]:
    if not path.exists():
        yield Finding("missing", path, "not there; BOP's readers need it")
        return
    try:
        content = read_json(path)
    except ValueError as error:
        yield Finding("unreadable", path, bare(error, path))
        return
    bad = [Finding("schema", path, fault.message) for fault in faults(TypeAdapter(CameraFile), content)]
    yield from bad
    if not bad:
        expected: Mapping[str, Any] = records.camera_json(recipe.intrinsics, recipe.encoding.depth_scale)
        for key, value in expected.items():
            if content[key] != value:
                yield Finding("camera", path, f"{key} is {content[key]}; the recipe has {value}")


def _check_symmetries(root: Path, header: Header, obj_ids: Sequence[int], findings: list[Finding]) -> bool:
    """Check symmetries.json; whether labels can be recomputed from it."""
    path = root / SYMMETRIES_FILE
    if not path.exists():
        findings.append(Finding("missing", path, "not there; without it nobody knows what the labels mean"))
        return False
    try:
        table = SymmetryTable.read(path)
    except ValueError as error:
        findings.append(Finding("symmetries", path, bare(error, path)))
        return False
    if table.digest() != header.symmetries.sha256:
        findings.append(
            Finding(
                "stale",
                path,
                f"is not what {DATASET_FILE} says the labels were made with (SHA-256 {table.digest()[:12]}..., "
                f"there {header.symmetries.sha256[:12]}...): it was edited since; run relabel",
            )
        )
    if table.scheme != header.symmetries.scheme:
        findings.append(
            Finding("stale", path, f"has the scheme {table.scheme}, {DATASET_FILE} {header.symmetries.scheme}")
        )
    missing = sorted(set(obj_ids) - table.entries.keys())
    if missing:
        findings.append(Finding("symmetries", path, f"has no entry for object {', '.join(map(str, missing))}"))
    return not missing
