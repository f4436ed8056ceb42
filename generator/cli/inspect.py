"""Commands that look at things: recipes, doctor, preview, validate."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from synthetless.cli.options import AsJson, Split, Workers
from synthetless.cli.terminal import EXIT_FAILED, say
from synthetless.extras import need


def recipes_command(
    copy: Annotated[str | None, typer.Option(metavar="NAME", help="Write this one to a file, to be edited.")] = None,
    to: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Of the copy; default: its name in this folder.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """List the recipes that come with the package.

    Examples: synthetless recipes --copy demo; synthetless generate demo.yaml --out out/mine
    """
    from synthetless.config import builtin_recipes, copy_recipe, recipe_summary
    from synthetless.errors import UserError

    if copy is not None:
        written = copy_recipe(copy, to)
        say(json.dumps({"recipe": str(written)}) if as_json else f"recipe: {written}")
        return
    if to is not None:
        raise UserError(f"--to {to}: of which recipe? Add --copy NAME")
    summaries = {name: recipe_summary(file) for name, file in builtin_recipes().items()}
    if as_json:
        say(json.dumps(summaries))
        return
    width = max(map(len, summaries))
    for name, summary in summaries.items():
        say(f"{name:<{width}}  {summary}")


def doctor_command(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Where datasets are to be made.")] = Path(),
    as_json: Annotated[bool, typer.Option("--json", help="Print the checks as JSON.")] = False,
) -> None:
    """Look whether this machine can make datasets.

    Says what to do where it cannot; then the exit code is 1.
    """
    from synthetless.doctor import examine, is_fit, to_json, to_text

    checks = examine(out)
    say(to_json(checks) if as_json else to_text(checks))
    if not is_fit(checks):
        raise typer.Exit(EXIT_FAILED)


def preview_command(
    dataset: Annotated[Path, typer.Argument(help="Folder of a dataset.")],
    to: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder of the pages; default: preview, inside the dataset.")
    ] = None,
    split: Split = None,
    images: Annotated[int | None, typer.Option(min=1, metavar="N", help="Show at most so many, evenly spread.")] = None,
    workers: Workers = None,
    copy: Annotated[
        bool, typer.Option("--copy", help="Copy the pictures into it, for a folder to send; else it links to them.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the statistics as JSON.")] = False,
) -> None:
    """Make a gallery and statistics for the browser.

    Images that have not changed since the last time are not drawn again.
    """
    need("jinja2")
    need("matplotlib")
    from synthetless.dataset.labels import undisturbed
    from synthetless.io.files import read_json
    from synthetless.preview import write_preview
    from synthetless.preview.pages import STATISTICS_FILE

    def opens(page: Path) -> None:
        if not as_json:
            say(f"preview: {page} opens already; the other images are being drawn")

    with undisturbed(dataset, may_grow=True):
        page = write_preview(dataset, to, split, images, workers, copy, opens)
    statistics = read_json(page.parent / STATISTICS_FILE)
    say(json.dumps({"page": str(page), "statistics": statistics}) if as_json else f"preview: {page}")


def validate_command(
    dataset: Annotated[Path, typer.Argument(help="The dataset's folder.")],
    deep: Annotated[bool, typer.Option("--deep", help="Recompute every image, however many there are.")] = False,
    sample: Annotated[
        int | None,
        typer.Option(min=0, metavar="N", help="Recompute so many images at most, evenly spread; default: 30000."),
    ] = None,
    exports: Annotated[
        list[Path] | None,
        typer.Option(
            "--export",
            metavar="PATH",
            help="An export made from it, file or folder; may be given several times.",
        ),
    ] = None,
    limit: Annotated[int, typer.Option(min=1, metavar="N", help="How many faults of each kind to show.")] = 20,
    as_json: Annotated[bool, typer.Option("--json", help="Print the report as JSON.")] = False,
) -> None:
    """Check every file, every label, and both against each other."""
    from synthetless.validation import SAMPLE, validate

    most = SAMPLE if sample is None else sample
    found = validate(dataset, None if deep else most, exports or (), limit)
    say(json.dumps(found.to_json()) if as_json else "\n".join(found.lines()))
    if not found.valid:
        raise typer.Exit(EXIT_FAILED)
