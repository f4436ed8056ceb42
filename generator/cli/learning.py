"""Commands of the learning system: score."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Literal

import typer

from synthetless.cli.options import Split, Workers


def score_command(
    dataset: Annotated[Path, typer.Argument(help="Folder of a BOP dataset.")],
    results: Annotated[Path, typer.Argument(help="BOP result file: scene_id,im_id,obj_id,score,R,t,time.")],
    errors: Annotated[
        str, typer.Option(metavar="LIST", help="Some of vsd,mssd,mspd; vsd also gives the paper's recall.")
    ] = "vsd,mssd,mspd",
    true_z: Annotated[
        bool, typer.Option("--true-z", help="Move every pose along its ray to the true z first, as the paper does.")
    ] = False,
    symmetries: Annotated[
        Literal["models_info", "table"],
        typer.Option(help="Whose symmetries count: models_info.json's, as in BOP, or the dataset's own table's."),
    ] = "models_info",
    depth: Annotated[
        Literal["image", "models"],
        typer.Option(help="VSD's scene: the depth images, or the models in their true poses."),
    ] = "image",
    models: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder of the models, if they are not in the dataset.")
    ] = None,
    to: Annotated[Path | None, typer.Option(metavar="FILE", help="HTML page to write.")] = None,
    split: Split = None,
    workers: Workers = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the score as JSON.")] = False,
) -> None:
    """Score the estimated poses of any method.

    Recalls by BOP's errors and by the paper's rule, for each object, by margin, elevation and visibility.
    """
    from synthetless.learning.score import Judge, score
    from synthetless.learning.score_report import to_text, write_score_page

    names = tuple(name.strip() for name in errors.split(",") if name.strip())
    judge = Judge(dataset, split, models, names, true_z, symmetries, depth)  # type: ignore[arg-type]  # it checks
    found = score(judge, results, workers)
    if to is not None:
        write_score_page(found, to)
    print(json.dumps(found.to_json()) if as_json else to_text(found))
    if to is not None and not as_json:
        print(f"page: {to}")
