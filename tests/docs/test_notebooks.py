"""The notebooks run as they are printed, and are printed as they ran."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

nbformat = pytest.importorskip("nbformat", reason="nbformat is not installed; extra 'notebooks' has it")
nbclient = pytest.importorskip("nbclient", reason="nbclient is not installed; extra 'notebooks' has it")
pytest.importorskip("ipykernel", reason="ipykernel, which runs notebooks, is not installed; extra 'notebooks' has it")

NOTEBOOKS = sorted((Path(__file__).resolve().parents[2] / "docs" / "notebooks").glob("*.ipynb"))


def _read(path: Path) -> Any:
    return nbformat.read(path, 4)


def _texts(notebook: Any) -> list[str]:
    """What its cells print, apart from pictures."""
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    return [output["text"] for output in outputs if output["output_type"] == "stream"]


@pytest.mark.blender
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_can_be_run(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also: what it prints is what is printed in it, apart from what another machine's floating point may change."""
    pytest.importorskip("bpy", reason="the notebooks need Blender, extra 'blender'")
    pytest.importorskip("matplotlib", reason="the notebooks need matplotlib, extra 'preview'")
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path / "ipython"))
    monkeypatch.setenv("JUPYTER_RUNTIME_DIR", str(tmp_path / "jupyter"))
    (tmp_path / "here").mkdir()
    notebook = _read(path)
    nbclient.NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(tmp_path / "here")}}).execute()
    assert [text.split() for text in _texts(notebook)] == [text.split() for text in _texts(_read(path))]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_printed_as_it_ran(path: Path) -> None:
    """Every cell once, from the first to the last, without an error, and small enough to be kept."""
    notebook = _read(path)
    cells = [cell for cell in notebook.cells if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))
    outputs = [output for cell in cells for output in cell["outputs"]]
    assert all(output["output_type"] != "error" for output in outputs)
    assert any("image/jpeg" in output.get("data", {}) for output in outputs)
    assert path.stat().st_size < 300_000
    assert str(Path.home()) not in path.read_text(encoding="utf-8")


def test_there_are_notebooks() -> None:
    assert [path.stem for path in NOTEBOOKS] == ["first_dataset"]
