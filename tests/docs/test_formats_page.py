"""docs/formats.md: the snippets that need packages which are seldom installed; test_docs.py runs the others."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from packages import package_or_skip, torchvision_or_skip

from synthetless.exports.coco import export_coco
from synthetless.exports.webdataset import export_webdataset

PAGE = Path(__file__).resolve().parents[2] / "docs" / "formats.md"

Snippet = Callable[..., Any]


@pytest.fixture
def snippet(dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Snippet]:
    """Gives a function of the page, in a folder where the page's commands were given."""

    def find(name: str) -> Snippet:
        webdataset = package_or_skip("webdataset", "extra 'dev' has it")
        shutil.copytree(dataset, tmp_path / "out" / "demo")
        export_coco(dataset, tmp_path / "out" / "demo" / "coco.json")
        export_webdataset(dataset, tmp_path / "out" / "shards", images_per_shard=2, shuffle_seed=0, workers=1)
        monkeypatch.chdir(tmp_path)
        names = {"webdataset": webdataset, "shards": sorted(map(str, Path("out/shards").glob("shard-*.tar")))}
        (block,) = re.findall(rf"^```python\n(def {name}\(.*?)^```$", PAGE.read_text(), re.DOTALL | re.MULTILINE)
        exec(block, names)
        function: Snippet = names[name]
        return function

    return find


def test_torchvision(snippet: Callable[[str], Snippet]) -> None:
    torchvision_or_skip()
    images = list(snippet("torchvision_images")())
    assert len(images) == 6
    for _, target in images:
        assert len(target["boxes"]) == len(target["masks"]) == len(target["labels"]) > 0


@pytest.mark.parametrize("workers", [0, 2])
def test_torch(snippet: Callable[[str], Snippet], workers: int) -> None:
    package_or_skip("torch")
    samples = [sample for batch in snippet("torch_batches")(workers) for sample in batch]
    assert len({sample["__key__"] for sample in samples}) == len(samples) == 6
    for sample in samples:
        assert sample["rgb.png"].shape == (3, 48, 64)
        assert len(sample["gt_canonical.json"]) == len(sample["gt.json"])


def test_hugging_face(snippet: Callable[[str], Snippet], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setenv("HF_HOME", str(tmp_path / "hf"))
    package_or_skip("datasets")
    rows = list(snippet("hugging_face_images")())
    assert len({row["__key__"] for row in rows}) == 6
    assert all(len(row["gt_canonical.json"]) == len(row["gt.json"]) for row in rows)
