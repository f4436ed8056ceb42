"""The walls between the rooms: who may import whom, and what nobody may call."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = {
    "generator": "synthetless",
    "scenes": "synthetless.scenes",
    "assets": "synthetless.assets",
    "learning": "synthetless.learning",
}

FLOORS = (
    {"errors", "assets"},
    {"extras"},
    {"scenes"},
    {"io"},
    {"config"},
    {"annotation"},
    {"symmetry"},
    {"dataset"},
    {"generation", "exports"},
    {"validation", "preview", "fetch", "doctor"},
    {"learning"},
    {"cli", "api"},
    {"__main__"},
)
"""The rooms of the package, from the bottom: each imports from the floors below it, and from itself."""

WITHOUT_BLENDER = {"config", "io", "annotation", "symmetry", "dataset", "exports", "validation", "preview"}


def _modules() -> Iterator[tuple[str, Path]]:
    """Dotted name and file of every module of the package."""
    for folder, package in FOLDERS.items():
        for path in sorted((ROOT / folder).rglob("*.py")):
            parts = path.relative_to(ROOT / folder).with_suffix("").parts
            yield ".".join([package, *parts]).removesuffix(".__init__"), path


MODULES = dict(_modules())


def _room(module: str) -> str:
    return module.split(".")[1] if "." in module else "package"


def _imports(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def test_every_room_has_a_floor() -> None:
    assert {_room(module) for module in MODULES} - {"package"} == set().union(*FLOORS)


def test_imports_go_one_way() -> None:
    floor = {room: number for number, rooms in enumerate(FLOORS) for room in rooms}
    floor["package"] = len(FLOORS)  # the package's own names, which it loads when they are asked for
    wrong = []
    for module, path in MODULES.items():
        here = _room(module)
        for name in _imports(path):
            there = _room(name) if name.startswith("synthetless.") else here
            if there != here and floor.get(there, 99) >= floor.get(here, 0):
                wrong.append(f"{module} imports {name}")
            if name.split(".")[0] in {"generator", "scenes", "assets", "tests"}:
                wrong.append(f"{module} imports {name}: the package's name is synthetless")
            if name.split(".")[0] in {"bpy", "mathutils"} and here != "scenes":
                wrong.append(f"{module} imports {name}: Blender is met in scenes alone")
            if name.split(".")[0] == "torch" and here != "learning":
                wrong.append(f"{module} imports {name}: torch is met in learning alone")
    assert not wrong, "\n".join(wrong)


def test_what_needs_no_blender_runs_where_it_is_not_installed() -> None:
    """Import it with bpy, mathutils and OpenEXR made impossible."""
    names = [module for module in MODULES if _room(module) in WITHOUT_BLENDER]
    assert len(names) > 20
    code = (
        "import sys, importlib\n"
        "for name in ('bpy', 'mathutils', 'OpenEXR'): sys.modules[name] = None\n"
        f"for name in {names!r}: importlib.import_module(name)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_the_base_install_does_without_the_extras() -> None:
    """What only some commands need is imported when it is used, and asked for in one line that says how to get it."""
    rooms = WITHOUT_BLENDER - {"preview"} | {"api", "cli", "doctor", "errors", "extras", "fetch", "package"}
    names = [module for module in MODULES if _room(module) in rooms]
    code = (
        "import sys, importlib\n"
        "from synthetless.extras import EXTRAS, MissingExtraError, cv2, need\n"
        "for name in EXTRAS: sys.modules[name] = None\n"
        f"for name in {names!r}: importlib.import_module(name)\n"
        "for name in EXTRAS:\n"
        "    try: need(name)\n"
        "    except MissingExtraError as error: assert f'[{EXTRAS[name]}]' in str(error), error\n"
        "    else: raise AssertionError(name)\n"
        "try: cv2.imdecode\n"
        "except MissingExtraError as error: print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("OpenCV is not installed; run: pip install ")


def test_a_score_needs_no_torch() -> None:
    """Nor does any other room load it."""
    names = [module for module in MODULES if _room(module) != "learning" and _room(module) in WITHOUT_BLENDER]
    names += [f"synthetless.learning.{name}" for name in ("score", "score_report", "results", "targets", "settings")]
    code = (
        "import sys, importlib\n"
        f"for name in {names!r}: importlib.import_module(name)\n"
        "assert 'torch' not in sys.modules\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_nothing_is_drawn_from_a_global_generator() -> None:
    """np.random.seed, np.random.rand and the random module would tie an image to what was made before it."""
    allowed = {"default_rng", "Generator", "SeedSequence", "PCG64", "BitGenerator"}
    wrong = []
    for module, path in MODULES.items():
        if any(name.split(".")[0] == "random" for name in _imports(path)):
            wrong.append(f"{module} imports random")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            is_random = isinstance(node, ast.Attribute) and ast.unparse(node.value) in {"np.random", "numpy.random"}
            if is_random and node.attr not in allowed:
                wrong.append(f"{module}, line {node.lineno}: {ast.unparse(node)}")
    assert not wrong, "\n".join(wrong)


def test_importing_the_package_works_beside_files_of_the_same_names(tmp_path: Path) -> None:
    """A user's own generator.py, scenes/ and assets/ neither hide the package's rooms nor are hidden by them."""
    for name in ("generator", "scenes", "assets"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text("MINE = True\n")
    code = (
        "import generator, scenes, assets\n"
        "assert generator.MINE and scenes.MINE and assets.MINE\n"
        "from synthetless.symmetry import CanonicalMap, SymmetryGroup, SymmetryTable\n"
        "from synthetless.dataset import Dataset\n"
        "import synthetless.scenes.spec, synthetless.assets\n"
        "print(SymmetryGroup.from_name('C2').name)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.stdout == "C2\n", done.stderr
