"""Where the tests find real input: the T-LESS models and photographs, by environment variable or beside the project."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
import valid_dataset
from bop_dataset import build_dataset, dataset  # noqa: F401  (fixtures)
from hypothesis import settings

# A busy machine is no fault of the code; and CI judges a change by the same examples each time.
settings.register_profile("synthetless", deadline=None, derandomize="CI" in os.environ)
settings.load_profile("synthetless")

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session", autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Tests, and the commands that they start, keep what they compute apart from the user's cache."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SYNTHETLESS_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


def _external(variable: str, fallback: Path) -> Path:
    folder = Path(os.environ.get(variable, fallback))
    if not folder.is_dir():
        pytest.skip(f"{folder} is not here; set {variable} to run this test")
    return folder


@pytest.fixture(scope="session")
def tless_models() -> Path:
    """The 30 T-LESS CAD models with models_info.json."""
    return _external("SYNTHETLESS_TLESS_MODELS", ROOT.parent / "shared" / "tless" / "models_cad")


@pytest.fixture(scope="session")
def photo_textures() -> Path:
    """A folder of photographs for the table."""
    return _external("SYNTHETLESS_TEXTURES", ROOT.parent / "shared" / "textures")


@pytest.fixture(scope="session")
def builtin_models() -> Path:
    """The parts that come with the project."""
    return ROOT / "assets" / "parts"


@pytest.fixture
def small_scene_folders() -> Iterator[None]:
    """Three images a scene folder, so that six images fill two."""
    with valid_dataset.small_scene_folders():
        yield


@pytest.fixture(scope="session")
def parts(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A models folder of a few parts with symmetries of every kind."""
    return valid_dataset.write_models(tmp_path_factory.mktemp("parts") / "models")


@pytest.fixture(scope="session")
def valid(tmp_path_factory: pytest.TempPathFactory, parts: Path) -> Path:
    """A valid dataset of six images in two scene folders, for tests that only read it."""
    root = tmp_path_factory.mktemp("valid") / "dataset"
    valid_dataset.write_dataset(root, parts)
    return root
