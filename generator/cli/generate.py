"""Commands that make images: generate, render, redo, redevelop."""

from __future__ import annotations

import json
import os
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from synthetless.cli.options import AsJson, RecipeArgument, Workers
from synthetless.cli.progress import display
from synthetless.cli.terminal import EXIT_FAILED, EXIT_INTERRUPTED, leave, say
from synthetless.errors import UserError
from synthetless.extras import need
from synthetless.scenes.blender import KINDS, Kind

if TYPE_CHECKING:
    from synthetless.config import Recipe
    from synthetless.generation.generate import Summary

Device = Literal["auto", Kind]


def _print_settings(wanted: bool) -> None:
    if wanted:
        say(settings_help())
        raise typer.Exit


def settings_help() -> str:
    """All settings of a recipe, a paragraph for each group."""
    import textwrap
    from itertools import groupby

    from synthetless.config import settings

    paragraphs = []
    for _, group in groupby(settings(), key=lambda setting: setting.key.rpartition(".")[0]):
        lines = []
        for setting in group:
            lines.append(f"{setting.key}={json.dumps(setting.default)}")
            lines.append(textwrap.indent(textwrap.fill(" ".join(setting.description.split()), 76), "    "))
        paragraphs.append("\n".join(lines))
    return "\n\n".join(["Settings of a recipe, for --set (docs/recipe.md has units and ranges):", *paragraphs])


def generate_command(
    recipe: RecipeArgument,
    out: Annotated[Path, typer.Option(metavar="DIR", help="The dataset's folder; again to continue it.")],
    images: Annotated[int | None, typer.Option(metavar="N", help="How many; more than before extends it.")] = None,
    seed: Annotated[int | None, typer.Option(metavar="N", help="Everything random follows from it.")] = None,
    models: Annotated[
        str | None, typer.Option(metavar="DIR", help="CAD models as in BOP (with models_info.json), or builtin.")
    ] = None,
    textures: Annotated[str | None, typer.Option(metavar="DIR", help="Photographs, or builtin.")] = None,
    overrides: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Change a setting. Repeatable.")
    ] = None,
    help_settings: Annotated[
        bool,
        typer.Option("--help-settings", callback=_print_settings, is_eager=True, help="List the settings, and exit."),
    ] = False,
    workers: Annotated[
        int | None, typer.Option(min=1, metavar="N", help="Processes; default: one per core or GPU.")
    ] = None,
    threads: Annotated[int, typer.Option(min=0, metavar="N", help="Of each process; 0: as many as cores.")] = 1,
    on: Annotated[
        Device, typer.Option("--device", metavar="KIND", help=f"To render on: auto (the best), {', '.join(KINDS)}.")
    ] = "auto",
    drop_limit: Annotated[
        float, typer.Option(min=1, metavar="SECONDS", help="Give up a drop that takes longer.")
    ] = 1800,
    part: Annotated[
        str | None, typer.Option(metavar="K/N", help="Make part K of N; other machines make the others.")
    ] = None,
    executor: Annotated[Literal["local", "ray"], typer.Option(help="This machine, or a Ray cluster.")] = "local",
    address: Annotated[
        str | None, typer.Option(metavar="HOST:PORT", help="Of the Ray cluster; default: the one here.")
    ] = None,
    preview_every: Annotated[
        int, typer.Option(min=0, metavar="N", help="Images between contact sheets; 0: one at the end.")
    ] = 50,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only tell what it would take, as measured.")] = False,
    no_cache: Annotated[bool, typer.Option("--no-cache", help="Make meshes' colliders anew, and keep none.")] = False,
    json_progress: Annotated[
        bool, typer.Option("--json-progress", help="Tell progress on stderr as lines of JSON.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Make a dataset: drop, render, measure, label, write.

    Example: synthetless generate demo --out out/demo --set camera.distance_m='[0.5, 0.8]'
    """
    resolved = _resolve(recipe, overrides or [], images, seed, models, textures)
    if address is not None and executor != "ray":
        raise UserError(f"--address {address} is of a Ray cluster; add --executor ray")
    if dry_run and executor == "ray":
        raise UserError("--dry-run measures this machine; leave out --executor ray")
    need("bpy")
    with display(json_progress) as tell:  # from here on it takes time
        from synthetless.dataset.layout import Part
        from synthetless.generation import devices
        from synthetless.generation.estimate import estimate
        from synthetless.generation.generate import Execution, generate
        from synthetless.generation.progress import Progress
        from synthetless.io.cache import CACHE_VARIABLE

        if no_cache:
            os.environ[CACHE_VARIABLE] = "off"  # for the workers, too, which inherit it
        if executor == "local":
            tell(Progress("looking for devices", "looking for devices"))
        execution = Execution(
            workers,
            threads,
            drop_limit,
            Part.parse(part) if part else None,
            devices.choose(on) if executor == "local" else devices.Devices(on),
            preview_every,
            (address or "auto") if executor == "ray" else None,
        )
        if dry_run:
            plan = estimate(resolved, out, execution, tell)
        else:
            try:
                summary = generate(resolved, out, execution, tell)
            except KeyboardInterrupt:
                leave("interrupted; run the same command again to continue", EXIT_INTERRUPTED)
    if dry_run:
        say(json.dumps(asdict(plan)) if as_json else plan)
        return
    _report(summary, out, as_json)
    if summary.failures:
        raise typer.Exit(EXIT_FAILED)


def _resolve(
    recipe: Path, overrides: list[str], images: int | None, seed: int | None, models: str | None, textures: str | None
) -> Recipe:
    from synthetless.config import load_recipe

    given: list[tuple[str, Any]] = [
        ("images", images),
        ("seed", seed),
        ("source.models", models),
        ("source.textures", textures),
    ]
    direct = [f"{key}={json.dumps(value)}" for key, value in given if value is not None]
    return load_recipe(recipe, [*overrides, *direct])


def _report(summary: Summary, out: Path, as_json: bool) -> None:
    from synthetless.dataset.layout import SHEET_FILE

    if as_json:
        answer = {
            "images": summary.images,
            "instances": summary.instances,
            "made": summary.made,
            "mean_visib_fract": summary.mean_visib_fract,
            "failures": summary.failures,
            "dataset": str(out),
        }
        say(json.dumps(answer))
        return
    say(
        f"{summary.images} images ({summary.made} new), {summary.instances} instances, "
        f"{summary.mean_visib_fract:.0%} visible on average, {len(summary.failures)} failed drops"
    )
    for failure in summary.failures:
        say(f"  {failure}")
    say(f"dataset: {out}")
    if (out / SHEET_FILE).exists():
        say(f"picture: {out / SHEET_FILE}")


def render_command(
    dataset: Annotated[Path, typer.Argument(help="The dataset's folder.")],
    scene: Annotated[int, typer.Argument(help="Number of the scene folder.")],
    image: Annotated[int, typer.Argument(help="Image id in it.")],
    to: Annotated[Path, typer.Option(metavar="FILE", help="PNG file to write.")],
    textures: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder of the photographs, if it has moved.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Render one recorded image again."""
    need("bpy")
    from synthetless.dataset.layout import refuse_target
    from synthetless.generation.rerender import render_again
    from synthetless.io.files import atomic_write
    from synthetless.io.images import encode_png

    refuse_target(dataset, to)
    if to.exists():
        raise UserError(f"{to}: exists already; give a new name")
    atomic_write(to, encode_png(render_again(dataset, scene, image, textures)))
    say(json.dumps({"picture": str(to)}) if as_json else to)


def redo_command(
    dataset: Annotated[Path, typer.Argument(help="The dataset's folder.")],
    drop: Annotated[int, typer.Argument(min=0, help="Number of the drop.")],
    textures: Annotated[
        str | None, typer.Option(metavar="DIR", help="Folder of the photographs, if it has moved.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Make one drop again, to see why it failed.

    It is made alone, in the foreground, and put where it is missing.
    """
    need("bpy")
    from synthetless.generation.drop import DropFailed
    from synthetless.generation.generate import retry

    try:
        made = retry(dataset, drop, textures)
    except DropFailed as failure:
        leave(f"drop {drop}: {failure}", EXIT_FAILED)
    answer = {"drop": drop, "made": made, "dataset": str(dataset)}
    say(json.dumps(answer) if as_json else f"drop {drop}: {made} images in {dataset}")


def redevelop_command(
    dataset: Annotated[Path, typer.Argument(help="The dataset's folder; its outputs have exr.")],
    to: Annotated[Path, typer.Option(metavar="DIR", help="Folder of the new dataset.")],
    overrides: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="sensor=NAME, or a setting of sensor; several times."),
    ] = None,
    workers: Workers = None,
    as_json: AsJson = False,
) -> None:
    """Make other pictures of the same scenes.

    Another camera takes them; nothing is rendered, and no label changes.

    Example: synthetless redevelop out/a --to out/b --set sensor=primesense
    """
    from synthetless.generation.redevelop import redevelop

    count = redevelop(dataset, to, overrides or [], workers)
    say(json.dumps({"images": count, "dataset": str(to)}) if as_json else f"{count} images in {to}")
