"""Every test here works on datasets of two scene folders."""

from __future__ import annotations

import pytest


@pytest.fixture(autouse=True)
def _small_scene_folders(small_scene_folders: None) -> None:
    """Whatever a test builds or checks has three images a scene folder."""
