"""Names of parts, from where they are given to everything that shows them."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
import trimesh
import valid_dataset
import yaml

from synthetless.errors import UserError
from synthetless.exports.bop import export_bop
from synthetless.exports.coco import export_coco
from synthetless.exports.yolo import export_yolo
from synthetless.io.files import read_json
from synthetless.io.models import load_models
from synthetless.preview.write import class_name
from synthetless.symmetry.detection import detect_folder
from synthetless.validation import validate

NAMES = {1: "angle", 3: "fuse *box*"}


def _named(folder: Path, parts: Path, text: str | None = None) -> Path:
    shutil.copytree(parts, folder)
    (folder / "names.yaml").write_text(yaml.safe_dump(NAMES) if text is None else text)
    return folder


@pytest.fixture(scope="module")
def named(parts: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("named")
    valid_dataset.write_dataset(folder / "d", _named(folder / "models", parts), ["images=2"]).finish()
    return folder / "d"


def test_a_dataset_of_named_parts_says_their_names_everywhere(named: Path, tmp_path: Path) -> None:
    coco = read_json(named / "train_synthetless" / "000001" / "scene_gt_coco.json")
    assert [category["name"] for category in coco["categories"]] == ["angle", "2", "fuse *box*"]
    infos = {int(key): info for key, info in read_json(named / "models" / "models_info.json").items()}
    assert [class_name(obj_id, info) for obj_id, info in infos.items()] == ["1 angle", "2", "3 fuse *box*"]
    assert r"| 3 fuse \*box\* |" in (named / "README.md").read_text()
    export_yolo(named, tmp_path / "y", classes="regressor", val_percent=0, workers=1)
    names = yaml.safe_load((tmp_path / "y" / "data.yaml").read_text())["names"]
    assert list(names.values()) == ["angle", "2_r0", "2_r1", "fuse *box*_r0", "fuse *box*_r1"]
    report = validate(named, exports=[tmp_path / "y"], workers=1)
    assert report.valid, report.lines()


def test_names_that_come_later_reach_the_exports(valid: Path, tmp_path: Path) -> None:
    root = shutil.copytree(valid, tmp_path / "d")
    (root / "models" / "names.yaml").write_text("2: pin\n")
    export_coco(root, tmp_path / "coco.json")
    assert [category["name"] for category in read_json(tmp_path / "coco.json")["categories"]] == ["1", "pin", "3"]
    exported = export_bop(root, tmp_path, workers=1)
    assert read_json(exported / "models_cad" / "models_info.json")["2"]["name"] == "pin"
    with valid_dataset.small_scene_folders():
        report = validate(root, exports=[tmp_path / "coco.json", exported], workers=1)
    assert report.valid, report.lines()


def test_detection_takes_names_from_files_or_from_names_yaml(tmp_path: Path) -> None:
    (tmp_path / "cad").mkdir()
    for name, length in (("arm", 30), ("box", 40)):
        corners = [[0, 0, 0], [length, 0, 0], [0, 20, 0], [0, 0, 10]]
        wedge = trimesh.Trimesh(corners, [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
        wedge.export(tmp_path / "cad" / f"{name}.ply")
    for yaml_text, expected in ((None, ["arm", "box"]), ("2: fuse", ["arm", "fuse"])):
        if yaml_text:
            (tmp_path / "cad" / "names.yaml").write_text(yaml_text)
        out = tmp_path / str(yaml_text)
        detect_folder(tmp_path / "cad", workers=1).write_models(out)
        assert [info["name"] for info in json.loads((out / "models_info.json").read_text()).values()] == expected
    assert [model.info["name"] for model in load_models(tmp_path / "2: fuse").values()] == ["arm", "fuse"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[a, b]", "object ids and names are needed"),
        ("gear: 1", "the key 'gear' is no object id"),
        ("1: 2", "object 1 is called 2; a name of one line is needed"),
        ('1: "a\\nb"', "a name of one line is needed"),
        ("1: ''", "a name of one line is needed"),
        ("1: pin\n2: pin", "'pin' is the name of two objects"),
        ("7: pin", "object 7 has a name, but no entry in models_info.json"),
        ("1: pin\n1: nut", "twice"),
    ],
)
def test_wrong_names_are_refused(parts: Path, tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(UserError, match=message):
        load_models(_named(tmp_path / "m", parts, text))
