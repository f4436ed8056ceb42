"""render writes a new file: neither over what the dataset consists of, nor over what is there already."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from trees import contents

SPLIT = "train_synthetless"
PLACES = (
    "z",
    "z/dataset.json",
    "z/new.png/../symmetries.json",
    "z/models/obj_000001.ply",
    "z/models/new.png",
    f"z/{SPLIT}/000001/rgb/000000.png",
    f"z/{SPLIT}/000001/new.png",
    "z/.records/000001/000000.json",
    "alias/dataset.json",
    "link.png",
    ".",
    "photograph.jpg",
    "rendered.png",
    "folder",
)


@pytest.fixture
def place(valid: Path, tmp_path: Path) -> Path:
    """A folder with a dataset, links to it, and files of the user's."""
    shutil.copytree(valid, tmp_path / "z")
    (tmp_path / "alias").symlink_to(tmp_path / "z")
    (tmp_path / "link.png").symlink_to(tmp_path / "z" / "dataset.json")
    for name in ("photograph.jpg", "rendered.png"):
        (tmp_path / name).write_text("mine")
    (tmp_path / "folder").mkdir()
    return tmp_path


@pytest.mark.parametrize("to", PLACES)
def test_nothing_is_replaced(
    place: Path, to: str, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    before = contents(place)
    code, told = _run(["render", place / "z", 1, 0, "--to", place / to], monkeypatch, capfd)
    assert code == 2
    assert told.count("\n") == 1
    assert "belongs to the dataset" in told or "holds the dataset" in told or "exists already; give a new name" in told
    assert contents(place) == before


def _run(
    arguments: list[object], monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> tuple[int, str]:
    from synthetless.cli.app import main

    monkeypatch.setattr("sys.argv", ["synthetless", *map(str, arguments)])
    with pytest.raises(SystemExit) as stop:
        main()
    return int(stop.value.code or 0), capfd.readouterr().err
