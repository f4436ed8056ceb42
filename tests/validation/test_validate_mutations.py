"""Each kind of damage, done alone to a valid dataset, is found and its place is named."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import damages_of_images
import damages_of_labels
import damages_of_poses
import damages_of_records
import numpy as np
import pytest
from damage_kit import DAMAGES, Damage, Victim

from synthetless.dataset.layout import RECORDS_FOLDER
from synthetless.validation import validate

MODULES = (damages_of_images, damages_of_labels, damages_of_poses, damages_of_records)


def test_a_valid_dataset_has_no_finding(valid: Path) -> None:
    report = validate(valid, workers=1)
    assert report.lines()[:-1] == []
    assert report.valid
    assert (report.images, report.recomputed_images) == (6, 6)


def test_there_are_enough_damages() -> None:
    assert {damage.act.__module__ for damage in DAMAGES} == {module.__name__ for module in MODULES}
    assert len({damage.name for damage in DAMAGES}) == len(DAMAGES) >= 40


@pytest.mark.parametrize("damage", DAMAGES, ids=lambda damage: damage.name)
def test_damage_is_found_in_its_place(valid: Path, tmp_path: Path, damage: Damage) -> None:
    root = tmp_path / "dataset"
    shutil.copytree(valid, root)
    damage.act(Victim(root))
    if damage.deep:
        shutil.rmtree(root / RECORDS_FOLDER)  # they would betray it
        assert validate(root, sample=0, workers=1).valid, "only recomputing tells"
    report = validate(root, workers=1)
    places = [(f.kind, str(f.file.relative_to(root)), f.image, f.instance) for f in report.findings]
    assert (damage.kind, damage.file, damage.image, damage.instance) in places, report.lines()


def test_a_copy_without_records_is_valid(valid: Path, tmp_path: Path) -> None:
    root = tmp_path / "dataset"
    shutil.copytree(valid, root, ignore=shutil.ignore_patterns(RECORDS_FOLDER))
    assert validate(root, workers=1).valid


FILES = (
    "dataset.json",
    f"{RECORDS_FOLDER}/000001/000001.json",
    "camera.json",
    "symmetries.json",
    "models/models_info.json",
    "models/obj_000001.ply",
    "scene_camera.json",
    "scene_gt.json",
    "scene_gt_info.json",
    "scene_gt_coco.json",
    "scene_gt_canonical.json",
    "scene_spec.jsonl",
    "rgb/000001.png",
    "depth/000001.png",
    "mask/000001_000002.png",
    "mask_visib/000001_000002.png",
)


@pytest.mark.parametrize("left", [0, 0.5, 1])
@pytest.mark.parametrize("name", FILES)
def test_a_cut_file_is_named(valid: Path, tmp_path: Path, name: str, left: float) -> None:
    """Empty, half there, or without the last bytes."""
    root = tmp_path / "dataset"
    shutil.copytree(valid, root)
    path = next(path for path in (root / name, root / "train_synthetless/000001" / name) if path.exists())
    data = path.read_bytes()
    path.write_bytes(data[: int(left * (len(data) - 3))])
    report = validate(root, workers=1)
    assert path in {finding.file for finding in report.findings}, report.lines()


@pytest.mark.parametrize("seed", range(40))
def test_no_damage_is_too_much(valid: Path, tmp_path: Path, seed: int) -> None:
    """A JSON value replaced by one of another kind anywhere: validate ends with a report, never with an error."""
    rng = np.random.default_rng(seed)
    root = tmp_path / "dataset"
    shutil.copytree(valid, root)
    path = root / rng.choice([name for name in FILES if name.endswith("json")])
    path = path if path.exists() else root / "train_synthetless/000001" / path.name
    content = json.loads(path.read_text())
    node: Any = content
    while True:
        key = rng.choice(list(node)) if isinstance(node, dict) else int(rng.integers(len(node)))
        if not isinstance(node[key], dict | list) or not node[key] or rng.random() < 0.1:
            break
        node = node[key]
    values: list[Any] = [None, "", "x", -1, 0.5, 1e300, 10**30, [], {}, [1], {"a": 1}, True]
    node[key] = values[rng.integers(len(values))]
    path.write_text(json.dumps(content))
    validate(root, workers=1).lines()


ODD_INFOS = ["{}", "[]", "null", "5", '{"1": 5}', '{"1": []}', '{"x": {}}', '{"1": {}}', '{"1": {"size_x": [30]}}', "{"]


@pytest.mark.parametrize("text", ODD_INFOS)
def test_an_odd_models_info_is_a_finding(valid: Path, tmp_path: Path, text: str) -> None:
    root = tmp_path / "dataset"
    shutil.copytree(valid, root)
    (root / "models/models_info.json").write_text(text)
    report = validate(root, workers=1)
    assert "models_info.json" in "\n".join(report.lines())
    assert (report.images, report.instances) == (6, 34)


@pytest.mark.parametrize("key", ["size_x", "diameter", "symmetries_discrete", "symmetries_continuous"])
@pytest.mark.parametrize("value", [[30], {}, "30", float("nan"), [[[]]], -1e400])
def test_an_odd_value_of_an_object_is_a_finding(valid: Path, tmp_path: Path, key: str, value: Any) -> None:
    root = tmp_path / "dataset"
    shutil.copytree(valid, root)
    with Victim(root).json(root / "models/models_info.json") as infos:
        infos["2"][key] = value
    found = [f for f in validate(root, workers=1).findings if f.file.name == "models_info.json"]
    assert found and all(f.message.startswith("object 2") for f in found), found
