"""The command line. Thin: each command reads its arguments, calls one function and prints what it returns."""

from __future__ import annotations

import json
import os
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn

import typer

from generator.adopt import adopt
from generator.config import load_recipe, settings
from generator.doctor import examine, is_fit, to_json, to_text
from generator.fetch import fetch
from generator.formats.card import write_card
from generator.formats.coco import export_coco
from generator.formats.files import atomic_write, read_json
from generator.formats.images import encode_png
from generator.formats.webdataset import export_webdataset, relabel_webdataset
from generator.generate import Execution, Summary, generate, redo
from generator.plan import Part
from generator.relabel import relabel
from generator.replay import render_again
from generator.review.preview import write_preview
from generator.review.preview.pages import STATISTICS_FILE
from generator.review.sheet import write_contact_sheet
from generator.review.validate import validate
from generator.studio import DropFailed
from generator.symmetry.detection import detect_folder, report
from generator.symmetry.detection.gallery import draw_detected, draw_table
from generator.symmetry.detection.show import describe, read_table
from scenes.blender import BlenderError

SHEET_FILE = "preview.jpg"
EXIT_FAILED, EXIT_WRONG_REQUEST, EXIT_INTERRUPTED = 1, 2, 130

app = typer.Typer(
    help="Synthetic 6D pose datasets of symmetric, texture-less parts, with labels a network can learn.",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)

export = typer.Typer(help="Write the dataset in other formats.", no_args_is_help=True, rich_markup_mode=None)
app.add_typer(export, name="export")
symmetries_app = typer.Typer(help="Symmetry groups of parts.", no_args_is_help=True, rich_markup_mode=None)
app.add_typer(symmetries_app, name="symmetries")

TableOption = Annotated[Path | None, typer.Option(help="Symmetry table (YAML or JSON); it may name some objects only.")]
SchemeOption = Annotated[
    Literal["pitteri2019", "atlas"] | None, typer.Option(help="How labels are made; the table's own if not given.")
]


def main() -> None:
    """Entry point: a wrong request becomes one line on stderr and exit code 2."""
    try:
        app()
    except (ValueError, BlenderError) as error:
        _quit(str(error), EXIT_WRONG_REQUEST)
    except OSError as error:
        place = f"{error.filename}: " if error.filename else ""
        _quit(f"{place}{error.strerror or error}", EXIT_WRONG_REQUEST)


def _quit(message: str, code: int) -> NoReturn:
    print(f"synthetless: {' '.join(message.split())}", file=sys.stderr)
    sys.exit(code)


def _settings_help() -> str:
    lines = [f"{s.key}={json.dumps(s.default)}  {s.description}" for s in settings()]
    return "Settings of a recipe, for --set:\n\n" + "\n\n".join(lines)


@app.command("generate", epilog=_settings_help())
def generate_command(
    recipe: Annotated[Path, typer.Argument(help="The recipe, a YAML file.")],
    out: Annotated[Path, typer.Option(help="Folder of the dataset. Run again to go on with it.")],
    images: Annotated[int | None, typer.Option(help="How many images; more than before extends the dataset.")] = None,
    seed: Annotated[int | None, typer.Option(help="Everything random follows from it.")] = None,
    models: Annotated[str | None, typer.Option(help="BOP models folder, or builtin.")] = None,
    textures: Annotated[str | None, typer.Option(help="Folder of photographs, or builtin.")] = None,
    overrides: Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Change a setting.")] = None,
    workers: Annotated[int | None, typer.Option(min=1, help="Processes; as many as cores if not given.")] = None,
    threads: Annotated[int, typer.Option(min=0, help="Threads of each process; 0 uses every core.")] = 1,
    drop_limit: Annotated[float, typer.Option(min=1, help="Seconds after which a drop is given up.")] = 1800,
    part: Annotated[
        str | None, typer.Option(metavar="K/N", help="Make only every N-th drop; others do the rest.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the summary as JSON.")] = False,
) -> None:
    """Make a dataset: drop, render, measure, label, write."""
    given: list[tuple[str, Any]] = [
        ("images", images),
        ("seed", seed),
        ("source.models", models),
        ("source.textures", textures),
    ]
    direct = [f"{key}={json.dumps(value)}" for key, value in given if value is not None]
    resolved = load_recipe(recipe, [*(overrides or []), *direct])
    execution = Execution(
        workers or len(os.sched_getaffinity(0)), threads, drop_limit, Part.parse(part) if part else None
    )
    try:
        summary = generate(resolved, out, execution)
    except KeyboardInterrupt:  # here, since typer would end without a word
        _quit("interrupted; run the same command again to go on", EXIT_INTERRUPTED)
    sheet = None
    if "rgb" in resolved.outputs and summary.images:
        sheet = out / SHEET_FILE
        write_contact_sheet(out, sheet, resolved.split)
    _report(summary, out, sheet, as_json)
    if summary.failures:
        raise typer.Exit(EXIT_FAILED)


def _report(summary: Summary, out: Path, sheet: Path | None, as_json: bool) -> None:
    if as_json:
        answer = {
            "images": summary.images,
            "instances": summary.instances,
            "made": summary.made,
            "mean_visib_fract": summary.mean_visib_fract,
            "failures": summary.failures,
            "dataset": str(out),
        }
        print(json.dumps(answer))
        return
    print(
        f"{summary.images} images ({summary.made} new), {summary.instances} instances, "
        f"{summary.mean_visib_fract:.0%} visible on average, {len(summary.failures)} failed drops"
    )
    for failure in summary.failures:
        print(f"  {failure}")
    print(f"dataset: {out}")
    if sheet:
        print(f"picture: {sheet}")


@app.command("render")
def render_command(
    dataset: Annotated[Path, typer.Argument(help="The dataset's folder.")],
    scene: Annotated[int, typer.Argument(help="Number of the scene folder.")],
    image: Annotated[int, typer.Argument(help="Image id in it.")],
    to: Annotated[Path, typer.Option(help="PNG file to write.")],
    textures: Annotated[Path | None, typer.Option(help="Folder of the photographs, if it has moved.")] = None,
) -> None:
    """Render one recorded image again."""
    atomic_write(to, encode_png(render_again(dataset, scene, image, textures)))
    print(to)


@app.command("redo")
def redo_command(
    dataset: Annotated[Path, typer.Argument(help="The dataset's folder.")],
    drop: Annotated[int, typer.Argument(min=0, help="Number of the drop.")],
    textures: Annotated[str | None, typer.Option(help="Folder of the photographs, if it has moved.")] = None,
) -> None:
    """Make one drop again, alone and in the foreground, to see why it failed."""
    try:
        made = redo(dataset, drop, textures)
    except DropFailed as failure:
        _quit(f"drop {drop}: {failure}", EXIT_FAILED)
    print(f"drop {drop}: {made} images in {dataset}")


@app.command("relabel")
def relabel_command(
    dataset: Annotated[Path, typer.Argument(help="The dataset's folder.")],
    symmetries: TableOption = None,
    scheme: SchemeOption = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only tell what would change.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the changes as JSON.")] = False,
) -> None:
    """Make the labels those of other symmetries; images stay. Without options: make all labels again."""
    done = relabel(dataset, symmetries, scheme, dry_run)
    if not dry_run:
        write_card(dataset)
    print(json.dumps(asdict(done)) if as_json else done)


@app.command("adopt")
def adopt_command(
    dataset: Annotated[Path, typer.Argument(help="Folder of a BOP dataset, with or without images.")],
    models: Annotated[Path | None, typer.Option(help="Folder of its models_info.json, if not inside.")] = None,
    symmetries: TableOption = None,
    scheme: SchemeOption = None,
) -> None:
    """Put labels beside the files of an existing BOP dataset, whose own files stay as they are."""
    print(adopt(dataset, models, symmetries, scheme))


@export.command("coco")
def export_coco_command(
    dataset: Annotated[Path, typer.Argument(help="The dataset's folder.")],
    to: Annotated[Path, typer.Option(help="JSON file to write.")],
    boxes: Annotated[Literal["visible", "amodal"], typer.Option(help="What the boxes hold.")] = "visible",
) -> None:
    """Write one COCO file for the whole split, with canonical poses and box corners as keypoints."""
    print(f"{export_coco(dataset, to, boxes=boxes)} images in {to}")


@export.command("webdataset")
def export_webdataset_command(
    dataset: Annotated[Path, typer.Argument(help="The dataset's folder.")],
    to: Annotated[Path, typer.Option(help="Folder of the shards.")],
    images_per_shard: Annotated[int, typer.Option(min=1, help="Images in a shard, at most.")] = 1000,
    shuffle_seed: Annotated[int | None, typer.Option(help="Shuffle the images by this seed.")] = None,
    relabel_only: Annotated[bool, typer.Option("--relabel-only", help="Renew the labels of existing shards.")] = False,
) -> None:
    """Write BOP webdataset shards, with the labels in .gt_canonical.json."""
    if relabel_only:
        relabel_webdataset(dataset, to)
        print(f"labels renewed in {to}")
        return
    shards = export_webdataset(dataset, to, images_per_shard=images_per_shard, shuffle_seed=shuffle_seed)
    print(f"{len(shards)} images in {len(set(shards.values()))} shards in {to}")


@app.command("validate")
def validate_command(
    dataset: Annotated[Path, typer.Argument(help="The dataset's folder.")],
    deep: Annotated[bool, typer.Option("--deep", help="Also cast the rays of some images again.")] = False,
    exports: Annotated[list[Path] | None, typer.Option("--export", help="A COCO file or shards made from it.")] = None,
    limit: Annotated[int, typer.Option(min=1, help="How many faults of each kind to show.")] = 20,
    as_json: Annotated[bool, typer.Option("--json", help="Print the report as JSON.")] = False,
) -> None:
    """Check every file, every label, and both against each other."""
    found = validate(dataset, deep, exports or (), limit)
    print(json.dumps(found.to_json()) if as_json else "\n".join(found.lines()))
    if not found.valid:
        raise typer.Exit(EXIT_FAILED)


@app.command("preview")
def preview_command(
    dataset: Annotated[Path, typer.Argument(help="Folder of a dataset.")],
    to: Annotated[Path | None, typer.Option(help="Folder of the pages; DIR/preview if not given.")] = None,
    split: Annotated[str | None, typer.Option(help="Folder of images, where there are several.")] = None,
    images: Annotated[int | None, typer.Option(min=1, help="Show at most so many, evenly spread.")] = None,
    workers: Annotated[int | None, typer.Option(min=1, help="Processes; as many as cores if not given.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the statistics as JSON.")] = False,
) -> None:
    """Make pages that show a dataset, and its statistics, in any browser."""
    page = write_preview(dataset, to, split, images, workers)
    statistics = read_json(page.parent / STATISTICS_FILE)
    print(json.dumps({"page": str(page), "statistics": statistics}) if as_json else f"preview: {page}")


@symmetries_app.command("detect")
def detect_command(
    models: Annotated[Path, typer.Argument(help="Folder of PLY, STL, OBJ or OFF files.")],
    out: Annotated[Path | None, typer.Option(help="Symmetry table to write.")] = None,
    models_out: Annotated[Path | None, typer.Option(help="BOP models folder to write, models_info.json too.")] = None,
    tolerance_percent: Annotated[float, typer.Option(min=0, help="Largest residual, in % of the diameter.")] = 1.0,
    scale: Annotated[float, typer.Option(min=0, help="Millimetres per unit of the files; 1000 for metres.")] = 1.0,
    pictures: Annotated[Path | None, typer.Option(help="Folder for a picture of each part.")] = None,
    workers: Annotated[int | None, typer.Option(min=1, help="Processes; as many as cores if not given.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print everything as JSON.")] = False,
) -> None:
    """Find each mesh's symmetry group, and what every other group would leave as residual."""
    detected = detect_folder(models, tolerance_percent, scale, workers)
    if out is not None:
        detected.table().write(out)
    if models_out is not None:
        detected.write_models(models_out)
    if pictures is not None:
        draw_detected(detected, pictures, workers)
    print(json.dumps(detected.to_json()) if as_json else report(detected))


@symmetries_app.command("show")
def show_command(
    table: Annotated[Path, typer.Argument(help="Symmetry table, models_info.json, or a folder that holds one.")],
    models: Annotated[Path | None, typer.Option(help="Folder of the meshes, for pictures.")] = None,
    pictures: Annotated[Path | None, typer.Option(help="Folder for a picture of each part.")] = None,
) -> None:
    """Tell what a symmetry table means: regressors, margins, and which views are dangerous."""
    read = read_table(table)
    if pictures is not None:
        draw_table(read, models or (table if table.is_dir() else table.parent), pictures)
    print(describe(read))


@app.command("doctor")
def doctor_command(
    out: Annotated[Path, typer.Option(help="Where datasets are to be made.")] = Path(),
    as_json: Annotated[bool, typer.Option("--json", help="Print the checks as JSON.")] = False,
) -> None:
    """Look whether this machine can make datasets, and say what to do where it cannot."""
    checks = examine(out)
    print(to_json(checks) if as_json else to_text(checks))
    if not is_fit(checks):
        raise typer.Exit(EXIT_FAILED)


@app.command("fetch")
def fetch_command(
    what: Annotated[Literal["tless", "dtd"], typer.Argument(help="T-LESS CAD models, or Describable Textures.")],
    to: Annotated[Path, typer.Option(help="Folder to put them into.")],
    source: Annotated[str | None, typer.Option("--from", help="Archive, folder or address to take them from.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the report as JSON.")] = False,
) -> None:
    """Get public data: from where it is published, checked, with its licence."""
    report = fetch(what, to, source)
    if as_json:
        print(json.dumps(asdict(report), default=str))
    else:
        print(f"{report}\n\n{report.licence}\nlicence: {report.licence_file}")
