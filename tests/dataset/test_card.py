"""The card: front matter that is YAML, numbers that are counted, text that nobody can break out of."""

from __future__ import annotations

import json
import re
import shutil
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
import valid_dataset
import yaml
from hypothesis import given
from hypothesis import strategies as st

from synthetless.config import load_recipe
from synthetless.dataset.card import escape, write_card
from synthetless.dataset.layout import CARD_FILE, ScenePaths
from synthetless.dataset.records import read_scene_json
from synthetless.dataset.store import DatasetStore
from synthetless.exports.webdataset import export_webdataset
from synthetless.io.models import load_models

pytestmark = pytest.mark.usefixtures("small_scene_folders")


def _card(dataset: Path) -> tuple[dict[str, Any], str]:
    write_card(dataset)
    text = (dataset / CARD_FILE).read_text()
    _, front, body = text.split("---\n", 2)
    return yaml.safe_load(front), body


@pytest.fixture
def copy(valid: Path, tmp_path: Path) -> Path:
    root = tmp_path / "d"
    shutil.copytree(valid, root)
    return root


def _change_recipe(root: Path, **changes: Any) -> None:
    path = root / "dataset.json"
    header = json.loads(path.read_text())
    for key, value in changes.items():
        node = header["recipe"]["source"] if key in header["recipe"]["source"] else header["recipe"]
        node[key] = value
    path.write_text(json.dumps(header))


def test_front_matter_is_what_hugging_face_reads(copy: Path) -> None:
    front, _ = _card(copy)
    assert front == {
        "license": "cc0-1.0",
        "task_categories": ["object-detection", "keypoint-detection", "image-segmentation", "depth-estimation"],
        "tags": ["6d-pose-estimation", "bop", "synthetic", "symmetry", "texture-less"],
        "pretty_name": "synthetless",
        "size_categories": ["n<1K"],
        "configs": [{"config_name": "default", "data_files": [{"split": "train", "path": "**/shard-*.tar"}]}],
    }


@pytest.mark.parametrize("folder", ["shards", "dataset"])
def test_hugging_face_loads_a_folder_by_its_card(
    copy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, folder: str
) -> None:
    """The shards alone, as they are uploaded, and a dataset's folder that has them somewhere in it."""
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    datasets = pytest.importorskip("datasets", reason="datasets is not installed; extra 'interop' has it")
    write_card(copy)
    export_webdataset(copy, copy / "shards", workers=1)
    place = {"shards": copy / "shards", "dataset": copy}[folder]
    loaded = datasets.load_dataset(str(place), split="train", cache_dir=str(tmp_path / "cache"))
    assert len(loaded) == valid_dataset.IMAGES
    assert {"rgb.png", "depth.png", "gt.json", "gt_canonical.json"} <= set(loaded.column_names)


def test_the_card_says_what_visible_means(copy: Path) -> None:
    assert "| visible | what is the nearest surface |" in _card(copy)[1]
    path = copy / "dataset.json"
    header = json.loads(path.read_text())
    header["recipe"]["labels"]["visibility_delta_mm"] = 5
    path.write_text(json.dumps(header))
    assert "| visible | what is the nearest surface, or up to 5 mm behind it" in _card(copy)[1]


def test_statistics_are_counted(copy: Path) -> None:
    _, body = _card(copy)
    instances: Counter[int] = Counter()
    for scene_id in (1, 2):
        gt = read_scene_json(ScenePaths.of(copy, scene_id).scene_gt)
        instances.update(entry["obj_id"] for entries in gt.values() for entry in entries)
    rows = re.findall(r"^\| (\d+) \| (\S+) \| (\d+) \| [\d.]+% \| (\d+) \| ([\d% /]+) \|$", body, re.MULTILINE)
    assert {int(row[0]): int(row[2]) for row in rows} == instances
    assert [(row[1], row[3]) for row in rows] == [("C1", "1"), ("O(2)", "2"), ("C2", "2")]
    assert all(98 <= sum(map(int, re.findall(r"\d+", row[4]))) <= 102 for row in rows)
    assert f"{valid_dataset.IMAGES} synthetic images with {instances.total()} instances of 3 objects" in body


def test_the_same_dataset_gives_the_same_card(copy: Path) -> None:
    write_card(copy)
    first = (copy / CARD_FILE).read_bytes()
    write_card(copy)
    assert (copy / CARD_FILE).read_bytes() == first
    assert str(copy).encode() not in first


@pytest.mark.parametrize(
    ("licence", "expected"),
    [
        ("T-LESS by T. Hodan et al., CC BY-SA 4.0", "cc-by-sa-4.0"),
        ("CC BY 4.0 says one, CC BY-SA 4.0 the other", "other"),
        ("ask my boss", "other"),
        ("MIT", "mit"),
        ("submitted", "other"),
    ],
)
def test_licences_are_named_as_hugging_face_does(copy: Path, licence: str, expected: str) -> None:
    _change_recipe(copy, licence=licence)
    front, body = _card(copy)
    assert front["license"] == expected
    assert escape(licence) in body


def test_an_unknown_licence_is_said_to_be_unknown(copy: Path) -> None:
    _change_recipe(copy, licence="", models="/data/parts")
    front, body = _card(copy)
    assert front["license"] == "unknown"
    assert "does not state a licence" in body
    assert "/data/parts" not in body, "a card tells nothing of the machine"


def test_built_in_parts_and_textures_are_free(copy: Path) -> None:
    _change_recipe(copy, licence="")
    front, body = _card(copy)
    assert front["license"] == "cc0-1.0"
    assert "own work" in body


def test_text_cannot_break_out(copy: Path) -> None:
    nasty = 'x: [1, 2] # "y"\n---\n# Title\n| a | <script>alert(1)</script> [l](http://x) `code` ${1}'
    _change_recipe(copy, name=nasty, licence=nasty)
    front, body = _card(copy)
    assert front["pretty_name"] == " ".join(nasty.split())
    assert "<script>" not in body
    assert body.count("\n# ") == 1
    assert re.findall(r"(?<!\\)\]\(http://x", body) == []


@given(st.text())
def test_escaped_text_is_one_line_without_active_characters(text: str) -> None:
    escaped = escape(text)
    assert "\n" not in escaped
    assert re.sub(r"\\[!-/:-@\[-`{-~]", "", escaped).find("<") == -1
    assert re.sub(r"\\([!-/:-@\[-`{-~])", r"\1", escaped) == " ".join(text.split())


def test_an_empty_dataset_has_a_card(tmp_path: Path, parts: Path) -> None:
    recipe = load_recipe(None, valid_dataset.RECIPE)
    DatasetStore.open(tmp_path / "d", recipe, load_models(parts), "").assemble()
    _, body = _card(tmp_path / "d")
    assert "0 synthetic images with 0 instances of 0 objects (0.0 an image)" in body


def test_a_dataset_without_pictures_has_a_card(tmp_path: Path, parts: Path) -> None:
    valid_dataset.write_dataset(tmp_path / "d", parts, ("outputs=[]",))
    front, body = _card(tmp_path / "d")
    assert front["task_categories"] == ["object-detection"]
    assert "`depth/`" not in body
