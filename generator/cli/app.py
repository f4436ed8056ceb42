"""The command line. Thin: each command reads its arguments, calls one function and prints what it returns."""

from __future__ import annotations

from importlib.metadata import version
from typing import Annotated, NoReturn

import typer

from synthetless.cli import data as exchanging
from synthetless.cli import generate as making
from synthetless.cli import inspect as looking
from synthetless.cli import labels as labelling
from synthetless.cli import learning
from synthetless.cli.generate import EXIT_WRONG_REQUEST
from synthetless.errors import UserError
from synthetless.scenes.blender import BlenderError

app = typer.Typer(
    help="Synthetic 6D pose datasets of symmetric, texture-less parts, with labels a network can learn.",
    epilog="Exit codes: 0 done; 1 the data is wrong, or some drops failed; 2 the request is wrong. "
    "Documentation: docs/README.md",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)
export = typer.Typer(help="Write a dataset in other formats.", no_args_is_help=True, rich_markup_mode=None)
symmetries = typer.Typer(
    help="Find the symmetry groups of parts, and see what they mean.", no_args_is_help=True, rich_markup_mode=None
)

# In the order in which one needs them.
app.command("doctor")(looking.doctor_command)
app.command("fetch")(exchanging.fetch_command)
app.command("generate", epilog=making.settings_help())(making.generate_command)
app.command("preview")(looking.preview_command)
app.command("validate")(looking.validate_command)
app.command("relabel")(labelling.relabel_command)
app.command("adopt")(labelling.adopt_command)
app.command("render")(making.render_command)
app.command("redo")(making.redo_command)
app.command("train")(learning.train_command)
app.command("predict")(learning.predict_command)
app.command("score")(learning.score_command)
app.command("compare")(learning.compare_command)
app.add_typer(export, name="export")
export.command("coco")(exchanging.coco_command)
export.command("webdataset")(exchanging.webdataset_command)
app.add_typer(symmetries, name="symmetries")
symmetries.command("detect")(labelling.detect_command)
symmetries.command("show")(labelling.show_command)


def _tell_version(wanted: bool) -> None:
    if wanted:
        print(f"synthetless {version('synthetless')}")
        raise typer.Exit


@app.callback()
def options(
    _: Annotated[
        bool, typer.Option("--version", callback=_tell_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Options of the command itself."""


def main() -> None:
    """Entry point: a wrong request becomes one line on stderr and exit code 2."""
    try:
        app()
    except (UserError, BlenderError) as error:
        _refuse(str(error))
    except OSError as error:
        place = f"{error.filename}: " if error.filename else ""
        _refuse(f"{place}{error.strerror or error}")


def _refuse(message: str) -> NoReturn:
    making.leave(message, EXIT_WRONG_REQUEST)
