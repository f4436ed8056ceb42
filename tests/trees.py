"""A folder as what its files hold, to compare with another."""

from __future__ import annotations

from pathlib import Path

from generator.workers import LOGS_FOLDER


def contents(root: Path) -> dict[str, bytes]:
    """Every file below ``root``, by its path there."""
    return {str(path.relative_to(root)): path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}


def data_files(root: Path) -> dict[str, bytes]:
    """The files of a dataset: not the workers' logs, nor a lock that a killed process has left."""
    return {
        name: content
        for name, content in contents(root).items()
        if not name.startswith(f"{LOGS_FOLDER}/") and not name.endswith(".lock")
    }
