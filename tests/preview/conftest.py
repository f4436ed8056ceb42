"""A dataset without Blender and its preview, made once; a browser to look at it with."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from valid_dataset import write_dataset, write_models

from synthetless.dataset.ambiguity import write_ambiguity
from synthetless.dataset.layout import DATASET_FILE, ScenePaths, scene_ids
from synthetless.dataset.reader import ImageEntries, read_entries
from synthetless.dataset.relabel import relabel
from synthetless.preview import write_preview
from tests.preview import chromium

HOSTILE_NAME = "<script>document.title='owned'</script> \"quotes\" ' & ../slash\\ ünï☃"
HOSTILE_OBJECT = "</script><img src=x onerror=\"console.error('owned')\"> 'q' \"\u2028\""


@dataclass(frozen=True)
class SmallImage:
    """An image of the small dataset: what the pages call it, and where its files are."""

    key: str
    scene: ScenePaths
    labels: ImageEntries


def images_of(dataset: Path) -> list[SmallImage]:
    """All images of a dataset, in order."""
    scenes = [ScenePaths.of(dataset, scene_id) for scene_id in scene_ids(dataset)]
    return [
        SmallImage(f"{scene.root.name}/{labels.im_id:06d}", scene, labels)
        for scene in scenes
        for labels in read_entries(scene)
    ]


@pytest.fixture(scope="session")
def small_dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six images with every output, in several scene folders."""
    pytest.importorskip("jinja2", reason="jinja2 is not installed")
    folder = tmp_path_factory.mktemp("small")
    models = write_models(folder / "models")
    overrides = ["outputs=[rgb,depth,masks,normals]", f"name={json.dumps(HOSTILE_NAME)}"]
    root = write_dataset(folder / "dataset", models, overrides).root
    path = root / "models" / "models_info.json"
    infos = json.loads(path.read_text())
    infos["1"]["name"] = HOSTILE_OBJECT
    path.write_text(json.dumps(infos))
    assert json.loads((root / DATASET_FILE).read_text())["name"] == HOSTILE_NAME
    return root


@pytest.fixture(scope="session")
def small_preview(small_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of its preview."""
    return write_preview(small_dataset, tmp_path_factory.mktemp("preview") / "a folder #1 of 100%")


@pytest.fixture(scope="session")
def judged_dataset(small_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small dataset, its cylinder taken for one without symmetries, and judged by ``ambiguity``."""
    root = tmp_path_factory.mktemp("judged") / "dataset"
    shutil.copytree(small_dataset, root)
    (root.parent / "table.yaml").write_text("{2: {group: C1, quasi: SO(2)}, 3: {group: C2, quasi: D2}}")
    relabel(root, root.parent / "table.yaml", workers=1)
    write_ambiguity(root, with_poses=True, workers=1)
    return root


@pytest.fixture(scope="session")
def judged_preview(judged_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of its preview."""
    return write_preview(judged_dataset, tmp_path_factory.mktemp("preview of judged") / "pages", workers=1)


@pytest.fixture(scope="session")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    yield from chromium.start(tmp_path_factory.mktemp("profile"))
