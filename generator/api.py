"""Making datasets from Python: what ``from synthetless import ...`` gives.

The same as the commands, for scripts and notebooks.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from synthetless import config
from synthetless.config import Recipe
from synthetless.errors import UserError
from synthetless.extras import need
from synthetless.generation.progress import Progress, silent

if TYPE_CHECKING:
    from synthetless.generation.generate import Summary


def load_recipe(recipe: str | Path, changes: Mapping[str, Any] | None = None) -> Recipe:
    """A recipe from a file, or one that comes with the package, with some settings changed.

    Args:
        recipe: a YAML file, or a name that ``synthetless recipes`` lists, such as "demo".
        changes: values by setting, such as {"images": 8, "camera.distance_m": [0.5, 0.8]}; docs/recipe.md lists them.

    Raises:
        UserError: there is no such recipe, or a setting is unknown or has a wrong value.
    """
    return config.load_recipe(Path(recipe), [config.override(key, value) for key, value in (changes or {}).items()])


def generate(
    recipe: Recipe | str | Path,
    out: str | Path,
    *,
    workers: int | None = None,
    threads: int = 1,
    device: str = "auto",
    drop_limit_s: float = 1800.0,
    preview_every: int = 0,
    progress: Callable[[Progress], None] | None = None,
) -> Summary:
    """Make a dataset, or the images that it lacks; called again after an interruption, it continues.

    The images are made in processes of their own, which do not import the script that calls this: neither a notebook
    nor a script without ``if __name__ == "__main__":`` needs anything special.

    Args:
        recipe: what to make: a ``Recipe``, a YAML file, or the name of a recipe such as "demo".
        out: the dataset's folder, which ``Dataset.open`` reads afterwards.
        workers: processes that work side by side; None for one per core, or per GPU.
        threads: of the renderer in each of them; 0 for as many as there are cores.
        device: what to render on: auto, cpu, optix, cuda, hip, oneapi or metal.
        drop_limit_s: a drop that takes longer is given up.
        preview_every: the contact sheet preview.jpg is drawn after every so many images; 0 for only in the end.
        progress: is called with where the run stands, with every change and about once a second; ``print`` will do.

    Returns:
        What is in the dataset now, and which drops failed.

    Raises:
        UserError: the request, the recipe's sources or the folder cannot be used, or a file cannot be written.
        BlenderError: Blender cannot be used.
    """
    if workers is not None and workers < 1:
        raise UserError(f"workers is {workers}; a number of processes >= 1, or None, is needed")
    if threads < 0:
        raise UserError(f"threads is {threads}; a number >= 0 is needed")
    if not drop_limit_s > 0:
        raise UserError(f"drop_limit_s is {drop_limit_s}; a number of seconds > 0 is needed")
    need("bpy")
    from synthetless.generation import devices
    from synthetless.generation.generate import Execution
    from synthetless.generation.generate import generate as make

    made = recipe if isinstance(recipe, Recipe) else load_recipe(recipe)
    execution = Execution(workers, threads, drop_limit_s, None, devices.choose(device), preview_every)
    return make(made, Path(out), execution, progress or silent)
