"""What is installed: one package called synthetless with all that it needs, the same from a checkout and an sdist."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tarfile
import zipfile
from importlib.metadata import version
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = {"generator": "", "scenes": "scenes/", "assets": "assets/", "configs": "configs/", "learning": "learning/"}


def _build(what: str, project: Path, to: Path) -> Path:
    """Let the project's build backend make an sdist or a wheel."""
    pytest.importorskip("hatchling", reason="hatchling, which builds the package, is not installed; extra 'dev' has it")
    code = f"import sys, hatchling.build; hatchling.build.build_{what}(sys.argv[1])"
    subprocess.run([sys.executable, "-c", code, str(to)], cwd=project, check=True, capture_output=True)
    (made,) = to.iterdir()
    return made


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel of this checkout."""
    return _build("wheel", ROOT, tmp_path_factory.mktemp("wheel"))


def _content(wheel: Path) -> dict[str, int]:
    """Names and checksums."""
    with zipfile.ZipFile(wheel) as archive:
        return {info.filename: info.CRC for info in archive.infolist()}


def test_a_wheel_installs_one_name(wheel: Path) -> None:
    """Nothing called generator, scenes, assets or tests may land beside other people's packages."""
    assert {name.split("/")[0] for name in _content(wheel)} == {
        "synthetless",
        f"synthetless-{version('synthetless')}.dist-info",
    }


def test_a_wheel_holds_every_file_of_the_package(wheel: Path) -> None:
    expected = {
        f"synthetless/{prefix}{path.relative_to(ROOT / folder).as_posix()}"
        for folder, prefix in FOLDERS.items()
        for path in (ROOT / folder).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert {name for name in _content(wheel) if name.startswith("synthetless/")} == expected
    assert {
        "synthetless/py.typed",
        "synthetless/assets/parts/obj_000037.ply",
        "synthetless/assets/parts/models_info.json",
        "synthetless/configs/demo.yaml",
        "synthetless/scenes/textures/photos.py",
        "synthetless/preview/static/preview.css",
        "synthetless/preview/templates/page.html",
    } <= expected


def test_a_wheel_made_from_an_sdist_is_the_same(wheel: Path, tmp_path: Path) -> None:
    """An sdist holds no links, which join the folders in a checkout."""
    for folder in ("sdist", "unpacked", "wheel"):
        (tmp_path / folder).mkdir()
    with tarfile.open(_build("sdist", ROOT, tmp_path / "sdist")) as archive:
        archive.extractall(tmp_path / "unpacked", filter="data")
    (project,) = (tmp_path / "unpacked").iterdir()
    assert _content(_build("wheel", project, tmp_path / "wheel")) == _content(wheel)


def test_a_wheel_works_beside_folders_of_the_same_names(wheel: Path, tmp_path: Path) -> None:
    """From a user's folder that has its own generator.py, scenes/ and assets/."""
    site, home = tmp_path / "site", tmp_path / "home"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
    for name in ("scenes", "assets"):
        (home / name).mkdir(parents=True)
        (home / name / "__init__.py").write_text("raise ImportError('mine')\n")
    (home / "generator.py").write_text("raise ImportError('mine')\n")
    (home / "recipe.yaml").write_text("imges: 3\n")
    code = (
        "import synthetless, synthetless.scenes.spec, synthetless.symmetry\n"
        "from synthetless.config import models_folder\n"
        "from synthetless.io.models import load_models\n"
        "model = load_models(models_folder('builtin'), (1,))[1]\n"
        "print(synthetless.__path__[0], model.path, sep='\\n')\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(site)}

    def run(*arguments: str) -> tuple[str, str]:
        done = subprocess.run(
            [sys.executable, *arguments], cwd=home, env=environment, capture_output=True, text=True, check=False
        )
        return done.stdout, done.stderr

    places, error = run("-c", code)
    assert error == ""
    assert all(Path(place).is_relative_to(site) for place in places.splitlines())
    assert len(places.splitlines()) == 2
    assert run("-m", "synthetless", "--version") == (f"synthetless {version('synthetless')}\n", "")
    recipes, _ = run("-m", "synthetless", "recipes", "--json")
    assert "demo" in json.loads(recipes)
    _, error = run("-m", "synthetless", "generate", "recipe.yaml", "--out", "out")
    assert "did you mean images?" in error
