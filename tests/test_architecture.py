"""The walls between the rooms: who may import whom, and what nobody may call."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
MODULES = sorted(path for room in ("generator", "scenes", "assets") for path in (ROOT / room).rglob("*.py"))
WITHOUT_BLENDER = ("symmetry", "formats", "review", "labels.py", "relabel.py", "adopt.py", "raycast.py")


def _imports(tree: ast.AST) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            yield node.module


def _packages(path: Path) -> set[str]:
    return {name.partition(".")[0] for name in _imports(ast.parse(path.read_text(encoding="utf-8")))}


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_go_one_way(path: Path) -> None:
    room = path.relative_to(ROOT).parts[0]
    imported = _packages(path)
    if room == "generator":
        assert not imported & {"bpy", "mathutils"}, "generator never imports Blender"
    if room == "scenes":
        assert "generator" not in imported, "scenes never imports generator"
    if room == "assets":
        assert not imported & {"bpy", "mathutils", "scenes", "generator"}
    assert "tests" not in imported


def test_labels_formats_and_review_run_where_blender_is_not_installed() -> None:
    """Import them with bpy, mathutils and OpenEXR made impossible."""
    names = []
    for path in MODULES:
        parts = path.relative_to(ROOT).parts
        if parts[0] == "generator" and parts[1] in WITHOUT_BLENDER and parts[-1] != "__main__.py":
            names.append(".".join(parts).removesuffix(".py").removesuffix(".__init__"))
    assert len(names) > 20
    code = (
        "import sys, importlib\n"
        "for name in ('bpy', 'mathutils', 'OpenEXR'): sys.modules[name] = None\n"
        f"for name in {names!r}: importlib.import_module(name)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_nothing_is_drawn_from_a_global_generator(path: Path) -> None:
    """np.random.seed, np.random.rand and the random module would tie an image to what was made before it."""
    allowed = {"default_rng", "Generator", "SeedSequence", "PCG64", "BitGenerator"}
    tree = ast.parse(path.read_text(encoding="utf-8"))
    assert "random" not in _packages(path)
    for node in ast.walk(tree):
        if (
            isinstance(node, ast.Attribute)
            and isinstance(node.value, ast.Attribute)
            and node.value.attr == "random"
            and isinstance(node.value.value, ast.Name)
            and node.value.value.id in {"np", "numpy"}
        ):
            assert node.attr in allowed, f"line {node.lineno}: np.random.{node.attr}"


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_modules_can_be_read_from_top_to_bottom(path: Path) -> None:
    assert len(path.read_text(encoding="utf-8").splitlines()) <= 330
