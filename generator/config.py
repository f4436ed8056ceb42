"""The recipe: one tree of settings that is the YAML file, the ``--set`` overrides and what a dataset records.

Settings of the scene itself live in :mod:`synthetless.scenes.settings`; this adds the seed, the sources, the files
written and the labels, and reads, overrides and documents the whole tree.
"""

from __future__ import annotations

import difflib
import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_args

from pydantic import Field, ValidationError, ValidationInfo, field_validator, model_validator
from pydantic_core import PydanticCustomError

from synthetless import assets
from synthetless.errors import UserError
from synthetless.io.documents import parse_document, read_document, shown
from synthetless.io.files import atomic_write
from synthetless.scenes.settings import (
    CONTAINERS,
    DEPTH_SENSORS,
    SENSORS,
    Bounds,
    DepthSensorSettings,
    RoomSettings,
    SceneSettings,
    SensorSettings,
    Settings,
)
from synthetless.scenes.spec import Intrinsics

BUILTIN = "builtin"
BUILTIN_MODELS = Path(assets.__file__).parent / "parts"
BUILTIN_RECIPES = Path(__file__).parent / "configs"
Tree = TypeVar("Tree", bound=Settings)
DISTRACTORS = (2, 6)
"""How many a scene has, if a recipe names their folder and says no more."""
SPLIT = "train_synthetless"
"""The folder of scenes, if a recipe names no other."""

_NAMED: Mapping[tuple[str, ...], Callable[[str], dict[str, Any]]] = {
    ("sensor",): lambda name: {} if name == "none" else {"preset": name},
    ("depth_sensor",): lambda name: {} if name == "none" else {"preset": name},
    ("light", "room"): lambda _: {},
    ("release", "container"): lambda name: deepcopy(CONTAINERS.get(name, {name: {}})),
}
"""Groups of settings that may be given by name, and what a name stands for when an override changes one of them."""
_NAMES: Mapping[type[Settings], tuple[str, ...]] = {
    SensorSettings: ("none", *SENSORS),
    DepthSensorSettings: ("none", *DEPTH_SENSORS),
    RoomSettings: ("none", "ranges"),
}

Output = Literal["rgb", "depth", "depth_sensed", "masks", "normals", "object_coordinates", "exr"]


_EXPECTED = {
    "tuple_type": "expected a list, such as [min, max] or [rgb, depth]",
    "model_type": "expected a mapping of settings",
}
"""Faults whose wording by pydantic would speak of Python instead of the recipe."""


class RecipeError(UserError):
    """A recipe or an override that cannot be used; the message is one line."""


class SourceSettings(Settings):
    """Where models and textures come from."""

    models: str = BUILTIN
    """BOP models folder (obj_000001.ply, ..., models_info.json), or builtin."""
    distractors: str | None = None
    """BOP models folder of unlabelled objects, or builtin; gives each scene 2 to 6 of them, unless objects.distractors
    says how many."""
    textures: str = BUILTIN
    """Folder of photographs for the table, or builtin."""
    licence: str = ""
    """Licence and attribution of the models, recorded with the dataset."""


class EncodingSettings(Settings):
    """How the files of an image are encoded."""

    rgb_format: Literal["png", "jpg"] = "png"
    """Image format of rgb: png keeps what was rendered, jpg is smaller."""
    jpeg_quality: Annotated[int, Bounds(1, 100)] = 95
    """Quality of jpg files."""
    depth_scale: Annotated[float, Bounds(0.001, 100, "mm")] = 0.1
    """Millimetres per unit of the depth files."""


class LabelSettings(Settings):
    """How poses become labels."""

    scheme: Literal["pitteri2019", "atlas"] = "pitteri2019"
    """Canonical map and regressor index: the paper's, or the atlas that has no jumps."""
    visibility_delta_mm: Annotated[float, Bounds(0, 100, "mm")] = 5.0
    """A surface this close behind another still counts as visible, as in BOP's synthetic sets; 0 is exact."""


class Recipe(SceneSettings):
    """Everything that decides a dataset."""

    name: str = "synthetless"
    """Name of the dataset, recorded with it."""
    split: Annotated[str, Field(pattern=r"^[A-Za-z0-9_]+$")] = SPLIT
    """Name of the split's folder."""
    images: Annotated[int, Bounds(1, 100_000_000, "images")] = 30000
    """How many images to make."""
    seed: Annotated[int, Bounds(0, 2**63 - 1)] = 0
    """Everything random follows from it."""
    source: SourceSettings = Field(default_factory=SourceSettings)
    """Models and textures."""
    outputs: tuple[Output, ...] = ("rgb", "depth", "masks")
    """Files written for each image: any of rgb, depth, depth_sensed (as a depth camera measures it: depth_sensor),
    masks, normals, object_coordinates, exr (the linear image)."""
    encoding: EncodingSettings = Field(default_factory=EncodingSettings)
    """How they are encoded."""
    labels: LabelSettings = Field(default_factory=LabelSettings)
    """Canonical poses."""

    @model_validator(mode="before")
    @classmethod
    def _with_distractors(cls, given: Any) -> Any:
        """A folder of distractors alone asks for some; written out, so that a stored recipe keeps its meaning."""
        if not isinstance(given, dict) or not isinstance(source := given.get("source"), dict):
            return given
        objects = given.get("objects", {})
        if source.get("distractors") is None or not isinstance(objects, dict) or "distractors" in objects:
            return given
        return {**given, "objects": {**objects, "distractors": DISTRACTORS}}

    @model_validator(mode="before")
    @classmethod
    def _with_a_depth_camera(cls, given: Any) -> Any:
        """An output that needs one, and no more said: written out likewise."""
        if not isinstance(given, dict) or "depth_sensor" in given or not isinstance(given.get("outputs"), list | tuple):
            return given
        return {**given, "depth_sensor": next(iter(DEPTH_SENSORS)) if "depth_sensed" in given["outputs"] else None}

    @field_validator("outputs")
    @classmethod
    def _refuse_no_depth_camera(cls, given: tuple[Output, ...], others: ValidationInfo) -> tuple[Output, ...]:
        if "depth_sensed" in given and others.data.get("depth_sensor", ...) is None:
            names = " or ".join(DEPTH_SENSORS)
            raise PydanticCustomError("outputs", "depth_sensed needs depth_sensor: {names}", {"names": names})
        return given

    @property
    def intrinsics(self) -> Intrinsics:
        """The camera's model."""
        return self.camera.intrinsics


@dataclass(frozen=True)
class Setting:
    """One leaf of the recipe, for help texts."""

    key: str
    kind: str
    default: Any
    description: str


def builtin_recipes() -> dict[str, Path]:
    """The recipes and trainings that come with the package, by name: their places in configs/, without the suffix."""
    files = sorted(BUILTIN_RECIPES.rglob("*.yaml"))
    return {file.relative_to(BUILTIN_RECIPES).with_suffix("").as_posix(): file for file in files}


def recipe_file(name: Path) -> Path:
    """The file that is meant by a name or a path: the user's own, or else one that comes with the package.

    Raises:
        RecipeError: there is neither.
    """
    known = builtin_recipes()
    if name.as_posix() in known and not name.is_file():  # a folder may well be called demo
        return known[name.as_posix()]
    if name.exists():
        return name
    near = difflib.get_close_matches(name.as_posix(), known, n=1)
    meant = f"did you mean {near[0]}?" if near else "`synthetless recipes` lists those that come with it"
    raise RecipeError(f"{name}: no such recipe file; {meant}")


def recipe_summary(file: Path) -> str:
    """The first sentence of the comment that a recipe begins with."""
    lines = takewhile(lambda line: line.startswith("# "), file.read_text(encoding="utf-8").splitlines())
    comment = " ".join(line.removeprefix("# ") for line in lines)
    return re.split(r"(?<=[a-z)\d])[.:;](?: |$)", comment, maxsplit=1)[0]


def copy_recipe(name: str, to: Path | None = None) -> Path:
    """Write a recipe that comes with the package to a new file; in this folder, if none is given.

    Raises:
        RecipeError: there is no such recipe.
        UserError: the file exists already.
    """
    known = builtin_recipes()
    if name not in known:
        raise RecipeError(f"--copy {name}: no such recipe; one of {', '.join(known)} is needed")
    place = to or Path(known[name].name)
    if place.exists():
        raise UserError(f"{place}: exists already; give a new name with --to")
    atomic_write(place, known[name].read_bytes())
    return place


def override(key: str, value: object) -> str:
    """The override that gives a setting this value.

    Raises:
        RecipeError: it is no value that a recipe can hold.
    """
    try:
        return f"{key}={json.dumps(value)}"
    except (TypeError, ValueError):
        raise RecipeError(f"{key} = {shown(value)}: expected text, a number, a list, or a mapping of them") from None


def load_recipe(path: Path | None, overrides: Sequence[str] = ()) -> Recipe:
    """Read a recipe, by its file or its name, and apply ``key.path=value`` overrides (values are YAML).

    Raises:
        RecipeError: as in ``load_settings``.
    """
    return load_settings(Recipe, path, overrides)


def load_settings(kind: type[Tree], path: Path | None, overrides: Sequence[str] = ()) -> Tree:
    """Read a tree of settings and apply ``key.path=value`` overrides (values are YAML).

    Raises:
        RecipeError: unreadable file, no mapping, unknown key, value of the wrong kind or outside its range.
    """
    return _parse(kind, {} if path is None else _read_recipe(path), overrides, "recipe" if path is None else str(path))


def parse_recipe(tree: dict[str, Any], overrides: Sequence[str] = (), origin: str = "recipe") -> Recipe:
    """A recipe from a tree of plain values, which the overrides change; ``origin`` is what an error calls it.

    Raises:
        RecipeError: as in ``load_recipe``.
    """
    return _parse(Recipe, tree, overrides, origin)


def _parse(kind: type[Tree], tree: dict[str, Any], overrides: Sequence[str], origin: str) -> Tree:
    for override in overrides:
        _apply(tree, override)
    try:
        return kind.model_validate(tree)
    except ValidationError as error:
        raise RecipeError(f"{origin}: {_explain(error, kind)}") from None


def dump_recipe(recipe: Recipe) -> dict[str, Any]:
    """The whole tree as plain JSON values, defaults included."""
    return recipe.model_dump(mode="json")


def settings(group: type[Settings] = Recipe, prefix: str = "") -> Iterator[Setting]:
    """All leaves of the recipe: a group's own first, then those of the groups inside it."""
    inner: list[tuple[str, type[Settings]]] = []
    for name, field in group.model_fields.items():
        key, kind = f"{prefix}{name}", field.annotation
        groups = [item for item in (kind, *get_args(kind)) if isinstance(item, type) and issubclass(item, Settings)]
        inner += [(key, item) for item in groups]
        if kind not in groups:
            yield Setting(
                key, _kind(kind, field.metadata), field.get_default(), " ".join((field.description or "").split())
            )
    for key, kind in inner:
        yield from settings(kind, f"{key}.")


def _read_recipe(path: Path) -> dict[str, Any]:
    try:
        content = read_document(recipe_file(path))
    except UserError as error:
        raise RecipeError(str(error)) from None
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise RecipeError(f"{path}: a recipe is a mapping of settings, not a {type(content).__name__}")
    return content


def _apply(tree: dict[str, Any], override: str) -> None:
    key, equals, text = override.partition("=")
    path = key.strip().split(".")
    if not equals or not all(path):
        raise RecipeError(f"--set {shown(override)}: expected key.path=value")
    try:
        value = parse_document(text, shown(text))
    except UserError as error:
        raise RecipeError(f"--set {key}: {error}") from None
    node = tree
    for depth, name in enumerate(path[:-1], start=1):
        child = node.setdefault(name, {})
        if tuple(path[:depth]) in _NAMED and (child is None or isinstance(child, str)):
            child = node[name] = _NAMED[tuple(path[:depth])](child or "none")
        if not isinstance(child, dict):
            raise RecipeError(f"--set {key}: {shown(name)} is a single value, it has no settings inside")
        node = child
    node[path[-1]] = value


def _explain(error: ValidationError, kind: type[Settings]) -> str:
    """The first fault in one line: key, value, what would be right."""
    faults = error.errors(include_url=False)
    fault = faults[0]
    place = fault["loc"]
    key = ".".join(str(part) for part in place)
    if fault["type"] == "extra_forbidden":
        known = [setting.key for setting in settings(kind)]
        groups = sorted({k[:end] for k in known for end, character in enumerate(k) if character == "."})
        return f"unknown setting {shown(key)[1:-1]}{_nearest(key, known + groups)}"
    value = fault["input"]
    if fault["type"] == "missing" and isinstance(place[-1], int):
        missing = sum(other["type"] == "missing" and other["loc"][:-1] == place[:-1] for other in faults)
        return f"{key.rpartition('.')[0]} = {shown(value)}: expected {len(value) + missing} values, not {len(value)}"
    if fault["type"] == "too_long":
        return f"{key} = {shown(value)}: expected {fault['ctx']['max_length']} values, not {len(value)}"
    detail = _EXPECTED.get(fault["type"]) or fault["msg"][0].lower() + fault["msg"][1:]
    more = len(faults) - 1
    suffix = f" (and {more} more)" if more else ""
    return f"{key} = {shown(value)}: {detail}{suffix}"


def _nearest(key: str, known: list[str]) -> str:
    leaf = key.rsplit(".", maxsplit=1)[-1]
    by_leaf = {k.rsplit(".", maxsplit=1)[-1]: k for k in reversed(known)}
    match = [by_leaf[leaf]] if leaf in by_leaf else difflib.get_close_matches(key, known, n=1, cutoff=0.75)
    match = match or [by_leaf[k] for k in difflib.get_close_matches(leaf, by_leaf, n=1)]
    return f"; did you mean {match[0]}?" if match else "; see docs/recipe.md for all settings"


def _kind(annotation: Any, metadata: Sequence[Any]) -> str:
    """How the value is written: choices, range or number with its bounds and unit."""
    bounds = next((str(item) for item in metadata if isinstance(item, Bounds)), "")
    arguments = get_args(annotation)
    names = next((names for group, names in _NAMES.items() if group in arguments), arguments)
    if names and all(isinstance(item, str) for item in names):
        return " | ".join(names)
    if len(arguments) == 2 and arguments[0] is arguments[1] and Ellipsis not in arguments:
        return f"[min, max] in {bounds}"
    if bounds:
        what = f"{len(arguments)} numbers" if arguments else "integer" if annotation is int else "number"
        return f"{what} in {bounds}"
    if annotation is str or str in arguments:
        return "text"
    return "list"


def recipe_page() -> str:
    """The reference page of all settings, as Markdown."""
    lines = [
        "# The recipe",
        "",
        "A recipe is a YAML file of the settings below; a setting that it leaves out has its default. On the command",
        "line, `--set camera.width=640` overrides one. A range is written `[min, max]`; values are drawn uniformly",
        "between the two unless the setting says otherwise. `dataset.json` records the recipe as it was used.",
        "",
        "This page is written by `make docs`.",
        *settings_tables(Recipe),
    ]
    return "\n".join(lines) + "\n"


def settings_tables(kind: type[Settings]) -> list[str]:
    """Lines of Markdown: a table of each group's settings."""
    lines: list[str] = []
    group = None
    for setting in settings(kind):
        name = setting.key.rpartition(".")[0]
        if name != group:
            group = name
            title = f"`{group}`" if group else "At the top"
            lines += ["", f"## {title}", "", "| setting | value | default | meaning |", "|---|---|---|---|"]
        kind_of_value = setting.kind.replace("|", "\\|")
        lines.append(f"| `{setting.key}` | {kind_of_value} | `{json.dumps(setting.default)}` | {setting.description} |")
    return lines


def models_folder(source: str) -> Path:
    """The folder that a recipe's source of models stands for."""
    return BUILTIN_MODELS if source == BUILTIN else Path(source)
