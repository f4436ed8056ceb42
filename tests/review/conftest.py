"""Valid datasets of six images in two scene folders, made once."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import valid_dataset


@pytest.fixture(autouse=True)
def small_scene_folders() -> Iterator[None]:
    """Three images a scene folder, so that six images fill two."""
    with valid_dataset.small_scene_folders():
        yield


@pytest.fixture(scope="session")
def parts(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A models folder."""
    return valid_dataset.write_models(tmp_path_factory.mktemp("parts") / "models")


@pytest.fixture(scope="session")
def valid(tmp_path_factory: pytest.TempPathFactory, parts: Path) -> Path:
    """The dataset as made, for tests that only read it."""
    root = tmp_path_factory.mktemp("valid") / "dataset"
    valid_dataset.write_dataset(root, parts)
    return root
