"""Synthetic 6D pose datasets of symmetric, texture-less parts, with labels a network can learn.

``from synthetless import Recipe, generate`` makes a dataset, ``from synthetless import Dataset`` reads one; both are
loaded when they are asked for. Labels for poses of your own are in :mod:`synthetless.symmetry`.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from synthetless.api import generate, load_recipe
    from synthetless.config import Recipe
    from synthetless.dataset import Dataset
    from synthetless.errors import UserError
    from synthetless.generation.generate import Summary
    from synthetless.generation.progress import Progress

__all__ = ["Dataset", "Progress", "Recipe", "Summary", "UserError", "generate", "load_recipe"]

_PLACES = {
    "Dataset": "dataset",
    "Progress": "generation.progress",
    "Recipe": "config",
    "Summary": "generation.generate",
    "UserError": "errors",
    "generate": "api",
    "load_recipe": "api",
}


def __getattr__(name: str) -> Any:
    if name in _PLACES:
        return getattr(import_module(f"{__name__}.{_PLACES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
