"""A folder as what its files hold, to compare with another."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

from synthetless.dataset.layout import LOGS_FOLDER

SHARED_LOCK = ".synthetless.lock"
"""Runs that make parts of a dataset hold it together, so that none of them takes it away."""


def contents(root: Path) -> dict[str, bytes]:
    """Every file below ``root``, by its path there."""
    return {str(path.relative_to(root)): path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}


def data_files(root: Path, but: Collection[str] = ()) -> dict[str, bytes]:
    """The files of a dataset: not the workers' logs, nor those whose paths are in ``but``."""
    found = contents(root).items()
    return {name: content for name, content in found if not name.startswith(f"{LOGS_FOLDER}/") and name not in but}
