"""Commands about labels: relabel, adopt, ambiguity; and about symmetries: detect, show, carry-back."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Literal

import typer

from synthetless.cli.options import AsJson, Workers, above_zero
from synthetless.cli.terminal import say
from synthetless.errors import UserError

TableOption = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="Symmetry table (YAML or JSON); it may name some objects only."),
]
SchemeOption = Annotated[
    Literal["pitteri2019", "atlas"] | None,
    typer.Option(help="pitteri2019: the paper's; atlas: without jumps. Default: the table's own."),
]


def relabel_command(
    dataset: Annotated[Path, typer.Argument(help="The dataset's folder.")],
    symmetries: TableOption = None,
    scheme: SchemeOption = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only tell what would change.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the changes as JSON.")] = False,
) -> None:
    """Make the labels again, for other symmetries.

    Images, masks and poses stay as they are. Without options all labels are made again from symmetries.json.
    """
    from synthetless.dataset.card import write_card
    from synthetless.dataset.relabel import relabel

    done = relabel(dataset, symmetries, scheme, dry_run)
    if not dry_run:
        write_card(dataset)
    say(json.dumps(asdict(done)) if as_json else done)


def adopt_command(
    dataset: Annotated[Path, typer.Argument(help="Folder of a BOP dataset, with or without images.")],
    models: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder of its models, if they are not in the dataset.")
    ] = None,
    symmetries: TableOption = None,
    scheme: SchemeOption = None,
    as_json: AsJson = False,
) -> None:
    """Label an existing BOP dataset; its own files stay as they are."""
    from synthetless.dataset.relabel import adopt

    done = adopt(dataset, models, symmetries, scheme)
    say(json.dumps(done.to_json()) if as_json else done)


def ambiguity_command(
    dataset: Annotated[Path, typer.Argument(help="Folder of a dataset that generate made, or that adopt labelled.")],
    eps_mm: Annotated[
        float | None,
        typer.Option(
            callback=above_zero,
            metavar="E",
            help="Depths that differ by more are told apart. Default: what a pixel measures.",
        ),
    ] = None,
    what: Annotated[
        Literal["depth", "normals", "silhouette"], typer.Option(help="What is compared; for colour images normals.")
    ] = "depth",
    models: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder of its models, if they are not in the dataset.")
    ] = None,
    symmetries: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Symmetry table of the larger groups; they are put into symmetries.json, labels stay."
        ),
    ] = None,
    poses: Annotated[bool, typer.Option("--poses", help="Also write the poses themselves that look alike.")] = False,
    workers: Workers = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the counts as JSON.")] = False,
) -> None:
    """Find which nearly symmetrical poses look alike in each image.

    For objects with a quasi-symmetry group. Images are not looked at: poses and meshes decide. Called again, it goes on
    where it was interrupted.
    """
    from synthetless.dataset.ambiguity import write_ambiguity

    done = write_ambiguity(dataset, what, eps_mm, models, poses, workers, symmetries)
    say(json.dumps(asdict(done)) if as_json else done)


def detect_command(
    models: Annotated[Path, typer.Argument(help="Folder of PLY, STL, OBJ, OFF, GLB, STEP or IGES files.")],
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="Symmetry table to write.")] = None,
    models_out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="BOP models folder to write, models_info.json too.")
    ] = None,
    tolerance_percent: Annotated[
        float, typer.Option(callback=above_zero, metavar="PERCENT", help="Largest residual, in % of the diameter.")
    ] = 1.0,
    tolerance: Annotated[
        list[str] | None,
        typer.Option(metavar="ID=VALUE|FILE", help="Of one object: 26=0.5mm or 26=2%; or a table of them. Repeatable."),
    ] = None,
    quasi: Annotated[
        str | None,
        typer.Option(metavar="VALUE", help="Also find larger groups within 2mm or 3%, for ambiguity."),
    ] = None,
    scale: Annotated[
        float,
        typer.Option(callback=above_zero, metavar="FACTOR", help="Millimetres per unit of the files; 1000 for metres."),
    ] = 1.0,
    tessellation_mm: Annotated[
        float,
        typer.Option(
            callback=above_zero, metavar="MM", help="How far triangles may be from the surface of STEP or IGES."
        ),
    ] = 0.05,
    recentre: Annotated[
        bool, typer.Option("--recentre", help="Move the models written, so that main axes are z through the origin.")
    ] = False,
    colours: Annotated[
        bool, typer.Option("--colours", help="Keep colours and textures of the meshes in --models-out.")
    ] = False,
    pictures: Annotated[Path | None, typer.Option(metavar="DIR", help="Folder for a picture of each part.")] = None,
    workers: Workers = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print everything as JSON.")] = False,
) -> None:
    """Find each mesh's symmetry group.

    The report also tells what every other group would leave as residual.
    """
    from synthetless.symmetry.detection import Tolerance, detect_folder, parse_tolerances, report

    if recentre and models_out is None:
        raise UserError("--recentre moves the models that --models-out writes: give both")
    larger = None if quasi is None else Tolerance.parse(quasi)
    detected = detect_folder(
        models, tolerance_percent, scale, workers, parse_tolerances(tolerance or ()), larger, tessellation_mm
    )
    if out is not None:
        detected.table(recentred=recentre).write(out)
    if models_out is not None:
        detected.write_models(models_out, recentre, colours)
    if pictures is not None:
        from synthetless.symmetry.detection.pictures import draw_detected

        draw_detected(detected, pictures, workers)
    say(json.dumps(detected.to_json()) if as_json else report(detected))
    if models_out is not None and not recentre and detected.off_axis and not as_json:
        objects = ", ".join(map(str, detected.off_axis))
        say(
            f"note: continuous symmetries not about x, y or z through the origin: object {objects}. happypose refuses "
            "this models_info.json and FoundationPose misreads it; --recentre moves the models"
        )


def carry_back_command(
    results: Annotated[Path, typer.Argument(help="Poses of recentred models: a result file of the BOP challenge.")],
    models: Annotated[Path, typer.Option(metavar="DIR", help="Folder that detect --recentre wrote.")],
    to: Annotated[Path, typer.Option(metavar="FILE", help="Result file to write, of the models as they were given.")],
    as_json: AsJson = False,
) -> None:
    """Give poses of recentred models as poses of the models before."""
    from dataclasses import replace

    from synthetless.learning.results import read_results, write_results
    from synthetless.symmetry.recentring import RECENTRED_FILE, read_recentrings

    motions, estimates = read_recentrings(models), read_results(results)
    for estimate in estimates:
        if estimate.obj_id not in motions:
            raise UserError(
                f"{results}, row {estimate.row}: object {estimate.obj_id} is not in {models / RECENTRED_FILE}"
            )
    carried = []
    for estimate in estimates:
        R_m2c, t_m2c = motions[estimate.obj_id].pose_back(estimate.R_m2c, estimate.t_m2c)
        carried.append(replace(estimate, R_m2c=R_m2c, t_m2c=t_m2c))
    write_results(to, carried)
    say(json.dumps({"poses": len(carried), "file": str(to)}) if as_json else f"{len(carried)} poses: {to}")


def show_command(
    table: Annotated[Path, typer.Argument(help="Symmetry table, models_info.json, or a folder that holds one.")],
    models: Annotated[Path | None, typer.Option(metavar="DIR", help="Folder of the meshes, for pictures.")] = None,
    pictures: Annotated[Path | None, typer.Option(metavar="DIR", help="Folder for a picture of each part.")] = None,
    as_json: AsJson = False,
) -> None:
    """Tell what a symmetry table means for the labels.

    Regressors, margins, and which views are dangerous.
    """
    from synthetless.symmetry import SymmetryTable
    from synthetless.symmetry.detection.report import describe, described

    read = SymmetryTable.read(table)
    if pictures is not None:
        from synthetless.symmetry.detection.pictures import draw_table

        draw_table(read, models or (table if table.is_dir() else table.parent), pictures)
    say(json.dumps(described(read)) if as_json else describe(read))
