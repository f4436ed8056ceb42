"""Options that several commands have."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from synthetless.errors import UserError


def above_zero(option: typer.CallbackParam, value: float | None) -> float | None:
    """Refuse what is no number above 0.

    Raises:
        UserError: it is not.
    """
    if value is not None and not 0 < value < math.inf:
        raise UserError(f"{option.opts[0]} is {value:g}; a number above 0 is needed")
    return value


def recipe_names() -> list[str]:
    """The names of the recipes that come with the package, for completion."""
    from synthetless.config import builtin_recipes

    return list(builtin_recipes())


AsJson = Annotated[bool, typer.Option("--json", help="Print the answer as JSON.")]
RecipeArgument = Annotated[
    Path, typer.Argument(help="A YAML file, or a name that `synthetless recipes` lists.", autocompletion=recipe_names)
]
Split = Annotated[str | None, typer.Option(metavar="NAME", help="Folder of images, where there are several.")]
Workers = Annotated[int | None, typer.Option(min=1, metavar="N", help="Processes; default: one per core.")]
Copy = Annotated[bool, typer.Option("--copy", help="Copy the dataset's files, for a folder to send; else links.")]
