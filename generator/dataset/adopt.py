"""Labels for a BOP dataset that others made: real images and synthetic ones then train a network alike."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from synthetless.dataset.changes import changes, complete
from synthetless.dataset.labelling import LabelledScene, label_folders, laid_out, scene_folders
from synthetless.dataset.layout import DATASET_FILE, SYMMETRIES_FILE, ScenePaths
from synthetless.dataset.relabel import revised
from synthetless.errors import UserError
from synthetless.io.files import locked, read_json
from synthetless.io.models import INFO_FILE, read_models_info
from synthetless.symmetry import SymmetryTable
from synthetless.symmetry.atlas import Scheme

_MODELS_FOLDERS = ("models", "models_cad", "models_eval")
_TABLE_KEYS = {"scheme", "allocentric", "objects"}


@dataclass(frozen=True)
class Adoption:
    """What an adopted dataset holds.

    Attributes:
        models: the folder whose models_info.json the boxes, and by default the symmetries, are from.
        table: what the labels were made with.
        splits: names of the folders that were labelled.
        scenes, images, instances: in them.
        written: scene folders whose labels are other than before.
    """

    models: Path
    table: SymmetryTable
    splits: tuple[str, ...]
    scenes: int
    images: int
    instances: int
    written: int

    def __str__(self) -> str:
        return (
            f"{self.instances} instances in {self.images} images of {', '.join(self.splits)}, scheme "
            f"{self.table.scheme}, models of {self.models}; {self.written} of {self.scenes} scene folders changed"
        )


def adopt(
    root: Path,
    models: Path | None = None,
    symmetries: Path | None = None,
    scheme: Scheme | None = None,
    workers: int | None = None,
) -> Adoption:
    """Put scene_gt_canonical.json into every scene folder that has a scene_gt.json, and symmetries.json into ``root``.

    No other file is written, and images are not looked at. All of it is written, or after a mistake nothing; the
    result depends on the arguments alone, so that the same call again changes nothing and another one relabels.
    If the process is killed while the files take their places, the next call first does the rest.

    Args:
        root: folder of a BOP dataset, which holds SPLIT/%06d.
        models: folder with the models_info.json to use; by default models, models_cad or models_eval in ``root``.
        symmetries: a symmetry table, or a models_info.json; objects that it does not name have the symmetries that
            the models_info.json of ``models`` declares.
        scheme: None for what ``symmetries`` states, and else pitteri2019.
        workers: as in ``relabel``.

    Raises:
        UserError: this is no BOP dataset, or one that is damaged; the symmetries are none, or of other objects; a
            file that is to be written exists and is somebody else's.
    """
    scenes = _scenes(root)
    models = models or models_folder(root)
    models_info = read_models_info(models)
    try:
        declared = SymmetryTable.from_models_info(models_info)
    except ValueError as error:
        raise UserError(f"{models / INFO_FILE}: {error}") from None
    table = revised(declared, symmetries, scheme, models_info)
    with locked(root):
        complete(root)
        _refuse_foreign(root, scenes)
        with changes(root) as draft:
            labelled = label_folders(scenes, table, models_info, workers=workers)
            counts = [_counted(scene) for scene in laid_out(labelled, root, draft)]
            table.write(draft / SYMMETRIES_FILE)
    splits = tuple(sorted({scene.root.parent.name for scene in scenes}))
    images, instances, written = map(sum, zip(*counts, strict=True))
    return Adoption(models, table, splits, len(scenes), images, instances, written)


def models_folder(root: Path) -> Path:
    """The folder with the models_info.json of a BOP dataset.

    Raises:
        UserError: there is none in any of the places where BOP has it.
    """
    for name in _MODELS_FOLDERS:
        if (root / name / INFO_FILE).exists():
            return root / name
    raise UserError(f"{root}: holds no {INFO_FILE} in {', '.join(_MODELS_FOLDERS)}; name the models folder")


def _scenes(root: Path) -> list[ScenePaths]:
    if not root.is_dir():
        raise UserError(f"{root}: no such folder; give that of a BOP dataset")
    if (root / DATASET_FILE).exists():
        raise UserError(f"{root}: holds a {DATASET_FILE}: synthetless made it, so use relabel")
    scenes = scene_folders(root, ("scene_gt.json",))
    if not scenes:
        raise UserError(f"{root}: holds no ground truth of a BOP dataset, such as test_primesense/000001/scene_gt.json")
    return scenes


def _refuse_foreign(root: Path, scenes: list[ScenePaths]) -> None:
    """A file of ours is replaced, one of somebody else's is not. Labels are ours if there is a table beside them."""
    path = root / SYMMETRIES_FILE
    if path.exists():
        if read_json(path).keys() != _TABLE_KEYS:
            raise UserError(f"{path}: is no symmetry table of synthetless and would be overwritten; move it away")
        return
    for scene in scenes:
        if scene.scene_gt_canonical.exists():
            raise UserError(
                f"{scene.scene_gt_canonical}: exists, but no {SYMMETRIES_FILE} that tells what it means, and would be "
                "overwritten; move it away"
            )


def _counted(scene: LabelledScene) -> tuple[int, int, int]:
    return scene.images, sum(tally.instances for tally in scene.tallies.values()), int(scene.content is not None)
