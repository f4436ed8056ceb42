"""The tree of commands.

Each reads its arguments, calls one function and prints what it returns. What a command needs is imported when it
runs: help, completion and a usage error need only this module and its neighbours, which import nothing heavy.
"""

from __future__ import annotations

import logging
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from synthetless.cli import data, generate, inspect, labels, learning
from synthetless.cli.terminal import end, printable


class CommandGroup(TyperGroup):
    """Ends with what an error means before Typer sees it, which would say nothing of Ctrl-C and hide an EOFError."""

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except (typer.Exit, typer.TyperException):
            raise
        except (Exception, KeyboardInterrupt) as error:
            end(error)


app = typer.Typer(
    cls=CommandGroup,
    help="Synthetic 6D pose datasets of symmetric, texture-less parts, with labels a network can learn.",
    epilog="Exit codes: 0 done; 1 the data is wrong, or some drops failed; 2 the request is wrong; 3 a bug in "
    "synthetless; 130 interrupted. Documentation: docs/README.md",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)
fetch = typer.Typer(
    help="Get the T-LESS models or the Describable Textures.", no_args_is_help=True, rich_markup_mode=None
)
export = typer.Typer(help="Write a dataset in other formats.", no_args_is_help=True, rich_markup_mode=None)
symmetries = typer.Typer(
    help="Find the symmetry groups of parts, and see what they mean.", no_args_is_help=True, rich_markup_mode=None
)

# In the order in which one needs them.
app.command("doctor")(inspect.doctor_command)
app.add_typer(fetch, name="fetch")
fetch.command("tless")(data.fetch_tless_command)
fetch.command("dtd")(data.fetch_dtd_command)
app.command("recipes")(inspect.recipes_command)
app.command("generate")(generate.generate_command)
app.command("preview")(inspect.preview_command)
app.command("validate")(inspect.validate_command)
app.command("relabel")(labels.relabel_command)
app.command("adopt")(labels.adopt_command)
app.command("ambiguity")(labels.ambiguity_command)
app.command("render")(generate.render_command)
app.command("redo")(generate.redo_command)
app.command("redevelop")(generate.redevelop_command)
app.command("train")(learning.train_command)
app.command("curves")(learning.curves_command)
app.command("predict")(learning.predict_command)
app.command("score")(learning.score_command)
app.command("compare")(learning.compare_command)
app.add_typer(export, name="export")
export.command("coco")(data.coco_command)
export.command("webdataset")(data.webdataset_command)
export.command("yolo")(data.yolo_command)
export.command("bop")(data.bop_command)
app.add_typer(symmetries, name="symmetries")
symmetries.command("detect")(labels.detect_command)
symmetries.command("show")(labels.show_command)
symmetries.command("carry-back")(labels.carry_back_command)


class _PrintableFormatter(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        return printable(super().format(record))


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        print(f"synthetless {version('synthetless')}")
        raise typer.Exit


@app.callback()
def options(
    _: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Options of the command itself."""
    if logging.lastResort:  # what prints warnings
        logging.lastResort.setFormatter(_PrintableFormatter())
